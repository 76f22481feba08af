"""Estimator of features on the robot, from the motion capture frames so far.

It needs neither JAX nor MuJoCo, so that it can be exported with the policy.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

POSITION_WINDOW = 0.04
"""Time window (s) of frames for positions and velocities. Longer ones lag at footfalls, shorter ones pass more
noise."""
ORIENTATION_WINDOW = 0.1
"""Time window (s) of frames for the tracked body's orientation, which is noisier and changes slowly."""
FEWEST_FRAMES = 3
"""Smallest number of frames for an estimate. If a window has fewer, as after a drop-out, older frames are added."""
EXTRAPOLATION_LIMIT = 0.2
"""Time (s) for which a hidden marker is assumed to continue its last motion. Drop-outs usually last up to 0.15 s."""


@dataclasses.dataclass
class Capture:
    """Motion capture frames so far, in the world frame. NaN where a marker is hidden.

    The newest frame may have no command yet.

    **Fields**

    - `names`: names of the tracked body and then of the robot's points.
    - `time`: times (s), one for each frame.
    - `command`: commands in the actuators' units, one row for each frame.
    - `position`: positions (m) of all `names`, one array for each frame.
    - `quaternion`: orientation of the tracked body (w, x, y, z), one for each frame.
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

    A least-squares line is fitted to each position and to the tracked body's Euler angles. It uses the visible frames
    of a window that ends with the last visible frame. Its value at the newest frame is the estimate, and its slope is
    the velocity. A marker that was seen once has velocity 0. A marker that has been hidden for longer than
    `EXTRAPOLATION_LIMIT` is assumed to rest where the line was at that time.

    **Arguments**

    - `capture`: all frames so far. The cost depends not on their number, but on the time for which a marker is hidden.
    - `window`, `orientation_window`: windows (s).

    **Returns**

    Features in the world frame (m, m/s, rad). Position, velocity and Euler angles (roll, pitch, yaw; intrinsic z-y-x;
    yaw and roll in [-pi, pi]) of the tracked body come first, then position and velocity of each point.

    **Raises** `ValueError` if a marker has been hidden since the first frame.
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
    """Return the name of the tracked body's orientation."""
    return f"{tracked}'s orientation"


def euler_angles(quaternion: Float[np.ndarray, " 4"]) -> Float[np.ndarray, " 3"]:
    """Return roll, pitch and yaw (rad; intrinsic z-y-x) of a unit quaternion (w, x, y, z).

    It is the same function as `observation.euler_angles`.
    """
    w, x, y, z = quaternion
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.array([roll, pitch, yaw])


def _visible(
    time: list[float], sample: Callable[[int], np.ndarray], name: str, window: float
) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, "frames 3"]]:
    """Return times (s) and values of the frames that are visible within `window` (s) of the last visible one."""
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
    """Return value and slope of the least-squares line at `now` (s).

    Later than `EXTRAPOLATION_LIMIT` after the last frame, the value stays constant and the slope is 0.
    """
    centre = time.mean()
    spread = np.sum((time - centre) ** 2)
    slope = (time - centre) @ values / spread if spread > 0 else np.zeros(3)
    until = min(now, time[-1] + EXTRAPOLATION_LIMIT)
    value = values.mean(axis=0) + slope * (until - centre)
    return value, slope if until == now else np.zeros(3)
