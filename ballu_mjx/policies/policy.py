"""A trained locomotion policy: its commands, and its own simulator in closed loop."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.closed_loop import ClosedLoop
from ballu_mjx.policies.locomotion_env import (
    OBSERVATIONS,
    LocomotionConfig,
    LocomotionEnv,
    check_locomotion_config,
    command_of,
    locomotion_observation,
    setting_name,
)
from ballu_mjx.policies.tasks import TASKS, Task
from ballu_mjx.residuals.run_config import run_actuators, run_residual, run_robot
from ballu_mjx.residuals.trained import TrainedResidual
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import Inference, Params, PPOConfig
from ballu_mjx.robots.model import ModelParameters, same_parameters
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs.checkpoints import Which, restore_checkpoint
from ballu_mjx.runs.folder import read_config, typed_config

ACTIONS = 2
"""One command a servo."""


@dataclasses.dataclass(frozen=True)
class Policy:
    """The deterministic policy of a run, and what it was trained in.

    **Fields**

    - `task`, `config`, `actuators` (None: nominal), `residual` (the run's folder; None: none): its simulator.
    - `params`: what `learner.params` gave.
    - `infer`: (parameters, observation) to action.
    - `step`: control steps of training behind it.
    """

    task: Task
    config: LocomotionConfig
    actuators: ModelParameters | None
    residual: Path | None
    params: Params
    infer: Inference
    step: int

    @staticmethod
    def load(folder: Path | str, which: Which = "best") -> Policy:
        """The policy in a run's best checkpoint, by its reward without exploration; in the last, or that of a step.

        **Raises** `InputError` where `folder` is no run of a locomotion task, or has no such checkpoint.
        """
        folder = Path(folder)
        stored = read_config(folder, *TASKS)
        config = typed_config(LocomotionConfig, stored, "env", folder, check_locomotion_config)
        sizes = OBSERVATIONS, ACTIONS, typed_config(PPOConfig, stored, "ppo", folder, ppo.check_values)
        infer = ppo.make_inference(*sizes)
        step, tree = restore_checkpoint(folder, which)
        params = ppo.from_tree(tree)
        if not ppo.fits(infer, params, OBSERVATIONS):
            raise InputError(
                f"{folder}: the stored parameters are not of the network in its config.json; restore one of the two."
            )
        return Policy(
            task=TASKS[stored["task"]],
            config=config,
            actuators=run_actuators(stored, folder, run_robot(stored, folder)),
            residual=run_residual(stored, folder),
            params=params,
            infer=infer,
            step=step,
        )

    @functools.cached_property  # a residual's name takes reading its run
    def setting(self) -> str:
        """The paper's name of the simulator; see `locomotion_env.setting_name`."""
        name = None if self.residual is None else TrainedResidual.load(self.residual).model.name
        return setting_name(self.config, self.actuators is not None, name)

    def environment(self) -> LocomotionEnv:
        """The simulator that the policy was trained in."""
        return make_environment(self.task, self.config, self.actuators, self.residual)

    def closed_loop(self) -> ClosedLoop:
        """That simulator, for any parameters of the policy."""
        return ClosedLoop(self.environment(), self.infer)

    def act(self) -> Callable[[Float[np.ndarray, " 27"]], Float[np.ndarray, " 2"]]:
        """`observation.observe_features` to servo commands, for use outside of JAX, step by step."""

        @jax.jit
        def command(features: Array) -> Array:
            return command_of(self.infer(self.params, locomotion_observation(features)))

        return lambda features: np.asarray(command(jnp.asarray(features, jnp.float32)), np.float64)


def make_environment(
    task: Task, config: LocomotionConfig, actuators: ModelParameters | None, residual: Path | None
) -> LocomotionEnv:
    """A task's simulator.

    **Raises** `InputError` where `residual` holds no residual, or one that belongs to other actuators.
    """
    force = None if residual is None else TrainedResidual.load(residual)
    if force is not None and not same_parameters(force.actuators, actuators):
        raise InputError(
            f"{residual}: its forces were learned beside other actuators; give --actuators the same file, or leave it "
            "out to take the residual's."
        )
    return LocomotionEnv(load_robot().load_model(), task, config, actuators=actuators, residual=force)
