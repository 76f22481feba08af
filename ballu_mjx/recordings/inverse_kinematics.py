"""Inverse kinematics: damped least squares over all joints, sample by sample."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import ReconstructionParameters
from ballu_mjx.robots.description import RobotDescription

_WORST_FIT = 0.05
"""RMS distance (m) between measured and fitted places beyond which the recording is not of this model."""
_MAX_STEPS = 200
"""Levenberg-Marquardt steps: a handful, but for the first sample."""
_CONVERGED = 1e-6
"""Step (rad or m) of no consequence."""
_NO_GAIN = 1e-6
"""Of the squared misfit: where measurements do not fit the model, steps shrink slowly."""
_UNSEEN = 1e-9
"""Of the best seen direction's information: what a direction shows that no measurement sees."""


@dataclasses.dataclass(frozen=True)
class MeasurementGrid:
    """Measurements at uniform times, `step` (s) apart; `samples_per_step` of them to a control step."""

    step: float
    samples_per_step: int
    places: Float[np.ndarray, "T sites 3"]
    """Of the tracked site, then of the points."""
    quaternion: Float[np.ndarray, "T 4"]
    angles: dict[str, Float[np.ndarray, " T"]]


def solve_inverse_kinematics(
    model: mujoco.MjModel,
    robot: RobotDescription,
    grid: MeasurementGrid,
    parameters: ReconstructionParameters,
    name: str,
) -> tuple[Float[np.ndarray, "T nq"], dict[str, float]]:
    """Generalized positions that fit the measurements, and the RMS distance (mm) that is left, by site."""
    misfit = _Misfit(model, robot, grid, parameters)
    qpos = misfit.first_guess()
    found, information = np.zeros((len(grid.places), model.nq)), []
    for sample in range(len(found)):
        damping = 1e-6
        error, slope = misfit(qpos, sample), misfit.slope(sample)
        for _ in range(_MAX_STEPS):
            square = slope.T @ slope
            scale = np.diag(np.diag(square) + 1e-12 * np.trace(square))
            step = -np.linalg.solve(square + damping * scale, slope.T @ error)
            moved = qpos.copy()
            mujoco.mj_integratePos(model, moved, step, 1.0)
            after = misfit(moved, sample)
            gain = error @ error - after @ after
            if gain >= 0:
                qpos, error, slope, damping = moved, after, misfit.slope(sample), max(damping / 10, 1e-12)
                if np.max(np.abs(step)) < _CONVERGED or gain < _NO_GAIN * (after @ after):
                    break
            elif (damping := 10 * damping) > 1e6:
                break
        found[sample] = qpos
        information.append(slope.T @ slope)
    _check_seen(model, np.array(information), name)
    distance = misfit.distance(found)
    worst = max(distance, key=lambda site: distance[site])
    if distance[worst] > 1e3 * _WORST_FIT:
        raise InputError(
            f"{name}: {worst} is {distance[worst]:.0f} mm (RMS) from where the model can have it; measure places at "
            f"the sites of {robot.model.name}, in its frame."
        )
    return found, distance


class _Misfit:
    """Differences to the measurements in units of their noise, and their derivatives."""

    def __init__(
        self,
        model: mujoco.MjModel,
        robot: RobotDescription,
        grid: MeasurementGrid,
        parameters: ReconstructionParameters,
    ) -> None:
        self.model, self.robot, self.grid, self.parameters = model, robot, grid, parameters
        self.data = mujoco.MjData(model)
        self.names = (robot.tracked, *robot.points)
        self.sites = [model.site(site).id for site in self.names]
        self.body = int(model.site_bodyid[self.sites[0]])
        self.joints = {joint: (model.joint(joint).qposadr[0], model.joint(joint).dofadr[0]) for joint in grid.angles}

    def __call__(self, qpos: Float[np.ndarray, " nq"], sample: int) -> Float[np.ndarray, " measurements"]:
        grid, parameters, turn = self.grid, self.parameters, np.zeros(3)
        self._pose(qpos)
        mujoco.mju_subQuat(turn, self.data.xquat[self.body], grid.quaternion[sample])
        angles = np.array([qpos[place] - grid.angles[joint][sample] for joint, (place, _) in self.joints.items()])
        return np.concatenate(
            [
                (self.data.site_xpos[self.sites] - grid.places[sample]).ravel() / parameters.position_noise,
                turn / parameters.rotation_noise,
                angles / parameters.joint_noise,
            ]
        )

    def slope(self, sample: int) -> Float[np.ndarray, "measurements nv"]:
        """Derivatives along the velocities, where `__call__` was evaluated last."""
        parameters, rotation = self.parameters, np.zeros(9)
        mujoco.mj_comPos(self.model, self.data)
        along, about = (np.zeros((len(self.sites), 3, self.model.nv)) for _ in range(2))
        for number, site in enumerate(self.sites):
            mujoco.mj_jacSite(self.model, self.data, along[number], about[number], site)
        mujoco.mju_quat2Mat(rotation, self.grid.quaternion[sample])
        units = np.eye(self.model.nv)[[dof for _, dof in self.joints.values()]]
        return np.concatenate(
            [
                along.reshape(-1, self.model.nv) / parameters.position_noise,
                rotation.reshape(3, 3).T @ about[0] / parameters.rotation_noise,
                units / parameters.joint_noise,
            ]
        )

    def first_guess(self) -> Float[np.ndarray, " nq"]:
        """The model's reference pose, recorded angles, and a free root where the tracked body then is as recorded."""
        qpos = self.model.qpos0.copy()
        for joint, (place, _) in self.joints.items():
            qpos[place] = self.grid.angles[joint][0]
        if not self.robot.anchored:
            self._pose(qpos)
            turn = Rotation.from_quat(self.grid.quaternion[0], scalar_first=True) * self._tracked().inv()
            root = Rotation.from_quat(qpos[3:7], scalar_first=True)
            arm = self.data.site_xpos[self.sites[0]] - qpos[:3]
            qpos[:3] = self.grid.places[0, 0] - turn.apply(arm)
            qpos[3:7] = (turn * root).as_quat(scalar_first=True)
        return qpos

    def distance(self, found: Float[np.ndarray, "T nq"]) -> dict[str, float]:
        """RMS distance (mm) between measured and fitted places, by site."""
        squares = np.zeros(len(self.sites))
        for qpos, places in zip(found, self.grid.places, strict=True):
            self._pose(qpos)
            squares += np.sum((self.data.site_xpos[self.sites] - places) ** 2, axis=1)
        return dict(zip(self.names, (1e3 * np.sqrt(squares / len(found))).tolist(), strict=True))

    def _pose(self, qpos: Float[np.ndarray, " nq"]) -> None:
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)

    def _tracked(self) -> Rotation:
        return Rotation.from_quat(self.data.xquat[self.body], scalar_first=True)


def _check_seen(model: mujoco.MjModel, information: Float[np.ndarray, "T nv nv"], name: str) -> None:
    """**Raises** `InputError` naming the joint that most samples leave open, each taken alone."""
    values, vectors = np.linalg.eigh(information)
    seen = values[:, 0] / values[:, -1]
    middle = int(np.argsort(seen)[len(seen) // 2])
    if seen[middle] < _UNSEEN:
        open_dof = np.argmax(np.abs(vectors[middle, :, 0]))
        joint = model.joint(int(model.dof_jntid[open_dof])).name
        raise InputError(
            f'{name}: nothing that is measured shows the joint {joint}; add it to "joints" of the robot description '
            "and record it, or add a point that it moves."
        )
