"""Training of a locomotion policy: `python -m ballu_mjx.train walk` and the other tasks."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ballu_mjx.cli._command import TrainCommand, find_start, load_chosen_robot, open_run, written_to
from ballu_mjx.cli._help import refuse_without
from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.actuators import AUTO, NOMINAL, read_actuators, read_validation
from ballu_mjx.policies.closed_loop import Rollout
from ballu_mjx.policies.locomotion_config import DRAWN_OPTIONS, LocomotionConfig, check_task
from ballu_mjx.policies.locomotion_env import variant_of
from ballu_mjx.policies.policy import check_belongs
from ballu_mjx.policies.tasks import Task
from ballu_mjx.policies.training import (
    KEEP_EVERY,
    VALIDATION_METRIC,
    check_policy_options,
    locomotion_ppo,
    train_policy,
    validation_trials,
)
from ballu_mjx.residuals.run_config import ResidualReference, describe_run, run_actuators, run_residual
from ballu_mjx.residuals.trained_residual import TrainedResidual, describe_residual
from ballu_mjx.rl import distributed, learner
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters
from ballu_mjx.runs import loggers
from ballu_mjx.runs.folder import new_folder, read_config
from ballu_mjx.runs.metrics import read_column
from ballu_mjx.runs.progress import Progress
from ballu_mjx.runs.rollout_file import ROLLOUT_FILE, StoredRollout, write_rollouts
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.viz import plots

QUICK: Mapping[str, Any] = {"num_timesteps": 60_000, "num_envs": 256, "batch_size": 128}
"""Defaults of `PPOConfig` under `--quick`."""


@dataclasses.dataclass(frozen=True)
class Data(loggers.LoggingOptions, distributed.DistributedOptions):
    """Robot, actuators and residual of the simulator, and folders."""

    robot: str | None = None
    """Robot for which the policy is trained: the name of a robot that comes with the package, or a description file
    (docs/own_robot.md). Without this option: the robot of --resume or --residual, or else ballu."""
    actuators: Path = AUTO
    """File of identified actuators (`train sysid` writes it), or one of two words. nominal: nominal actuators. auto:
    the actuators of --residual, or nominal ones without it."""
    residual: Path | None = None
    """Run folder of a residual (`train envmimic`, supervised, analytic, aerodynamic or fluid), which acts in every
    control step. Without this option: none."""
    output: Path | None = None
    """Folder of the run, new or empty. Without this option: one under runs/, named after task and time."""
    resume: Path | None = None
    """Resume the run in this folder from its last checkpoint, in its simulator. Options of task and reinforcement
    learning on the command line override the run's. --num-timesteps counts from the start of the run."""
    quick: bool = False
    """Try the command within two minutes. The policy will not walk."""
    keep_every: int = KEEP_EVERY
    """Number of control steps between two checkpoints. The last three are kept, and the best one, which has the highest
    reward in whole trials without exploration."""


def train(task: Task, data: Data, env: LocomotionConfig, ppo: PPOConfig) -> int:
    """Check all inputs, train a policy, write and print its rollouts, and return the exit status."""
    distributed.join(data)
    loggers.check(data.wandb)
    start = find_start(task.name, data, ppo)
    robot = load_chosen_robot(data.robot, data.resume, task.name, data.residual)
    check_task(task, robot)
    check_policy_options(env, ppo, data.keep_every, robot)
    identified, residual, reference = _parts(task, data, robot)
    where = None if reference is None else reference.folder
    check_belongs(residual, identified, where)
    simulator = Simulator(robot, identified).with_residual(None if residual is None else residual.bound)
    first = distributed.is_first()
    with written_to(first=first) as written:
        folder = written.folder = data.resume or new_folder(data.output if first else None, task.name)
        setting = variant_of(env, identified, residual).name
        if first:
            print(f"Run folder: {folder}")
            print(f"  task: {task.name}; simulator: {setting}" + (f", residual {where}" if where is not None else ""))
            if data.actuators not in (AUTO, NOMINAL):
                print(f"  actuators: {data.actuators}{_verdict(data.actuators)}")
            if data.quick:
                print("  --quick: sizes so small that the policy will not walk.")
        devices = [str(device) for device in jax.devices()]
        content = describe_run(task.name, {"env": env, "ppo": ppo, "data": data}, {}, devices, identified, robot)
        content |= describe_residual(residual, where)
        with open_run(folder, content, start.resumed_at, data.wandb, first=first) as run:
            policy = train_policy(
                simulator,
                task,
                env,
                ppo,
                keep_every=data.keep_every,
                run=run,
                progress=Progress(learner.total_timesteps(ppo, start.step), start.step) if first else None,
                start=start,
            )
        if first:
            curves = (*read_column(folder, "reward"), *read_column(folder, VALIDATION_METRIC))
            plots.reward_curve(folder / "learning_curve.png", *curves, setting)
            rollout = validation_trials(policy.closed_loop(), policy.params, task, robot.control_timestep)
            robot.adapter.draw_rollout(folder, rollout.qpos[0], rollout.command[0])
            seconds = np.arange(len(rollout.qpos[0])) * robot.control_timestep
            qpos = {setting: rollout.qpos[0]}
            command = rollout.command[0]
            episode = StoredRollout(name=task.name, description=robot, time=seconds, qpos=qpos, command=command)
            write_rollouts(folder / ROLLOUT_FILE, [episode])
            print(summary(task, rollout, robot, residual is not None))
    return 0


