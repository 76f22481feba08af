"""A run keeps the residual that its simulator had in training, also if the residual's run is resumed afterwards."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tethered import ROBOT

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.load_simulator import load_simulator
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.residuals.network_input import num_inputs
from ballu_mjx.residuals.network_loads import num_loads
from ballu_mjx.residuals.run_config import describe_run
from ballu_mjx.residuals.trained_residual import TrainedResidual, describe_residual
from ballu_mjx.residuals.training_range import TrainingRange
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import Params, PPOConfig
from ballu_mjx.runs.folder import Run

CONFIG = EnvMimicConfig(forces="force", force_scale=0.05, force_limit=1.0, force_cost=20.0, expected_loads=(0.02,))
NETWORK = PPOConfig(policy_layers=(8,), value_layers=(4,))
SECTIONS = {"env": CONFIG, "ppo": NETWORK}
SEEN = np.random.default_rng(0).normal(size=(20, num_inputs(CONFIG, ROBOT)))


def network(mean: float) -> Params:
    """Return a network whose untrained policy has this mean."""
    policy = ppo.initial_policy(SEEN, num_loads(CONFIG, ROBOT), NETWORK)
    return policy._replace(policy=ppo.with_mean(policy.policy, np.full(3, mean)))


def base(
    folder: Path,
    scores: Mapping[int, float],
    resumed_at: int | None = None,
    residual: Mapping[str, Any] | None = None,
    shift: float = 0.0,
) -> Path:
    """Write checkpoints with scores. Their networks differ, and depend on `shift`."""
    config = describe_run("envmimic", SECTIONS, {}, [], None, ROBOT) | dict(residual or {"residual": None})
    with Run(folder, config, resumed_at=resumed_at) as run:
        if resumed_at is None:
            TrainingRange.of(SEEN).write(run)
        for step, score in scores.items():
            run.save(step, ppo.as_tree(network(step / 100 + shift)), score)
    return folder


def users(folder: Path, where: Path) -> list[Path]:
    """Write a residual and a policy whose simulators have the best residual of `where`."""
    residual = describe_residual(TrainedResidual.load(where, ROBOT), where)
    second = base(folder / "second", {0: 0.3}, residual=residual)
    sections = {"env": LocomotionConfig(), "ppo": NETWORK}
    with Run(folder / "walk", describe_run("walk", sections, {}, [], None, ROBOT) | residual):
        pass
    return [second, folder / "walk"]


def residuals(runs: list[Path]) -> list[str]:
    found = [TrainedResidual.of(load_simulator(run)) for run in runs]
    return [each.sha256 for each in found if each is not None]


def test_runs_keep_their_residual_if_its_training_goes_on(tmp_path: Path):
    where = base(tmp_path / "base", {10: 0.5})
    runs = users(tmp_path, where)
    before = residuals(runs)
    base(where, {20: 0.4}, resumed_at=10)
    assert TrainedResidual.load(where, ROBOT).step == 20
    assert residuals(runs) == before


def test_a_residual_whose_checkpoint_is_gone_is_refused_by_name(tmp_path: Path):
    where = base(tmp_path / "base", {10: 0.5})
    runs = users(tmp_path, where)
    base(where, {20: 0.4, 30: 0.3, 40: 0.2}, resumed_at=10)
    for run in runs:
        with pytest.raises(InputError, match=f"base: has no checkpoint of step 10 any more, .*{run.name} contains"):
            load_simulator(run)
    where.rename(tmp_path / "moved")
    for run in runs:
        with pytest.raises(InputError, match=f"{run.name}/config.json: names the run .*base, which is missing"):
            load_simulator(run)


def test_a_residual_with_other_parameters_is_refused_by_name(tmp_path: Path):
    where = base(tmp_path / "base", {10: 0.5})
    runs = users(tmp_path, where)
    shutil.rmtree(where)
    base(where, {10: 0.5}, shift=0.3)
    for user in runs:
        with pytest.raises(InputError, match=f"base: its residual has changed since .*{user.name} was trained with it"):
            load_simulator(user)
