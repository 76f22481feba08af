"""How well a simulator predicts recordings: open-loop replay of recorded commands from recorded states.

Every recording is started afresh every second and simulated to its end; errors are taken over horizons, for over
a whole recording small errors only compound. The paper's whole-recording figures are reported beside them.
"""

from __future__ import annotations

import copy
import dataclasses
import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int
from mujoco import mjx

from ballu_mjx import envmimic, files, simulation
from ballu_mjx import robot as ballu
from ballu_mjx.errors import InputError, is_number
from ballu_mjx.forces import ForceModel
from ballu_mjx.reconstruction import Motion
from ballu_mjx.robot_description import RobotDescription

HORIZONS = (1.0, 2.0, 5.0, 10.0, 20.0)
"""Seconds over which errors are taken."""
START_INTERVAL = 1.0
"""Seconds between two starts in the same recording."""
SCORE_HORIZONS = (5.0, 10.0)
"""Horizons (s) that the validation score looks at."""
_BALLOON_YAW = 8
_LEAST = 1e-5
"""m or deg: an error below is that of single precision."""
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


@dataclasses.dataclass(frozen=True)
class Errors:
    """Errors of one simulator on one recording; spread is the standard deviation over starts."""

    recording: str
    group: str
    """`near` or `far` where the recording's name begins so, else `all`."""
    position: dict[float, tuple[float, float]]
    """Horizon (s) to mean and spread of the balloon position's RMSE (m)."""
    yaw: dict[float, tuple[float, float]]
    """Horizon (s) to mean and spread of the yaw's RMSE (deg)."""
    mean_com_error: float
    """Mean distance (m) of the centres of mass over the whole recording (paper, Table I, open loop)."""
    final_yaw_error: float
    """Simulated less recorded yaw (deg) at the end of the recording (paper, Table II, open loop)."""
    mean_force: float
    """Mean magnitude of the residual force (N)."""


GROUPS = ("near", "far", "all")
"""What recordings are reported in."""


def group_of(name: str) -> str:
    """The group a recording is reported in."""
    head = name.split("-")[0]
    return head if head in GROUPS else "all"


def base_name(identified: bool) -> str:
    """What the simulator without residual forces is called, with identified or nominal actuators."""
    return "vanilla+sysid" if identified else "vanilla"


