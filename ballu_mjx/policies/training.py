"""Training of locomotion policies in a simulator, for a task."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.closed_loop import ClosedLoop, Rollout
from ballu_mjx.policies.locomotion_config import LocomotionConfig, check_locomotion_config
from ballu_mjx.policies.policy import Policy, environment_of
from ballu_mjx.policies.tasks import Task, find_task
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import Params, PPOConfig
from ballu_mjx.rl.resume_point import ResumePoint
from ballu_mjx.rl.training_loop import TrainingLoop, Validation
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.runs.progress import Progress
from ballu_mjx.runs.record import MemoryRecord, TrainingRecord
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator

KEEP_EVERY = 500_000
"""Number of control steps between two checkpoints."""
VALIDATION_METRIC = "validation_reward"
"""Metric that selects the best checkpoint: the reward without exploration.

The training reward does not suffice. Exploration can free a robot that would otherwise stay at rest.
"""
_LOCOMOTION: Mapping[str, Any] = {
    "num_timesteps": 3_000_000,
    "learning_rate": 3e-4,
    "desired_kl": 0.02,
    "discounting": 0.985,
    "gae_lambda": 0.97,
    "reward_scaling": 7.0,
    "initial_std": 0.7,
    "entropy_cost": 1e-3,
    "averaging": 5,
}
_VALIDATION_STARTS = 16


def locomotion_ppo(**changes: Any) -> PPOConfig:
    """Return `PPOConfig` for locomotion, with `changes`.

    Its defaults suit rewards of the order of 0.1 m/s. In turning, rewards follow only after seconds.
    """
    return PPOConfig(**{**_LOCOMOTION, **changes})


def train_policy(
    simulator: Simulator | AugmentedSimulator,
    task: str | Task = "walk",
    config: LocomotionConfig | None = None,
    ppo_config: PPOConfig | None = None,
    *,
    keep_every: int = KEEP_EVERY,
    run: TrainingRecord | None = None,
    progress: Progress | None = None,
    start: ResumePoint | None = None,
) -> Policy:
    """Train a policy for a task, and return that of the best checkpoint.

    It has the highest reward in whole trials without exploration.

    **Arguments**

    - `simulator`: simulator of the training, with or without a residual.
    - `task`: a name in `tasks.TASKS`, or a task.
    - `config`: options of the simulator and of its episodes. None for the defaults.
    - `ppo_config`: options of the learning, with the seed. None for the defaults of `locomotion_ppo`.
    - `keep_every`: number of control steps between two checkpoints. Each checkpoint is validated.
    - `run`: record of measurements and checkpoints, for example in a folder. None to keep them in memory.
    - `progress`: display of the progress, updated after every training step. None for no display.
    - `start`: state from which to resume. None to start from the beginning.

    **Raises** `InputError` if options do not fit, the task is unknown, or learning breaks down. Raises
    `TrainingInterrupted` after SIGINT or SIGTERM, with the last state saved.
    """
    config, ppo_config = config or LocomotionConfig(), ppo_config or locomotion_ppo()
    start = start or ResumePoint()
    augmented = simulator.with_residual(None)
    check_policy_options(config, ppo_config, keep_every, augmented.robot)
    chosen = find_task(task) if isinstance(task, str) else task
    actuators, residual = augmented.actuators, TrainedResidual.of(augmented)
    env = environment_of(augmented.robot, chosen, config, actuators, residual)
    infer = ppo.make_inference(env.observation_size, env.action_size, ppo_config)
    loop = ClosedLoop(env, infer)
    sections = {"env": dataclasses.asdict(config), "ppo": dataclasses.asdict(ppo_config)}
    record = MemoryRecord(sections) if run is None else run

    def measure(params: Params) -> float:
        return float(validation_trials(loop, params, chosen, augmented.robot.control_timestep).reward.mean())

    tells_best = Validation(measure, VALIDATION_METRIC, greatest=True)
    TrainingLoop(record, progress, keep_every, tells_best).train(env, ppo_config, start, record.config)
    step, tree = record.best()
    return Policy(
        task=chosen,
        config=config,
        robot=augmented.robot,
        actuators=actuators,
        residual=residual,
        network=ppo_config,
        params=ppo.from_tree(tree),
        infer=infer,
        step=step,
        loop=loop,
    )


def check_policy_options(
    config: LocomotionConfig, ppo_config: PPOConfig, keep_every: int, robot: RobotDescription
) -> None:
    """Check the options of `train_policy`.

    **Raises** `InputError` if they are out of range, or do not fit the devices.
    """
    ppo.check(ppo_config, len(jax.devices()))
    check_locomotion_config(config, robot.control_timestep)
    if keep_every < 1:
        raise InputError(f"--keep-every is {keep_every}: it must be 1 or more.")


def validation_trials(loop: ClosedLoop, params: Params, task: Task, control_timestep: float) -> Rollout:
    """Simulate whole trials of a policy without exploration, each from its own starting state."""
    return loop(params, *loop.standing(_VALIDATION_STARTS), round(task.trial_seconds / control_timestep))
