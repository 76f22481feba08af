"""Shared code of the experiments on public recordings: training of networks that output residual loads."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from ballu_mjx.recordings.motion import Motion
from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.residuals.envmimic_training import train_envmimic
from ballu_mjx.residuals.force_gradients import AnalyticConfig
from ballu_mjx.residuals.force_regression import SupervisedConfig
from ballu_mjx.residuals.force_training import fit_analytic, fit_supervised
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.runs.progress import PhaseProgress, Progress
from ballu_mjx.sim.force_sets import ForceSet
from ballu_mjx.sim.simulator import Simulator

QUICK = PPOConfig(num_timesteps=4000, num_envs=16, batch_size=16, num_minibatches=4)
"""Options of EnvMimic for a training that takes seconds."""


def learn_network(
    method: str,
    simulator: Simulator,
    training: Sequence[Motion],
    validation: Sequence[Motion],
    forces: ForceSet,
    seed: int,
    *,
    quick: bool,
    start_from: TrainedResidual | None = None,
) -> TrainedResidual:
    """Learn a residual by `supervised`, `analytic` or `envmimic`, with its defaults. `quick` learns for seconds.

    EnvMimic starts with the network of `start_from`, if it is given.
    """
    if method == "envmimic":
        ppo = dataclasses.replace(QUICK if quick else PPOConfig(), seed=seed)
        config, progress = EnvMimicConfig(forces=forces), Progress(ppo.num_timesteps)
        found = train_envmimic(
            simulator, training, config, ppo, validation=validation, progress=progress, start_from=start_from
        )
        progress.close()
        return found
    progress = PhaseProgress()
    if method == "supervised":
        config = SupervisedConfig(seed=seed, updates=50, validate_every=50) if quick else SupervisedConfig(seed=seed)
        return fit_supervised(simulator, training, config, forces=forces, validation=validation, progress=progress)
    config = AnalyticConfig(seed=seed, relinearizations=1, windows=2) if quick else AnalyticConfig(seed=seed)
    return fit_analytic(simulator, training, config, forces=forces, validation=validation, progress=progress)
