"""Comparison of identified and nominal actuators by open-loop replays of recordings.

Replays run in C MuJoCo, which needs no compilation. The recordings must be validation recordings: neither the
identification nor a final test may use them.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Float, Int

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion, measured_hinges
from ballu_mjx.recordings.recording_groups import group_of
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters, bare_parameters
from ballu_mjx.sim.drivetrain import count_slots, drivetrain_of, filter_commands
from ballu_mjx.sim.step import count_substeps

HORIZONS = (1.0, 5.0)
"""Horizons of the errors (s). Horizons longer than all recordings are left out."""
START_INTERVAL = 1.0
"""Time between two starts in the same recording (s)."""

Quantity = Literal["position", "joints"]


class ReplayErrors(NamedTuple):
    """Root mean square errors over a horizon, as means over the starts that did not diverge. inf if all diverged."""

    position: float
    """Position error of the tracked site (m)."""
    joints: float
    """Angle error of the robot's recorded hinges (rad). NaN if it has none."""
    diverged: int
    """Number of starts that diverged."""


class ReplayRow(NamedTuple):
    """Errors of a group of recordings over one horizon."""

    group: str
    horizon: float
    """Horizon (s)."""
    starts: int
    """Number of starts."""
    nominal: ReplayErrors
    identified: ReplayErrors

    def ratio(self, quantity: Quantity) -> float:
        """Return identified over nominal error, over the starts that diverge with neither.

        If there is none, it is inf or nearly 0 in favour of the actuators with fewer diverged starts, and 1 if these
        are equally many. It is also inf if more starts diverge with identified actuators.
        """
        if self.identified.diverged > self.nominal.diverged:
            return np.inf
        one, other = getattr(self.identified, quantity), getattr(self.nominal, quantity)
        if np.isfinite(other):
            return float(max(one, _LEAST) / max(other, _LEAST))
        return 1.0 if self.identified.diverged == self.nominal.diverged else _LEAST


_LEAST = 1e-6
_SCALES: Mapping[Quantity, float] = {"position": 1.0, "joints": 180 / np.pi}
_WORDS: Mapping[Quantity, str] = {"position": "position", "joints": "joint angles"}


@dataclasses.dataclass(frozen=True, eq=False)
class Choice:
    """Comparison of nominal and identified actuators in replays of recordings."""

    identified: ModelParameters
    rows: tuple[ReplayRow, ...]
    decides: Quantity
    """Quantity that decides: the tracked site's position, or the joint angles of an anchored robot with recorded
    hinges."""

    @property
    def ratio(self) -> float:
        """Return the geometric mean over groups and horizons of identified over nominal error."""
        return float(np.exp(np.mean(np.log([row.ratio(self.decides) for row in self.rows]))))

    @property
    def improves(self) -> bool:
        """Return whether the identified actuators replay the recordings better."""
        return self.ratio < 1

    @property
    def actuators(self) -> ModelParameters | None:
        """Return the better actuators. None for the nominal ones."""
        return self.identified if self.improves else None

    @property
    def worse(self) -> tuple[str, ...]:
        """Return the groups, horizons and quantities in which identified actuators are worse, in words."""
        return tuple(
            f"{words} of {row.group} recordings over {row.horizon:g} s ({row.ratio(quantity):.2f} times the error)"
            for row in self.rows
            for quantity, words in _WORDS.items()
            if not np.isnan(getattr(row.nominal, quantity)) and row.ratio(quantity) > 1
        )

    def table(self) -> str:
        """Return the errors and the result of the comparison as text."""
        lines = [
            f"{'':8}{'horizon':>8}{'':8} | {'position RMSE (m)':^30} | {'joint RMSE (deg)':^30}",
            f"{'group':8}{'(s)':>8}{'starts':>8}" + f" | {'nominal':>10}{'identified':>12}{'ratio':>8}" * 2,
        ]
        for row in self.rows:
            cells = []
            for quantity, scale in _SCALES.items():
                pair = [getattr(errors, quantity) * scale for errors in (row.nominal, row.identified)]
                given = not np.isnan(pair[0])
                digits = 4 if quantity == "position" else 2
                cell = f"{pair[0]:>10.{digits}f}{pair[1]:>12.{digits}f}{row.ratio(quantity):>8.2f}"
                cells.append(cell if given else f"{'none':>10}{'none':>12}{'':>8}")
            lines.append(f"{row.group:8}{row.horizon:>8g}{row.starts:>8} | {' | '.join(cells)}")
            if row.nominal.diverged or row.identified.diverged:
                diverged = f"{row.nominal.diverged} nominal, {row.identified.diverged} identified"
                lines.append(f"{'':24} | diverged: {diverged}")
        better = "better" if self.improves else "WORSE"
        what = {"position": "position", "joints": "joint"}[self.decides]
        lines.append(
            f"Identified actuators are {better} than nominal: {self.ratio:.2f} times the {what} error on average."
        )
        lines += [f"Identification is worse in: {place}." for place in self.worse]
        return "\n".join(lines)