def _verdict(path: Path) -> str:
    """Return how identified actuators compare with nominal ones according to their file, as text in parentheses."""
    found = read_validation(path)
    if found is None:
        return ""
    better = "better" if found.improves else "WORSE"
    why = "and more replays diverged" if found.ratio is None else f"with {found.ratio:.2f} times the error"
    return f" (replayed validation recordings {better} than nominal ones, {why})"


def summary(task: Task, rollout: Rollout, robot: RobotDescription, with_residual: bool) -> str:
    """Return a sentence with mean and range of distance (m), change of yaw (deg) and counts over some rollouts."""
    way = rollout.com[:, -1] - rollout.com[:, 0]
    yaw = np.rad2deg(np.unwrap(rollout.yaw, axis=1))
    counts = robot.adapter.rollout_counts(rollout.features)

    def spread(values: Float[np.ndarray, " runs"], digits: int) -> str:
        return f"{values.mean():.{digits}f} ({values.min():.{digits}f} to {values.max():.{digits}f})"

    figures = [
        f"x {spread(way[:, 0], 2)} m",
        f"y {spread(way[:, 1], 2)} m",
        f"yaw {spread(yaw[:, -1] - yaw[:, 0], 0)} deg",
        *(f"{spread(np.array(values, float), 0)} {name}" for name, values in counts.items()),
    ]
    drawn = np.any(rollout.qpos[:, 0] != rollout.qpos[0, 0])
    start = "drawn starting states" if drawn else "its initial pose"
    runs = f"{len(way)} times {task.trial_seconds:g} s from {start}"
    text = f"In its own simulator, {runs}: {', '.join(figures)}."
    if rollout.divergence is not None:
        text += f" {rollout.divergence}"
    if with_residual:
        text += (
            f" The residual left the range seen in its training in {rollout.outside.mean():.0%} of the control steps."
        )
    return text


def _parts(
    task: Task, data: Data, robot: RobotDescription
) -> tuple[ModelParameters | None, TrainedResidual | None, ResidualReference | None]:
    """Return the actuators (None if nominal), the residual (None if there is none), and where it is stored."""
    stored = None
    if data.resume is not None:
        chosen = None if data.actuators == AUTO else data.actuators
        for option, given in (("--actuators", chosen), ("--residual", data.residual)):
            if given is not None:
                raise InputError(
                    f"{option} does not go with --resume, which keeps the simulator; leave out one of them."
                )
        stored = read_config(data.resume, task.name), data.resume
    reference = ResidualReference.chosen(data.residual) if stored is None else run_residual(*stored)
    residual = None if reference is None else TrainedResidual.load_reference(reference, robot)
    if stored is not None:
        actuators = run_actuators(*stored, robot)
    elif data.actuators == AUTO:
        actuators = None if residual is None else residual.actuators
    else:
        actuators = None if data.actuators == NOMINAL else read_actuators(robot, data.actuators)[1]
    return actuators, residual, reference


def _run(task: Task, data: Data, env: LocomotionConfig, ppo: PPOConfig) -> int:
    if data.resume is None and not env.domain_randomization:
        refuse_without(env, DRAWN_OPTIONS, "--domain-randomization")
    return train(task, data, env, ppo)


def command_for(task: Task) -> TrainCommand:
    """Return the command that trains a policy for a task."""
    return TrainCommand(
        f"{task.summary} In the nominal simulator, or one improved by --actuators and --residual.",
        {"data": Data(), "env": LocomotionConfig(), "ppo": locomotion_ppo()},
        functools.partial(_run, task),
        {"ppo": QUICK},
    )
