"""What motion capture shows of a state, and the heading frame in which residuals and policies see it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from mujoco import mjx

HISTORY = 3
"""Control steps that the policy sees: the current one and the last two (paper)."""


def observe_features(
    data: mjx.Data, sites: Int[np.ndarray, " sites"], bodies: Int[np.ndarray, " sites"], root: int = 1
) -> Float[Array, " features"]:
    """What motion capture sees of a state, in the world frame.

    Position, velocity and Euler angles (roll, pitch, yaw) of the tracked body (the balloon), position and velocity of
    each point (base, left and right foot); m, m/s, rad. `sites`, of `bodies` below the body `root` of the world, begin
    with the tracked one. `data` must hold current `com_vel`.
    """
    position = data.site_xpos[sites]
    offset = position - data.subtree_com[root]
    # cvel is the spatial velocity (angular, linear) about the whole robot's centre of mass.
    velocity = data.cvel[bodies, 3:] + jnp.cross(data.cvel[bodies, :3], offset)
    euler = euler_angles(data.xquat[bodies[0]])
    kinematics = jnp.concatenate([position, velocity], axis=1)
    return jnp.concatenate([kinematics[0], euler, kinematics[1:].ravel()])


def euler_angles(quaternion: Float[Array, " 4"]) -> Float[Array, " 3"]:
    """Roll, pitch and yaw (rad; intrinsic z-y-x) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return jnp.stack([roll, pitch, yaw])


def wrap_angle(angle: Array) -> Array:
    """The same angle in (-pi, pi]."""
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))


def heading_rotation(yaw: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Rotation about z that takes vectors in the balloon's heading frame to the world."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def world_rotation(yaw: Float[Array, ""], anchored: bool) -> Float[Array, "3 3"]:
    """Rotation that takes vectors in the frame of observations and forces to the world: by heading, or none."""
    return heading_rotation(jnp.zeros_like(yaw) if anchored else yaw)


def heading_observation(
    history: Float[Array, "steps features"], anchored: bool = False
) -> Float[Array, " observations"]:
    """The policy's state, from the features of the last control steps (three in the paper; the current one last).

    The paper's state, made independent of place and heading: horizontal positions are taken from the current
    balloon's, and positions, velocities and yaw from its heading. A force that depends on where in the room the
    robot stands would fit the recordings and nothing else. Heights stay absolute, for the floor is. Of an anchored
    robot everything is absolute: its place and heading are part of its physics.
    """
    now = history[-1]
    origin = now[:3] * jnp.array([0.0, 0.0, 0.0] if anchored else [1.0, 1.0, 0.0])
    heading = jnp.zeros_like(now[8]) if anchored else now[8]
    to_heading = heading_rotation(heading).T

    def relative(frame: Float[Array, " features"]) -> Array:
        vectors = jnp.concatenate([frame[:6], frame[9:]]).reshape(-1, 3)
        is_position = jnp.tile(jnp.array([True, False]), len(vectors) // 2)
        vectors = jnp.where(is_position[:, None], vectors - origin, vectors) @ to_heading.T
        return jnp.concatenate([vectors.ravel(), frame[6:8], wrap_angle(frame[8:9] - heading)])

    return jax.vmap(relative)(history).ravel()


def commands_seen(commands: Float[Array, "steps commands"], time: Int[Array, ""]) -> Float[Array, "3 commands"]:
    """The commands of the last two control steps and the coming one."""
    start = jnp.clip(time - HISTORY + 1, 0, commands.shape[0] - HISTORY)
    return jax.lax.dynamic_slice_in_dim(commands, start, HISTORY)
