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

from ballu_mjx.evaluation.errors_table import HORIZONS, Errors, Evaluation
from ballu_mjx.recordings.groups import group_of
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import ReferenceMotions, pad_to_bucket, stack_motions
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import CONTROL_TIMESTEP
from ballu_mjx.sim.force_model import ForceModel
from ballu_mjx.sim.observation import HISTORY, commands_seen
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.sim.step import PhysicsState

START_INTERVAL = 1.0
"""Seconds between two starts in the same recording."""
_BALLOON_YAW = 8
_RUNS = {True: 64, False: 1024}
"""Runs side by side on each device; on a CPU, and elsewhere. Fewer are filled up, more go batch after batch."""
_CHUNK = 100
"""Control steps that the compiled program does at a time: one program for recordings of all lengths."""


class Replay(NamedTuple):
    """Simulated runs from recorded states, time first point included; what stands behind a recording's end means
    nothing."""

    position: Float[np.ndarray, "runs states 3"]
    """Balloon (m, world)."""
    yaw: Float[np.ndarray, "runs states"]
    """Balloon (rad), not unwrapped."""
    com: Float[np.ndarray, "runs states 3"]
    """Centre of mass (m, world)."""
    force: Float[np.ndarray, "runs steps 3"]
    """Residual force (N, world)."""
    qpos: Float[np.ndarray, "recordings states nq"]
    """Generalized positions from each recording's first start."""


