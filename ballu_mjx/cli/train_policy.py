"""Training a locomotion policy: `python -m ballu_mjx.train walk` and the other tasks."""

from __future__ import annotations

import dataclasses
import functools
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu import plots as ballu_plots
from ballu_mjx.ballu.actuators_file import read_actuators
from ballu_mjx.ballu.features import foot_positions
from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.gait import count_steps
from ballu_mjx.policies.closed_loop import ClosedLoop, Rollout
from ballu_mjx.policies.locomotion_env import LocomotionConfig, check_locomotion_config, setting_name
from ballu_mjx.policies.policy import Policy, make_environment
from ballu_mjx.policies.tasks import Task
from ballu_mjx.residuals.run_config import describe_run, run_actuators, run_residual
from ballu_mjx.residuals.trained import TrainedResidual
from ballu_mjx.rl import distributed, learner, ppo
from ballu_mjx.rl.ppo import Params, PPOConfig
from ballu_mjx.rl.training_loop import TrainingLoop, Validation, find_resume_point
from ballu_mjx.robots.model import CONTROL_TIMESTEP, ModelParameters
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs import loggers
from ballu_mjx.runs.folder import Run, new_folder, read_config
from ballu_mjx.runs.metrics import read_column
from ballu_mjx.runs.progress import Progress
from ballu_mjx.runs.rollout_file import ROLLOUT_FILE, StoredRollout, write_rollouts
from ballu_mjx.viz import plots

defaults = functools.partial(
    PPOConfig,
    **{
        "num_timesteps": 3_000_000,
        "learning_rate": 3e-4,
        "desired_kl": 0.02,
        "discounting": 0.985,
        "gae_lambda": 0.97,
        "reward_scaling": 7.0,
        "initial_std": 0.7,
        "entropy_cost": 1e-3,
        "averaging": 5,
    },
)
"""`PPOConfig` for locomotion: rewards are of the order of 0.1 m/s, and a turn pays only after seconds."""
QUICK: Mapping[str, Any] = {"num_timesteps": 60_000, "num_envs": 256, "batch_size": 128}
"""Defaults of `PPOConfig` under `--quick`."""
_VALIDATION_STARTS = 16
NOMINAL = Path("nominal")
"""What `--actuators` takes beside a file."""


@dataclasses.dataclass(frozen=True)
class Data(loggers.LoggingOptions, distributed.DistributedOptions):
    """The simulator's parts, and folders."""

    actuators: Path | None = None
    """File of identified actuators (`train sysid` writes it), or the word nominal. Without this option: the residual's
    if there is one, else nominal."""
    residual: Path | None = None
    """Folder of a run of `train residual` or `train envmimic`, which acts in every control step. Without this option:
    none."""
    output: Path | None = None
    """Folder of the run, new or empty. Without this option: one under runs/, named after task and time."""
    resume: Path | None = None
    """Go on with the run in this folder, from its last checkpoint, in its simulator; options of env and ppo given
    beside it change these. --num-timesteps counts from the run's start."""
    quick: bool = False
    """See everything work within two minutes; the policy will not walk."""
    keep_every: int = 500_000
    """Control steps between two checkpoints; the last three are kept, and the best, whose policy earns most in whole
    trials without exploration."""


