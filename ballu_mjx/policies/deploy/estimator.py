"""What runs on the robot between motion capture and a policy: from frames as they come to features, now.

Without JAX and MuJoCo, so that it can go where the policy goes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

POSITION_WINDOW = 0.04
"""Seconds of frames behind a position and velocity. Longer ones lag at footfalls, shorter ones pass on more noise."""
ORIENTATION_WINDOW = 0.1
"""Seconds of frames behind the balloon's orientation, which is noisier and turns slowly."""
FEWEST_FRAMES = 3
"""Where fewer are visible in a window, as at the end of a drop-out, older ones are taken."""
EXTRAPOLATION_LIMIT = 0.2
"""Seconds for which a hidden marker is taken to move on as it last did; drop-outs usually last up to 0.15."""


@dataclasses.dataclass
class Capture:
    """Motion capture frames as they come: time (s), noisy poses (m; w, x, y, z) in the world frame; NaN where a marker
    is hidden. One list entry a frame; the newest frame has no command (left, right) yet."""

    time: list[float]
    command: list[np.ndarray]
    balloon_position: list[np.ndarray]
    balloon_quaternion: list[np.ndarray]
    base_position: list[np.ndarray]
    base_quaternion: list[np.ndarray]
    foot_position: list[np.ndarray]


Controller = Callable[[Capture], Float[np.ndarray, " 2"]]
"""Sees all frames so far, returns the next commands (left, right)."""


class PolicyController:
    """A `Controller` that asks a policy.

    **Arguments**

    - `act`: the policy, from features (see `estimate`) to commands (left, right), which are clipped to [0, 1].
    """

    def __init__(self, act: Callable[[Float[np.ndarray, " 27"]], Float[np.ndarray, " 2"]]) -> None:
        self.act = act
        self.features: list[Float[np.ndarray, " 27"]] = []
        """The estimates acted on so far, one a call."""

    def __call__(self, capture: Capture) -> Float[np.ndarray, " 2"]:
        """The next commands. Raises `ValueError` as `estimate` does."""
        features = estimate(capture)
        self.features.append(features)
        return np.clip(np.asarray(self.act(features), float), 0.0, 1.0)


def estimate(
    capture: Capture, window: float = POSITION_WINDOW, orientation_window: float = ORIENTATION_WINDOW
) -> Float[np.ndarray, " 27"]:
    """The features of `observation.observe_features` at the newest frame, from this and earlier frames only.

    Each position, and the balloon's Euler angles, are a least-squares line over the visible frames of a window that
    ends with the last visible frame, read off now; the line's slope is the velocity. Of a marker seen once, the
    velocity is 0. One hidden for longer than `EXTRAPOLATION_LIMIT` is taken to have come to rest there.

    **Arguments**

    - `capture`: all frames so far. The cost does not grow with their number, only with how long a marker is hidden.
    - `window`, `orientation_window`: s.

    **Returns**

    World frame; m, m/s, rad: balloon position, velocity and Euler angles (roll, pitch, yaw; intrinsic z-y-x; yaw and
    roll in [-pi, pi]), base position and velocity, position and velocity of the left and of the right foot.

    Raises `ValueError` if a marker has been hidden from the first frame on.
    """

    def kinematics(name: str, position: Callable[[int], np.ndarray]) -> np.ndarray:
        time, visible = _visible(capture.time, position, name, window)
        return np.concatenate(_line(time, visible, capture.time[-1]))

    def angles(frame: int) -> np.ndarray:
        return euler_angles(capture.balloon_quaternion[frame])

    balloon = kinematics("balloon", lambda frame: capture.balloon_position[frame])
    base = kinematics("base", lambda frame: capture.base_position[frame])
    left = kinematics("left foot", lambda frame: capture.foot_position[frame][0])
    right = kinematics("right foot", lambda frame: capture.foot_position[frame][1])
    time, visible = _visible(capture.time, angles, "balloon's orientation", orientation_window)
    euler, _ = _line(time, np.unwrap(visible, axis=0), capture.time[-1])
    euler = np.arctan2(np.sin(euler), np.cos(euler))
    return np.concatenate([balloon, euler, base, left, right])


def euler_angles(quaternion: Float[np.ndarray, " 4"]) -> Float[np.ndarray, " 3"]:
    """Roll, pitch and yaw (rad; intrinsic z-y-x) of a unit quaternion (w, x, y, z), as `observation.euler_angles`."""
    w, x, y, z = quaternion
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.array([roll, pitch, yaw])


def _visible(
    time: list[float], sample: Callable[[int], np.ndarray], name: str, window: float
) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, "frames 3"]]:
    """Times (s) and values of the visible frames within `window` of the last visible one, the oldest first."""
    times: list[float] = []
    samples: list[np.ndarray] = []
    for frame in reversed(range(len(time))):
        if len(times) >= FEWEST_FRAMES and times[0] - time[frame] > window + 1e-6:
            break
        value = sample(frame)
        if not np.isnan(value).any():
            times.append(time[frame])
            samples.append(value)
    if not times:
        raise ValueError(f"motion capture has not seen the {name} in any of {len(time)} frames so far")
    return np.array(times[::-1]), np.array(samples[::-1])


def _line(
    time: Float[np.ndarray, " frames"], values: Float[np.ndarray, "frames 3"], now: float
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Value and slope, at `now` (s), of the least-squares line; of rest after `EXTRAPOLATION_LIMIT`."""
    centre = time.mean()
    spread = np.sum((time - centre) ** 2)
    slope = (time - centre) @ values / spread if spread > 0 else np.zeros(3)
    until = min(now, time[-1] + EXTRAPOLATION_LIMIT)
    value = values.mean(axis=0) + slope * (until - centre)
    return value, slope if until == now else np.zeros(3)