def choose_actuators(
    robot: RobotDescription,
    actuators: ModelParameters,
    motions: Sequence[Motion],
    horizons: Sequence[float] = HORIZONS,
) -> Choice:
    """Replay recorded motions with nominal and with identified actuators, and compare the errors.

    Each motion is restarted from its recorded states every second. Both replays start from the same states. For joints
    without measurements, these states may depend on one of the models.

    **Raises** `InputError` if no motion is as long as the shortest horizon (s).
    """
    identified = bare_parameters(actuators)
    assert identified is not None, "There are no actuators to choose."
    lasting = [h for h in horizons if any(len(_starts(motion, h, robot)) for motion in motions)]
    if not lasting:
        names = ", ".join(motion.name for motion in motions)
        raise InputError(f"{names}: no validation recording lasts {min(horizons):g} s; give longer recordings.")
    both = [_replay(robot, parameters, motions, lasting) for parameters in (None, identified)]
    rows = []
    for group in dict.fromkeys(group_of(motion.name) for motion in motions):
        for horizon in lasting:
            pair = [found.get((group, horizon)) for found in both]
            if pair[0] is not None and pair[1] is not None:
                rows.append(ReplayRow(group, horizon, len(pair[0]), *_summaries(pair[0], pair[1])))
    model = robot.load_model()
    by_joints = robot.anchored and all(measured_hinges(robot, model, motion) for motion in motions)
    return Choice(identified, tuple(rows), "joints" if by_joints else "position")


def _starts(motion: Motion, horizon: float, robot: RobotDescription) -> Int[np.ndarray, " starts"]:
    """Return the control steps at which replays of a motion over a horizon (s) start."""
    steps, every = (round(seconds / robot.control_timestep) for seconds in (horizon, START_INTERVAL))
    return np.arange(0, len(motion.command) - steps + 1, max(every, 1))


def _summaries(*sides: Float[np.ndarray, "starts 2"]) -> list[ReplayErrors]:
    """Return each side's mean errors over the starts that diverged on no side. Infinite if there is none.

    Joint errors are NaN for recordings without hinges.
    """
    finite = [np.isfinite(errors[:, 0]) for errors in sides]
    common = np.logical_and.reduce(finite)
    without = np.isnan(np.concatenate(sides)[:, 1]).any()
    none = (np.inf, np.nan if without else np.inf)
    means = [errors[common].mean(axis=0) if common.any() else none for errors in sides]
    return [
        ReplayErrors(float(position), float(joints), int(np.sum(~own)))
        for (position, joints), own in zip(means, finite, strict=True)
    ]


