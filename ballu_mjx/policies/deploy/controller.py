"""A locomotion policy on the robot: frames of motion capture in, servo commands out.

Python 3.9 and NumPy are all it needs. `python -m ballu_mjx export` copies this file, with the policy's `weights.npz`
and the estimator `estimator.py`, into one folder; `python controller.py` there tests itself and tells its time.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ballu_mjx.policies.deploy.estimator import Capture, estimate

CONTROL_PERIOD = 0.05
"""Seconds between two commands (20 Hz), as in training."""
FULL_TRAVEL = 0.2
"""Seconds in which a command may go from 0 to 1, which turns the servo by 90 deg. The servo itself takes 0.14 s for
60 deg without load, 0.21 s for 90: a faster command would ask for what it cannot do."""
TIMEOUT = 0.3
"""Seconds without a marker after which the servos are relaxed."""
ROOM = 100.0
"""Largest coordinate, m, that is taken for a measurement."""
MEMORY = 1.0
"""Seconds of frames that are kept; also the longest gap between two that the clock counts."""
LOST_CALL = 0.01
"""Seconds that a call whose time cannot be used is taken to have lasted."""
_JITTER = 0.005
"""Seconds by which a control step may be early or late without moving those after it."""

MARKERS = ("balloon", "balloon's orientation", "base", "left foot", "right foot")
OBSERVATION = (
    *(f"{name} {axis}, {unit}"
      for point in ("balloon", "base", "left foot", "right foot")
      for name, unit in ((f"{point} position", "m"), (f"{point} velocity", "m/s"))
      for axis in "xyz"),
    "balloon roll, rad", "balloon pitch, rad", "cosine of balloon yaw", "sine of balloon yaw",
)  # fmt: skip
"""What the policy sees, in order. x and y axes are turned about z into the balloon's heading (its yaw); x and y of
positions are relative to the balloon's, so that the first two entries are 0; z is above the floor."""


def observation(features: np.ndarray) -> np.ndarray:
    """Return `OBSERVATION` for the 27 features that `estimator.estimate` returns.

    The same as `locomotion_env.locomotion_observation`, in NumPy."""
    yaw = features[8]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    vectors = np.concatenate([features[:6], features[9:]]).reshape(8, 3)
    vectors[::2, :2] -= features[:2]
    turned = vectors @ np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return np.concatenate([turned.ravel(), features[6:8], [cosine, sine]])


