"""A controller that runs a locomotion policy on the robot: motion capture frames in, commands out.

It needs only Python 3.9 and NumPy. `python -m ballu_mjx export policy` copies this file, the policy's `weights.npz` and
the estimator `estimator.py` into one folder. `python controller.py` in that folder runs a self-test and measures the
time of a control step.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ballu_mjx.policies.deploy.estimator import Capture, estimate, orientation_of

TIMEOUT = 0.3
"""Time (s) after which a marker counts as lost if it was not seen or if its pose did not change."""
ROOM = 100.0
"""Largest absolute coordinate (m) that counts as a measurement."""
MEMORY = 1.0
"""Time (s) for which frames are kept. It is also the longest gap between two frames that the clock counts."""
_JITTER = 0.005
"""Time (s) by which a control step may be early or late without moving the steps after it."""


def observation(features: np.ndarray, anchored: bool = False) -> np.ndarray:
    """Return the policy's observation for the features that `estimator.estimate` returns.

    It equals `locomotion_env.locomotion_observation`, in NumPy. `observation_names` names its entries.
    """
    yaw = features[8]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    vectors = np.concatenate([features[:6], features[9:]]).reshape(-1, 3)
    if not anchored:
        vectors[::2, :2] -= features[:2]
        vectors = vectors @ np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return np.concatenate([vectors.ravel(), features[6:8], [cosine, sine]])


def observation_names(names: Sequence[str]) -> list[str]:
    """Return the names, with units, of the entries of the policy's observation, in order.

    `names` are the names of the tracked body and of the points. For a free robot, the x and y axes are rotated about z
    into the tracked body's heading (its yaw). The x and y positions are relative to the tracked body, so that the first
    two entries are 0. The z positions are heights above the floor. For an anchored robot, everything is in the world
    frame.
    """
    kinematics = [
        f"{name} {quantity} {axis}, {unit}"
        for name in names
        for quantity, unit in (("position", "m"), ("velocity", "m/s"))
        for axis in "xyz"
    ]
    tracked = names[0]
    return [
        *kinematics,
        f"{tracked} roll, rad",
        f"{tracked} pitch, rad",
        f"cosine of {tracked} yaw",
        f"sine of {tracked} yaw",
    ]


class Controller:
    """A controller that runs an exported policy, one control step at a time.

    For any input, commands stay within their ranges, and change at the control rate and no faster than the rate limit.
    A hidden marker is assumed to continue its motion for a while (`estimator.estimate`). A marker is lost if it was not
    seen, or if its pose did not change, for `timeout` seconds. The latter happens if a stream repeats its last frame.
    Commands then move, at the rate limit, to those of a robot at rest. The policy resumes when all markers move again.

    **Arguments**

    - `source`: the folder that holds `weights.npz`, or its arrays by name.
    - `full_travel`: shortest time (s) in which a command may move through its whole range. 0 for no limit, None for the
      value stored at export.
    - `timeout`: time-out (s) of markers, above 0 and below `MEMORY`; see `TIMEOUT`.
    - `clock`: function that returns the present time (s). It counts where a call's time does not advance.

    **Raises** `ValueError` if a number is out of range, or if the arrays are not a network for this controller.
    """

    def __init__(
        self,
        source: Path | str | Mapping[str, np.ndarray],
        full_travel: float | None = None,
        timeout: float = TIMEOUT,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not ((full_travel is None or full_travel >= 0) and 0 < timeout < MEMORY):
            raise ValueError(
                f"full_travel is {full_travel} and timeout is {timeout}: full_travel must be 0 or more, "
                f"and timeout above 0 and below {MEMORY:g} s."
            )
        self.weights = _checked(source, "weights") if isinstance(source, Mapping) else _read(Path(source))
        count = sum(name.startswith("kernel_") for name in self.weights)
        self._layers = [
            (self.weights[f"kernel_{i}"].astype(float), self.weights[f"bias_{i}"].astype(float)) for i in range(count)
        ]
        self._mean, self._std, self._clip = (self.weights[n].astype(float) for n in ("mean", "std", "observation_clip"))
        self._activation = _ACTIVATIONS[str(self.weights["activation"])]
        self.names = tuple(str(name) for name in self.weights["names"])
        """Names of the sites that motion capture must see, the tracked body first."""
        self.commands = tuple(str(name) for name in self.weights["commands"])
        """Names of the commands."""
        self.period = float(self.weights["control_timestep"])
        """Duration of a control step (s)."""
        self.full_travel = float(self.weights["full_travel"]) if full_travel is None else full_travel
        self.timeout = timeout
        self._low, self._high, self._rest = (self.weights[f"command_{n}"].astype(float) for n in _LEVELS)
        self._anchored = bool(self.weights["anchored"])
        self.command = self._rest.copy()
        """Current commands. The robot is assumed to start at rest."""
        self.status = "waiting for the first frame"
        """`running`, or a description of what is missing."""
        self.steps = 0
        """Number of control steps so far."""
        # The controller's clock starts at 0 and never runs backwards, even if the frames' clock does.
        self._now = self._newest = self._offset = 0.0
        self._clock, self._called = clock, clock()
        self._due = self._controlled = -math.inf
        self._capture = Capture(self.names)
        self._markers = (self.names[0], orientation_of(self.names[0]), *self.names[1:])
        self._seen = np.full(len(self._markers), -math.inf)
        self._last = [np.full(3, np.nan)] * len(self._markers)

    def act(self, features: np.ndarray) -> np.ndarray:
        """Return the policy's commands, in the actuators' units, for the features of `estimator.estimate`."""
        x = np.clip((observation(features, self._anchored) - self._mean) / self._std, -self._clip, self._clip)
        for number, (kernel, bias) in enumerate(self._layers):
            x = x @ kernel + bias
            if number < len(self._layers) - 1:
                x = self._activation(x)
        return self._low + np.clip((x + 1) / 2, 0.0, 1.0) * (self._high - self._low)

    def step(self, time: Any, frame: Any = None) -> tuple[float, ...]:
        """Return the current commands, in the order of `commands`. Call this with every frame, or at the control rate.

        **Arguments**

        - `time`: time (s) at which the frame was taken, or the present time. It must come from a steady clock
          (`time.monotonic()`) with any origin. A frame whose time is not later than that of the last one is ignored.
        - `frame`: mapping, or object with attributes, of arrays in the world frame. `NAME_position` (3 numbers, m) is
          needed for each of `names`, and `NAME_quaternion` (4 numbers: w, x, y, z) for the first of them. NaN means
          hidden. None if no frame arrived.
        """
        self._take(time, frame)
        now = self._now
        if not self._capture.time or now < self._due - _JITTER:
            return self._given()
        lost = [self._markers[i] for i in np.flatnonzero(now - self._seen > self.timeout)]
        target = self._rest
        if lost:
            self.status = f"relaxed: {', '.join(lost)} not seen, or unchanged, in the last {self.timeout:g} s"
        else:
            self.status = "running"
            target = self.act(estimate(self._until(now)))
            if not np.all(np.isfinite(target)):
                self.status, target = "relaxed: the policy's output is not finite", self._rest
        change = target - self.command
        if self.full_travel > 0:
            limit = min(now - self._controlled, self.period) / self.full_travel * (self._high - self._low)
            change = np.clip(change, -limit, limit)
        self.command = np.clip(self.command + change, self._low, self._high)
        self.steps += 1
        self._controlled = now
        self._due = (self._due if now < self._due + _JITTER else now) + self.period
        return self._given()

    def _given(self) -> tuple[float, ...]:
        return tuple(float(value) for value in self.command)

    def _take(self, time: Any, frame: Any) -> None:
        """Advance the clock, and keep the frame if its time can be used."""
        try:
            time = float(time)
        except (TypeError, ValueError, OverflowError):
            time = math.nan
        called, before = self._clock(), self._called
        self._called = called
        if not self._capture.time and math.isfinite(time):
            self._offset = -time
        elif not time + self._offset > self._newest:  # NaN, too
            self._now += min(max(called - before, 0.0), MEMORY)
            if time + self._offset < self._newest - self.timeout:  # the frames' clock was set back
                self._newest, self._offset = self._now, self._now - time
            return
        moment = time + self._offset
        if not self._now - self.period <= moment <= self._now + MEMORY:  # the frames' clock stood still or jumped
            moment = self._now if moment < self._now else self._now + MEMORY
            self._offset = moment - time
        self._newest = moment
        self._now = max(self._now, moment)
        self._keep(moment, frame)

    def _keep(self, moment: float, frame: Any) -> None:
        capture = self._capture
        places = np.array([_position(frame, f"{name}_position") for name in self.names])
        quaternion = _quaternion(frame, f"{self.names[0]}_quaternion")
        capture.time.append(moment)
        capture.command.append(self.command)
        capture.position.append(places)
        capture.quaternion.append(quaternion)
        for marker, value in enumerate((places[0], quaternion, *places[1:])):
            # Noise changes every measurement, so that an unchanged value is not a new measurement.
            if not np.isnan(value).any() and not np.array_equal(value, self._last[marker]):
                self._seen[marker], self._last[marker] = moment, value
        while capture.time[0] < moment - MEMORY:
            for values in (capture.time, capture.command, capture.position, capture.quaternion):
                del values[0]

    def _until(self, now: float) -> Capture:
        """Return the frames, followed by an empty frame at `now` if the newest one is older."""
        kept = self._capture
        if kept.time[-1] >= now:
            return kept
        return Capture(
            names=self.names,
            time=[*kept.time, now],
            command=[*kept.command, self.command],
            position=[*kept.position, np.full((len(self.names), 3), np.nan)],
            quaternion=[*kept.quaternion, np.full(4, np.nan)],
        )


def _swish(x: np.ndarray) -> np.ndarray:
    return x * (1 + np.tanh(x / 2)) / 2  # without overflow


_LEVELS = ("low", "high", "rest")
_ACTIVATIONS = {"swish": _swish, "tanh": np.tanh}
_LARGEST = 1e6
"""Upper bound of the absolute values in `weights.npz`. Trained networks stay far below it."""


def _read(folder: Path) -> Mapping[str, np.ndarray]:
    """Return the arrays of a folder's `weights.npz`.

    **Raises** `ValueError` if they are not a network for this controller.
    """
    path = folder / "weights.npz"
    with path.open("rb") as file:
        try:
            with np.load(file, allow_pickle=False) as archive:
                weights = {name: archive[name] for name in archive.files}
        except Exception as error:  # a damaged archive raises many kinds of errors
            raise ValueError(f"{path}: is damaged ({type(error).__name__}); copy it from the export again.") from error
    return _checked(weights, str(path))


def _checked(weights: Mapping[str, np.ndarray], name: str) -> Mapping[str, np.ndarray]:
    try:
        good = _fit(weights)
    except Exception as error:  # missing or wrong arrays raise many kinds of errors
        raise ValueError(f"{name}: is damaged ({type(error).__name__}); copy it from the export again.") from error
    if not good:
        raise ValueError(f"{name}: is not a network for this controller; copy it from the export again.")
    return weights


def _fit(weights: Mapping[str, np.ndarray]) -> bool:
    """Return whether the arrays are a network for this controller, with the right shapes and finite values."""
    names = [str(name) for name in weights["names"]]
    commands, width = len(weights["commands"]), len(observation_names(names))
    shapes = {"mean": (width,), "std": (width,), "observation_clip": (), "control_timestep": (), "full_travel": ()}
    shapes.update({f"command_{which}": (commands,) for which in _LEVELS})
    for number in range(sum(name.startswith("kernel_") for name in weights)):
        last = width
        width = weights[f"kernel_{number}"].shape[-1]
        shapes.update({f"kernel_{number}": (last, width), f"bias_{number}": (width,)})
    good = width == commands and all(
        weights[name].shape == shape
        and weights[name].dtype.kind == "f"
        # The clip is infinite where observations are not normalized.
        and (name == "observation_clip" or bool(np.all(np.abs(weights[name]) < _LARGEST)))
        for name, shape in shapes.items()
    )
    low, high, rest = (weights[f"command_{which}"] for which in _LEVELS)
    good = good and bool(np.all(weights["std"] > 0)) and bool(weights["observation_clip"] > 0)
    good = good and bool(weights["control_timestep"] > 0) and bool(weights["full_travel"] >= 0)
    good = good and bool(np.all((low <= rest) & (rest <= high) & (low < high)))
    return good and str(weights["activation"]) in _ACTIVATIONS and weights["anchored"].dtype.kind == "b"


def _values(frame: Any, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of a frame. NaN if it is missing or has another shape."""
    value = frame.get(name) if isinstance(frame, Mapping) else getattr(frame, name, None)
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return np.full(shape, np.nan)
    return array if array.shape == shape else np.full(shape, np.nan)