def quotient(with_it: float, without: float) -> float:
    """Error with a residual over error without; 1 where there is none either way, as of the yaw of a robot that cannot
    turn."""
    return max(with_it, _LEAST) / max(without, _LEAST)


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """A simulator's errors beside vanilla's, on the same recordings and starts."""

    vanilla: tuple[Errors, ...]
    residual: tuple[Errors, ...]
    base: str = "vanilla"
    """What the simulator without the residual is called."""
    name: str = "envmimic"
    """What the simulator with it is called."""

    @property
    def groups(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(errors.group for errors in self.vanilla))

    def ratio(self, group: str, quantity: str, horizon: float) -> float:
        """`quotient` of the errors with the residual and without, each averaged over the group's recordings."""
        with_it, without = (_group_mean(e, group, quantity, horizon) for e in (self.residual, self.vanilla))
        return quotient(with_it, without)

    @property
    def score(self) -> float:
        """What choices are made by, on validation recordings: the mean ratio to vanilla, position and yaw alike.

        Averaged over groups and over `SCORE_HORIZONS`, or over the longest horizon where recordings are shorter. Worst
        cases stay out of it: at 20 s they are a matter of luck, and choosing by them chose untrained policies.
        """
        ratios = []
        for group in self.groups:
            reached = {horizon for e in self.vanilla if e.group == group for horizon in e.position}
            for horizon in reached.intersection(SCORE_HORIZONS) or {max(reached)}:
                ratios += [self.ratio(group, quantity, horizon) for quantity in ("position", "yaw")]
        return float(np.mean(ratios))

    def excess(self) -> tuple[float, str]:
        """Worst case over recordings and horizons of the residual's error beyond 1.2 vanilla + (2 cm or 3 deg).

        Given in units of that bound (0.1: ten per cent beyond it; negative: within), with where it is.
        """
        worst, place = -np.inf, ""
        for base, mimic in zip(self.vanilla, self.residual, strict=True):
            for quantity, allowance, unit in (("position", 0.02, "m"), ("yaw", 3.0, "deg")):
                for horizon, (value, _) in getattr(mimic, quantity).items():
                    bound = 1.2 * getattr(base, quantity)[horizon][0] + allowance
                    if value / bound - 1 > worst:
                        worst = value / bound - 1
                        place = (
                            f"{quantity} of {mimic.recording} at {horizon:g} s: {value:.3f} {unit}, bound {bound:.3f}"
                        )
        return float(worst), place

    def table(self) -> str:
        """Errors by group and horizon, without and with the residual, with the spread over starts; then the whole
        recordings."""
        base, name = self.base, self.name
        wide, narrow = max(16, len(name) + 2), max(13, len(name) + 2)
        lines = [
            f"{'':7}{'horizon':>8} |{'position RMSE (m)':^{wide + 23}}| {'yaw RMSE (deg)':^{wide + 22}}",
            f"{'':7}{'(s)':>8} |{base:>14}{name:>{wide}}{'ratio':>8} | {base:>13}{name:>{wide}}{'ratio':>8}",
        ]
        for group in self.groups:
            for horizon in HORIZONS:
                if not any(horizon in e.position for e in self.vanilla if e.group == group):
                    continue
                cells = []
                for quantity, digits in (("position", 3), ("yaw", 1)):
                    for errors in (self.vanilla, self.residual):
                        mean = _group_mean(errors, group, quantity, horizon)
                        spread = _group_mean(errors, group, quantity, horizon, place=1)
                        cells.append(f"{mean:.{digits}f} ± {spread:.{digits}f}")
                    cells.append(f"{self.ratio(group, quantity, horizon):.2f}")
                lines.append(
                    f"{group:7}{horizon:>8g} |{cells[0]:>14}{cells[1]:>{wide}}{cells[2]:>8} | "
                    f"{cells[3]:>13}{cells[4]:>{wide}}{cells[5]:>8}"
                )
        lines += [
            "",
            f"{'whole recording':24}{'mean CoM error (m)':>{15 + narrow}}{'final yaw error (deg)':>{15 + narrow}}",
        ]
        lines.append(f"{'':24}{base:>15}{name:>{narrow}}{base:>15}{name:>{narrow}}")
        for without, mimic in zip(self.vanilla, self.residual, strict=True):
            lines.append(
                f"{without.recording:24}{without.mean_com_error:>15.3f}{mimic.mean_com_error:>{narrow}.3f}"
                f"{without.final_yaw_error:>15.1f}{mimic.final_yaw_error:>{narrow}.1f}"
            )
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """All figures, as plain lists and numbers."""
        worst, place = self.excess()
        return {
            "base": self.base,
            "name": self.name,
            "score": self.score,
            "worst_beyond_bound": {"relative": worst, "where": place},
            "vanilla": [dataclasses.asdict(errors) for errors in self.vanilla],
            "residual": [dataclasses.asdict(errors) for errors in self.residual],
        }

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> Evaluation:
        """The inverse of `to_json`.

        **Raises** `ValueError`, `TypeError`, `KeyError` or `AttributeError` for what is none.
        """

        def number(value: Any) -> float:
            if not is_number(value):
                raise ValueError(f"{reprlib.repr(value)} is no number")
            return float(value)

        def text(value: Any) -> str:
            if not isinstance(value, str):
                raise ValueError(f"{reprlib.repr(value)} is no text")
            return value

        def table(values: Any) -> dict[float, tuple[float, float]]:
            found = {float(horizon[:8]): (number(mean), number(spread)) for horizon, (mean, spread) in values.items()}
            if not all(horizon in HORIZONS for horizon in found):
                raise ValueError(f"errors are taken over {HORIZONS} s, not {reprlib.repr(list(found))}")
            if not all(0 <= error < 1e9 and spread >= 0 for error, spread in found.values()):
                raise ValueError("errors and their spreads are 0 or more")
            return found

        def errors(row: Any) -> Errors:
            found = Errors(
                recording=text(row["recording"]),
                group=text(row["group"]),
                position=table(row["position"]),
                yaw=table(row["yaw"]),
                mean_com_error=number(row["mean_com_error"]),
                final_yaw_error=number(row["final_yaw_error"]),
                mean_force=number(row["mean_force"]),
            )
            if found.group not in GROUPS or not found.position or found.position.keys() != found.yaw.keys():
                raise ValueError(f"{reprlib.repr(found.recording)} has no group or not the same horizons for both")
            return found

        without, mimic = (tuple(map(errors, content[which])) for which in ("vanilla", "residual"))
        if not without or [_compared(e) for e in without] != [_compared(e) for e in mimic]:
            raise ValueError("there are not the same recordings and horizons without the residual and with it")
        return Evaluation(without, mimic, text(content["base"]), text(content["name"]))


