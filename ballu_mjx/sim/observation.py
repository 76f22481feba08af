"""What motion capture shows of a state, and the heading frame in which residuals and policies see it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from mujoco import mjx

from ballu_mjx.robots.description import RobotDescription

HISTORY = 3
"""Control steps that the policy sees: the current one and the last two (paper)."""


@dataclasses.dataclass(frozen=True)
class ObservationLayout:
    """Where `observe_features` has what: slices and indices of its last axis; m, m/s, rad, world frame.

    What is said of the tracked body comes first, for all robots in the same places.
    """

    points: tuple[str, ...]
    """The robot's points, in order."""

    position: ClassVar[slice] = slice(0, 3)
    """Of the tracked body."""
    velocity: ClassVar[slice] = slice(3, 6)
    """Of the tracked body."""
    euler_angles: ClassVar[slice] = slice(6, 9)
    """Roll, pitch and yaw of the tracked body."""
    yaw: ClassVar[int] = 8
    """Of the tracked body: its heading."""
    first_point: ClassVar[int] = 9
    """Where the points begin."""

    @staticmethod
    def of(robot: RobotDescription) -> ObservationLayout:
        """Return the layout of a robot's features."""
        return ObservationLayout(robot.points)

    @property
    def size(self) -> int:
        """Number of features."""
        return self.first_point + 6 * len(self.points)

    def point_position(self, point: str) -> slice:
        """Return where the position of a point stands."""
        first = self.first_point + 6 * self.points.index(point)
        return slice(first, first + 3)

    def point_velocity(self, point: str) -> slice:
        """Return where the velocity of a point stands."""
        first = self.point_position(point).stop
        return slice(first, first + 3)


def observe_features(
    data: mjx.Data, sites: Int[np.ndarray, " sites"], bodies: Int[np.ndarray, " sites"], root: int = 1
) -> Float[Array, " features"]:
    """Return what motion capture sees of a state, in the world frame; `ObservationLayout` says what stands where.

    Position, velocity and Euler angles (roll, pitch, yaw) of the tracked body, position and velocity of each point; m,
    m/s, rad. `sites`, of `bodies` below the body `root` of the world, begin with the tracked one. `data` must hold
    current `com_vel`.
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


def euler_to_matrix(euler: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """Return the rotation matrix, body to world, of roll, pitch and yaw (rad; intrinsic z-y-x)."""
    roll, pitch, yaw = euler
    cr, sr, cp, sp = jnp.cos(roll), jnp.sin(roll), jnp.cos(pitch), jnp.sin(pitch)
    tilt = jnp.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])
    return heading_rotation(yaw) @ tilt


def wrap_angle(angle: Array) -> Array:
    """The same angle in (-pi, pi]."""
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))


def heading_rotation(yaw: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Return the rotation about z that takes vectors in the tracked body's heading frame to the world."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def world_rotation(yaw: Float[Array, ""], anchored: bool) -> Float[Array, "3 3"]:
    """Return the rotation that takes vectors in the frame of observations and forces to the world.

    It is the one by the heading, or, of an anchored robot, none.
    """
    return heading_rotation(jnp.zeros_like(yaw) if anchored else yaw)


def heading_observation(
    history: Float[Array, "steps features"], anchored: bool = False, *, relative: bool = True, turned: bool = True
) -> Float[Array, " observations"]:
    """Return what policies see of the features of the last control steps (three in the paper; the current one last).

    It is the paper's state, made independent of place and heading: horizontal positions are taken from the tracked
    body's current one, and positions, velocities and yaw from its heading. A force that depends on where in the room
    the robot stands would fit the recordings and nothing else. Heights stay absolute, for the floor is. Of an anchored
    robot everything is absolute: its place and heading are part of its physics. Without `relative` and `turned`, places
    and headings of any robot stay absolute (the paper's state).
    """
    now, layout = history[-1], ObservationLayout
    origin = now[layout.position] * jnp.array([1.0, 1.0, 0.0] if relative and not anchored else [0.0, 0.0, 0.0])
    heading = now[layout.yaw] if turned and not anchored else jnp.zeros_like(now[layout.yaw])
    to_heading = heading_rotation(heading).T

    def transformed(frame: Float[Array, " features"]) -> Array:
        parts = frame[layout.position], frame[layout.velocity], frame[layout.first_point :]
        vectors = jnp.concatenate(parts).reshape(-1, 3)
        is_position = jnp.tile(jnp.array([True, False]), len(vectors) // 2)
        vectors = jnp.where(is_position[:, None], vectors - origin, vectors) @ to_heading.T
        roll, pitch, yaw = frame[layout.euler_angles]
        return jnp.concatenate([vectors.ravel(), jnp.stack([roll, pitch, wrap_angle(yaw - heading)])])

    return jax.vmap(transformed)(history).ravel()


def heading_observation_names(names: Sequence[str]) -> list[str]:
    """Return the names, with units, of one control step of `heading_observation`, in order.

    `names` are the tracked body and the points.
    """
    kinematics = [
        f"{name} {quantity} {axis}, {unit}"
        for name in names
        for quantity, unit in (("position", "m"), ("velocity", "m/s"))
        for axis in "xyz"
    ]
    return [*kinematics, *(f"{names[0]} {angle}, rad" for angle in ("roll", "pitch", "yaw"))]


def commands_seen(commands: Float[Array, "steps commands"], time: Int[Array, ""]) -> Float[Array, "3 commands"]:
    """The commands of the last two control steps and the coming one."""
    start = jnp.clip(time - HISTORY + 1, 0, commands.shape[0] - HISTORY)
    return jax.lax.dynamic_slice_in_dim(commands, start, HISTORY)