def train(task: Task, data: Data, config: LocomotionConfig, ppo_config: PPOConfig) -> int:
    """Check everything, train, show the gait; returns the exit status."""
    started = time.perf_counter()
    distributed.join(data)
    devices = [str(device) for device in jax.devices()]
    ppo.check(ppo_config, len(devices))
    loggers.check(data.wandb)
    check_locomotion_config(config)
    if data.keep_every < 1:
        raise InputError(f"--keep-every is {data.keep_every}: it must be 1 or more.")
    start = find_resume_point(task.name, data.resume, ppo_config, output=data.output, quick=data.quick)
    identified, forces = _simulator(task, data)
    env = make_environment(task, config, identified, forces)
    setting = setting_name(config, identified is not None, None if env.residual is None else env.residual.model.name)

    content = describe_run(task.name, {"env": config, "ppo": ppo_config, "data": data}, {}, devices, identified)
    content["residual"] = None if forces is None else str(forces.resolve())
    loop = ClosedLoop(env, ppo.make_inference(env.observation_size, env.action_size, ppo_config))

    def trials(params: Params) -> Rollout:
        steps = round(task.trial_seconds / CONTROL_TIMESTEP)
        return loop(params, *loop.standing(_VALIDATION_STARTS), steps)

    # Training's reward says too little: exploration frees a robot that would rest without.
    validation = Validation(lambda params: float(trials(params).reward.mean()), "validation_reward", greatest=True)
    if not distributed.is_first():
        return TrainingLoop(None, None, data.keep_every, validation).follow(env, ppo_config, start, content)

    folder = data.resume or new_folder(data.output, task.name)
    print(f"Run folder: {folder}")
    print(f"  task: {task.name}; simulator: {setting}" + (f", residual {forces}" if forces is not None else ""))
    if data.quick:
        print("  --quick: sizes so small that the policy will not walk.")
    with Run(folder, content, resumed_at=start.resumed_at, wandb=data.wandb) as run:
        print("Compiling: about a minute the first time ...", flush=True)
        progress = Progress(learner.total_timesteps(ppo_config, start.step), start.step)
        session = TrainingLoop(run, progress, data.keep_every, validation)
        try:
            session.train(env, ppo_config, start, content)
        except KeyboardInterrupt:
            print(f"To go on: python -m ballu_mjx.train {task.name} --resume {folder}", file=sys.stderr)
            return session.exit_status

    curves = (*read_column(folder, "reward"), *read_column(folder, validation.name))
    plots.reward_curve(folder / "learning_curve.png", *curves, setting)
    trained = Policy.load(folder)
    rollout = trials(trained.params)
    ballu_plots.gait(folder / "gait.png", rollout.qpos[0], rollout.command[0])
    time_axis = np.arange(len(rollout.qpos[0])) * CONTROL_TIMESTEP
    episode = StoredRollout(name=task.name, time=time_axis, qpos={setting: rollout.qpos[0]}, command=rollout.command[0])
    write_rollouts(folder / ROLLOUT_FILE, [episode])
    print(summary(task, rollout, forces is not None))
    print(f"\nWritten to {folder}. {time.perf_counter() - started:.0f} s in all.")
    return 0


def summary(task: Task, rollout: Rollout, with_residual: bool) -> str:
    """What some runs did, in words: means and ranges."""
    way = rollout.com[:, -1] - rollout.com[:, 0]
    yaw = np.rad2deg(np.unwrap(rollout.yaw, axis=1))
    steps = np.array([count_steps(feet) for feet in foot_positions(rollout.features)])

    def spread(values: Float[np.ndarray, " runs"], digits: int) -> str:
        return f"{values.mean():.{digits}f} ({values.min():.{digits}f} to {values.max():.{digits}f})"

    text = (
        f"In its own simulator, {len(way)} times {task.trial_seconds:g} s from standing: x {spread(way[:, 0], 2)} m, "
        f"y {spread(way[:, 1], 2)} m, yaw {spread(yaw[:, -1] - yaw[:, 0], 0)} deg, {spread(steps, 0)} steps."
    )
    if with_residual:
        text += (
            f" The residual left the range seen in its training in {rollout.outside.mean():.0%} of the control steps."
        )
    return text


def _simulator(task: Task, data: Data) -> tuple[ModelParameters | None, Path | None]:
    """Actuators (None: nominal) and residual (None: none)."""
    if data.resume is not None:
        for option, given in (("--actuators", data.actuators), ("--residual", data.residual)):
            if given is not None:
                raise InputError(f"{option} does not go with --resume, which keeps the simulator; leave one out.")
        stored = read_config(data.resume, task.name)
        return run_actuators(stored, data.resume, load_robot()), run_residual(stored, data.resume)
    if data.actuators == NOMINAL:
        return None, data.residual
    if data.actuators is not None:
        return read_actuators(data.actuators)[1], data.residual
    return None if data.residual is None else TrainedResidual.load(data.residual).actuators, data.residual
