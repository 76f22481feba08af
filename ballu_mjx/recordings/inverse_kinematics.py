"""Inverse kinematics: damped least squares over all joints, for all samples of a recording at once.

Single samples may be seen equally well in several postures. Some samples along the recording are therefore fitted from
several starts; of what is found, the sequence that fits best and moves least is taken (dynamic programming), and all
samples are fitted from between its neighbours.

Joints keep their ranges, unless no pose within them fits. A closed loop (a model's `connect` or `joint` equality) is a
measurement like others.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.hooks import hooks_of
from ballu_mjx.recordings.kinematic_tree import KinematicTree, to_matrices
from ballu_mjx.recordings.motion import MeasurementGrid, ReconstructionParameters
from ballu_mjx.robots.description import RobotDescription

_WORST_FIT = 0.05
"""RMS distance (m) between measured and fitted places beyond which the recording is not of this model."""
_MAX_STEPS = 100
"""Levenberg-Marquardt steps: a handful, but from far away."""
_CONVERGED = 1e-6
"""Step (rad or m) of no consequence."""
_NO_GAIN = 1e-6
"""Of the squared misfit: where measurements do not fit the model, steps shrink slowly."""
_LONGEST_STEP = 0.5
"""rad: longer ones wind joints up."""
_UNSEEN = 1e-9
"""Of the best seen direction's information: what a direction shows that no measurement sees."""
_RANGE_GIVE = (0.05, 0.005)
"""How far beyond its range a hinge (rad) or a slide (m) may be: measurements are noisy, and stops soft."""
_LOOP_NOISE = 0.1
"""Of a measured position's noise: how far a closed loop may be open."""
_PRIOR = float(np.deg2rad(60.0))
"""Standard deviation (rad, m) of a joint about its guess: keeps the problem of a single sample well posed."""
_ANCHOR_INTERVAL = 0.2
"""s between samples that are fitted from several starts."""
_STARTS, _FITS = 6, 60
"""Random starts of each, and fits in all, at least, where the starting pose does not lead to what was measured."""
_LOST = 25.0
"""Squared misfit a measurement, in units of its noise, beyond which a sample's posture may not have been found."""
_SAME = 0.1
"""rad, m: what joints differ by at most in one posture."""
_MOVED = 0.3
"""rad, m: what a joint moves between such samples, where two sequences of postures are told apart by it."""
_MOST_JUMPS = 8
_OUTSTANDING = 3.0
"""Of what the quietest fifth of such samples moves at most: what a change of posture moves at least."""
_AWAY = (1.0, 0.3)
"""rad, m: the same from the starting pose, where two first postures are. From the reference pose; from a keyframe."""


@dataclasses.dataclass(frozen=True, eq=False)
class KinematicFit:
    """Generalized positions of all samples that fit what was measured."""

    problem: KinematicProblem
    qpos: Float[np.ndarray, "T nq"]
    information: Float[np.ndarray, "T nv nv"]
    """Inverse covariance by each sample's measurements, Gauss-Newton."""
    uncertainty: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """What an adapter states about its own part of the fit, by name."""

    def refit(
        self, site: str, quaternion: Float[np.ndarray, "T 4"], weight: Float[np.ndarray, " 3"], **uncertainty: float
    ) -> KinematicFit:
        """Return the fit with an orientation of a site's body held, with a weight (1/rad) about each of its axes."""
        orientations = {**self.problem.orientations, site: (quaternion, weight)}
        problem = dataclasses.replace(self.problem, orientations=orientations)
        solver = _Solver(problem)
        rows = np.arange(len(self.qpos))
        qpos, _ = solver.fit(self.qpos, rows)
        return KinematicFit(problem, qpos, solver.information(qpos, rows), {**self.uncertainty, **uncertainty})


@dataclasses.dataclass(frozen=True, eq=False)
class KinematicProblem:
    """What was measured, and of which model."""

    model: mujoco.MjModel
    robot: RobotDescription
    grid: MeasurementGrid
    parameters: ReconstructionParameters
    orientations: Mapping[str, tuple[Float[np.ndarray, "T 4"], Float[np.ndarray, " 3"]]]
    """Quaternions (w, x, y, z) by site, and weights (1/rad) about the body's axes."""