def _compared(errors: Errors) -> tuple[str, str, set[float]]:
    return errors.recording, errors.group, set(errors.position)


def read(path: Path) -> Evaluation:
    """The evaluation in a file, `evaluation.json` of a run, say.

    **Raises** `InputError` where it is none.
    """
    mend = f"`python -m ballu_mjx.evaluate {path.parent} --output {path.parent}` writes it again"
    content = files.read_json(path, mend)
    try:
        return Evaluation.from_json(content)
    except KeyError as error:
        raise InputError(f"{path}: is no evaluation ({error} is missing); {mend}.") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: is no evaluation ({error}); {mend}.") from error


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
        self._simulator = envmimic.Simulator(model, robot)
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
        reference, com = envmimic.stack(self._simulator, motions)
        self._recorded, self._recorded_com = np.asarray(reference.features), np.asarray(com)
        self._reference = jax.device_get(envmimic.roomy(reference))
        self._fixed = jax.device_put((jax.device_get(self._simulator.model), self._reference), self._everywhere)
        interval = round(START_INTERVAL / ballu.CONTROL_TIMESTEP)
        self.starts = [
            (index, start)
            for index, motion in enumerate(self.motions)
            for start in range(envmimic.HISTORY - 1, len(motion.command) - interval + 1, interval)
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

    def _begin(self, places: Int[np.ndarray, "runs 2"]) -> tuple[simulation.State, Float[Array, "runs 3 features"]]:
        """States at their places (recording, control step), and what was seen of the last three."""
        recording, first = places.T
        earlier = first[:, None] + np.arange(1 - envmimic.HISTORY, 1)
        qvel = self._reference.qvel[recording, first]
        state = simulation.State(self._reference.qpos[recording, first], qvel, np.zeros_like(qvel))  # pyright: ignore
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
        reference: envmimic.Reference,
        carry: tuple[simulation.State, Array],
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
            commands = envmimic.commands_seen(reference.command[recording], time)
            wrench = scale * residual.wrench(params, history, commands)
            command = (1 - scale) * commands[-1] + scale * residual.command(params, commands)
            state = simulator.step(state, command, wrench)
            seen, com = simulator.observe(state)
            history = jnp.concatenate([history[1:], seen[None]])
            return (state, history), (seen, com, wrench[0, :3], state.qpos)

        return jax.lax.scan(step, carry, start + jnp.arange(_CHUNK))

    def of_starts(self, motions: Sequence[Motion], params: Any) -> tuple[Errors, ...]:
        """What the simulator with the residual is off from itself when it starts from the states of `motions`: the same
        recordings reconstructed otherwise, from `reconstruction.noisier` ones, say. No simulator can be expected to be
        much nearer to what was recorded."""
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
                    steps = round(horizon / ballu.CONTROL_TIMESTEP)
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


def grouped(errors: Sequence[Errors]) -> tuple[Errors, ...]:
    """The means of each group's recordings, as one recording named after it."""
    groups = dict.fromkeys(e.group for e in errors)
    return tuple(_mean([e for e in errors if e.group == group]) for group in groups)


def _mean(errors: Sequence[Errors]) -> Errors:
    """Of recordings of one group; named after it."""
    group = errors[0].group

    def over(quantity: str) -> dict[float, tuple[float, float]]:
        reached = [horizon for horizon in HORIZONS if any(horizon in e.position for e in errors)]
        return {
            h: (_group_mean(errors, group, quantity, h), _group_mean(errors, group, quantity, h, 1)) for h in reached
        }

    whole = (float(np.mean([getattr(e, name) for e in errors])) for name in _WHOLE)
    return Errors(group, group, over("position"), over("yaw"), *whole)


_WHOLE = ("mean_com_error", "final_yaw_error", "mean_force")


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


def _mean_spread(values: list[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values))


def _group_mean(errors: Sequence[Errors], group: str, quantity: str, horizon: float, place: int = 0) -> float:
    values = [getattr(e, quantity)[horizon][place] for e in errors if e.group == group and horizon in e.position]
    return float(np.mean(values))
