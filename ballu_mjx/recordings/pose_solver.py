"""Least squares of inverse kinematics: many poses at once, each fitted to the measurements near a guess.

Joints stay within their ranges, unless no pose within them fits. A closed loop (a `connect` or `joint` equality of the
model) counts as one more measurement.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from ballu_mjx.common.rotations import matrix_to_rotation_vector, quaternion_to_matrix
from ballu_mjx.recordings.closed_loops import closed_loops, joint_couplings
from ballu_mjx.recordings.kinematic_tree import KinematicTree
from ballu_mjx.recordings.motion import MeasurementGrid, ReconstructionParameters
from ballu_mjx.robots.description import RobotDescription

_MAX_STEPS = 100
"""Maximum number of Levenberg-Marquardt steps. A few suffice, except from a distant guess."""
_CONVERGED = 1e-6
"""Step (rad or m) below which a fit has converged."""
_NO_GAIN = 1e-6
"""Relative decrease of the squared misfit below which a fit has converged. If measurements do not fit the model, steps
shrink only slowly."""
_LONGEST_STEP = 0.5
"""Longest step of a rotation (rad). Longer steps could add full turns to joints."""
_RANGE_TOLERANCE = (0.05, 0.005)
"""Distance by which a hinge (rad) or a slide (m) may exceed its range. Measurements are noisy, and stops are soft."""
_LOOP_NOISE = 0.1
"""Standard deviation of a closed loop's error, relative to the noise of a measured position or joint angle."""
_PRIOR = float(np.deg2rad(60.0))
"""Standard deviation (rad, m) of a hidden joint about its guess. It keeps the fit of a single sample well posed."""


@dataclasses.dataclass(frozen=True, eq=False)
class KinematicProblem:
    """Measurements of a recording, and the model to which they are fitted."""

    model: mujoco.MjModel
    robot: RobotDescription
    grid: MeasurementGrid
    parameters: ReconstructionParameters
    orientations: Mapping[str, tuple[Float[np.ndarray, "T 4"], Float[np.ndarray, " 3"]]]
    """Orientations by site: quaternions (w, x, y, z) of the site's body, and weights (1/rad) about the body's axes."""