def solve_inverse_kinematics(
    model: mujoco.MjModel,
    robot: RobotDescription,
    grid: MeasurementGrid,
    parameters: ReconstructionParameters,
    name: str,
) -> tuple[KinematicFit, dict[str, float]]:
    """Return generalized positions that fit the measurements, and the RMS distance (mm) that is left, by site.

    **Raises** `InputError`, with the recording's `name`, where a joint is not seen, or measurements fit no pose.
    """
    weight = np.full(3, 1.0 / parameters.rotation_noise)
    orientations = {site: (quaternion, weight) for site, quaternion in grid.orientations.items()}
    problem = KinematicProblem(model, robot, grid, parameters, orientations)
    solver = _Solver(problem)
    qpos = solver.solve()
    fit = KinematicFit(problem, qpos, solver.information(qpos, np.arange(len(qpos))))
    _check_seen(solver, fit, name)
    distance = site_distances(fit)
    worst = max(distance, key=lambda site: distance[site])
    if distance[worst] > 1e3 * _WORST_FIT:
        raise InputError(
            f"{name}: {worst} is {distance[worst]:.0f} mm (RMS) from where the model can have it; measure places at "
            f"the sites of {robot.model.name}, in its frame."
        )
    return hooks_of(robot).complete_positions(fit), distance


def site_distances(fit: KinematicFit) -> dict[str, float]:
    """Return the RMS distance (mm) between measured and fitted places, by site."""
    solver = _Solver(fit.problem)
    points = solver.tree.pose(fit.qpos).points
    places = fit.problem.grid.positions
    return {
        site: 1e3 * float(np.sqrt(np.mean(np.sum((points[number] - places[site]) ** 2, axis=1))))
        for number, site in enumerate(places)
    }


