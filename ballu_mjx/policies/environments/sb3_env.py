"""Tasks in improved simulators as vector environments of Stable-Baselines3, which differ from those of Gymnasium."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.environments.gym_env import GymVectorEnv

try:
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise InputError(
        "The package stable-baselines3 is not installed; `pip install -c constraints.txt stable-baselines3` brings it."
    ) from error


class StableBaselinesEnv(VecEnv):
    """A `GymVectorEnv` for Stable-Baselines3. `info` has the entry `episode` of Stable-Baselines3's `VecMonitor`."""

    def __init__(self, env: GymVectorEnv) -> None:
        self._env, self._seed, self.render_mode = env, None, None
        self._actions = np.zeros(env.action_space.shape or (), np.float32)
        self._return, self._length = np.zeros(env.num_envs), np.zeros(env.num_envs, int)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        """Start all episodes."""
        self._return[:], self._length[:] = 0.0, 0
        seed = self._seeds[0]
        self._reset_seeds()
        return self._env.reset(seed=seed)[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions for the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advance all environments by a control step."""
        observation, reward, terminated, truncated, more = self._env.step(self._actions)
        done = terminated | truncated
        self._return += reward
        self._length += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done):
            infos[index] = {
                "terminal_observation": more["final_obs"][index],  # pyright: ignore
                "TimeLimit.truncated": bool(truncated[index]),
                "episode": {"r": float(self._return[index]), "l": int(self._length[index]), "t": 0.0},
            }
        self._return[done], self._length[done] = 0.0, 0
        return observation, reward, done, infos

    def close(self) -> None:
        """Do nothing: there are no resources to release."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the vector environment, once for each index."""
        return [getattr(self._env, attr_name, None)] * len(self._get_indices_of(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: all environments are one object.

        **Raises** `NotImplementedError` always.
        """
        raise NotImplementedError(f"{attr_name} cannot be set: all environments are one object.")

    def env_method(self, method_name: str, *arguments: Any, indices: Any = None, **named: Any) -> list[Any]:
        """Refuse: all environments are one object.

        **Raises** `NotImplementedError` always.
        """
        raise NotImplementedError(f"{method_name} cannot be called: all environments are one object.")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False for each index: no environment is wrapped."""
        return [False] * len(self._get_indices_of(indices))

    def _get_indices_of(self, indices: Any) -> Sequence[int]:
        return list(self._get_indices(indices))
