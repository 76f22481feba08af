"""Open-loop evaluation of a simulator: replay of recorded commands from recorded states.

A run begins every second of a recording, at the recorded state. The first run goes on to the recording's end, and each
other run to the longest horizon. Errors are computed over horizons, because small errors compound over a whole
recording. The paper's figures for whole recordings are also computed.
"""

from __future__ import annotations

import copy
import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from mujoco import mjx

from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.errors import (
    LARGEST,
    SCORE_HORIZONS,
    Errors,
    Evaluation,
    base_name,
    choose_horizons,
    has_diverged,
    median_of_starts,
    orientation_errors,
    summarize_starts,
)
from ballu_mjx.identification.parameters import LEAST_FRICTION
from ballu_mjx.recordings.motion import Motion, measured_hinges
from ballu_mjx.recordings.recording_groups import group_of
from ballu_mjx.recordings.reference import ReferenceMotions, pad_to_bucket, stack_motions
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.drivetrain import DrivetrainParameters, identity_drivetrain
from ballu_mjx.sim.observation import HISTORY, ObservationLayout
from ballu_mjx.sim.residual import BoundResidual, Residual
from ballu_mjx.sim.sharding import compile_for_devices, device_shardings
from ballu_mjx.sim.simulator import AugmentedSimulator, RolloutState, Simulator
from ballu_mjx.sim.step import PhysicsState, state_at

START_INTERVAL = 1.0
"""Time (s) between two starts in a recording. It is the shortest horizon if that is shorter."""
_RUNS = {True: (8, 64), False: (1024,)}
"""Batch sizes: runs in parallel on each device, on a CPU (True) and on other devices (False). Runs are padded to the
smallest size that holds all of them, or split into batches of the largest one. Each size compiles its own program."""
_CHUNK = 100
"""Control steps that the compiled program simulates at once. One program then serves recordings of all lengths."""


def shortest_recording(robot: RobotDescription) -> float:
    """Return the least length (s) of a validation or test recording.

    It contains the longest horizon that the robot declares, or the shortest one of the default score. Half a second is
    added, or the control steps before the first start and one more if these take longer.
    """
    horizon = max(robot.horizons) if robot.horizons else min(SCORE_HORIZONS)
    return horizon + max(0.5, HISTORY * robot.control_timestep)


class Replay(NamedTuple):
    """Simulated runs from recorded states. The recorded starting state is the first state of each run.

    All arrays have the length of the longest run. Values are NaN after the end of a run, and after the run has diverged
    (`LARGEST`).
    """

    position: Float[np.ndarray, "runs states 3"]
    """Position of the tracked body (m, world frame)."""
    euler_angles: Float[np.ndarray, "runs states 3"]
    """Roll, pitch and yaw of the tracked body (rad), not unwrapped."""
    points: Float[np.ndarray, "runs states points 3"]
    """Positions of the robot's points (m, world frame)."""
    joints: Float[np.ndarray, "runs states hinges"]
    """Angles of the measured hinges (rad); see `measured_hinges`."""
    com: Float[np.ndarray, "runs states 3"]
    """Position of the centre of mass (m, world frame)."""
    force: Float[np.ndarray, "runs steps 3"]
    """Residual force on the tracked body (N, world frame)."""
    qpos: Float[np.ndarray, "recordings states nq"]
    """Generalized positions of the run from each recording's first start."""

    @property
    def yaw(self) -> Float[np.ndarray, "runs states"]:
        """Yaw of the tracked body (rad), not unwrapped."""
        return self.euler_angles[..., 2]


def evaluate(simulator: AugmentedSimulator, motions: Sequence[Motion]) -> Evaluation:
    """Return the open-loop errors of a simulator with and without its residual on recorded motions.

    **Raises** `ValueError` if the simulator has no residual or a scaled one, and if there are no motions.
    """
    if simulator.residual is None:
        raise ValueError("The simulator has no residual; give one from `with_residual`.")
    if simulator.scale is not None:
        raise ValueError("The residual has a scale; errors are those of a whole residual.")
    if not motions:
        raise ValueError("There are no motions; give one or more.")
    evaluator = Evaluators(simulator.without_residual()).of(simulator.residual.model, motions)
    return evaluator(simulator.residual.params)