class _Solver:
    """Differences to the measurements in units of their noise, their derivatives, and the poses that make them least.

    `rows` are the samples that poses belong to: several poses may belong to one.
    """

    def __init__(self, problem: KinematicProblem) -> None:
        self.problem = problem
        model, grid, parameters = problem.model, problem.grid, problem.parameters
        sites = {site: model.site(site) for site in {**grid.positions, **problem.orientations}}
        points = [(int(sites[site].bodyid[0]), sites[site].pos) for site in grid.positions]
        self._loops = _closed_loops(model)
        bodies = [int(sites[site].bodyid[0]) for site in problem.orientations]
        self.tree = KinematicTree(model, [*points, *(end for loop in self._loops for end in loop)], bodies)
        self._couplings = _couplings(model)
        self._turned = [to_matrices(quaternion) for quaternion, _ in problem.orientations.values()]
        self._turn_weights = [weight for _, weight in problem.orientations.values()]

        self._addresses, self._dofs = _scalar_joints(model)
        """Places of hinges and slides in qpos and qvel."""
        index = {model.joint(int(joint)).name: i for i, joint in enumerate(model.dof_jntid[self._dofs])}
        self._recorded = np.array([index[joint] for joint in grid.joint_angles], int)
        self._angles = np.stack(list(grid.joint_angles.values()), 1) if grid.joint_angles else np.zeros((0, 0))
        self._hidden = np.setdiff1d(np.arange(len(self._dofs)), self._recorded)
        joints = model.dof_jntid[self._dofs]
        low, high = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], [-np.inf, np.inf]).T
        give = np.where(self.tree.rotates[self._dofs], *_RANGE_GIVE)
        self._low, self._high = low, high
        self._lowest, self._highest = low - give, high + give
        self._has_keyframe = problem.robot.keyframe is not None or model.nkey > 0
        self.bounded = True
        """Whether poses keep within the joints' ranges."""
        self._turns = self.tree.rotates[self._dofs] & ~(np.isfinite(self._low) & np.isfinite(self._high))
        """Hinges that may turn on and on."""
        places = 3 * (len(grid.positions) + len(problem.orientations) + len(self._loops))
        self._measurements = places + len(self._couplings) + len(self._recorded)
        self.joint_weight, self.prior_weight = np.zeros(model.nv), np.zeros(model.nv)
        self.joint_weight[self._dofs[self._recorded]] = 1.0 / parameters.joint_noise
        self.prior_weight[self._dofs[self._hidden]] = 1.0 / _PRIOR

    # ---- misfit ----

    def misfit(
        self, qpos: Float[np.ndarray, "N nq"], rows: Int[np.ndarray, " N"]
    ) -> tuple[Float[np.ndarray, "N m"], Float[np.ndarray, "N m nv"]]:
        """Differences to all measurements but joint angles, and their derivatives along velocities."""
        parameters, grid = self.problem.parameters, self.problem.grid
        poses = self.tree.pose(qpos)
        errors, slopes = [], []
        for number, places in enumerate(grid.positions.values()):
            errors.append((poses.points[number] - places[rows]) / parameters.position_noise)
            slopes.append(self.tree.point_jacobian(poses, number) / parameters.position_noise)
        for number, (turned, weight) in enumerate(zip(self._turned, self._turn_weights, strict=True)):
            back = turned[rows].transpose(0, 2, 1)
            errors.append(_rotation_vectors(back @ poses.rotations[number]) * weight)
            slopes.append(back @ self.tree.turn_jacobian(poses, number) * weight[:, None])
        noise, first = _LOOP_NOISE * parameters.position_noise, len(grid.positions)
        for number in range(len(self._loops)):
            one, other = first + 2 * number, first + 2 * number + 1
            errors.append((poses.points[one] - poses.points[other]) / noise)
            slopes.append((self.tree.point_jacobian(poses, one) - self.tree.point_jacobian(poses, other)) / noise)
        for coupling in self._couplings:
            error, slope = coupling.misfit(qpos, self.problem.model.nv)
            errors.append(error[:, None] / (_LOOP_NOISE * parameters.joint_noise))
            slopes.append(slope[:, None] / (_LOOP_NOISE * parameters.joint_noise))
        return np.concatenate(errors, axis=1), np.concatenate(slopes, axis=1)

    def information(self, qpos: Float[np.ndarray, "T nq"], rows: Int[np.ndarray, " T"]) -> np.ndarray:
        """What each sample's measurements show, the prior included."""
        _, slope = self.misfit(qpos, rows)
        information = slope.transpose(0, 2, 1) @ slope
        diagonal = np.arange(information.shape[1])
        information[:, diagonal, diagonal] += self.joint_weight**2 + self.prior_weight**2
        return information

    # ---- fit ----

    def fit(
        self, guess: Float[np.ndarray, "N nq"], rows: Int[np.ndarray, " N"]
    ) -> tuple[Float[np.ndarray, "N nq"], Float[np.ndarray, " N"]]:
        """Poses of the least misfit near `guess`, and their squared misfit to what was measured."""
        nv, diagonal = self.problem.model.nv, np.arange(self.problem.model.nv)
        wanted = np.zeros((len(guess), nv))
        wanted[:, self._dofs] = guess[:, self._addresses]
        wanted[:, self._dofs[self._recorded]] = self._angles[rows] if len(self._recorded) else 0.0
        weight = self.joint_weight**2 + self.prior_weight**2

        def joint_errors(qpos: np.ndarray, lanes: np.ndarray) -> np.ndarray:
            errors = np.zeros((len(qpos), nv))
            errors[:, self._dofs] = qpos[:, self._addresses]
            return errors - wanted[lanes]

        def square(error: np.ndarray, joint_error: np.ndarray) -> np.ndarray:
            return np.einsum("ij,ij->i", error, error) + np.einsum("ij,ij,j->i", joint_error, joint_error, weight)

        qpos, active = guess.copy(), np.arange(len(guess))
        damping, cost = np.full(len(guess), 1e-6), np.empty(len(guess))
        error, slope = self.misfit(qpos, rows)
        joint_error = joint_errors(qpos, active)
        cost[:] = square(error, joint_error)
        for _ in range(_MAX_STEPS):
            transposed = slope.transpose(0, 2, 1)
            curvature = transposed @ slope
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
                moved[:, self._addresses] = np.clip(moved[:, self._addresses], self._lowest, self._highest)
            error_there, slope_there = self.misfit(moved, rows[active])
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
            slope = np.where(chosen[..., None], slope_there, slope)[going]
            joint_error = np.where(chosen, joint_error_there, joint_error)[going]
            active = active[going]
            if not len(active):
                break
        away = joint_errors(qpos, np.arange(len(qpos)))
        return qpos, cost - np.einsum("ij,ij,j->i", away, away, self.prior_weight**2)

    def _hold_stops(self, qpos: np.ndarray, curvature: np.ndarray, gradient: np.ndarray) -> None:
        """Take joints at a stop, and pushed against it, out of the step, in place."""
        angles, slope = qpos[:, self._addresses], gradient[:, self._dofs]
        held = ((angles <= self._lowest) & (slope > 0)) | ((angles >= self._highest) & (slope < 0))
        for joint in np.flatnonzero(held.any(axis=0)):
            lanes, dof = np.flatnonzero(held[:, joint]), self._dofs[joint]
            own = curvature[lanes, dof, dof]
            curvature[lanes, dof, :] = curvature[lanes, :, dof] = 0.0
            curvature[lanes, dof, dof], gradient[lanes, dof] = own, 0.0

    # ---- starts ----

    def solve(self) -> Float[np.ndarray, "T nq"]:
        """Poses of all samples."""
        grid = self.problem.grid
        count = len(next(iter(grid.positions.values())))
        start = self._starting_pose()
        rows = np.arange(count)
        joints = np.tile(start[self._addresses], (count, 1))
        if len(self._hidden):
            anchors = np.unique(np.append(rows[:: max(1, round(_ANCHOR_INTERVAL / grid.step))], count - 1))
            found = self._anchor_joints(start, anchors)
            joints = np.stack([np.interp(rows, anchors, column) for column in found.T], axis=1)
        return self.fit(self._guess(start, joints, rows), rows)[0]

    def _anchor_joints(
        self, start: Float[np.ndarray, " nq"], anchors: Int[np.ndarray, " A"]
    ) -> Float[np.ndarray, "A joints"]:
        """Joints of some samples, of which no posture is known, continuous in time."""
        own, count = start[self._addresses], len(anchors)
        everywhere = np.arange(count)
        candidates: list[tuple[np.ndarray, np.ndarray]] = []

        def fitted(joints: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            rows = anchors[which]
            qpos, cost = self.fit(self._guess(start, joints, rows), rows)
            found = qpos[:, self._addresses]
            free = self._turns & ~np.isin(np.arange(len(own)), self._recorded)
            found[:, free] = own[free] + _wrapped(found[:, free] - own[free])
            return found, cost

        def add(joints: Float[np.ndarray, "starts n joints"], which: Int[np.ndarray, " n"]) -> None:
            """Fit the samples in `which` from several starts each."""
            found, cost = fitted(joints.reshape(-1, len(own)), np.tile(which, len(joints)))
            rows = np.zeros((len(joints), count, len(own))), np.full((len(joints), count), np.inf)
            rows[0][:, which], rows[1][:, which] = found.reshape(joints.shape), cost.reshape(joints.shape[:2])
            candidates.append(rows)

        def carry(path: np.ndarray, places: np.ndarray, ways: np.ndarray) -> None:
            """Fit sample after sample from the one before, from each place on in its way (1 or -1), to
            where this leads to what is known."""
            rows = np.zeros((len(places), count, len(own))), np.full((len(places), count), np.inf)
            joints, going = path[places], np.arange(len(places))
            for step in range(1, count):
                which = places + step * ways
                going = going[(which[going] >= 0) & (which[going] < count)]
                if not len(going):
                    break
                joints[going], cost = fitted(joints[going], which[going])
                rows[0][going, which[going]], rows[1][going, which[going]] = joints[going], cost
                going = going[self._apart(joints[going], path[which[going]]) > _SAME**2]
            candidates.append(rows)

        def best() -> tuple[np.ndarray, np.ndarray]:
            return self._best_path(own, *(np.concatenate(each) for each in zip(*candidates, strict=True)))

        def lost(cost: np.ndarray) -> np.ndarray:
            return np.flatnonzero(cost > _LOST * self._measurements)

        add(np.tile(own, (1, count, 1)), everywhere)
        if len(which := lost(candidates[0][1][0])):
            add(self._starts(start, len(which)), which)
        path, cost = best()
        apart = 1
        while apart < count and len(lost(cost)):  # Others may have found what one has not.
            before, after = np.maximum(everywhere - apart, 0), np.minimum(everywhere + apart, count - 1)
            add(np.stack([path[before], path[after]]), everywhere)
            path, cost = best()
            apart *= 2
        if len(which := lost(cost)):  # What is measured clearly is believed, against the model's ranges.
            self.bounded = False
            add(np.concatenate([self._starts(start, len(which)), path[None, which]]), which)
            path, cost = best()
        if len(jumps := self._jumps(path)):
            carry(path, np.concatenate([jumps, jumps + 1]), np.repeat([1, -1], len(jumps)))
            path, _ = best()
        path[:, self._turns] = np.unwrap(path[:, self._turns], axis=0)
        return path

    def _jumps(self, path: Float[np.ndarray, "A joints"]) -> Int[np.ndarray, " jumps"]:
        """Samples after which joints move by much more than elsewhere: from one posture to another. The largest few."""
        moved = np.sqrt(self._apart(path[1:], path[:-1]))
        largest = np.argsort(-moved)[:_MOST_JUMPS]
        return largest[moved[largest] > _SAME + _OUTSTANDING * np.percentile(moved, 20)]

    def _apart(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Squared distances (rad, m) of joints, turns aside."""
        difference = a - b
        difference[..., self._turns] = _wrapped(difference[..., self._turns])
        return np.sum(difference**2, axis=-1)

    def _best_path(
        self,
        own: Float[np.ndarray, " joints"],
        joints: Float[np.ndarray, "candidates A joints"],
        cost: Float[np.ndarray, "candidates A"],
    ) -> tuple[Float[np.ndarray, "A joints"], Float[np.ndarray, " A"]]:
        """One candidate of each sample, so that misfits and movements are least in all, and their misfits."""
        total = cost[:, 0] + self._apart(joints[:, 0], own) / _AWAY[self._has_keyframe] ** 2
        came = []
        for sample in range(1, joints.shape[1]):
            moved = self._apart(joints[:, sample, None], joints[None, :, sample - 1]) / _MOVED**2
            came.append(np.argmin(total + moved, axis=1))
            total = cost[:, sample] + np.min(total + moved, axis=1)
        chosen = [int(np.argmin(total))]
        for back in reversed(came):
            chosen.append(int(back[chosen[-1]]))
        places = chosen[::-1], np.arange(joints.shape[1])
        return joints[places], cost[places]

    def _starting_pose(self) -> Float[np.ndarray, " nq"]:
        """Where the description or else the model's first keyframe says that the robot starts. Without any: the
        reference pose, with joints whose ranges do not hold it in the middle of these."""
        problem, model = self.problem, self.problem.model
        start = problem.robot.adapter.initial_qpos(problem.robot, model)
        if self._has_keyframe:
            return model.key_qpos[0].copy() if problem.robot.keyframe is None else start
        joints = start[self._addresses]
        outside = (joints < self._low) | (joints > self._high)
        start[self._addresses] = np.where(outside, self._middle(joints), joints)
        return start

    def _middle(self, otherwise: Float[np.ndarray, " joints"]) -> Float[np.ndarray, " joints"]:
        limited = np.isfinite(self._low) & np.isfinite(self._high)
        with np.errstate(invalid="ignore"):
            return np.where(limited, (self._low + self._high) / 2, otherwise)

    def _starts(self, start: Float[np.ndarray, " nq"], count: int) -> Float[np.ndarray, "starts n joints"]:
        """Joints to begin with beside the starting pose: the model's keyframes, the middles of the ranges, and others
        at random, more of them where few samples need them."""
        own, model = start[self._addresses], self.problem.model
        spread = np.where(self.tree.rotates[self._dofs], np.pi, 0.1)
        low = np.where(np.isfinite(self._low), self._low, own - spread)
        high = np.where(np.isfinite(self._high), self._high, own + spread)
        drawn = np.random.default_rng(0).uniform(low, high, (max(_STARTS, _FITS // count), count, len(own)))
        fixed = [*model.key_qpos[:, self._addresses], self._middle(own)]
        return np.concatenate([np.tile(np.stack(fixed)[:, None], (1, count, 1)), drawn])

    def _guess(
        self, start: Float[np.ndarray, " nq"], joints: Float[np.ndarray, "N joints"], rows: Int[np.ndarray, " N"]
    ) -> Float[np.ndarray, "N nq"]:
        """Poses with these joints, or recorded ones, and a free root where the tracked body then is as recorded."""
        qpos = np.tile(start, (len(rows), 1))
        qpos[:, self._addresses] = joints
        if len(self._recorded):
            qpos[:, self._addresses[self._recorded]] = self._angles[rows]
        if self.bounded:
            qpos[:, self._addresses] = np.clip(qpos[:, self._addresses], self._lowest, self._highest)
        if self.problem.robot.anchored:
            return qpos
        qpos[:, :7] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
        poses = self.tree.pose(qpos)
        tracked = self.problem.grid.positions[self.problem.robot.tracked][rows]
        rotation = self._turned[0][rows] @ poses.rotations[0].transpose(0, 2, 1)
        qpos[:, :3] = tracked - (rotation @ poses.points[0][..., None])[..., 0]
        qpos[:, 3:7] = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
        return qpos


# ---- the model ----


def _scalar_joints(model: mujoco.MjModel) -> tuple[Int[np.ndarray, " joints"], Int[np.ndarray, " joints"]]:
    """Addresses of hinges and slides in qpos and in qvel."""
    scalar = model.jnt_type != mujoco.mjtJoint.mjJNT_FREE
    return model.jnt_qposadr[scalar].astype(int), model.jnt_dofadr[scalar].astype(int)


_End = tuple[int, Float[np.ndarray, " 3"]]


def _closed_loops(model: mujoco.MjModel) -> list[tuple[_End, _End]]:
    """Pairs of points that `connect` equalities hold together: bodies, and places in their frames."""
    loops = []
    for number in np.flatnonzero(model.eq_active0):
        if model.eq_type[number] != mujoco.mjtEq.mjEQ_CONNECT:
            continue
        one, other = int(model.eq_obj1id[number]), int(model.eq_obj2id[number])
        if model.eq_objtype[number] == mujoco.mjtObj.mjOBJ_SITE:
            ends = [(int(model.site_bodyid[site]), model.site_pos[site]) for site in (one, other)]
        else:
            ends = [(one, model.eq_data[number, :3]), (other, model.eq_data[number, 3:6])]
        loops.append(tuple(ends))
    return loops


@dataclasses.dataclass(frozen=True)
class _Coupling:
    """A `joint` equality: one joint's deviation from its reference is a polynomial of another's (or constant)."""

    address: int
    dof: int
    reference: float
    other: tuple[int, int, float] | None
    coefficients: Float[np.ndarray, " 5"]

    def misfit(
        self, qpos: Float[np.ndarray, "N nq"], nv: int
    ) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N nv"]]:
        slope = np.zeros((len(qpos), nv))
        slope[:, self.dof] = 1.0
        polynomial = np.polynomial.Polynomial(self.coefficients)
        if self.other is None:
            return qpos[:, self.address] - self.reference - self.coefficients[0], slope
        address, dof, reference = self.other
        moved = qpos[:, address] - reference
        slope[:, dof] = -polynomial.deriv()(moved)
        return qpos[:, self.address] - self.reference - polynomial(moved), slope


def _couplings(model: mujoco.MjModel) -> list[_Coupling]:
    found = []
    for number in np.flatnonzero(model.eq_active0):
        if model.eq_type[number] != mujoco.mjtEq.mjEQ_JOINT:
            continue
        places = [
            (int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]), float(model.qpos0[model.jnt_qposadr[joint]]))
            for joint in (model.eq_obj1id[number], model.eq_obj2id[number])
            if joint >= 0
        ]
        found.append(_Coupling(*places[0], places[1] if len(places) > 1 else None, model.eq_data[number, :5].copy()))
    return found


def _rotation_vectors(matrices: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 3"]:
    sine = np.stack(
        [
            matrices[:, 2, 1] - matrices[:, 1, 2],
            matrices[:, 0, 2] - matrices[:, 2, 0],
            matrices[:, 1, 0] - matrices[:, 0, 1],
        ],
        axis=1,
    )
    length = np.linalg.norm(sine, axis=1)
    cosine = np.trace(matrices, axis1=1, axis2=2) - 1
    vectors = sine * (np.arctan2(length, cosine) / np.maximum(length, 1e-300))[:, None]
    vectors[length < 1e-12] = 0.0
    far = cosine < -1.9  # near a half turn the axis is lost in the sine
    if far.any():
        vectors[far] = Rotation.from_matrix(matrices[far]).as_rotvec()
    return vectors


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _check_seen(solver: _Solver, fit: KinematicFit, name: str) -> None:
    """**Raises** `InputError` naming the joint that most samples leave open, each taken alone."""
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
        raise InputError(
            f'{name}: nothing that is measured shows the joint {joint}; add it to "joints" of the robot description '
            "and record it, or add a point that it moves."
        )
