"""Training of residual forces by reinforcement learning: `python -m ballu_mjx.train envmimic`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ballu_mjx.cli._command import TrainCommand, find_start, load_chosen_robot
from ballu_mjx.cli._residual import EarlierRun, Prepared, settle, train_residual
from ballu_mjx.common.errors import InputError
from ballu_mjx.residuals.dataset import RecordingsData
from ballu_mjx.residuals.envmimic import EnvMimicConfig, resolve_envmimic
from ballu_mjx.residuals.envmimic_training import (
    VALIDATE_EVERY,
    check_envmimic_options,
    check_resumes,
    started_from,
    train_envmimic,
)
from ballu_mjx.residuals.network_config import network_values
from ballu_mjx.residuals.network_loads import check_load_options
from ballu_mjx.residuals.network_mirror import network_mirror
from ballu_mjx.residuals.presets import PresetName, describe_preset, preset_values
from ballu_mjx.residuals.registry import NETWORKS
from ballu_mjx.residuals.run_config import ResidualReference, run_residual
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.rl import distributed, learner
from ballu_mjx.rl.ppo import POLICY_OPTIONS, PPOConfig
from ballu_mjx.runs.folder import read_config, typed_config
from ballu_mjx.runs.progress import Progress
from ballu_mjx.runs.record import TrainingRecord
from ballu_mjx.viz import artifacts

QUICK: Mapping[str, Any] = {"num_timesteps": 120_000, "num_envs": 256, "batch_size": 128}
"""Defaults of `PPOConfig` under `--quick`."""


@dataclasses.dataclass(frozen=True)
class Data(RecordingsData, distributed.DistributedOptions):
    """Recordings and folders. A path is a recording (.csv or .csv.gz) or a folder of them."""

    residual: Path | None = None
    """Run folder of another residual, which acts in addition to the forces to be learned. Both must have the same
    actuators. Without this option: none."""
    resume: Path | None = None
    """Resume the run in this folder from its last checkpoint, with its recordings and configuration. Options on the
    command line override its configuration. --num-timesteps counts from the start of the run."""
    start_from: Path | None = None
    """Run folder of a network with which the training starts: a run of `supervised`, `analytic` or `envmimic`. Options
    of the network are those of that run, and so are the actuators, unless --actuators names others. Without this
    option: an untrained network at the mean of the loads that the model lacks."""
    preset: PresetName | None = None
    """Named set of defaults. Options on the command line override them. paper: state, action, reward, network and
    optimizer of the paper, and the defaults of Stable-Baselines3 (docs/envmimic.md). Without this option: none."""
    validate_every: int = VALIDATE_EVERY
    """Number of control steps between two validations. Each validation writes a checkpoint."""


def train(data: Data, env: EnvMimicConfig, ppo: PPOConfig) -> int:
    """Read and check all inputs, train, evaluate the result, and return the exit status."""
    distributed.join(data)
    if data.preset is not None and data.resume is not None:
        raise InputError("--preset does not go with --resume, which keeps the run's options; leave out one of them.")
    if data.start_from is not None and data.resume is not None:
        raise InputError("--start-from does not go with --resume, which continues the network; leave one out.")
    if data.preset is not None and data.start_from is not None:
        raise InputError("--preset does not go with --start-from, which keeps the network's options; leave out one.")
    robot = load_chosen_robot(data.robot, data.resume, "envmimic", data.residual or data.start_from)
    check_envmimic_options(env, ppo, data.validate_every, robot.control_timestep)
    start = find_start("envmimic", data, ppo)
    check_resumes(start, env, robot)
    check_load_options(env, robot)
    network_mirror(env, robot)
    begun = data.start_from if data.resume is None else _stored_start(data.resume)
    # A checkpoint already continues from that network.
    earlier = None if begun is None or start.checkpoint is not None else EarlierRun.load(begun, robot)
    first = distributed.is_first()
    if first and data.preset is not None:
        print(f"--preset {data.preset} sets:\n{describe_preset(data.preset, env, ppo)}\n")

    def learn(prepared: Prepared, run: TrainingRecord) -> TrainedResidual:
        return train_envmimic(
            prepared.improved,
            prepared.motions["training"],
            env,
            ppo,
            validation=prepared.motions["validation"],
            validate_every=data.validate_every,
            run=run,
            progress=Progress(learner.total_timesteps(ppo, start.step), start.step) if first else None,
            start=start,
            start_from=None if earlier is None else earlier.residual,
            evaluators=prepared.evaluators,
        )

    def show(folder: Path, residual: TrainedResidual) -> None:
        artifacts.draw_learning_curve(folder, residual.step)
        if residual.step:
            print(f"Best checkpoint: step {residual.step:,}. ", end="")
        else:
            print(
                "Best checkpoint: step 0, before any training: no later one validated better. "
                "Train longer (--num-timesteps), or give more varied recordings."
            )

    def sections(prepared: Prepared) -> Mapping[str, Any]:
        nonlocal env
        if earlier is not None:
            env, _ = started_from(earlier.residual, prepared.improved, env, ppo)
        env = settle(env, prepared, resolve_envmimic, first=first)
        if first and earlier is not None:
            print(f"Training starts with the network of {earlier.folder}.", flush=True)
        kept = None if begun is None else begun.resolve()
        return {"env": env, "ppo": ppo, "data": dataclasses.replace(data, start_from=kept)}

    base = _base_residual(data)
    return train_residual("envmimic", data, sections, learn, show, base=base, earlier=earlier, start=start, first=first)


def _base_residual(data: Data) -> ResidualReference | None:
    """Return the residual that acts beside the forces to be learned. None if there is none."""
    if data.resume is None:
        return ResidualReference.chosen(data.residual)
    if data.residual is not None:
        raise InputError("--residual does not go with --resume, which keeps the simulator; leave out one of them.")
    return run_residual(read_config(data.resume, "envmimic"), data.resume)


def _stored_start(folder: Path) -> Path | None:
    """Return the run whose network the training in `folder` started with. None if there is none."""
    stored = read_config(folder, "envmimic").get("data", {}).get("start_from")
    return None if stored is None else Path(stored)


def _defaults(data: Data) -> Mapping[str, Mapping[str, Any]]:
    """Return the defaults that --preset, --start-from and --quick imply.

    Sizes of a preset override those of --quick, because the preset's sizes match each other.
    """
    quick = QUICK if data.quick else {}
    if data.preset is None and data.start_from is not None:
        config = read_config(data.start_from, *NETWORKS)
        env = typed_config(EnvMimicConfig, config, "env", data.start_from)
        network = typed_config(PPOConfig, config, "ppo", data.start_from)
        policy = {name: getattr(network, name) for name in POLICY_OPTIONS}
        return {"env": network_values(env), "ppo": {**quick, **policy}}
    if data.preset is None:
        return {"ppo": quick} if quick else {}
    preset = preset_values(data.preset)
    return {**preset, "ppo": {**quick, **preset["ppo"]}}


COMMAND = TrainCommand(
    "Learn residual forces from recordings by reinforcement learning. Evaluate them on test recordings.",
    {"data": Data(), "env": EnvMimicConfig(), "ppo": PPOConfig()},
    train,
    {"ppo": QUICK},
    _defaults,
)
