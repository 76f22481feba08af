"""Errors of simulated windows beside recorded ones, in expected errors, and the loss that fits make of them."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.observation import ObservationLayout, euler_to_matrix, wrap_angle

POSITION = (0.002, 0.01)
"""Expected error of the tracked body's position (m) at a window's start, and what each second adds."""
ANGLE = (np.deg2rad(0.3), np.deg2rad(0.6))
"""Likewise of its orientation (rad)."""
_LOST = 20.0
"""What a window counts as that diverged in simulation, in expected errors."""
OUTLYING = 3.0
"""Expected errors beyond which a window counts less: a contact point slipped there, for example."""


def window_errors(
    features: Float[Array | np.ndarray, "windowsteps features"],
    recorded: Float[Array | np.ndarray, "windowsteps features"],
    robot: RobotDescription,
) -> Float[Array, "windowsteps errors"]:
    """Return errors of the tracked body's position and orientation, in expected errors.

    Errors of orientation are those of roll, pitch and yaw of an upright robot. Of others they are the nine differences
    of the rotation matrices over sqrt(2), whose length is the angle between small rotations and grows up to 180 deg.
    Neighbours in time say the same: all of a window's squares add up to one for each of the six degrees of freedom
    where errors are as expected.
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
    start, each_second = np.array([POSITION] * 3 + [ANGLE] * angles.shape[1]).T
    return jnp.concatenate([position, angles], axis=1) / ((start + each_second * time) * np.sqrt(steps))


def pseudo_huber(squared: Any) -> Any:
    """Pseudo-Huber loss of windows, by their errors' squared length: that itself below `OUTLYING`, linear above."""
    return 2 * OUTLYING**2 * ((1 + squared / OUTLYING**2) ** 0.5 - 1)


def count_lost(errors: Float[np.ndarray, "windows entries"]) -> Float[np.ndarray, "windows entries"]:
    """Return errors of windows in which those that diverged have `_LOST` in all."""
    finite = np.isfinite(errors).all(axis=1, keepdims=True)
    return np.where(finite, errors, _LOST / math.sqrt(errors.shape[1]))