class _Run(NamedTuple):
    """State of a run between two control steps."""

    rollout: RolloutState
    over: Bool[Array, ""] | Bool[np.ndarray, "*batch"]
    """Whether the recording has ended or the run has diverged. The rollout then stays at recorded states, because the
    solver needs up to its largest number of iterations for a state without meaning."""


class Evaluators:
    """Evaluators of one simulator. Evaluators of the same residual share a compiled program."""

    def __init__(self, simulator: Simulator) -> None:
        """Prepare evaluators of `simulator`, which has no residual."""
        self._simulator = simulator
        self._made: list[tuple[Residual, Sequence[Motion], OpenLoopEvaluator]] = []

    def of(self, residual: Residual, motions: Sequence[Motion]) -> OpenLoopEvaluator:
        """Return the evaluator of `residual` on `motions`. The same arguments give the same evaluator."""
        made = None
        for known, on, evaluator in self._made:
            if known is residual and on is motions:
                return evaluator
            made = evaluator if known is residual else made
        made = OpenLoopEvaluator(self._simulator, motions, residual) if made is None else made.on(motions)
        self._made.append((residual, motions, made))
        return made


def nominal_model(simulator: Simulator) -> mujoco.MjModel:
    """Return the nominal model in a form that shares a compiled program with the simulator's model.

    Both need the same constraint rows and solver iterations. The nominal model therefore has negligible dry friction
    where the simulator's model has any.
    """
    model = simulator.robot.load_model()
    model.opt.iterations = simulator.mj_model.opt.iterations
    for name in ("dof_frictionloss", "tendon_frictionloss"):
        field, rubbing = getattr(model, name), getattr(simulator.mj_model, name) > 0
        field[rubbing] = np.maximum(field[rubbing], LEAST_FRICTION)
    return model


