"""How well a simulator predicts recordings: open-loop replay of recorded commands from recorded states.

Every recording is started afresh every second and simulated to its end; errors are taken over horizons, for over
a whole recording small errors only compound. The paper's whole-recording figures are reported beside them.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int
from mujoco import mjx

from ballu_mjx.evaluation.errors_table import HORIZONS, Errors, Evaluation, base_name, has_diverged, summarize_starts
from ballu_mjx.identification.parameters import LEAST_FRICTION
from ballu_mjx.recordings.groups import group_of
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import ReferenceMotions, pad_to_bucket, stack_motions
from ballu_mjx.sim.drivetrain import DrivetrainParameters, identity_drivetrain
from ballu_mjx.sim.force_model import BoundForces, ForceModel
from ballu_mjx.sim.observation import HISTORY, ObservationLayout
from ballu_mjx.sim.sharding import compile_for_devices, device_shardings
from ballu_mjx.sim.simulator import AugmentedSimulator, RolloutState, Simulator
from ballu_mjx.sim.step import PhysicsState

START_INTERVAL = 1.0
"""Seconds between two starts in the same recording."""
_RUNS = {True: 64, False: 1024}
"""Runs side by side on each device; on a CPU, and elsewhere. Fewer are filled up, more go batch after batch."""
_CHUNK = 100
"""Control steps that the compiled program does at a time: one program for recordings of all lengths."""


class Replay(NamedTuple):
    """Simulated runs from recorded states, time first point included; what stands behind a recording's end means
    nothing."""

    position: Float[np.ndarray, "runs states 3"]
    """Of the tracked body (m, world)."""
    yaw: Float[np.ndarray, "runs states"]
    """Of the tracked body (rad), not unwrapped."""
    com: Float[np.ndarray, "runs states 3"]
    """Centre of mass (m, world)."""
    force: Float[np.ndarray, "runs steps 3"]
    """Residual force (N, world)."""
    qpos: Float[np.ndarray, "recordings states nq"]
    """Generalized positions from each recording's first start."""


def evaluate(simulator: AugmentedSimulator, motions: Sequence[Motion]) -> Evaluation:
    """Return how well a simulator with a residual predicts recorded motions, beside the one without it.

    **Raises** `ValueError` where the simulator has no residual.
    """
    if simulator.residual is None:
        raise ValueError("The simulator has no residual; give one that `with_residual` made.")
    evaluator = Evaluators(simulator.without_residual()).of(simulator.residual.model, motions)
    return evaluator(simulator.residual.params)


class Evaluators:
    """Evaluators of one simulator: those of the same residual share a compiled program."""

    def __init__(self, simulator: Simulator) -> None:
        """`simulator` is the one without residual."""
        self._simulator = simulator
        self._made: list[tuple[ForceModel, Sequence[Motion], OpenLoopEvaluator]] = []

    def of(self, residual: ForceModel, motions: Sequence[Motion]) -> OpenLoopEvaluator:
        """Return the evaluator of `residual` on `motions`; the same one for the same arguments."""
        made = None
        for known, on, evaluator in self._made:
            if known is residual and on is motions:
                return evaluator
            made = evaluator if known is residual else made
        base = base_name(self._simulator.actuators is not None)
        made = OpenLoopEvaluator(self._simulator, motions, residual, base) if made is None else made.on(motions)
        self._made.append((residual, motions, made))
        return made


def nominal_model(simulator: Simulator) -> mujoco.MjModel:
    """Return the nominal robot, with dry friction of no effect where the simulated one has any: both share a program,
    and so their rows of constraints."""
    model = simulator.robot.load_model()
    for name in ("dof_frictionloss", "tendon_frictionloss"):
        field, rubbing = getattr(model, name), getattr(simulator.mj_model, name) > 0
        field[rubbing] = np.maximum(field[rubbing], LEAST_FRICTION)
    return model


