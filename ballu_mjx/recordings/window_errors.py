"""Errors of simulated windows against recorded ones, in units of the expected error, and the loss used by fits."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.observation import ObservationLayout, euler_to_matrix, wrap_angle

EXPECTED_POSITION_ERROR = (0.002, 0.01)
"""Expected error of the tracked body's position: value at a window's start (m), and growth rate (m/s)."""
EXPECTED_ANGLE_ERROR = (np.deg2rad(0.3), np.deg2rad(0.6))
"""Expected error of the tracked body's orientation: value at a window's start (rad), and growth rate (rad/s)."""
_DIVERGED = 20.0
"""Norm of the errors assigned to a window that diverged in simulation, in units of the expected error."""
OUTLIER_THRESHOLD = 3.0
"""Norm of a window's errors above which the loss grows linearly, in units of the expected error. It limits the weight
of windows in which, for example, a contact point slipped."""


def window_errors(
    features: Float[Array | np.ndarray, "windowsteps features"],
    recorded: Float[Array | np.ndarray, "windowsteps features"],
    robot: RobotDescription,
) -> Float[Array, "windowsteps errors"]:
    """Return errors of the tracked body's position and orientation, in units of the expected error.

    For an upright robot, the orientation errors are differences of roll, pitch and yaw. For other robots they are the
    nine differences of the rotation matrices, divided by sqrt(2). Their norm equals the angle between the orientations
    if this is small, and grows with it up to 180 deg.

    Errors at neighbouring times are correlated, so all errors are divided by the square root of the number of steps. If
    errors are as expected, the squares of a window add up to one for each of the six degrees of freedom.
    """
    steps, layout = len(recorded), ObservationLayout
    time = np.arange(1, steps + 1)[:, None] * robot.control_timestep
    difference = jnp.asarray(features) - recorded
    position = difference[:, layout.position]
    if robot.upright:
        angles = wrap_angle(difference[:, layout.euler_angles])
    else:
        one, other = (jax.vmap(euler_to_matrix)(jnp.asarray(x)[:, layout.euler_angles]) for x in (features, recorded))
        angles = ((one - other) / np.sqrt(2)).reshape(steps, 9)
    start, each_second = np.array([EXPECTED_POSITION_ERROR] * 3 + [EXPECTED_ANGLE_ERROR] * angles.shape[1]).T
    return jnp.concatenate([position, angles], axis=1) / ((start + each_second * time) * np.sqrt(steps))


def pseudo_huber(squared: Any) -> Any:
    """Return the pseudo-Huber loss of windows from the squared norms of their errors.

    For norms below `OUTLIER_THRESHOLD` the loss is about the squared norm. Above, it grows linearly with the norm.
    """
    return 2 * OUTLIER_THRESHOLD**2 * ((1 + squared / OUTLIER_THRESHOLD**2) ** 0.5 - 1)


def fill_diverged(errors: Float[np.ndarray, "windows entries"]) -> Float[np.ndarray, "windows entries"]:
    """Return errors of windows in which each diverged (non-finite) window has errors of norm `_DIVERGED`."""
    finite = np.isfinite(errors).all(axis=1, keepdims=True)
    return np.where(finite, errors, _DIVERGED / math.sqrt(errors.shape[1]))
