"""Motion of the tracked body in its body frame, the input of residuals for air and water."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ballu_mjx.sim.observation import ObservationLayout, euler_to_matrix


def turn(matrix: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """Return the rotation vector (rad) of a small rotation matrix, accurate to second order."""
    return jnp.stack([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2


def body_motion(
    history: Float[Array, "steps features"], control_timestep: float
) -> tuple[Float[Array, "3 3"], Float[Array, " 3"], Float[Array, " 3"]]:
    """Return the tracked body's rotation matrix (body to world), velocity (m/s) and angular velocity (rad/s).

    The rotation is the current one. Both velocities are in the body frame. They are extrapolated from the last features
    (`sim.observation.observe_features`) to the middle of the coming control step, over which forces are held.
    """
    layout = ObservationLayout
    earlier, before, now = (euler_to_matrix(seen[layout.euler_angles]) for seen in history[-3:])
    velocity = now.T @ (1.5 * history[-1, layout.velocity] - 0.5 * history[-2, layout.velocity])
    turned = 2 * turn(before.T @ now) - turn(earlier.T @ before)
    return now, velocity, turned / control_timestep


def smooth_speed(velocity: Float[Array, " 3"]) -> Float[Array, ""]:
    """Return the speed (m/s), smoothed so that it has a derivative at rest."""
    return jnp.sqrt(jnp.sum(velocity**2) + _SPEED_AT_REST**2)


_SPEED_AT_REST = 1e-3
"""Smoothed speed of a body at rest (m/s)."""
