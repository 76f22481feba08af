"""What the experiments with residuals on real robots share: simulators to start from, methods, errors and the table.

Residuals are learned on top of each simulator. Nominal: the model as published, without friction. Reference: the same
with the friction that the data's authors identified. The validation recordings choose checkpoints; the test recordings
choose nothing.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable, Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ballu_mjx.evaluation.open_loop import Evaluators, OpenLoopEvaluator, Replay, measured_hinges
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.parameters import IdentifiedParameters
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.residuals.analytic import AnalyticConfig
from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.residuals.envmimic_training import train_envmimic
from ballu_mjx.residuals.force_fitting import fit_analytic, fit_supervised
from ballu_mjx.residuals.scales import describe_scales, settle_scales
from ballu_mjx.residuals.supervised import SupervisedConfig
from ballu_mjx.residuals.trained import TrainedResidual
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.simulator import Simulator

Errors = Float[np.ndarray, " quantities"]
Measure = Callable[[OpenLoopEvaluator, Replay], Errors]
"""Errors of a replay, in the order of the table's columns; inf where half of the starts diverged."""


@dataclasses.dataclass(frozen=True)
class Effort:
    """How long to learn."""

    seeds: int
    updates: int
    """Gradient steps of the supervised fit."""
    relinearizations: int
    env_steps: int

    @staticmethod
    def of(seeds: int, *, quick: bool) -> Effort:
        """Return that of a full or a quick run."""
        return Effort(1, 200, 1, 20_000) if quick else Effort(seeds, 2000, 8, 3_000_000)


def with_values(robot: RobotDescription, values: Mapping[str, float]) -> IdentifiedParameters:
    """Return the robot's declared parameters, nominal but for `values`."""
    declared = declared_parameters(robot, robot.load_model())
    vector = declared.nominal.copy()
    for name, value in values.items():
        vector[declared.names.index(name)] = value
    return IdentifiedParameters(jnp.asarray(vector), declared)


def pieces(motion: Motion, seconds: float, control_timestep: float) -> list[Motion]:
    """Return a motion in pieces of twice `seconds`, each begun `seconds` after the last.

    Chaotic motions and long recordings need not be simulated to their end.
    """
    step, found = round(seconds / control_timestep), []
    for first in range(0, max(len(motion.command) - step, 1), step):
        qpos, qvel = (x[first : first + 2 * step + 4] for x in (motion.qpos, motion.qvel))
        command = motion.command[first : first + len(qpos) - 1]
        found.append(dataclasses.replace(motion, time=motion.time[: len(qpos)], command=command, qpos=qpos, qvel=qvel))
    return found


def learn(
    method: str,
    simulator: Simulator,
    motions: Mapping[str, Sequence[Motion]],
    env: EnvMimicConfig,
    seed: int,
    effort: Effort,
    evaluators: Evaluators,
) -> TrainedResidual:
    """Learn a residual of a method on top of a simulator."""
    training, validation = motions["training"], motions["validation"]
    if method == "supervised":
        config = SupervisedConfig(observation_noise=0.1, updates=effort.updates, seed=seed)
        return fit_supervised(simulator, training, config, forces=env, validation=validation, evaluators=evaluators)
    if method == "analytic":
        config = AnalyticConfig(
            window_seconds=0.4,
            interval_seconds=0.4,
            relinearizations=effort.relinearizations,
            windows=64,
            observation_noise=0.1,
            seed=seed,
        )
        return fit_analytic(simulator, training, config, forces=env, validation=validation, evaluators=evaluators)
    return train_envmimic(
        simulator,
        training,
        dataclasses.replace(env, episode_seconds=1.0, observation_noise=0.1),
        PPOConfig(num_timesteps=effort.env_steps, seed=seed),
        validation=validation,
        evaluators=evaluators,
    )


def compare(
    simulators: Mapping[str, Simulator],
    motions: Mapping[str, Sequence[Motion]],
    tests: Mapping[str, Sequence[Motion]],
    env: EnvMimicConfig,
    methods: Sequence[str],
    effort: Effort,
    measure: Measure,
    columns: Sequence[str],
    elsewhere: Mapping[str, Mapping[str, Simulator]] | None = None,
) -> str:
    """Return a Markdown table: each simulator alone and with each method's residual, on each group of tests.

    Cells of several seeds are their mean, with the lowest and the highest. `elsewhere` are simulators, by group and
    name, of tests with another model (a load) than the residual is learned with.
    """
    groups = list(tests)
    heads = [f"{group}: {', '.join(columns)}" for group in groups]
    lines = [f"| simulator | {' | '.join(heads)} |"]
    lines.append("| --- |" + " --- |" * len(groups))
    for name, simulator in simulators.items():
        settled = settle_scales(env, simulator, motions["training"])
        _say(f"{name}: {describe_scales(settled, simulator.robot)}")
        evaluators, alone = Evaluators(simulator), None
        for method in methods:
            found: dict[str, list[Errors]] = {group: [] for group in groups}
            for seed in range(effort.seeds):
                began = time.perf_counter()
                residual = learn(method, simulator, motions, settled, seed, effort, evaluators)
                _say(f"{name}, {method}, seed {seed}: step {residual.step}, {time.perf_counter() - began:.0f} s")
                _say(residual.report)
                others = {group: by_name[name] for group, by_name in (elsewhere or {}).items()}
                looks = {
                    g: OpenLoopEvaluator(others[g], tests[g], residual.model)
                    if g in others
                    else evaluators.of(residual.model, tests[g])
                    for g in groups
                }
                if alone is None:
                    alone = {g: [measure(look, look.replay(residual.params, scale=0.0))] for g, look in looks.items()}
                    lines.append(_row(name, alone))
                for group, look in looks.items():
                    found[group].append(measure(look, look.replay(residual.params)))
            lines.append(_row(f"{name} + {method}", found))
            _say(lines[-1])
    return "\n".join(lines)


def _row(name: str, found: Mapping[str, Sequence[Errors]]) -> str:
    cells = []
    for errors in found.values():
        values = np.array(errors)
        shown = [_number(column) for column in values.T]
        cells.append(", ".join(shown))
    return f"| {name} | {' | '.join(cells)} |"


def _number(values: Float[np.ndarray, " seeds"]) -> str:
    if not np.isfinite(values).all():
        return f"{int((~np.isfinite(values)).sum())} of {len(values)} diverged"
    mean = f"{values.mean():.3g}"
    return mean if len(values) == 1 else f"{mean} ({values.min():.3g} to {values.max():.3g})"


def angle_errors(evaluator: OpenLoopEvaluator, replay: Replay, horizon: float) -> Float[np.ndarray, "starts hinges"]:
    """Return errors of the measured hinges' angles (deg) at a horizon's end, wrapped; inf of runs that diverged."""
    steps, found = round(horizon / evaluator.robot.control_timestep), []
    model = evaluator.robot.load_model()
    for run, (recording, start) in enumerate(evaluator.starts):
        motion = evaluator.motions[recording]
        places = list(measured_hinges(evaluator.robot, model, motion).values())
        if start + steps < len(motion.qpos):
            turn = replay.joints[run, steps] - motion.qpos[start + steps, places]
            found.append(np.rad2deg(np.abs(np.arctan2(np.sin(turn), np.cos(turn)))))
    return np.where(np.isfinite(found), found, np.inf)


def _say(text: str) -> None:
    if text:
        print(text, file=sys.stderr, flush=True)
