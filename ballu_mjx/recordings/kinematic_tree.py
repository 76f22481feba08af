"""Forward kinematics and Jacobians of many poses at once, in NumPy and double precision, with MuJoCo's conventions."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common.rotations import quaternion_integrate, quaternion_to_matrix, rotation_about

_JOINT = mujoco.mjtJoint


@dataclasses.dataclass(frozen=True, eq=False)
class Poses:
    """Positions of a tree's points, orientations of its bodies, and axes of its joints, for N poses (world frame)."""

    points: tuple[Float[np.ndarray, "N 3"], ...]
    """Positions of the points (m)."""
    rotations: tuple[Float[np.ndarray, "N 3 3"], ...]
    """Rotation matrices of the bodies. Their columns are the bodies' axes."""
    axes: Float[np.ndarray, "N nv 3"]
    """Unit vector of each degree of freedom: direction of a translation, or axis of a rotation."""
    anchors: Float[np.ndarray, "N nv 3"]
    """Point (m) on each of these axes."""


class KinematicTree:
    """Part of a model that moves given points and bodies: hinges, slides, and at most one free joint at the root."""

    def __init__(
        self, model: mujoco.MjModel, points: Sequence[tuple[int, Float[np.ndarray, " 3"]]], bodies: Sequence[int]
    ) -> None:
        """Select the points and bodies.

        `points`: body id and position (m) in the body's frame of each point. `bodies`: ids of the bodies whose
        orientation is needed.
        """
        self.model = model
        self.points = [(body, np.array(place, float)) for body, place in points]
        self.bodies = list(bodies)
        lineages = {body: self._lineage(body) for body in {*bodies, *(body for body, _ in points)}}
        self._order = sorted({each for lineage in lineages.values() for each in lineage})
        self.point_dofs = [self._dofs(lineages[body]) for body, _ in points]
        """Degrees of freedom that move each point."""
        self.body_dofs = [self._dofs(lineages[body]) for body in bodies]
        """Degrees of freedom that rotate or translate each body."""
        self.rotates = np.ones(model.nv, bool)
        """Mask of the degrees of freedom in radians. The others are in metres."""
        for joint, kind in enumerate(model.jnt_type):
            first = model.jnt_dofadr[joint]
            if kind == _JOINT.mjJNT_FREE:
                self.rotates[first : first + 3] = False
            elif kind == _JOINT.mjJNT_SLIDE:
                self.rotates[first] = False

    def _lineage(self, body: int) -> list[int]:
        """Return `body` and its ancestors, without the world body."""
        found = []
        while body:
            found.append(int(body))
            body = int(self.model.body_parentid[body])
        return found

    def _dofs(self, bodies: Sequence[int]) -> np.ndarray:
        first, count = self.model.body_dofadr, self.model.body_dofnum
        return np.array(sorted(d for body in bodies for d in range(first[body], first[body] + count[body])), int)

    def pose(self, qpos: Float[np.ndarray, "N nq"]) -> Poses:
        """Return the kinematics of poses. Quaternions in `qpos` must have unit length."""
        model, count = self.model, len(qpos)
        positions = {0: np.zeros((count, 3))}
        rotations = {0: np.broadcast_to(np.eye(3), (count, 3, 3))}
        axes, anchors = np.zeros((count, model.nv, 3)), np.zeros((count, model.nv, 3))
        for body in self._order:
            parent = int(model.body_parentid[body])
            joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
            if len(joints) and model.jnt_type[joints[0]] == _JOINT.mjJNT_FREE:
                address, dof = model.jnt_qposadr[joints[0]], model.jnt_dofadr[joints[0]]
                position = qpos[:, address : address + 3]
                rotation = quaternion_to_matrix(qpos[:, address + 3 : address + 7])
                axes[:, dof : dof + 3] = np.eye(3)
                axes[:, dof + 3 : dof + 6] = rotation.transpose(0, 2, 1)
                anchors[:, dof + 3 : dof + 6] = position[:, None]
            else:
                position = positions[parent] + rotations[parent] @ model.body_pos[body]
                rotation = rotations[parent] @ quaternion_to_matrix(model.body_quat[body][None])[0]
                for joint in joints:
                    moved = qpos[:, model.jnt_qposadr[joint]] - model.qpos0[model.jnt_qposadr[joint]]
                    dof, place = model.jnt_dofadr[joint], model.jnt_pos[joint]
                    anchor, axis = position + rotation @ place, rotation @ model.jnt_axis[joint]
                    axes[:, dof], anchors[:, dof] = axis, anchor
                    if model.jnt_type[joint] == _JOINT.mjJNT_SLIDE:
                        position = position + axis * moved[:, None]
                    else:
                        rotation = rotation @ rotation_about(model.jnt_axis[joint], moved)
                        position = anchor - rotation @ place
            positions[body], rotations[body] = position, rotation
        points = tuple(positions[body] + rotations[body] @ place for body, place in self.points)
        return Poses(points, tuple(rotations[body] for body in self.bodies), axes, anchors)

    def point_jacobian(self, poses: Poses, point: int) -> Float[np.ndarray, "N 3 nv"]:
        """Return the Jacobian of a point's position (world frame) with respect to generalized velocities."""
        dofs = self.point_dofs[point]
        axes = poses.axes[:, dofs]
        arms = poses.points[point][:, None] - poses.anchors[:, dofs]
        x, y, z = np.moveaxis(axes, -1, 0)
        u, v, w = np.moveaxis(arms, -1, 0)
        turned = np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
        jacobian = np.zeros((len(axes), 3, self.model.nv))
        jacobian[:, :, dofs] = np.where(self.rotates[dofs], turned, axes.transpose(0, 2, 1))
        return jacobian

    def rotation_jacobian(self, poses: Poses, number: int) -> Float[np.ndarray, "N 3 nv"]:
        """Return the rotational Jacobian of body `number` of `bodies` (rotation vectors in the world frame)."""
        dofs = self.body_dofs[number]
        dofs = dofs[self.rotates[dofs]]
        jacobian = np.zeros((len(poses.axes), 3, self.model.nv))
        jacobian[:, :, dofs] = poses.axes[:, dofs].transpose(0, 2, 1)
        return jacobian

    def move(self, qpos: Float[np.ndarray, "N nq"], step: Float[np.ndarray, "N nv"]) -> Float[np.ndarray, "N nq"]:
        """Return `qpos` after a displacement `step` along generalized velocities, as `mj_integratePos` does."""
        if self.model.jnt_type[0] != _JOINT.mjJNT_FREE:
            return qpos + step
        moved = np.concatenate([qpos[:, :3] + step[:, :3], qpos[:, 3:7], qpos[:, 7:] + step[:, 6:]], axis=1)
        moved[:, 3:7] = quaternion_integrate(qpos[:, 3:7], step[:, 3:6])
        return moved