class Controller:
    """The policy of a folder, step by step.

    Whatever it is given, commands are in [0, 1], change at 20 Hz and no faster than the rate limit. With a marker out
    of sight its last motion goes on for a while (`estimator.estimate`); after `timeout` seconds the command goes to 0
    at the limit's rate, and the policy takes over again when all markers have been seen.

    **Arguments**

    - `folder`: holds `weights.npz`.
    - `full_travel`: s, see `FULL_TRAVEL`.
    - `timeout`: s, see `TIMEOUT`; below `MEMORY`.

    **Raises** `ValueError` for numbers out of range, and where `weights.npz` is damaged.
    """

    def __init__(self, folder: Path | str, full_travel: float = FULL_TRAVEL, timeout: float = TIMEOUT) -> None:
        if not (full_travel > 0 and 0 < timeout < MEMORY):
            raise ValueError(f"full_travel must be above 0, timeout between 0 and {MEMORY:g} s")
        self.weights = _read(Path(folder) / "weights.npz")
        count = sum(name.startswith("kernel_") for name in self.weights)
        self._layers = [
            (self.weights[f"kernel_{i}"].astype(float), self.weights[f"bias_{i}"].astype(float)) for i in range(count)
        ]
        self._mean, self._std, self._clip = (self.weights[n].astype(float) for n in ("mean", "std", "observation_clip"))
        self._activation = _ACTIVATIONS[str(self.weights["activation"])]
        self.full_travel, self.timeout = full_travel, timeout
        self.command = np.zeros(2)
        """The present command (left, right); the servos are taken to start relaxed."""
        self.status = "waiting for the first frame"
        """`running`, or what is missing."""
        self.steps = 0
        """Control steps so far."""
        # The clock here starts at 0 and never runs back, whatever that of the frames does.
        self._now = self._newest = self._offset = 0.0
        self._due = self._controlled = -math.inf
        self._capture = Capture([], [], [], [], [], [], [])
        self._seen = np.full(len(MARKERS), -math.inf)

    def act(self, features: np.ndarray) -> np.ndarray:
        """The policy's commands (left, right) in [0, 1] for `estimator.estimate`'s features."""
        x = np.clip((observation(features) - self._mean) / self._std, -self._clip, self._clip)
        for number, (kernel, bias) in enumerate(self._layers):
            x = x @ kernel + bias
            if number < len(self._layers) - 1:
                x = self._activation(x)
        return np.clip((x + 1) / 2, 0.0, 1.0)

    def step(self, time: Any, frame: Any = None) -> tuple[float, float]:
        """The commands (left, right) from now on; to be called with every frame, or at 20 Hz.

        **Arguments**

        - `time`: s, when the frame was taken, or now; a steady clock's (`time.monotonic()`), from any origin. Frames
          that come out of order are passed over.
        - `frame`: mapping, or object with attributes, of arrays: `balloon_position` (3), `balloon_quaternion` (4: w, x,
          y, z), `base_position` (3), `foot_position` (2 x 3: left, right); m, world frame. NaN: hidden. None: nothing
          came.
        """
        self._take(time, frame)
        now = self._now
        if not self._capture.time or now < self._due - _JITTER:
            return self._pair()
        missing = [MARKERS[i] for i in np.flatnonzero(now - self._seen > self.timeout)]
        target = np.zeros(2)
        if missing:
            self.status = f"relaxed: {', '.join(missing)} not seen in the last {self.timeout:g} s"
        else:
            self.status = "running"
            target = self.act(estimate(self._until(now)))
            if not np.all(np.isfinite(target)):
                self.status, target = "relaxed: the policy's output is no number", np.zeros(2)
        limit = min(now - self._controlled, CONTROL_PERIOD) / self.full_travel
        self.command = np.clip(self.command + np.clip(target - self.command, -limit, limit), 0.0, 1.0)
        self.steps += 1
        self._controlled = now
        self._due = (self._due if now < self._due + _JITTER else now) + CONTROL_PERIOD
        return self._pair()

    def _pair(self) -> tuple[float, float]:
        return float(self.command[0]), float(self.command[1])

    def _take(self, time: Any, frame: Any) -> None:
        """Advance the clock and keep the frame, if its time can be used."""
        try:
            time = float(time)
        except (TypeError, ValueError, OverflowError):
            time = math.nan
        if not self._capture.time and math.isfinite(time):
            self._offset = -time
        elif not time + self._offset > self._newest:  # NaN, too
            self._now += LOST_CALL
            if time + self._offset < self._newest - self.timeout:  # The frames' clock was set back.
                self._newest, self._offset = self._now, self._now - time
            return
        moment = time + self._offset
        if not self._now - CONTROL_PERIOD <= moment <= self._now + MEMORY:  # It stood still, or jumped.
            moment = self._now if moment < self._now else self._now + MEMORY
            self._offset = moment - time
        self._newest = moment
        self._now = max(self._now, moment)
        self._keep(moment, frame)

    def _keep(self, moment: float, frame: Any) -> None:
        capture = self._capture
        balloon = _positions(frame, "balloon_position", (3,))
        base = _positions(frame, "base_position", (3,))
        feet = _positions(frame, "foot_position", (2, 3))
        quaternion = _quaternion(frame, "balloon_quaternion")
        capture.time.append(moment)
        capture.command.append(self.command)
        capture.balloon_position.append(balloon)
        capture.balloon_quaternion.append(quaternion)
        capture.base_position.append(base)
        capture.base_quaternion.append(np.full(4, np.nan))  # The policy does not use it.
        capture.foot_position.append(feet)
        for marker, value in enumerate((balloon, quaternion, base, feet[0], feet[1])):
            if not np.isnan(value).any():
                self._seen[marker] = moment
        while capture.time[0] < moment - MEMORY:
            for values in vars(capture).values():
                del values[0]

    def _until(self, now: float) -> Capture:
        """The frames, with an empty one at `now` where the newest is older."""
        kept = self._capture
        if kept.time[-1] >= now:
            return kept
        hidden = [np.full(3, np.nan)]
        return Capture(
            time=[*kept.time, now],
            command=[*kept.command, self.command],
            balloon_position=kept.balloon_position + hidden,
            balloon_quaternion=[*kept.balloon_quaternion, np.full(4, np.nan)],
            base_position=kept.base_position + hidden,
            base_quaternion=[*kept.base_quaternion, np.full(4, np.nan)],
            foot_position=[*kept.foot_position, np.full((2, 3), np.nan)],
        )