class OpenLoopEvaluator:
    """Replays a set of recordings; one compiled program for any parameters of the residual, any recordings and
    actuators."""

    def __init__(
        self,
        model: mujoco.MjModel,
        motions: Sequence[Motion],
        residual: ForceModel,
        base: str = "vanilla",
        robot: RobotDescription | None = None,
    ) -> None:
        """`base` is what `model`, the simulator without the residual, is called; `robot` says what is what in it (None:
        it is BALLU)."""
        self.base, self.name = base, residual.name
        self._residual = residual
        self._simulator = Simulator(model, robot)
        self.robot = self._simulator.robot
        devices = jax.local_devices()
        self._size = len(devices) * _RUNS[devices[0].platform == "cpu"]
        mesh = jax.sharding.Mesh(np.array(devices), ("batch",))
        spec = jax.sharding.PartitionSpec
        self._everywhere = jax.sharding.NamedSharding(mesh, spec())
        self._split = jax.sharding.NamedSharding(mesh, spec("batch"))
        # XLA splits the batch over the devices: one core a device.
        split = jax.shard_map(
            jax.vmap(self._advance, in_axes=(None, None, None, None, 0, 0)),
            mesh=mesh,
            in_specs=(spec(), spec(), spec(), spec(), spec("batch"), spec("batch")),
            out_specs=spec("batch"),
            check_vma=False,
        )
        self._chunk = jax.jit(split)
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
        self._fixed = jax.device_put((jax.device_get(self._simulator.model), self._reference), self._everywhere)
        interval = round(START_INTERVAL / CONTROL_TIMESTEP)
        self.starts = [
            (index, start)
            for index, motion in enumerate(self.motions)
            for start in range(HISTORY - 1, len(motion.command) - interval + 1, interval)
        ]
        recordings = [recording for recording, _ in self.starts]
        # Of each recording, the place in `starts` of the run over (nearly) all of it.
        self.first_runs = [recordings.index(index) for index in range(len(self.motions))]
        self._vanilla: tuple[Errors, ...] | None = None

    def replay(self, params: Any, *, scale: float = 1.0) -> Replay:
        """Simulate every start to its recording's end; `scale` is the residual's share (0: none, 1: all of it)."""
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
                carry, seen = self._chunk(params, np.float32(scale), *self._fixed, carry, now)
                part = slice(done, min(done + _CHUNK, longest))
                after = slice(part.start + 1, part.stop + 1)
                for array, where, values in zip(
                    (features, com, force, qpos), (after, after, part, after), jax.device_get(seen), strict=True
                ):
                    array[batch, where] = values[: len(batch), : part.stop - part.start]
        return Replay(features[..., :3], features[..., _BALLOON_YAW], com, force, qpos[self.first_runs])

    def _begin(self, places: Int[np.ndarray, "runs 2"]) -> tuple[PhysicsState, Float[Array, "runs 3 features"]]:
        """States at their places (recording, control step), and what was seen of the last three."""
        recording, first = places.T
        earlier = first[:, None] + np.arange(1 - HISTORY, 1)
        qvel = self._reference.qvel[recording, first]
        state = PhysicsState(self._reference.qpos[recording, first], qvel, np.zeros_like(qvel))  # pyright: ignore
        return jax.device_put((state, self._reference.features[recording[:, None], earlier]), self._split)

    def recorded(self, run: int) -> tuple[Float[np.ndarray, "states 3"], Float[np.ndarray, " states"]]:
        """Recorded balloon position (m) and yaw (rad) from the start of `run` to the recording's end."""
        recording, start = self.starts[run]
        states = self._recorded[recording, start : len(self.motions[recording].qpos)]
        return states[:, :3], states[:, _BALLOON_YAW]

    def __call__(self, params: Any) -> Evaluation:
        """Errors of the simulator with the residual, beside those of the one without."""
        if self._vanilla is None:
            self._vanilla = self.errors(self.replay(params, scale=0.0))
        return Evaluation(self._vanilla, self.errors(self.replay(params)), self.base, self.name)

    def _advance(
        self,
        params: Any,
        scale: Array,
        model: mjx.Model,
        reference: ReferenceMotions,
        carry: tuple[PhysicsState, Array],
        place: Int[Array, " 2"],
    ) -> tuple[Any, tuple[Array, Array, Array, Array]]:
        """One run, on by `_CHUNK` control steps: what the next ones start from, and features, centre of mass, force and
        generalized positions after each."""
        residual = self._residual
        recording, start = place
        fields = {
            name: (1 - scale) * getattr(model, name) + scale * value for name, value in residual.fields(params).items()
        }
        simulator = self._simulator.of(model).altered(fields)

        def step(carry: tuple, time: Array) -> tuple[tuple, tuple]:
            state, history = carry
            commands = commands_seen(reference.command[recording], time)
            wrench = scale * residual.wrench(params, history, commands)
            command = (1 - scale) * commands[-1] + scale * residual.command(params, commands)
            state = simulator.step(state, command, wrench)
            seen, com = simulator.observe(state)
            history = jnp.concatenate([history[1:], seen[None]])
            return (state, history), (seen, com, wrench[0, :3], state.qpos)

        return jax.lax.scan(step, carry, start + jnp.arange(_CHUNK))

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
            com_error, final_yaw, forces = float("nan"), float("nan"), []
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
                forces.append(np.linalg.norm(replay.force[run, : states - 1], axis=-1).mean())
                for horizon in HORIZONS:
                    steps = round(horizon / CONTROL_TIMESTEP)
                    if steps < states:
                        position[horizon].append(_rms(distance[1 : steps + 1]))
                        yaw[horizon].append(_rms(turn[1 : steps + 1]))
                if run == runs[0]:
                    com_error = float(np.linalg.norm(replay.com[run, :states] - other_com, axis=-1).mean())
                    final_yaw = float(turn[-1])
            results.append(
                Errors(
                    recording=motion.name,
                    group=group_of(motion.name),
                    position={h: _mean_spread(v) for h, v in position.items() if v},
                    yaw={h: _mean_spread(v) for h, v in yaw.items() if v},
                    mean_com_error=com_error,
                    final_yaw_error=final_yaw,
                    mean_force=float(np.mean(forces)),
                )
            )
        return tuple(results)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


def _mean_spread(values: list[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values))