def _position(frame: Any, name: str) -> np.ndarray:
    """Return a position in a frame. NaN if it is missing or a coordinate is larger than `ROOM`."""
    array = _values(frame, name, (3,))
    return array if np.all(np.abs(array) <= ROOM) else np.full(3, np.nan)


def _quaternion(frame: Any, name: str) -> np.ndarray:
    """Return a unit quaternion in a frame. NaN if it is missing or its norm is not close to 1."""
    array = _values(frame, name, (4,))
    if not np.all(np.abs(array) <= 2.0):
        return np.full(4, np.nan)
    norm = np.linalg.norm(array)
    return array / norm if 0.9 < norm < 1.1 else np.full(4, np.nan)


def self_test(folder: Path, frames: int = 5000) -> int:
    """Compare the policy with its commands at export, run it on random frames at 100 Hz, and print times.

    Return 0 if the test passed, else 1.
    """
    controller = Controller(folder)
    pairs = range(len(controller.weights["check_features"]))
    given = np.array([controller.act(controller.weights["check_features"][i]) for i in pairs])
    ranges = controller.weights["command_high"] - controller.weights["command_low"]
    difference = float(np.max(np.abs(given - controller.weights["check_commands"]) / ranges))
    rng = np.random.default_rng(0)
    durations, good = [], True
    for number in range(frames):
        frame = {f"{name}_position": rng.normal(0, 0.5, 3) for name in controller.names}
        frame[f"{controller.names[0]}_quaternion"] = np.array([1.0, *rng.normal(0, 0.05, 3)])
        for values in frame.values():
            if rng.uniform() < 0.1:
                values[...] = np.nan
        before = controller.steps
        start = time.perf_counter()
        command = np.array(controller.step(number * 0.01, frame))
        if controller.steps > before:
            durations.append(time.perf_counter() - start)
        low, high = (controller.weights[f"command_{which}"] for which in ("low", "high"))
        good = good and bool(np.all((low <= command) & (command <= high)))
    median, worst = 1000 * float(np.median(durations)), 1000 * max(durations)
    print(f"Difference from the policy at export: {difference:.1e} of a command's range (at most 1e-4).")
    print(f"Time of a control step: {median:.2f} ms (median); {worst:.2f} ms (slowest of {len(durations)}).")
    print(f"Available time: {1000 * controller.period:g} ms.")
    good = good and difference <= 1e-4
    print("Passed." if good else "FAILED: do not run this on the robot.")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(self_test(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent))