def _replay(
    robot: RobotDescription, parameters: ModelParameters | None, motions: Sequence[Motion], horizons: Sequence[float]
) -> dict[tuple[str, float], Float[np.ndarray, "starts 2"]]:
    """Return the position and joint errors of every start, by group and horizon. inf if the start diverged."""
    model, nominal = robot.load_model(parameters), robot.load_model()
    substeps = count_substeps(model, robot.control_timestep)
    found: dict[tuple[str, float], list[np.ndarray]] = {}
    for motion in motions:
        starts = _starts(motion, min(horizons), robot)
        if not len(starts):
            continue
        steps = min(round(max(horizons) / robot.control_timestep), len(motion.command))
        ctrl = physics_commands(parameters, motion.command, substeps, float(model.opt.timestep))
        qpos, intact = simulate_motion(model, motion, starts, ctrl, steps, substeps)
        hinges = list(measured_hinges(robot, nominal, motion).values())
        recorded, position = _look(nominal, robot, motion.qpos), _look(model, robot, qpos.reshape(-1, model.nq))
        angles, joints = motion.qpos[:, hinges], qpos[..., hinges]
        position, joints = position.reshape(len(starts), steps, 3), joints.reshape(len(starts), steps, len(hinges))
        for horizon in horizons:
            count = round(horizon / robot.control_timestep)
            errors = []
            for run, start in enumerate(starts):
                if start + count > len(motion.command):
                    continue
                later = slice(start + 1, start + count + 1)
                far = np.sqrt(np.mean(np.sum((position[run, :count] - recorded[later]) ** 2, axis=1)))
                turned = joints[run, :count] - angles[later]
                turn = np.sqrt(np.mean(turned**2)) if turned.size else np.nan
                diverged = [np.inf, np.inf if turned.size else np.nan]
                errors.append([far, turn] if intact[run, :count].all() else diverged)
            if errors:
                found.setdefault((group_of(motion.name), horizon), []).extend(map(np.array, errors))
    return {key: np.array(errors) for key, errors in found.items()}


def physics_commands(
    parameters: ModelParameters | None, commands: Float[np.ndarray, "steps commands"], substeps: int, timestep: float
) -> Float[np.ndarray, "physics commands"]:
    """Return the actuators' `ctrl` at each physics step. The drivetrain starts at rest under the first command."""
    fine, drivetrain = np.repeat(commands, substeps, axis=0), drivetrain_of(parameters)
    if drivetrain is None:
        return fine
    slots = count_slots(float(np.max(drivetrain.delay)), timestep)
    return np.asarray(filter_commands(drivetrain, jnp.asarray(fine, jnp.float32), timestep, slots), np.float64)


def simulate_motion(
    model: mujoco.MjModel,
    motion: Motion,
    starts: Int[np.ndarray, " starts"],
    ctrl: Float[np.ndarray, "physics commands"],
    steps: int,
    substeps: int,
) -> tuple[Float[np.ndarray, "starts steps nq"], np.ndarray]:
    """Simulate a motion from several starts.

    **Returns** the generalized positions after each control step, and a mask that is false once a start has diverged.
    """
    data, kind = mujoco.MjData(model), mujoco.mjtState.mjSTATE_FULLPHYSICS
    initial = np.zeros((len(starts), mujoco.mj_stateSize(model, kind)))
    for row, start in zip(initial, starts, strict=True):
        data.qpos[:], data.qvel[:] = motion.qpos[start], motion.qvel[start]
        mujoco.mj_getState(model, data, row, kind)
    place = np.minimum(starts[:, None] * substeps + np.arange(steps * substeps), len(ctrl) - 1)
    with without_warnings():
        state, _ = mujoco.rollout.rollout(model, data, initial, ctrl[place])
    after = np.asarray(state, float)[:, substeps - 1 :: substeps]
    # MuJoCo resets a simulation that diverges. Its time then differs from the expected one.
    expected = np.arange(1, steps + 1) * substeps * model.opt.timestep
    intact = np.isfinite(after).all(axis=2) & (np.abs(after[..., 0] - expected) < 1e-6 * expected)
    return after[..., 1 : 1 + model.nq], intact


@contextlib.contextmanager
def without_warnings() -> Iterator[None]:
    """Suppress MuJoCo's warnings of divergence, on the screen and in its log file in the current folder."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _look(
    model: mujoco.MjModel, robot: RobotDescription, qpos: Float[np.ndarray, "states nq"]
) -> Float[np.ndarray, "states 3"]:
    """Return the position of the tracked site (m)."""
    data, site = mujoco.MjData(model), model.site(robot.tracked).id
    position = np.zeros((len(qpos), 3))
    for number, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        position[number] = data.site_xpos[site]
    return position