class OpenLoopEvaluator:
    """Replays a set of recordings; one compiled program for any parameters of the residual, any recordings and
    actuators."""

    def __init__(
        self,
        simulator: Simulator,
        motions: Sequence[Motion],
        residual: ForceModel,
        base: str = "vanilla",
    ) -> None:
        """Prepare to replay `motions` in `simulator` without and with `residual`; `base` is the name without it."""
        self.base, self.name = base, residual.name
        self._residual = residual
        self._simulator = simulator
        self.robot = simulator.robot
        devices = jax.local_devices()
        self._size = len(devices) * _RUNS[devices[0].platform == "cpu"]
        self._everywhere, self._split = device_shardings()
        self._chunk = compile_for_devices(self._advance, shared=5)
        self._look_at(motions)

    def on(self, motions: Sequence[Motion]) -> OpenLoopEvaluator:
        """The same for other recordings, with the program that is compiled already."""
        other = copy.copy(self)
        other._look_at(motions)
        return other

    def _look_at(self, motions: Sequence[Motion]) -> None:
        self.motions = tuple(motions)
        reference, com = stack_motions(self._simulator, motions)
        self._recorded, self._recorded_com = np.asarray(reference.features), np.asarray(com)
        self._reference = jax.device_get(pad_to_bucket(reference))
        own = self._simulator.model, self._simulator.drivetrain
        self._fixed = jax.device_put((*jax.device_get(own), self._reference), self._everywhere)
        interval = round(START_INTERVAL / self.robot.control_timestep)
        self.starts = [
            (index, start)
            for index, motion in enumerate(self.motions)
            for start in range(HISTORY - 1, len(motion.command) - interval + 1, interval)
        ]
        recordings = [recording for recording, _ in self.starts]
        # Of each recording, the place in `starts` of the run over (nearly) all of it.
        self.first_runs = [recordings.index(index) for index in range(len(self.motions))]
        self._without: tuple[tuple[Errors, ...], tuple[Errors, ...]] | None = None

    def replay(self, params: Any, *, scale: float = 1.0, nominal: bool = False) -> Replay:
        """Simulate every start to its recording's end.

        **Arguments**

        - `scale`: the residual's share (0: none, 1: all of it).
        - `nominal`: simulate with nominal actuators instead of identified ones.
        """
        fixed = self._fixed
        if nominal:
            model = jax.device_get(Simulator(self.robot, model=nominal_model(self._simulator)).model)
            unchanged = None if self._simulator.drivetrain is None else identity_drivetrain(len(self.robot.commands))
            fixed = jax.device_put((model, jax.device_get(unchanged), self._reference), self._everywhere)
        params = jax.device_get(params)  # they may live on one device; the batch is spread over all
        starts = np.array(self.starts, np.int32)
        steps = np.array([len(self.motions[recording].command) - start for recording, start in self.starts])
        shape, longest = (len(starts),), int(steps.max())
        features = np.zeros((*shape, longest + 1, self._recorded.shape[-1]), np.float32)
        com, force = np.zeros((*shape, longest + 1, 3), np.float32), np.zeros((*shape, longest, 3), np.float32)
        qpos = np.zeros((*shape, longest + 1, self._reference.qpos.shape[-1]), np.float32)
        recording, first = starts.T
        features[:, 0], com[:, 0] = self._recorded[recording, first], self._recorded_com[recording, first]
        qpos[:, 0] = self._reference.qpos[recording, first]

        order = np.argsort(-steps, kind="stable")  # batches of runs that end at about the same time
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
        return Replay(
            features[..., ObservationLayout.position],
            features[..., ObservationLayout.yaw],
            com,
            force,
            qpos[self.first_runs],
        )

    def _begin(self, places: Int[np.ndarray, "runs 2"]) -> RolloutState:
        """Return the recorded states at their places (recording, control step)."""
        recording, first = places.T
        earlier = first[:, None] + np.arange(1 - HISTORY, 1)
        qpos, qvel = (np.asarray(x)[recording, first] for x in (self._reference.qpos, self._reference.qvel))
        features, command = (
            np.asarray(x)[recording[:, None], when]
            for x, when in ((self._reference.features, earlier), (self._reference.command, earlier[:, :-1]))
        )
        physics = PhysicsState(qpos, qvel, np.zeros_like(qvel))  # pyright: ignore
        # Nominal actuators, which pass commands on, read nothing of the drivetrain's state.
        drivetrain = self._reference.drivetrain_at(recording, first)
        return jax.device_put(RolloutState(physics, features, command, drivetrain), self._split)  # pyright: ignore

    def recorded(self, run: int) -> tuple[Float[np.ndarray, "states 3"], Float[np.ndarray, " states"]]:
        """Return the tracked body's recorded position (m) and yaw (rad), from the start of `run` to the end."""
        recording, start = self.starts[run]
        states = self._recorded[recording, start : len(self.motions[recording].qpos)]
        return states[:, ObservationLayout.position], states[:, ObservationLayout.yaw]

    def __call__(self, params: Any) -> Evaluation:
        """Return errors of the simulator with the residual, beside those of the ones without."""
        if self._without is None:
            self._without = self.errors(self.replay(params, scale=0.0)), self.nominal_errors(params)
        vanilla, nominal = self._without
        return Evaluation(vanilla, self.errors(self.replay(params)), self.base, self.name, nominal)

    def nominal_errors(self, params: Any) -> tuple[Errors, ...]:
        """Return errors with nominal actuators and without the residual, of which `params` are any; empty where the
        simulator's own actuators are nominal."""
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
        rollout: RolloutState,
        place: Int[Array, " 2"],
    ) -> tuple[RolloutState, tuple[Array, Array, Array, Array]]:
        """One run, on by `_CHUNK` control steps: what the next ones start from, and features, centre of mass, force and
        generalized positions after each."""
        recording, start = place
        own = self._simulator.with_model(model).with_drivetrain(drivetrain)
        simulator = own.with_residual(BoundForces(self._residual, params), scale)

        def step(rollout: RolloutState, time: Array) -> tuple[RolloutState, tuple]:
            after = simulator.step(rollout, reference.command[recording, time])
            return after.state, (after.state.features, after.com, after.wrench[0, :3], after.state.physics.qpos)

        return jax.lax.scan(step, rollout, start + jnp.arange(_CHUNK))

    def of_starts(self, motions: Sequence[Motion], params: Any) -> tuple[Errors, ...]:
        """Return how far the simulator with the residual is from itself when it starts from the states of `motions`.

        `motions` are the same recordings, reconstructed otherwise, such as after `motion.add_capture_noise`. A
        simulator cannot be expected to be much nearer to what was recorded."""
        return self.errors(self.on(motions).replay(params), self.replay(params))

    def errors(self, replay: Replay, against: Replay | None = None) -> tuple[Errors, ...]:
        """Errors of a replay, by recording: beside what was recorded, or beside another replay."""
        results = []
        for index, motion in enumerate(self.motions):
            runs = [run for run, (recording, _) in enumerate(self.starts) if recording == index]
            position: dict[float, list[float]] = {h: [] for h in HORIZONS}
            yaw: dict[float, list[float]] = {h: [] for h in HORIZONS}
            com_error, final_yaw, forces = np.inf, np.inf, []
            for run in runs:
                start = self.starts[run][1]
                states = len(motion.qpos) - start
                if against is None:
                    other_position, other_yaw = self.recorded(run)
                    other_com = self._recorded_com[index, start : start + states]
                else:
                    other_position, other_yaw, other_com = (
                        x[run, :states] for x in (against.position, against.yaw, against.com)
                    )
                distance = np.linalg.norm(replay.position[run, :states] - other_position, axis=-1)
                turn = replay.yaw[run, :states] - other_yaw
                turn = np.rad2deg(np.arctan2(np.sin(turn), np.cos(turn)))
                forces.append(float(np.linalg.norm(replay.force[run, : states - 1], axis=-1).mean()))
                for horizon in HORIZONS:
                    steps = round(horizon / self.robot.control_timestep)
                    if steps < states:
                        # A start that diverged counts for neither: its angles may still be numbers.
                        far, turned = _rms(distance[1 : steps + 1]), _rms(turn[1 : steps + 1])
                        broken = has_diverged(far) or has_diverged(turned)
                        position[horizon].append(np.inf if broken else far)
                        yaw[horizon].append(np.inf if broken else turned)
                if run == runs[0]:
                    com_error = _finite(float(np.linalg.norm(replay.com[run, :states] - other_com, axis=-1).mean()))
                    final_yaw = _finite(float(turn[-1]))
            results.append(
                Errors(
                    recording=motion.name,
                    group=group_of(motion.name),
                    position={h: summarize_starts(v) for h, v in position.items() if v},
                    yaw={h: summarize_starts(v) for h, v in yaw.items() if v},
                    mean_com_error=com_error,
                    final_yaw_error=final_yaw,
                    mean_force=summarize_starts(forces)[0],
                    diverged={h: (sum(map(has_diverged, v)), len(v)) for h, v in position.items() if v},
                )
            )
        return tuple(results)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


def _finite(error: float) -> float:
    return np.inf if has_diverged(error) else error
