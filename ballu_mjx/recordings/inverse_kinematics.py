"""Inverse kinematics: poses that fit a recording's measurements, and checks of the fit.

`posture_search` finds starting poses, from which `pose_solver` fits poses to the measurements. The checks refuse joints
that no measurement shows, and measurements that fit no pose.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import MeasurementGrid, Motion, ReconstructionParameters
from ballu_mjx.recordings.pose_solver import KinematicProblem, PoseSolver
from ballu_mjx.recordings.posture_search import PostureSearch
from ballu_mjx.recordings.recording_hooks import hooks_of
from ballu_mjx.robots.description import RobotDescription

_WORST_FIT = 0.05
"""Largest RMS distance (m) between measured and fitted positions. Above it, the recording does not fit the model."""
NOTABLE_FIT_ERROR = 5.0
"""RMS distance (mm) between measured and fitted positions above which noise does not explain it."""
_PLACES = "its `offset` in the mapping, its site in the model, and the model's lengths"
_UNSEEN = 1e-9
"""Information about a direction of motion, relative to the best seen direction, below which no measurement shows it."""


@dataclasses.dataclass(frozen=True, eq=False)
class KinematicFit:
    """Generalized positions of all samples, fitted to the measurements."""

    problem: KinematicProblem
    qpos: Float[np.ndarray, "T nq"]
    information: Float[np.ndarray, "T nv nv"]
    """Inverse covariance of each sample from its measurements and the prior, in the Gauss-Newton approximation."""
    uncertainty: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Uncertainties that the robot's adapter reports for its part of the fit, by name."""

    def refit(
        self, site: str, quaternion: Float[np.ndarray, "T 4"], weight: Float[np.ndarray, " 3"], **uncertainty: float
    ) -> KinematicFit:
        """Return the fit with one more measurement, the orientation of a site's body.

        `weight` (1/rad) applies about each of the body's axes. `uncertainty` is added to the fit's.
        """
        orientations = {**self.problem.orientations, site: (quaternion, weight)}
        problem = dataclasses.replace(self.problem, orientations=orientations)
        solver = PoseSolver(problem)
        rows = np.arange(len(self.qpos))
        qpos, _ = solver.fit(self.qpos, rows)
        return KinematicFit(problem, qpos, solver.information(qpos, rows), {**self.uncertainty, **uncertainty})


def solve_inverse_kinematics(
    model: mujoco.MjModel,
    robot: RobotDescription,
    grid: MeasurementGrid,
    parameters: ReconstructionParameters,
    name: str,
) -> tuple[KinematicFit, dict[str, float]]:
    """Return generalized positions that fit the measurements, and the remaining RMS distance (mm) by site.

    **Raises** `InputError`, with the recording's `name`, if no measurement shows a joint or they fit no pose.
    """
    weight = np.full(3, 1.0 / parameters.rotation_noise)
    orientations = {site: (quaternion, weight) for site, quaternion in grid.orientations.items()}
    problem = KinematicProblem(model, robot, grid, parameters, orientations)
    solver = PoseSolver(problem)
    qpos = PostureSearch(solver).solve()
    fit = KinematicFit(problem, qpos, solver.information(qpos, np.arange(len(qpos))))
    distance = site_distances(fit)
    worst = max(distance, key=lambda site: distance[site])
    _check_seen(solver, fit, name, worst, distance[worst])
    if distance[worst] > 1e3 * _WORST_FIT:
        raise InputError(
            f"{name}: the recorded {worst} is {distance[worst]:.0f} mm (RMS) from the model's best fit; measure "
            f"positions at the sites of {robot.model.name}, in its frame."
        )
    return hooks_of(robot).complete_positions(fit), distance


def site_distances(fit: KinematicFit) -> dict[str, float]:
    """Return the RMS distance (mm) between measured and fitted positions, by site."""
    solver = PoseSolver(fit.problem)
    points = solver.tree.pose(fit.qpos).points
    places = fit.problem.grid.positions
    return {
        site: 1e3 * float(np.sqrt(np.mean(np.sum((points[number] - places[site]) ** 2, axis=1))))
        for number, site in enumerate(places)
    }


def _check_seen(solver: PoseSolver, fit: KinematicFit, name: str, worst: str, distance: float) -> None:
    """Check that single samples determine all joints that the adapter does not complete.

    `worst` is the site with the largest RMS distance (mm) between measured and fitted positions.

    **Raises** `InputError` naming the joint that the median sample determines least. If the fit is bad, the posture may
    be wrong, for example stretched, so the message names the site, too.
    """
    model, robot = fit.problem.model, fit.problem.robot
    completed = [model.joint(joint).dofadr[0] for joint in hooks_of(robot).completed_joints]
    kept = np.setdiff1d(np.arange(model.nv), completed)
    information = fit.information - np.diag(solver.prior_weight**2)
    values, vectors = np.linalg.eigh(information[:, kept][:, :, kept])
    seen = values[:, 0] / values[:, -1]
    middle = int(np.argsort(seen)[len(seen) // 2])
    if seen[middle] < _UNSEEN:
        open_dof = kept[np.argmax(np.abs(vectors[middle, :, 0]))]
        joint = model.joint(int(model.dof_jntid[open_dof])).name
        fix = 'add it to "joints" of the robot description and record it, or add a point that it moves'
        if distance > NOTABLE_FIT_ERROR:
            fix = f"the recorded {worst} is {distance:.0f} mm (RMS) from the model's best fit, so first check {_PLACES}"
        raise InputError(f"{name}: nothing that is measured shows the joint {joint}; {fix}.")


def describe_fit(motions: Sequence[Motion]) -> str | None:
    """Return a sentence about the largest distance between measured and fitted positions, or None if all are small."""
    distances = [(error, motion.name, site) for motion in motions for site, error in motion.fit_error_mm.items()]
    error, name, site = max(distances, default=(0.0, "", ""))
    if error <= NOTABLE_FIT_ERROR:
        return None
    return f"{name}: the recorded {site} is {error:.0f} mm (RMS) from the model's best fit; check {_PLACES}."