class OpenLoopEvaluator:
    """Open-loop evaluator of a simulator on a set of recordings.

    One compiled program serves all parameters of the residual, all recordings and all actuators.
    """

    def __init__(self, simulator: Simulator, motions: Sequence[Motion], residual: Residual) -> None:
        """Prepare to replay `motions` in `simulator`, without and with `residual`.

        **Raises** `InputError` for a motion that is too short for a replay.
        """
        self.base, self.name = base_name(simulator.actuators is not None), residual.name
        self._residual = residual
        self._simulator = simulator
        self.robot = simulator.robot
        self._everywhere, self._split = device_shardings()
        self._chunk = compile_for_devices(self._advance, shared=5)
        self._look_at(motions)

    def on(self, motions: Sequence[Motion]) -> OpenLoopEvaluator:
        """Return an evaluator on other recordings that shares this one's compiled program."""
        other = copy.copy(self)
        other._look_at(motions)
        return other

    def _look_at(self, motions: Sequence[Motion]) -> None:
        self.motions = tuple(motions)
        longest = max(len(motion.command) for motion in self.motions) * self.robot.control_timestep
        self.horizons = choose_horizons(self.robot.horizons, longest)
        interval = round(min(START_INTERVAL, *self.horizons) / self.robot.control_timestep)
        shortest = HISTORY - 1 + round(min(self.horizons) / self.robot.control_timestep)
        for motion in self.motions:
            if len(motion.command) < shortest:
                raise InputError(
                    f"{motion.name}: has {len(motion.command)} control steps, but a replay over the shortest horizon "
                    f"({min(self.horizons):g} s) needs {shortest}; give a longer recording."
                )
        reference, com = stack_motions(self._simulator, motions)
        self._recorded, self._recorded_com = np.asarray(reference.features), np.asarray(com)
        self._reference = jax.device_get(pad_to_bucket(reference))
        own = self._simulator.model, self._simulator.drivetrain
        self._fixed = jax.device_put((*jax.device_get(own), self._reference), self._everywhere)
        model = self._simulator.mj_model
        self._hinges = [measured_hinges(self.robot, model, motion) for motion in self.motions]
        names = dict.fromkeys(name for hinges in self._hinges for name in hinges)
        self._joints = {name: int(model.joint(name).qposadr[0]) for name in names}
        self.starts = [
            (index, start)
            for index, motion in enumerate(self.motions)
            for start in range(HISTORY - 1, len(motion.command) - interval + 1, interval)
        ]
        devices = jax.local_devices()
        sizes = [len(devices) * runs for runs in _RUNS[devices[0].platform == "cpu"]]
        self._size = next((size for size in sizes if size >= len(self.starts)), sizes[-1])
        recordings = [recording for recording, _ in self.starts]
        # Index in `starts` of each recording's first start, whose run covers (nearly) the whole recording.
        self.first_runs = [recordings.index(index) for index in range(len(self.motions))]
        rest = np.array([len(self.motions[recording].command) - start for recording, start in self.starts])
        first = np.isin(np.arange(len(rest)), self.first_runs)
        farthest = round(max(self.horizons) / self.robot.control_timestep)
        self._steps = np.where(first, rest, np.minimum(rest, farthest))
        self._without: tuple[tuple[Errors, ...], tuple[Errors, ...]] | None = None

    def replay(self, params: Any, *, scale: float = 1.0, nominal: bool = False, seconds: float = math.inf) -> Replay:
        """Simulate from every start to the end of its run, or for `seconds`, whichever is shorter.

        **Arguments**

        - `params`: parameters of the residual.
        - `scale`: factor on the residual (0: no residual, 1: full residual).
        - `nominal`: simulate with nominal actuators instead of identified ones.
        - `seconds`: longest time to simulate (s).
        """
        fixed = self._fixed
        if nominal:
            model = jax.device_get(Simulator(self.robot, model=nominal_model(self._simulator)).model)
            unchanged = None if self._simulator.drivetrain is None else identity_drivetrain(len(self.robot.commands))
            fixed = jax.device_put((model, jax.device_get(unchanged), self._reference), self._everywhere)
        params = jax.device_get(params)  # they may be on one device, but the batch is spread over all devices
        starts = np.array(self.starts, np.int32)
        steps = self._steps
        if seconds < math.inf:
            steps = np.minimum(steps, round(seconds / self.robot.control_timestep))
        shape, longest = (len(starts),), int(steps.max())
        features = np.zeros((*shape, longest + 1, self._recorded.shape[-1]), np.float32)
        com, force = np.zeros((*shape, longest + 1, 3), np.float32), np.zeros((*shape, longest, 3), np.float32)
        qpos = np.zeros((*shape, longest + 1, self._reference.qpos.shape[-1]), np.float32)
        recording, first = starts.T
        features[:, 0], com[:, 0] = self._recorded[recording, first], self._recorded_com[recording, first]
        qpos[:, 0] = self._reference.qpos[recording, first]

        order = np.argsort(-steps, kind="stable")  # runs of similar length share a batch
        for batch in np.split(order, range(self._size, len(order), self._size)):
            places = starts[batch[np.arange(self._size) % len(batch)]]
            carry = self._begin(places)
            for done in range(0, int(steps[batch].max()), _CHUNK):
                now = places + np.array([0, done], np.int32)
                carry, seen = self._chunk(params, np.float32(scale), *fixed, carry, now)
                part = slice(done, min(done + _CHUNK, longest))
                after = slice(part.start + 1, part.stop + 1)
                for array, where, values in zip(
                    (features, com, force, qpos), (after, after, part, after), jax.device_get(seen), strict=True
                ):
                    array[batch, where] = values[: len(batch), : part.stop - part.start]
        after_end = np.arange(longest + 1) > steps[:, None]
        for array in (features, com, qpos):
            array[after_end] = np.nan
        force[after_end[:, 1:]] = np.nan
        return Replay(
            features[..., ObservationLayout.position],
            features[..., ObservationLayout.euler_angles],
            self._points(features),
            qpos[..., list(self._joints.values())],
            com,
            force,
            qpos[self.first_runs],
        )

    def _begin(self, places: Int[np.ndarray, "runs 2"]) -> _Run:
        """Return the states of runs that start at recorded `places` (recording, control step)."""
        recording, first = places.T
        earlier = first[:, None] + np.arange(1 - HISTORY, 1)
        qpos, qvel = (np.asarray(x)[recording, first] for x in (self._reference.qpos, self._reference.qvel))
        features, command = (
            np.asarray(x)[recording[:, None], when]
            for x, when in ((self._reference.features, earlier), (self._reference.command, earlier[:, :-1]))
        )
        physics = PhysicsState(qpos, qvel, np.zeros_like(qvel))  # pyright: ignore
        # Nominal actuators have an identity drivetrain, which does not read this state.
        drivetrain = self._reference.drivetrain_at(recording, first)
        rollout = RolloutState(physics, features, command, drivetrain)  # pyright: ignore
        return jax.device_put(_Run(rollout, np.zeros(len(places), bool)), self._split)

    def recorded(self, run: int) -> tuple[Float[np.ndarray, "states 3"], Float[np.ndarray, " states"]]:
        """Return the recorded position (m, world frame) and yaw (rad) of the tracked body, from the start of `run` to
        the end of its recording."""
        states = self._recorded_features(run)
        return states[:, ObservationLayout.position], states[:, ObservationLayout.yaw]

    def _recorded_features(self, run: int) -> Float[np.ndarray, "states features"]:
        recording, start = self.starts[run]
        return self._recorded[recording, start : len(self.motions[recording].qpos)]

    @staticmethod
    def _points(features: Float[np.ndarray, "*runs features"]) -> Float[np.ndarray, "*runs points 3"]:
        return features[..., ObservationLayout.first_point :].reshape(*features.shape[:-1], -1, 6)[..., :3]

    def __call__(self, params: Any) -> Evaluation:
        """Return the errors with the residual, without it, and with nominal actuators.

        The latter two are computed only once.
        """
        if self._without is None:
            self._without = self.errors(self.replay(params, scale=0.0)), self.nominal_errors(params)
        vanilla, nominal = self._without
        return self.compared(vanilla, self.errors(self.replay(params)), nominal)

    def compared(
        self, vanilla: tuple[Errors, ...], residual: tuple[Errors, ...], nominal: tuple[Errors, ...]
    ) -> Evaluation:
        """Return an evaluation of given errors: without and with the residual, and with nominal actuators.

        `nominal` is empty if the actuators of the other two are nominal.
        """
        angle = "yaw" if self.robot.upright else "orientation"
        return Evaluation(vanilla, residual, self.base, self.name, nominal, angle)

    def nominal_errors(self, params: Any) -> tuple[Errors, ...]:
        """Return the errors with nominal actuators and without the residual.

        They do not depend on `params`, which may be any parameters of the residual. The result is empty if the
        simulator's own actuators are nominal.
        """
        if self._simulator.actuators is None:
            return ()
        return self.errors(self.replay(params, scale=0.0, nominal=True))

    def _advance(
        self,
        params: Any,
        scale: Array,
        model: mjx.Model,
        drivetrain: DrivetrainParameters | None,
        reference: ReferenceMotions,
        run: _Run,
        place: Int[Array, " 2"],
    ) -> tuple[_Run, tuple[Array, Array, Array, Array]]:
        """Simulate one run for `_CHUNK` control steps.

        Return the final state, and for each step: features, centre of mass (m), residual force (N) and generalized
        positions.
        """
        recording, start = place
        own = self._simulator.with_model(model).with_drivetrain(drivetrain)
        simulator = own.with_residual(BoundResidual(self._residual, params), scale)

        def step(run: _Run, time: Array) -> tuple[_Run, tuple]:
            after = simulator.step(run.rollout, reference.command[recording, time])
            rollout, recorded = after.state, reference.features[recording, time + 1]
            away = jnp.linalg.norm((rollout.features - recorded)[ObservationLayout.position])
            over = run.over | ~(away < LARGEST) | ~jnp.all(jnp.isfinite(rollout.features))
            seen = rollout.features, after.com, after.action.wrench[0, :3], rollout.physics.qpos
            seen = jax.tree.map(lambda x: jnp.where(over, jnp.nan, x), seen)

            over |= time + 1 >= reference.steps[recording]
            physics = state_at(reference.qpos[recording, time + 1], reference.qvel[recording, time + 1])
            held = rollout._replace(physics=physics, history=jnp.broadcast_to(recorded, rollout.history.shape))
            return _Run(jax.tree.map(functools.partial(jnp.where, over), held, rollout), over), seen

        return jax.lax.scan(step, run, start + jnp.arange(_CHUNK))

    def of_starts(self, motions: Sequence[Motion], params: Any) -> tuple[Errors, ...]:
        """Return the differences between two replays with the residual that differ only in their starting states.

        One starts from `motions`, the other from this evaluator's motions. `motions` are the same recordings in another
        reconstruction, for example after `capture_noise.add_capture_noise`. A simulator's errors cannot be expected to
        be much smaller than these differences.
        """
        return self.errors(self.on(motions).replay(params), self.replay(params))

    def errors(self, replay: Replay, against: Replay | None = None) -> tuple[Errors, ...]:
        """Return the errors of a replay relative to the recordings, or to the replay `against`, by recording."""
        results = []
        for index, motion in enumerate(self.motions):
            runs = [run for run, (recording, _) in enumerate(self.starts) if recording == index]
            found: dict[str, dict[float, list[float]]] = {
                quantity: {h: [] for h in self.horizons} for quantity in _QUANTITIES
            }
            com_error, final_turn, forces, soonest = np.inf, np.inf, [], None
            for run in runs:
                start, states = self.starts[run][1], self._steps[run] + 1
                series = self._differences(replay, run, against)
                forces.append(float(_lengths(replay.force[run, : states - 1]).mean()))
                broken = np.flatnonzero(~(np.abs(series["position"]) < LARGEST) | ~np.isfinite(series["orientation"]))
                if len(broken) and (soonest is None or broken[0] < soonest[1]):
                    soonest = start, int(broken[0])
                for horizon in self.horizons:
                    steps = round(horizon / self.robot.control_timestep)
                    if steps < states:
                        # A start that diverged has no valid error of any quantity, even if its angles are finite.
                        errors = {q: _rms(series[q][1 : steps + 1]) for q in _QUANTITIES if q in series}
                        diverged = has_diverged(errors["position"]) or has_diverged(errors["orientation"])
                        for quantity, error in errors.items():
                            found[quantity][horizon].append(np.inf if diverged else error)
                if run == runs[0]:
                    com_error = _finite(float(series["com"].mean()))
                    final_turn = _finite(float(series["orientation"][-1]))
            position = found["position"]
            means = {name: {h: summarize_starts(v) for h, v in values.items() if v} for name, values in found.items()}
            results.append(
                Errors(
                    recording=motion.name,
                    group=group_of(motion.name),
                    position=means["position"],
                    orientation=means["orientation"],
                    mean_com_error=com_error,
                    final_orientation_error=final_turn,
                    mean_force=summarize_starts(forces)[0],
                    diverged={h: (sum(map(has_diverged, v)), len(v)) for h, v in position.items() if v},
                    points=means["points"],
                    joints=means["joints"],
                    medians={
                        name: {h: median_of_starts(v) for h, v in values.items() if v} for name, values in found.items()
                    },
                    first_diverged=soonest if any(map(has_diverged, itertools.chain(*position.values()))) else None,
                )
            )
        return tuple(results)

    def _differences(
        self, replay: Replay, run: int, against: Replay | None
    ) -> dict[str, Float[np.ndarray, " states"] | Float[np.ndarray, "states several"]]:
        """Return the differences between a run and its recording, or the same run of another replay, by quantity.

        Quantities are the position of the tracked body (m), its orientation (deg), the centre of mass (m), every point
        (m) and every measured hinge (deg). Points and hinges are left out if there are none.
        """
        (recording, start), states = self.starts[run], self._steps[run] + 1
        hinges = list(self._hinges[recording])
        if against is None:
            features = self._recorded_features(run)[:states]
            position, euler = features[:, ObservationLayout.position], features[:, ObservationLayout.euler_angles]
            com, points = self._recorded_com[recording, start : start + states], self._points(features)
            qpos = np.asarray(self._reference.qpos)[recording, start : start + states]
            joints = qpos[:, [self._joints[name] for name in hinges]]
        else:
            columns = [list(self._joints).index(name) for name in hinges]
            position, euler, com, points = (
                x[run, :states] for x in (against.position, against.euler_angles, against.com, against.points)
            )
            joints = against.joints[run, :states][:, columns]
        found = {
            "position": _lengths(replay.position[run, :states] - position),
            "orientation": orientation_errors(replay.euler_angles[run, :states], euler, self.robot.upright),
            "com": _lengths(replay.com[run, :states] - com),
        }
        if points.shape[1]:
            found["points"] = _lengths(replay.points[run, :states] - points)
        if hinges:
            columns = [list(self._joints).index(name) for name in hinges]
            turn = replay.joints[run, :states][:, columns] - joints
            found["joints"] = np.rad2deg(np.arctan2(np.sin(turn), np.cos(turn)))
        return found


_QUANTITIES = ("position", "orientation", "points", "joints")


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


def _lengths(vectors: np.ndarray) -> np.ndarray:
    """Return Euclidean norms along the last axis. In single precision, squares of a diverging state would overflow."""
    return np.linalg.norm(np.asarray(vectors, np.float64), axis=-1)


def _finite(error: float) -> float:
    return np.inf if has_diverged(error) else error