def _swish(x: np.ndarray) -> np.ndarray:
    return x * (1 + np.tanh(x / 2)) / 2  # without overflow


_ACTIVATIONS = {"swish": _swish, "tanh": np.tanh}
_LARGEST = 1e6
"""No weight of a network that was trained comes near."""


def _read(path: Path) -> dict[str, np.ndarray]:
    """The arrays of `weights.npz`; raises `ValueError` where they are no network for this controller."""
    with path.open("rb") as file:
        try:
            with np.load(file, allow_pickle=False) as archive:
                weights = {name: archive[name] for name in archive.files}
            width = len(OBSERVATION)
            shapes = {"mean": (width,), "std": (width,), "observation_clip": ()}
            for number in range(sum(name.startswith("kernel_") for name in weights)):
                last = width
                width = weights[f"kernel_{number}"].shape[-1]
                shapes.update({f"kernel_{number}": (last, width), f"bias_{number}": (width,)})
            good = width == 2 and all(
                weights[name].shape == shape
                and weights[name].dtype.kind == "f"
                # The clip is infinite where observations are not normalized.
                and (name == "observation_clip" or bool(np.all(np.abs(weights[name]) < _LARGEST)))
                for name, shape in shapes.items()
            )
            good = good and bool(np.all(weights["std"] > 0)) and bool(weights["observation_clip"] > 0)
            good = good and str(weights["activation"]) in _ACTIVATIONS
        except Exception as error:  # what unpacking and NumPy make of damage is of many kinds
            raise ValueError(f"{path}: is damaged ({type(error).__name__}); copy it from the export again.") from error
    if not good:
        raise ValueError(f"{path}: is no network of this controller; copy it from the export again.")
    return weights


def _values(frame: Any, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """An array of a frame; NaN where it is missing or has another shape."""
    value = frame.get(name) if isinstance(frame, Mapping) else getattr(frame, name, None)
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return np.full(shape, np.nan)
    return array if array.shape == shape else np.full(shape, np.nan)


def _positions(frame: Any, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Positions of a frame; NaN where one is not in the room."""
    array = _values(frame, name, shape)
    array[~np.all(np.abs(array) <= ROOM, axis=-1)] = np.nan
    return array


def _quaternion(frame: Any, name: str) -> np.ndarray:
    """A unit quaternion of a frame; NaN where it is none."""
    array = _values(frame, name, (4,))
    if not np.all(np.abs(array) <= 2.0):
        return np.full(4, np.nan)
    norm = np.linalg.norm(array)
    return array / norm if 0.9 < norm < 1.1 else np.full(4, np.nan)


def self_test(folder: Path, frames: int = 5000) -> int:
    """Compare the policy with what it gave where it was exported, run on random frames at 100 Hz, print times."""
    controller = Controller(folder)
    pairs = range(len(controller.weights["check_features"]))
    given = np.array([controller.act(controller.weights["check_features"][i]) for i in pairs])
    difference = float(np.max(np.abs(given - controller.weights["check_commands"])))
    rng = np.random.default_rng(0)
    durations, good = [], True
    for number in range(frames):
        frame = {
            "balloon_position": np.array([0.0, 0.0, 1.1]) + rng.normal(0, 0.05, 3),
            "balloon_quaternion": np.array([1.0, *rng.normal(0, 0.05, 3)]),
            "base_position": np.array([0.0, 0.0, 0.75]) + rng.normal(0, 0.05, 3),
            "foot_position": rng.normal(0, 0.05, (2, 3)),
        }
        for values in frame.values():
            if rng.uniform() < 0.1:
                values[...] = np.nan
        before = controller.steps
        start = time.perf_counter()
        command = controller.step(number * 0.01, frame)
        if controller.steps > before:
            durations.append(time.perf_counter() - start)
        good = good and all(0.0 <= value <= 1.0 for value in command)
    median, worst = 1000 * float(np.median(durations)), 1000 * max(durations)
    print(f"Difference from the policy where it was exported: {difference:.1e} (1e-4 or less is right).")
    print(f"Control step: {median:.2f} ms, the slowest of {len(durations)} {worst:.2f} ms; there are 50 ms for each.")
    good = good and difference <= 1e-4
    print("Passed." if good else "FAILED: do not run this on the robot.")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(self_test(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent))
