"""Training of EnvMimic: from a simulator and recorded motions to a residual."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.open_loop import Evaluators
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.residuals.envmimic import EnvMimicConfig, EnvMimicEnv, check_envmimic_config, resolve_envmimic
from ballu_mjx.residuals.network import NetworkResidual
from ballu_mjx.residuals.network_config import network_values
from ballu_mjx.residuals.network_input import num_inputs
from ballu_mjx.residuals.network_loads import num_loads
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.residuals.training_range import FadingResidual, with_fading
from ballu_mjx.rl import ppo
from ballu_mjx.rl.mirror import OFFSET
from ballu_mjx.rl.ppo import Params, PPOConfig
from ballu_mjx.rl.resume_point import ResumePoint
from ballu_mjx.rl.training_loop import TrainingLoop, Validation
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.runs.progress import Progress
from ballu_mjx.runs.record import MemoryRecord, TrainingRecord
from ballu_mjx.sim.residual import SumOfResiduals, add_to_base
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator

VALIDATE_EVERY = 400_000
"""Default number of control steps between two validations. Each validation saves a checkpoint."""


def train_envmimic(
    simulator: Simulator | AugmentedSimulator,
    motions: Sequence[Motion],
    config: EnvMimicConfig | None = None,
    ppo_config: PPOConfig | None = None,
    *,
    validation: Sequence[Motion] | None = None,
    validate_every: int = VALIDATE_EVERY,
    run: TrainingRecord | None = None,
    progress: Progress | None = None,
    start: ResumePoint | None = None,
    start_from: TrainedResidual | None = None,
    evaluators: Evaluators | None = None,
) -> TrainedResidual:
    """Learn residual forces by reinforcement learning, and return those with the smallest validation error.

    **Arguments**

    - `simulator`: the simulator to correct. If it has a residual, that residual also acts, and the new forces add to
      it. The result is the sum of both residuals.
    - `motions`: training motions.
    - `config`: options of the task. None for the defaults.
    - `ppo_config`: options of PPO, with the seed. None for the defaults.
    - `validation`: motions that choose the checkpoint. None for `motions`.
    - `validate_every`: control steps between two validations.
    - `run`: record of metrics and checkpoints, for example a run's folder. None to keep them in memory.
    - `progress`: display that is updated after every training step.
    - `start`: point at which to resume. None to start anew.
    - `start_from`: residual with whose network a new training starts, for example of `fit_supervised` with the same
      forces. Options of the network's input and output that are left open are those of this network. None to start at
      the mean of the missing loads.
    - `evaluators`: evaluators of this simulator without residual, to share their compiled programs.

    **Raises** `InputError` for options that do not fit, also from `started_from`, and if learning breaks down. Raises
    `TrainingInterrupted` after SIGINT or SIGTERM, when the last state is saved.
    """
    config, ppo_config, start = config or EnvMimicConfig(), ppo_config or PPOConfig(), start or ResumePoint()
    augmented = simulator.with_residual(None)
    plain, robot = augmented.without_residual(), augmented.robot
    check_envmimic_options(config, ppo_config, validate_every, robot.control_timestep)
    check_resumes(start, config, robot)
    if start_from is not None:
        config, policy = started_from(start_from, augmented, config, ppo_config)
        start = dataclasses.replace(start, policy=policy)
    config = resolve_envmimic(config, augmented, motions)
    sections = {"env": dataclasses.asdict(config), "ppo": dataclasses.asdict(ppo_config)}
    record = MemoryRecord(sections) if run is None else run
    env = EnvMimicEnv(augmented, motions, config)
    sizes = env.observation_size, env.action_size, ppo_config, env.mirror
    infer = ppo.make_inference(*sizes)
    forces = NetworkResidual(config, robot, infer, ppo.make_sampler(*sizes), network=ppo_config)
    forces, with_range = with_fading(forces, config.fade_width, env.observed)
    model, with_base = add_to_base(augmented.residual, forces)
    measure = (evaluators or Evaluators(plain)).of(model, motions if validation is None else validation)
    validate = Validation(lambda params: measure(with_base(with_range(params))).score)
    env.observed.write(record)
    TrainingLoop(record, progress, validate_every, validate).train(env, ppo_config, start, record.config)
    step, tree = record.best()
    params = with_base(with_range(ppo.from_tree(tree)))
    return TrainedResidual(model, params, env.observed, step, plain.actuators)


def started_from(
    residual: TrainedResidual, simulator: AugmentedSimulator, config: EnvMimicConfig, ppo_config: PPOConfig
) -> tuple[EnvMimicConfig, Params]:
    """Return the options of a training that starts with the network of `residual`, and the network's parameters.

    Open options of the network's input and output are those of this network.

    **Raises** `InputError` if `residual` is no network, if other options contradict it, or if it was learned in
    addition to another base residual than that of `simulator`.
    """
    model, params, base = residual.model, residual.params, None
    if isinstance(model, SumOfResiduals):
        model, (base, params) = model.parts[1], params
    if isinstance(model, FadingResidual):
        model, params = model.inner, params[0]
    if not isinstance(model, NetworkResidual) or model.network is None:
        raise InputError(f"A training cannot start with {model.name}; give a residual whose loads a network computes.")
    here = () if simulator.residual is None else simulator.residual.params
    if not _same(here, () if base is None else base):
        raise InputError(
            "--start-from names a network that was learned with another --residual, or with none; give both the same."
        )
    of_network = network_values(model.config)
    of_policy = {name: getattr(model.network, name) for name in ppo.POLICY_OPTIONS}
    for own, values in ((config, of_network), (ppo_config, of_policy)):
        for name, known in values.items():
            value = getattr(own, name)
            if value not in (None, (), known):
                option = f"--{name.replace('_', '-')}"
                raise InputError(f"{option} is {value}, but the network of --start-from has {known}; give the same.")
    return dataclasses.replace(config, **of_network), params


def _same(one: Any, other: Any) -> bool:
    """Return whether two trees have the same arrays."""
    if jax.tree.structure(one) != jax.tree.structure(other):
        return False
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))


def check_envmimic_options(
    config: EnvMimicConfig, ppo_config: PPOConfig, validate_every: int, control_timestep: float
) -> None:
    """Check the options of `train_envmimic`.

    **Raises** `InputError` for options that are out of range or do not fit the number of devices.
    """
    check_envmimic_config(config, control_timestep)
    ppo.check(ppo_config, len(jax.devices()))
    if validate_every < 1:
        raise InputError(f"--validate-every is {validate_every}: it must be 1 or more.")


def check_resumes(start: ResumePoint, config: EnvMimicConfig, robot: RobotDescription) -> None:
    """Check that the policy of a resumed training has the input and output of these options.

    **Raises** `InputError` if their number differs, or if only one of both is symmetric (`--mirror`).
    """
    if start.params is None:
        return
    inputs, outputs = start.params.normalizer.mean["state"].shape, ppo.num_actions(start.params.policy)
    sizes = (*inputs, outputs) == (num_inputs(config, robot), num_loads(config, robot))
    if not sizes or (OFFSET in start.params.policy["params"]) != config.mirror:
        raise InputError(
            f"{start.folder}: its policy was trained with another input, other --forces or another --mirror; leave the "
            "options of env as they were."
        )
