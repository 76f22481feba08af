"""Resampling, angles over full turns, means of held commands, and Savitzky-Golay filters of positions and rotations."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.recording import Recording

_TURN_TOLERANCE = 0.1
"""Tolerance (rad) by which angles that restart each turn may span more than a full turn."""


def interpolate(
    grid: Float[np.ndarray, " T"], time: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples ..."]
) -> Float[np.ndarray, "T ..."]:
    """Return `values`, sampled at `time` (s), interpolated linearly at the times in `grid` (s)."""
    columns = [np.interp(grid, time, column) for column in values.reshape(len(time), -1).T]
    return np.stack(columns, axis=-1).reshape(len(grid), *values.shape[1:])


def turns_freely(model: mujoco.MjModel, joint: str) -> bool:
    """Return whether a joint is a hinge without a range, which may turn several times."""
    found = model.joint(joint)
    return bool(found.type[0] == mujoco.mjtJoint.mjJNT_HINGE and not model.jnt_limited[found.id])


def count_turns(angle: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """Return the angle (rad) of a hinge without jumps of a full turn, if it restarts each turn. NaN stays NaN.

    An angle that spans more than a full turn counts its turns already, and is returned unchanged.
    """
    seen = ~np.isnan(angle)
    if not seen.any() or np.ptp(angle[seen]) >= 2 * np.pi + _TURN_TOLERANCE:
        return angle
    counted = angle.copy()
    counted[seen] = np.unwrap(angle[seen])
    return counted


def unwound(model: mujoco.MjModel, joint: str, angle: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """Return a joint's values, by `count_turns` if it is a hinge without a range."""
    return count_turns(angle) if turns_freely(model, joint) else angle


def control_grid(recording: Recording, control_timestep: float) -> tuple[int, Float[np.ndarray, " T"]]:
    """Return the number of samples per control step, and uniform sample times (s from the recording's start).

    The sample rate is close to the recording's own. There are at least two samples per control step.

    **Raises** `InputError` for a recording shorter than two control steps.
    """
    time = recording.time - recording.time[0]
    control_steps = int(np.floor(time[-1] / control_timestep + 1e-6))
    if control_steps < 2:
        raise InputError(
            f"{recording.name}: lasts {time[-1]:.3f} s; give recordings of two control steps or more, "
            f"{2 * control_timestep:g} s."
        )
    per_step = max(2, round(control_timestep / float(np.median(np.diff(time)))))
    return per_step, np.arange(control_steps * per_step + 1) * (control_timestep / per_step)


def mean_command(recording: Recording, edges: Float[np.ndarray, " edges"]) -> Float[np.ndarray, "intervals commands"]:
    """Return the mean of the held commands between neighbouring `edges` (s from the recording's start)."""
    time = recording.time - recording.time[0]
    integral = np.cumsum(np.diff(time)[:, None] * recording.command[:-1], axis=0)
    integral = np.concatenate([np.zeros((1, integral.shape[1])), integral])
    at_edges = np.stack([np.interp(edges, time, column) for column in integral.T], axis=-1)
    mean = np.diff(at_edges, axis=0) / np.diff(edges)[:, None]
    return np.clip(mean, recording.command.min(axis=0), recording.command.max(axis=0))  # Rounding can exceed the range.


def odd_window(width: float, step: float, order: int, count: int) -> int:
    """Return the odd number of samples nearest to `width` (s), at most `count`, but always above `order`."""
    return max(order + 1 + order % 2, min(2 * round((width / step - 1) / 2) + 1, (count - 1) // 2 * 2 + 1))


def savitzky_golay(values: np.ndarray, width: float, step: float, order: int, derivative: int) -> np.ndarray:
    """Return values smoothed along the first axis by a Savitzky-Golay filter, or a derivative of them.

    The filter has the given `width` (s) and is centred, so it adds no lag. Samples are `step` (s) apart.
    """
    from scipy.signal import savgol_filter  # Slow to import: it needs all of scipy.stats.

    window = odd_window(width, step, order, len(values))
    return np.asarray(savgol_filter(values, window, order, deriv=derivative, delta=step, axis=0))


def noise_gain(window: int, order: int, step: float = 1.0, derivative: int = 0) -> float:
    """Return the standard deviation of `savitzky_golay`'s output for white noise of standard deviation 1.

    `window` is the number of samples, which are `step` (s) apart.
    """
    from scipy.signal import savgol_coeffs  # Slow to import, as above.

    return float(np.linalg.norm(savgol_coeffs(window, order, deriv=derivative, delta=step)))


def smooth_rotation(
    quaternion: Float[np.ndarray, "T 4"], width: float, step: float, order: int
) -> tuple[Float[np.ndarray, "T 4"], Float[np.ndarray, "T 3"]]:
    """Return smoothed quaternions, not of unit length, and the angular velocity (rad/s, body frame)."""
    # The components are as smooth as the motion. Their norm cancels in the angular velocity; callers normalize it.
    rate = savitzky_golay(quaternion, width, step, order, 1)
    quaternion = savitzky_golay(quaternion, width, step, order, 0)
    w, v, w_rate, v_rate = quaternion[:, :1], quaternion[:, 1:], rate[:, :1], rate[:, 1:]
    angular = 2 * (w * v_rate - w_rate * v - np.cross(v, v_rate)) / np.sum(quaternion**2, axis=1, keepdims=True)
    return quaternion, angular


def sign_continuous(quaternion: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, "T 4"]:
    """Return the same orientations without jumps of a quaternion to its negative."""
    flips = np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0
    return quaternion * np.concatenate([[1.0], np.cumprod(np.where(flips, -1.0, 1.0))])[:, None]
