"""How well a simulator predicts recordings: open-loop replay of recorded commands from recorded states.

Every recording is started afresh every second and simulated to its end; errors are taken over horizons, for over
a whole recording small errors only compound. The paper's whole-recording figures are reported beside them.
"""

from __future__ import annotations

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


class Replay(NamedTuple):
    """Simulated runs from recorded states, time first point included."""

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
    """Replays a set of recordings; compiles once, for any parameters of the residual."""

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
        self.motions = tuple(motions)
        self._simulator = envmimic.Simulator(model, robot)
        self.robot = self._simulator.robot
        self._reference, com = envmimic.stack(self._simulator, motions)
        self._recorded_com = np.asarray(com)
        self._recorded = np.asarray(self._reference.features)
        interval = round(START_INTERVAL / ballu.CONTROL_TIMESTEP)
        self.starts = [
            (index, start)
            for index, motion in enumerate(self.motions)
            for start in range(envmimic.HISTORY - 1, len(motion.command) - interval + 1, interval)
        ]
        self._vanilla: tuple[Errors, ...] | None = None
        length = max(len(motion.command) for motion in motions) - (envmimic.HISTORY - 1)
        # Pad the batch to the devices, and let XLA split it: one core a device.
        devices = jax.local_devices()
        padded = self.starts + [self.starts[0]] * (-len(self.starts) % len(devices))
        mesh = jax.sharding.Mesh(np.array(devices), ("batch",))
        sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("batch"))
        self._batch = jax.device_put(jnp.array(padded, jnp.int32), sharding)

        def replay(params: Any, scale: Array, batch: Int[Array, "runs 2"]) -> Any:
            return jax.vmap(lambda run: self._replay_one(residual, params, scale, run[0], run[1], length))(batch)

        spec = jax.sharding.PartitionSpec
        split = jax.shard_map(
            replay, mesh=mesh, in_specs=(spec(), spec(), spec("batch")), out_specs=spec("batch"), check_vma=False
        )
        recordings = [recording for recording, _ in self.starts]
        # Of each recording, the place in `starts` of the run over (nearly) all of it.
        self.first_runs = [recordings.index(index) for index in range(len(self.motions))]

        def replay_all(params: Any, scale: Array, batch: Int[Array, "runs 2"]) -> Any:
            # Positions of every start would be as much again as all else that comes back.
            *seen, qpos = split(params, scale, batch)
            return *seen, qpos[jnp.array(self.first_runs)]

        self._replay = jax.jit(replay_all)

    def replay(self, params: Any, *, scale: float = 1.0) -> Replay:
        """Simulate every start to the end; `scale` is the residual's share (0: none, 1: all of it)."""
        params = jax.device_get(params)  # they may live on one device; the batch is spread over all
        features, com, force, qpos = jax.device_get(self._replay(params, np.float32(scale), self._batch))
        runs = len(self.starts)
        return Replay(features[:runs, :, :3], features[:runs, :, _BALLOON_YAW], com[:runs], force[:runs], qpos)

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

    def _replay_one(
        self,
        residual: ForceModel,
        params: Any,
        scale: Array,
        recording: Array,
        start: Array,
        length: int,
    ) -> tuple[Array, Array, Array, Array]:
        reference, own = self._reference, self._simulator.model
        fields = {
            name: (1 - scale) * getattr(own, name) + scale * value for name, value in residual.fields(params).items()
        }
        simulator = self._simulator.altered(fields)
        history = jax.lax.dynamic_slice_in_dim(
            reference.features[recording], start - envmimic.HISTORY + 1, envmimic.HISTORY
        )

        def step(carry: tuple, time: Array) -> tuple[tuple, tuple]:
            state, history = carry
            commands = envmimic.commands_seen(reference.command[recording], time)
            wrench = scale * residual.wrench(params, history, commands)
            command = (1 - scale) * commands[-1] + scale * residual.command(params, commands)
            state = simulator.step(state, command, wrench)
            seen, com = simulator.observe(state)
            history = jnp.concatenate([history[1:], seen[None]])
            return (state, history), (seen, com, wrench[0, :3], state.qpos)

        first_state = simulation.at(reference.qpos[recording, start], reference.qvel[recording, start])
        first, first_com = simulator.observe(first_state)
        _, (features, com, force, qpos) = jax.lax.scan(step, (first_state, history), start + jnp.arange(length))
        features, com, qpos = (
            jnp.concatenate([x[None], xs]) for x, xs in ((first, features), (first_com, com), (first_state.qpos, qpos))
        )
        return features, com, force, qpos

    def errors(self, replay: Replay) -> tuple[Errors, ...]:
        """Errors of a replay, by recording."""
        results = []
        for index, motion in enumerate(self.motions):
            runs = [run for run, (recording, _) in enumerate(self.starts) if recording == index]
            position: dict[float, list[float]] = {h: [] for h in HORIZONS}
            yaw: dict[float, list[float]] = {h: [] for h in HORIZONS}
            com_error, final_yaw, forces = float("nan"), float("nan"), []
            for run in runs:
                recorded_position, recorded_yaw = self.recorded(run)
                states = len(recorded_yaw)
                distance = np.linalg.norm(replay.position[run, :states] - recorded_position, axis=-1)
                turn = replay.yaw[run, :states] - recorded_yaw
                turn = np.rad2deg(np.arctan2(np.sin(turn), np.cos(turn)))
                forces.append(np.linalg.norm(replay.force[run, : states - 1], axis=-1).mean())
                for horizon in HORIZONS:
                    steps = round(horizon / ballu.CONTROL_TIMESTEP)
                    if steps < states:
                        position[horizon].append(_rms(distance[1 : steps + 1]))
                        yaw[horizon].append(_rms(turn[1 : steps + 1]))
                if run == runs[0]:
                    start = self.starts[run][1]
                    recorded_com = self._recorded_com[index, start : start + states]
                    com_error = float(np.linalg.norm(replay.com[run, :states] - recorded_com, axis=-1).mean())
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


def _group_mean(errors: Sequence[Errors], group: str, quantity: str, horizon: float, place: int = 0) -> float:
    values = [getattr(e, quantity)[horizon][place] for e in errors if e.group == group and horizon in e.position]
    return float(np.mean(values))
