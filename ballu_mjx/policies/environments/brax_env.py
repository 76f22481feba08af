"""Tasks in improved simulators as Brax environments, for training with Brax's own trainers."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, cast

import jax.numpy as jnp
from brax.envs.base import Env, State
from jaxtyping import Array

from ballu_mjx.policies.environments.batch import make_environment
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.locomotion_env import LocomotionEnv, locomotion_state
from ballu_mjx.policies.tasks.base import Task
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator

_ENDLESS = 2**30


class BraxEnv(Env):
    """A task in a simulator, as an environment whose episodes the caller ends.

    Brax's trainers do so by `episode_length`. `done` is 1 if the simulation diverged. Brax's own wrapper starts every
    episode of an environment in the state that was drawn first.
    """

    def __init__(
        self,
        task: str | Task = "walk",
        simulator: Simulator | AugmentedSimulator | None = None,
        *,
        run: Path | str | None = None,
        robot: Path | str | None = None,
        config: LocomotionConfig | None = None,
        **settings: Any,
    ) -> None:
        """Make the environment of a simulator, or of that of a run or robot. `settings` are fields of `config`.

        **Raises** `InputError` like `batch.make_environment`.
        """
        config = dataclasses.replace(config or LocomotionConfig(), **settings)
        self.locomotion: LocomotionEnv = make_environment(task, simulator, config, run=run, robot=robot)

    @property
    def episode_length(self) -> int:
        """Number of control steps in a trial of the task. Brax's trainers take it under this name."""
        return max(round(self.locomotion.task.trial_seconds / self.dt), 1)

    @property
    def dt(self) -> float:
        """Duration of a control step (s)."""
        return self.locomotion.robot.control_timestep

    def reset(self, rng: Array) -> State:
        """Start an episode."""
        state = self.locomotion.reset(rng)
        endless = locomotion_state(state)._replace(remaining=jnp.asarray(_ENDLESS, jnp.int32))
        return dataclasses.replace(state, pipeline_state=cast(Any, endless))

    def step(self, state: State, action: Array) -> State:
        """Advance by a control step. Actions from -1 to 1 cover the commands' ranges."""
        return self.locomotion.step(state, action)

    @property
    def observation_size(self) -> int:
        return self.locomotion.observation_size

    @property
    def action_size(self) -> int:
        return self.locomotion.action_size

    @property
    def backend(self) -> str:
        return self.locomotion.backend


def brax_env(
    simulator: Simulator | AugmentedSimulator | None = None, task: str | Task = "walk", **options: Any
) -> BraxEnv:
    """Return a task in a simulator as a Brax environment. `options` are those of `BraxEnv`."""
    return BraxEnv(task, simulator, **options)