class PoseSolver:
    """Solver for the poses of least misfit. The misfit is the difference to the measurements in units of their noise.

    In all methods, `rows` are the samples to which the poses belong. Several poses may belong to one sample.
    """

    def __init__(self, problem: KinematicProblem) -> None:
        self.problem = problem
        model, grid, parameters = problem.model, problem.grid, problem.parameters
        sites = {site: model.site(site) for site in {**grid.positions, **problem.orientations}}
        points = [(int(sites[site].bodyid[0]), sites[site].pos) for site in grid.positions]
        self._loops = closed_loops(model)
        bodies = [int(sites[site].bodyid[0]) for site in problem.orientations]
        self.tree = KinematicTree(model, [*points, *(end for loop in self._loops for end in loop)], bodies)
        self._couplings = joint_couplings(model)
        self._turned = [quaternion_to_matrix(quaternion) for quaternion, _ in problem.orientations.values()]
        self._turn_weights = [weight for _, weight in problem.orientations.values()]

        self.addresses, self.dofs = _scalar_joints(model)
        """Addresses of hinges and slides in qpos and qvel."""
        index = {model.joint(int(joint)).name: i for i, joint in enumerate(model.dof_jntid[self.dofs])}
        self.recorded = np.array([index[joint] for joint in grid.joint_angles], int)
        """Indices, among hinges and slides, of the joints with recorded angles. The other joints are `hidden`."""
        self._angles = np.stack(list(grid.joint_angles.values()), 1) if grid.joint_angles else np.zeros((0, 0))
        self.hidden = np.setdiff1d(np.arange(len(self.dofs)), self.recorded)
        joints = model.dof_jntid[self.dofs]
        low, high = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], [-np.inf, np.inf]).T
        give = np.where(self.tree.rotates[self.dofs], *_RANGE_TOLERANCE)
        self.low, self.high = low, high
        self._lowest, self._highest = low - give, high + give
        self.bounded = True
        """True if poses must stay within the joints' ranges."""
        self.turns = self.tree.rotates[self.dofs] & ~(np.isfinite(self.low) & np.isfinite(self.high))
        """Mask of hinges without a finite range, which may turn several times."""
        places = 3 * (len(grid.positions) + len(problem.orientations) + len(self._loops))
        self.measurements = places + len(self._couplings) + len(self.recorded)
        """Number of scalar measurements of each sample, including closed loops."""
        self.joint_weight, self.prior_weight = np.zeros(model.nv), np.zeros(model.nv)
        self._joint_noise = np.where(self.tree.rotates, parameters.joint_noise, parameters.position_noise)
        self.joint_weight[self.dofs[self.recorded]] = 1.0 / self._joint_noise[self.dofs[self.recorded]]
        self.prior_weight[self.dofs[self.hidden]] = 1.0 / _PRIOR

    # ---- misfit ----

    def misfit(
        self, qpos: Float[np.ndarray, "N nq"], rows: Int[np.ndarray, " N"]
    ) -> tuple[Float[np.ndarray, "N m"], Float[np.ndarray, "N m nv"]]:
        """Return the differences to all measurements except joint angles, and their Jacobians, in units of the noise.

        The Jacobians are derivatives with respect to generalized velocities.
        """
        parameters, grid = self.problem.parameters, self.problem.grid
        poses = self.tree.pose(qpos)
        errors, jacobians = [], []
        for number, places in enumerate(grid.positions.values()):
            errors.append((poses.points[number] - places[rows]) / parameters.position_noise)
            jacobians.append(self.tree.point_jacobian(poses, number) / parameters.position_noise)
        for number, (turned, weight) in enumerate(zip(self._turned, self._turn_weights, strict=True)):
            back = turned[rows].transpose(0, 2, 1)
            errors.append(matrix_to_rotation_vector(back @ poses.rotations[number]) * weight)
            jacobians.append(back @ self.tree.rotation_jacobian(poses, number) * weight[:, None])
        noise, first = _LOOP_NOISE * parameters.position_noise, len(grid.positions)
        for number in range(len(self._loops)):
            one, other = first + 2 * number, first + 2 * number + 1
            errors.append((poses.points[one] - poses.points[other]) / noise)
            jacobians.append((self.tree.point_jacobian(poses, one) - self.tree.point_jacobian(poses, other)) / noise)
        for coupling in self._couplings:
            error, jacobian = coupling.misfit(qpos, self.problem.model.nv)
            coupled = _LOOP_NOISE * self._joint_noise[coupling.dof]
            errors.append(error[:, None] / coupled)
            jacobians.append(jacobian[:, None] / coupled)
        return np.concatenate(errors, axis=1), np.concatenate(jacobians, axis=1)

    def information(self, qpos: Float[np.ndarray, "T nq"], rows: Int[np.ndarray, " T"]) -> np.ndarray:
        """Return each sample's information matrix (inverse covariance) from its measurements and the prior."""
        _, jacobian = self.misfit(qpos, rows)
        information = jacobian.transpose(0, 2, 1) @ jacobian
        diagonal = np.arange(information.shape[1])
        information[:, diagonal, diagonal] += self.joint_weight**2 + self.prior_weight**2
        return information

    # ---- fit ----

    def fit(
        self, guess: Float[np.ndarray, "N nq"], rows: Int[np.ndarray, " N"]
    ) -> tuple[Float[np.ndarray, "N nq"], Float[np.ndarray, " N"]]:
        """Return the poses of least misfit near `guess`, and their squared misfit without the prior."""
        nv, diagonal = self.problem.model.nv, np.arange(self.problem.model.nv)
        wanted = np.zeros((len(guess), nv))
        wanted[:, self.dofs] = guess[:, self.addresses]
        wanted[:, self.dofs[self.recorded]] = self._angles[rows] if len(self.recorded) else 0.0
        weight = self.joint_weight**2 + self.prior_weight**2

        def joint_errors(qpos: np.ndarray, lanes: np.ndarray) -> np.ndarray:
            errors = np.zeros((len(qpos), nv))
            errors[:, self.dofs] = qpos[:, self.addresses]
            return errors - wanted[lanes]

        def square(error: np.ndarray, joint_error: np.ndarray) -> np.ndarray:
            return np.einsum("ij,ij->i", error, error) + np.einsum("ij,ij,j->i", joint_error, joint_error, weight)

        qpos, active = guess.copy(), np.arange(len(guess))
        damping, cost = np.full(len(guess), 1e-6), np.empty(len(guess))
        error, jacobian = self.misfit(qpos, rows)
        joint_error = joint_errors(qpos, active)
        cost[:] = square(error, joint_error)
        for _ in range(_MAX_STEPS):
            transposed = jacobian.transpose(0, 2, 1)
            curvature = transposed @ jacobian
            curvature[:, diagonal, diagonal] += weight
            gradient = (transposed @ error[..., None])[..., 0] + weight * joint_error
            if self.bounded:
                self._hold_stops(qpos[active], curvature, gradient)
            scale = curvature[:, diagonal, diagonal]
            scale = scale + 1e-12 * scale.sum(axis=1, keepdims=True)
            curvature[:, diagonal, diagonal] += damping[active, None] * scale
            step = -np.linalg.solve(curvature, gradient[..., None])[..., 0]
            longest = np.abs(step[:, self.tree.rotates]).max(axis=1, initial=0.0)
            step /= np.maximum(longest / _LONGEST_STEP, 1.0)[:, None]
            moved = self.tree.move(qpos[active], step)
            if self.bounded:
                moved[:, self.addresses] = np.clip(moved[:, self.addresses], self._lowest, self._highest)
            error_there, jacobian_there = self.misfit(moved, rows[active])
            joint_error_there = joint_errors(moved, active)
            there = square(error_there, joint_error_there)
            gain = cost[active] - there
            better = gain >= 0
            taken = active[better]
            qpos[taken], cost[taken] = moved[better], there[better]
            damping[active] = np.where(better, np.maximum(damping[active] / 10, 1e-12), 10 * damping[active])
            small = (np.abs(step).max(axis=1) < _CONVERGED) | (gain < _NO_GAIN * there)
            going = ~np.where(better, small, damping[active] > 1e6)
            chosen = better[:, None]
            error = np.where(chosen, error_there, error)[going]
            jacobian = np.where(chosen[..., None], jacobian_there, jacobian)[going]
            joint_error = np.where(chosen, joint_error_there, joint_error)[going]
            active = active[going]
            if not len(active):
                break
        away = joint_errors(qpos, np.arange(len(qpos)))
        return qpos, cost - np.einsum("ij,ij,j->i", away, away, self.prior_weight**2)

    def _hold_stops(self, qpos: np.ndarray, curvature: np.ndarray, gradient: np.ndarray) -> None:
        """Exclude joints from the step, in place, if they are at a stop and the step would push them against it."""
        angles, joint_gradient = qpos[:, self.addresses], gradient[:, self.dofs]
        held = ((angles <= self._lowest) & (joint_gradient > 0)) | ((angles >= self._highest) & (joint_gradient < 0))
        for joint in np.flatnonzero(held.any(axis=0)):
            lanes, dof = np.flatnonzero(held[:, joint]), self.dofs[joint]
            own = curvature[lanes, dof, dof]
            curvature[lanes, dof, :] = curvature[lanes, :, dof] = 0.0
            curvature[lanes, dof, dof], gradient[lanes, dof] = own, 0.0

    def guess(
        self, start: Float[np.ndarray, " nq"], joints: Float[np.ndarray, "N joints"], rows: Int[np.ndarray, " N"]
    ) -> Float[np.ndarray, "N nq"]:
        """Return poses with the given `joints`, except that recorded joints take their recorded angles.

        A free root is placed so that the tracked body has its recorded pose.
        """
        qpos = np.tile(start, (len(rows), 1))
        qpos[:, self.addresses] = joints
        if len(self.recorded):
            qpos[:, self.addresses[self.recorded]] = self._angles[rows]
        if self.bounded:
            qpos[:, self.addresses] = np.clip(qpos[:, self.addresses], self._lowest, self._highest)
        if self.problem.robot.anchored:
            return qpos
        qpos[:, :7] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
        poses = self.tree.pose(qpos)
        tracked = self.problem.grid.positions[self.problem.robot.tracked][rows]
        rotation = self._turned[0][rows] @ poses.rotations[0].transpose(0, 2, 1)
        qpos[:, :3] = tracked - (rotation @ poses.points[0][..., None])[..., 0]
        qpos[:, 3:7] = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
        return qpos


def _scalar_joints(model: mujoco.MjModel) -> tuple[Int[np.ndarray, " joints"], Int[np.ndarray, " joints"]]:
    """Return the addresses of hinges and slides in qpos and in qvel."""
    scalar = model.jnt_type != mujoco.mjtJoint.mjJNT_FREE
    return model.jnt_qposadr[scalar].astype(int), model.jnt_dofadr[scalar].astype(int)
