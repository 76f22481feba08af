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
"""Seconds of frames behind the tracked body's orientation, which is noisier and turns slowly."""
FEWEST_FRAMES = 3
"""Where fewer are visible in a window, as at the end of a drop-out, older ones are taken."""
EXTRAPOLATION_LIMIT = 0.2
"""Seconds for which a hidden marker is taken to move on as it last did; drop-outs usually last up to 0.15."""


@dataclasses.dataclass
class Capture:
    """Motion capture frames as they come, in the world frame; NaN where something is hidden.

    The newest frame has no command yet.

    **Fields**

    - `names`: of what is seen, the tracked body first, then the robot's points.
    - `time`: s, one entry a frame.
    - `command`: in the actuators' units, one entry a frame.
    - `position`: places (m) of what `names` names, one entry a frame.
    - `quaternion`: orientation of the tracked body (w, x, y, z), one entry a frame.
    """

    names: tuple[str, ...]
    time: list[float] = dataclasses.field(default_factory=list)
    command: list[Float[np.ndarray, " commands"]] = dataclasses.field(default_factory=list)
    position: list[Float[np.ndarray, "names 3"]] = dataclasses.field(default_factory=list)
    quaternion: list[Float[np.ndarray, " 4"]] = dataclasses.field(default_factory=list)


def estimate(
    capture: Capture, window: float = POSITION_WINDOW, orientation_window: float = ORIENTATION_WINDOW
) -> Float[np.ndarray, " features"]:
    """Return the features of `observation.observe_features` at the newest frame, from this and earlier frames only.

    Each position, and the tracked body's Euler angles, are a least-squares line over the visible frames of a window
    that ends with the last visible frame, read off now; the line's slope is the velocity. Of a marker seen once, the
    velocity is 0. One hidden for longer than `EXTRAPOLATION_LIMIT` is taken to have come to rest there.

    **Arguments**

    - `capture`: all frames so far. The cost does not grow with their number, only with how long a marker is hidden.
    - `window`, `orientation_window`: s.

    **Returns**

    World frame; m, m/s, rad: position, velocity and Euler angles (roll, pitch, yaw; intrinsic z-y-x; yaw and roll in
    [-pi, pi]) of the tracked body, then position and velocity of each point.

    **Raises** `ValueError` if a marker has been hidden from the first frame on.
    """
    kinematics = []
    for place, name in enumerate(capture.names):
        time, visible = _visible(capture.time, lambda frame, at=place: capture.position[frame][at], name, window)
        kinematics.append(np.concatenate(_line(time, visible, capture.time[-1])))

    def angles(frame: int) -> np.ndarray:
        return euler_angles(capture.quaternion[frame])

    time, visible = _visible(capture.time, angles, orientation_of(capture.names[0]), orientation_window)
    euler, _ = _line(time, np.unwrap(visible, axis=0), capture.time[-1])
    euler = np.arctan2(np.sin(euler), np.cos(euler))
    return np.concatenate([kinematics[0], euler, *kinematics[1:]])


def orientation_of(tracked: str) -> str:
    """Return what the orientation of the tracked body is called."""
    return f"{tracked}'s orientation"


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
