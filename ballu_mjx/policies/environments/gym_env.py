"""Tasks in improved simulators as Gymnasium environments, single and vector.

Actions from -1 to 1 cover the range of each command. Observations are those of this package's own policies
(`deploy.controller.observation_names` names their entries). An episode ends with `truncated` after a drawn time with
mean `LocomotionConfig.episode_seconds`, or with `terminated` if the simulation diverged.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, SupportsFloat

import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.deploy.controller import observation_names
from ballu_mjx.policies.environments.batch import LocomotionBatch, make_environment
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.locomotion_env import LocomotionEnv
from ballu_mjx.policies.tasks.base import Task
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
except ImportError as error:
    raise InputError(
        'The package gymnasium is not installed; `pip install -c constraints.txt -e ".[gym]"` brings it.'
    ) from error


class GymEnv(gymnasium.Env):
    """A task in a simulator, with one robot, for programs that need a single environment.

    `GymVectorEnv` is many times faster.
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, env: LocomotionEnv) -> None:
        self.locomotion = env
        self.observation_space, self.action_space = _spaces(env)
        self._batch = LocomotionBatch(env, 1)

    @property
    def observation_names(self) -> list[str]:
        """Names of the entries of the observation, with units."""
        return observation_names((self.locomotion.robot.tracked, *self.locomotion.robot.points))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode. `seed` determines all randomness from here on."""
        super().reset(seed=seed)
        return self._batch.reset(seed)[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, SupportsFloat, bool, bool, dict[str, Any]]:
        """Advance by a control step."""
        found = self._batch.step(np.asarray(action, np.float32)[None])
        info = {name: float(value[0]) for name, value in found.metrics.items()}
        return (
            found.last_observation[0],
            float(found.reward[0]),
            bool(found.terminated[0]),
            bool(found.truncated[0]),
            info,
        )


class GymVectorEnv(VectorEnv):
    """A task in a simulator, with many robots in one compiled program.

    Finished environments are reset in the same step. `info` then has `final_obs` and its mask `_final_obs`. In every
    step it has the environments' metrics.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, env: LocomotionEnv, num_envs: int) -> None:
        self.locomotion, self.num_envs = env, num_envs
        self.single_observation_space, self.single_action_space = _spaces(env)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self._batch = LocomotionBatch(env, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, "envs observations"], dict[str, Any]]:
        """Start all episodes. `seed` determines all randomness from here on; of a list, only the first entry counts."""
        first = seed[0] if isinstance(seed, list) else seed
        super().reset(seed=first)
        return self._batch.reset(first), {}

    def step(
        self, actions: Float[np.ndarray, "envs commands"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance all environments by a control step."""
        found = self._batch.step(actions)
        info: dict[str, Any] = dict(found.metrics)
        done = found.terminated | found.truncated
        if done.any():
            info |= {"final_obs": found.last_observation, "_final_obs": done}
        return found.observation, found.reward, found.terminated, found.truncated, info


def _spaces(env: LocomotionEnv) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    seen = gymnasium.spaces.Box(-np.inf, np.inf, (env.observation_size,), np.float32)
    return seen, gymnasium.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)


def gym_env(
    simulator: Simulator | AugmentedSimulator | None = None,
    task: str | Task = "walk",
    *,
    run: Path | str | None = None,
    robot: Path | str | None = None,
    config: LocomotionConfig | None = None,
    **settings: Any,
) -> GymEnv:
    """Return a task in a simulator, or in that of a run or robot, as a Gymnasium environment.

    `settings` are fields of `config`. **Raises** `InputError` like `batch.make_environment`.
    """
    return GymEnv(make_environment(task, simulator, _config(config, settings), run=run, robot=robot))


def gym_vector_env(
    simulator: Simulator | AugmentedSimulator | None = None,
    task: str | Task = "walk",
    num_envs: int = 1,
    *,
    run: Path | str | None = None,
    robot: Path | str | None = None,
    config: LocomotionConfig | None = None,
    **settings: Any,
) -> GymVectorEnv:
    """Return `num_envs` parallel environments as a Gymnasium vector environment; see `gym_env`."""
    return GymVectorEnv(make_environment(task, simulator, _config(config, settings), run=run, robot=robot), num_envs)


def _config(config: LocomotionConfig | None, settings: dict[str, Any]) -> LocomotionConfig:
    return dataclasses.replace(config or LocomotionConfig(), **settings)
