"""Features of a state that motion capture measures, and the heading frame of residuals' and policies' observations."""

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
"""Number of control steps that a residual's policy observes: the current one and the last two (paper)."""


@dataclasses.dataclass(frozen=True)
class ObservationLayout:
    """Layout of `observe_features`: slices and indices of its last axis. Units are m, m/s and rad, in the world frame.

    The features of the tracked body come first and have the same positions for all robots.
    """

    points: tuple[str, ...]
    """Names of the robot's points, in order."""

    position: ClassVar[slice] = slice(0, 3)
    """Position of the tracked body (m)."""
    velocity: ClassVar[slice] = slice(3, 6)
    """Velocity of the tracked body (m/s)."""
    euler_angles: ClassVar[slice] = slice(6, 9)
    """Roll, pitch and yaw of the tracked body (rad)."""
    yaw: ClassVar[int] = 8
    """Index of the tracked body's yaw (rad), which is its heading."""
    first_point: ClassVar[int] = 9
    """Index of the first feature of the points."""

    @staticmethod
    def of(robot: RobotDescription) -> ObservationLayout:
        """Return the layout of a robot's features."""
        return ObservationLayout(robot.points)

    @property
    def size(self) -> int:
        """Number of features."""
        return self.first_point + 6 * len(self.points)

    def point_position(self, point: str) -> slice:
        """Return the slice of a point's position (m)."""
        first = self.first_point + 6 * self.points.index(point)
        return slice(first, first + 3)

    def point_velocity(self, point: str) -> slice:
        """Return the slice of a point's velocity (m/s)."""
        first = self.point_position(point).stop
        return slice(first, first + 3)


def observe_features(
    data: mjx.Data,
    sites: Int[np.ndarray, " sites"],
    bodies: Int[np.ndarray, " sites"],
    roots: Int[np.ndarray, " sites"],
) -> Float[Array, " features"]:
    """Return the features of a state that motion capture measures, in the world frame.

    In the order of `ObservationLayout`, they are position (m), velocity (m/s) and Euler angles (roll, pitch, yaw; rad)
    of the tracked body, then position and velocity of each point. `sites` are the ids of the measured sites, the
    tracked one first. `bodies` are the ids of their bodies, and `roots` of the roots of these bodies' kinematic trees.
    `data` must hold current results of `com_vel`.
    """
    position = data.site_xpos[sites]
    offset = position - data.subtree_com[roots]
    # cvel is the spatial velocity (angular, linear) about the centre of mass of the body's kinematic tree.
    velocity = data.cvel[bodies, 3:] + jnp.cross(data.cvel[bodies, :3], offset)
    euler = euler_angles(data.xquat[bodies[0]])
    kinematics = jnp.concatenate([position, velocity], axis=1)
    return jnp.concatenate([kinematics[0], euler, kinematics[1:].ravel()])


def euler_angles(quaternion: Float[Array, " 4"]) -> Float[Array, " 3"]:
    """Return roll, pitch and yaw (rad; intrinsic z-y-x) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return jnp.stack([roll, pitch, yaw])


def euler_to_matrix(euler: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """Return the rotation matrix, body to world frame, for roll, pitch and yaw (rad; intrinsic z-y-x)."""
    roll, pitch, yaw = euler
    cr, sr, cp, sp = jnp.cos(roll), jnp.sin(roll), jnp.cos(pitch), jnp.sin(pitch)
    tilt = jnp.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])
    return heading_rotation(yaw) @ tilt


def wrap_angle(angle: Array) -> Array:
    """Return the equivalent angle in [-pi, pi] (rad)."""
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))


def heading_rotation(yaw: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Return the rotation about z that transforms vectors from the tracked body's heading frame to the world frame."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def world_rotation(yaw: Float[Array, ""], anchored: bool) -> Float[Array, "3 3"]:
    """Return the rotation that transforms vectors from the frame of observations and forces to the world frame.

    For a free robot it is the rotation by the heading `yaw` (rad). For an anchored robot it is the identity.
    """
    return heading_rotation(jnp.zeros_like(yaw) if anchored else yaw)


def heading_observation(
    history: Float[Array, "steps features"], anchored: bool = False, *, relative: bool = True, turned: bool = True
) -> Float[Array, " observations"]:
    """Return the observation of policies and residuals for the features of the last control steps.

    The current control step is the last one; the paper has three. The observation is the paper's state, made
    independent of horizontal position and heading. Horizontal positions are relative to the tracked body's current one.
    Positions, velocities and yaw are relative to its heading. A force that depended on the position in the room would
    fit the recordings and nothing else. Heights stay absolute, because the floor has a fixed height.

    For an anchored robot everything is absolute: position and heading are part of its physics. Without `relative`,
    positions of any robot stay absolute. Without `turned`, headings do. Without both, it is the paper's state.
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
    """Return the names, with units, of the entries of `heading_observation` for one control step, in order.

    `names` are the names of the tracked body and of the points.
    """
    kinematics = [
        f"{name} {quantity} {axis}, {unit}"
        for name in names
        for quantity, unit in (("position", "m"), ("velocity", "m/s"))
        for axis in "xyz"
    ]
    return [*kinematics, *(f"{names[0]} {angle}, rad" for angle in ("roll", "pitch", "yaw"))]


def commands_seen(commands: Float[Array, "steps commands"], time: Int[Array, ""]) -> Float[Array, "3 commands"]:
    """Return the commands of the last two control steps and of the upcoming one, whose index is `time`.

    At the ends of `commands`, return the first or the last three.
    """
    start = jnp.clip(time - HISTORY + 1, 0, commands.shape[0] - HISTORY)
    return jax.lax.dynamic_slice_in_dim(commands, start, HISTORY)
