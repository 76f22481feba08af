"""Resampling, held commands, and Savitzky-Golay filters of places and rotations."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.signal import savgol_filter

from ballu_mjx.recordings.recording import Recording


def interpolate(
    grid: Float[np.ndarray, " T"], time: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples ..."]
) -> Float[np.ndarray, "T ..."]:
    """Samples at `time` (s), linearly at the times of `grid`."""
    columns = [np.interp(grid, time, column) for column in values.reshape(len(time), -1).T]
    return np.stack(columns, axis=-1).reshape(len(grid), *values.shape[1:])


def control_grid(recording: Recording, control_timestep: float) -> tuple[int, Float[np.ndarray, " T"]]:
    """Return how many samples make a control step (s), and uniform times (s from the recording's start) at that rate,
    which is about the recording's own.

    **Raises** `ValueError` for a recording of less than two control steps.
    """
    time = recording.time - recording.time[0]
    control_steps = int(np.floor(time[-1] / control_timestep + 1e-6))
    if control_steps < 2:
        raise ValueError(
            f"{recording.name}: {time[-1]:.3f} s is too short; at least {2 * control_timestep} s are needed."
        )
    per_step = max(2, round(control_timestep / float(np.median(np.diff(time)))))
    return per_step, np.arange(control_steps * per_step + 1) * (control_timestep / per_step)


def mean_command(recording: Recording, edges: Float[np.ndarray, " edges"]) -> Float[np.ndarray, "intervals commands"]:
    """Mean of the held commands between neighbouring `edges` (s from the recording's start)."""
    time = recording.time - recording.time[0]
    integral = np.cumsum(np.diff(time)[:, None] * recording.command[:-1], axis=0)
    integral = np.concatenate([np.zeros((1, integral.shape[1])), integral])
    at_edges = np.stack([np.interp(edges, time, column) for column in integral.T], axis=-1)
    mean = np.diff(at_edges, axis=0) / np.diff(edges)[:, None]
    return np.clip(mean, recording.command.min(axis=0), recording.command.max(axis=0))  # rounding


def odd_window(width: float, step: float, order: int, count: int) -> int:
    """Odd number of samples nearest to `width` (s), enough for the polynomial and within the recording."""
    return max(order + 1 + order % 2, min(2 * round((width / step - 1) / 2) + 1, (count - 1) // 2 * 2 + 1))


def savitzky_golay(values: np.ndarray, width: float, step: float, order: int, derivative: int) -> np.ndarray:
    """Savitzky-Golay smoothing (or a derivative) along the first axis; centred, so that nothing lags."""
    window = odd_window(width, step, order, len(values))
    return np.asarray(savgol_filter(values, window, order, deriv=derivative, delta=step, axis=0))


def smooth_rotation(
    quaternion: Float[np.ndarray, "T 4"], width: float, step: float, order: int
) -> tuple[Float[np.ndarray, "T 4"], Float[np.ndarray, "T 3"]]:
    """Smoothed quaternions, not of unit length, and the angular velocity (rad/s) in the body's frame."""
    # Components of a quaternion are as smooth as the motion; the norm is restored after, and drops out of the rate.
    rate = savitzky_golay(quaternion, width, step, order, 1)
    quaternion = savitzky_golay(quaternion, width, step, order, 0)
    w, v, w_rate, v_rate = quaternion[:, :1], quaternion[:, 1:], rate[:, :1], rate[:, 1:]
    angular = 2 * (w * v_rate - w_rate * v - np.cross(v, v_rate)) / np.sum(quaternion**2, axis=1, keepdims=True)
    return quaternion, angular


def sign_continuous(quaternion: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, "T 4"]:
    """The same orientations without jumps to the opposite sign."""
    flips = np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0
    return quaternion * np.concatenate([[1.0], np.cumprod(np.where(flips, -1.0, 1.0))])[:, None]
