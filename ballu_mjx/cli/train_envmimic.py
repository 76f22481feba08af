"""Training residual forces: `python -m ballu_mjx.train envmimic`."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

from ballu_mjx.cli import evaluate
from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator
from ballu_mjx.residuals.dataset import RecordingsData, ResidualDataset
from ballu_mjx.residuals.envmimic import EnvMimicConfig, EnvMimicEnv, check_envmimic_config
from ballu_mjx.residuals.network import NetworkForces
from ballu_mjx.residuals.run_config import describe_run, run_residual, run_robot
from ballu_mjx.residuals.trained import TrainedResidual, write_observed
from ballu_mjx.rl import distributed, learner, ppo
from ballu_mjx.rl.ppo import Params, PPOConfig
from ballu_mjx.rl.training_loop import TrainingLoop, Validation, find_resume_point
from ballu_mjx.robots.description import RobotDescription, check_simulates, read_description
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs import loggers
from ballu_mjx.runs.folder import Run, new_folder, read_config
from ballu_mjx.runs.progress import Progress
from ballu_mjx.sim.force_model import ForceModel, SumOfForces
from ballu_mjx.viz import artifacts

QUICK: Mapping[str, Any] = {"num_timesteps": 120_000, "num_envs": 256, "batch_size": 128}
"""Defaults of `PPOConfig` under `--quick`."""


@dataclasses.dataclass(frozen=True)
class Data(RecordingsData, distributed.DistributedOptions):
    """Recordings and folders. A path is a recording (.csv or .csv.gz) or a folder of them."""

    residual: Path | None = None
    """Folder of another residual's run, which acts beside the forces: these learn what it leaves. It must have
    been learned beside the same actuators. Without this option: none."""
    robot_description: Path | None = None
    """Description of another robot than BALLU (docs/own_robot.md), whose recordings --recordings are."""
    resume: Path | None = None
    """Go on with the run in this folder, from its last checkpoint, with its recordings and configuration; options
    given beside it change these. --num-timesteps counts from the run's start."""
    validate_every: int = 400_000
    """Control steps between two validations, each of which leaves a checkpoint."""


def train(data: Data, env_config: EnvMimicConfig, ppo_config: PPOConfig) -> int:
    """Read and check everything, train, evaluate; returns the exit status."""
    started = time.perf_counter()
    distributed.join(data)
    devices = [str(device) for device in jax.devices()]
    ppo.check(ppo_config, len(devices))
    check_envmimic_config(env_config)
    loggers.check(data.wandb)
    if data.validate_every < 1:
        raise InputError(f"--validate-every is {data.validate_every}: it must be 1 or more.")
    start = find_resume_point("envmimic", data.resume, ppo_config, output=data.output, quick=data.quick)
    description = _description(data)
    where = _where_beside(data)
    beside = None if where is None else TrainedResidual.load(where, description=description)
    prepared = ResidualDataset.read(data, data.resume, description)
    if beside is not None:
        prepared.check_beside(beside.actuators, where)
    first = distributed.is_first()
    folder = data.resume or new_folder(data.output if first else None, "envmimic")
    if first:
        prepared.announce(folder, data.quick)
    model = prepared.load_model()
    motions = prepared.reconstruct(model)
    env = EnvMimicEnv(model, motions["training"], env_config, None if beside is None else beside.applied, description)
    if start.params is not None and start.params.normalizer.mean["state"].shape != env.observation_size["state"]:
        raise InputError(
            f"{data.resume}: its policy was trained on other observations; leave the options of env as they were."
        )
    infer = ppo.make_inference(env.observation_size, env.action_size, ppo_config)
    forces: ForceModel = NetworkForces(env_config, infer, anchored=description.anchored)
    whole = forces if beside is None else SumOfForces(beside.model, forces)

    def all_params(params: Params) -> Any:
        return params if beside is None else (beside.params, params)

    sections = {"env": env_config, "ppo": ppo_config, "data": data}
    config = describe_run("envmimic", sections, prepared.files, devices, prepared.identified, description)
    config["residual"] = None if where is None else str(where.resolve())
    validation = OpenLoopEvaluator(model, motions["validation"], whole, prepared.base, description)
    tells_best = Validation(lambda params: validation(all_params(params)).score)
    if not first:
        return TrainingLoop(None, None, data.validate_every, tells_best).follow(env, ppo_config, start, config)
    with Run(folder, config, resumed_at=start.resumed_at, wandb=data.wandb) as run:
        print("Compiling: about a minute the first time ...", flush=True)
        progress = Progress(learner.total_timesteps(ppo_config, start.step), start.step)
        write_observed(run, env.recorded_inputs)
        session = TrainingLoop(run, progress, data.validate_every, tells_best)
        try:
            session.train(env, ppo_config, start, config)
        except KeyboardInterrupt:
            print(f"To go on: python -m ballu_mjx.train envmimic --resume {folder}", file=sys.stderr)
            return session.exit_status

    best_step, params = evaluate.load_params(folder, "best")
    artifacts.draw_learning_curve(folder, best_step)
    test = validation if prepared.one_set else validation.on(motions["test"])
    untrained = "" if best_step else ", before any training: no later one validated better"
    print(f"Best checkpoint: step {best_step:,}{untrained}. Open-loop replay of the test recordings:\n")
    print(artifacts.write_evaluation(test, all_params(params), folder).table())
    if data.quick:
        print("\nThese numbers mean little: --quick trains for seconds.")
    print(f"\nWritten to {folder}. {time.perf_counter() - started:.0f} s in all.")
    return 0


def _description(data: Data) -> RobotDescription:
    """The robot: that of the run that goes on, or of the option, or BALLU."""
    if data.resume is not None:
        if data.robot_description is not None:
            raise InputError("--robot-description does not go with --resume, which keeps the robot; leave one out.")
        return run_robot(read_config(data.resume, "envmimic"), data.resume)
    if data.robot_description is None:
        return load_robot()
    found = read_description(data.robot_description)
    check_simulates(found)
    if not data.recordings:
        raise InputError(f"{found.file}: the bundled recordings are BALLU's; give those of {found.name}, --recordings.")
    return found


def _where_beside(data: Data) -> Path | None:
    """The run of the residual that acts beside the forces to be learned."""
    if data.resume is None:
        return data.residual
    if data.residual is not None:
        raise InputError("--residual does not go with --resume, which keeps the simulator; leave one out.")
    return run_residual(read_config(data.resume, "envmimic"), data.resume)
