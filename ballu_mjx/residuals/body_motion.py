"""How the tracked body moves, in its own axes, as residuals of the air or water see it."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ballu_mjx.sim.observation import ObservationLayout, euler_to_matrix


def turn(matrix: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """Return the rotation vector (rad) of a small rotation, to second order."""
    return jnp.stack([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2


def body_motion(
    history: Float[Array, "steps features"], control_timestep: float
) -> tuple[Float[Array, "3 3"], Float[Array, " 3"], Float[Array, " 3"]]:
    """Return the tracked body's rotation (body to world), velocity (m/s) and angular velocity (rad/s; body axes).

    The rotation is the current one. The velocities are those in the middle of the coming control step, extrapolated
    from the last features (`sim.observation.observe_features`): a force is held over that step.
    """
    layout = ObservationLayout
    earlier, before, now = (euler_to_matrix(seen[layout.euler_angles]) for seen in history[-3:])
    velocity = now.T @ (1.5 * history[-1, layout.velocity] - 0.5 * history[-2, layout.velocity])
    turned = 2 * turn(before.T @ now) - turn(earlier.T @ before)
    return now, velocity, turned / control_timestep


def smooth_speed(velocity: Float[Array, " 3"]) -> Float[Array, ""]:
    """Return the speed (m/s), rounded off at rest, where the norm of a vector has no derivative."""
    return jnp.sqrt(jnp.sum(velocity**2) + _SLOW**2)


_SLOW = 1e-3
"""m/s."""
