"""Gymnasium environment of a locomotion task in PyBullet, for Stable-Baselines3. Both are the paper's software."""

from __future__ import annotations

from typing import Any

import bullet
import gymnasium  # pyright: ignore[reportMissingImports]
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, load_model, standing_qpos
from ballu_mjx.policies.deploy.controller import observation
from ballu_mjx.policies.tasks import TASKS, Step

OBSERVATIONS = 28
"""Result of `locomotion_env.num_observations`, which would import MJX and Brax in every process."""


class LocomotionEnv(gymnasium.Env):
    """Equivalent of `locomotion_env.LocomotionEnv` in the nominal simulator, but simulated in PyBullet.

    Observations, actions, rewards, starting state and random episode lengths are the same. `info["reward"]` is the
    original reward, without changes by wrappers.
    """

    def __init__(self, task: str, timestep: float, episode_seconds: float) -> None:
        """Create the environment of `task`, with Bullet's `timestep` (s) and the mean length of an episode (s)."""
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATIONS,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        model = load_model()
        self._task, self.robot = TASKS[task], bullet.Robot(model, timestep)
        self._start = standing_qpos(model)
        self._mean = round(episode_seconds / CONTROL_TIMESTEP)
        self._com, self._remaining = np.zeros(3), 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, " 28"], dict[str, Any]]:
        """Return the observation of a new episode. The robot stands at the origin and faces x."""
        super().reset(seed=seed)
        self.robot.reset(self._start)
        features, self._com = self.robot.observe()
        self._remaining = int(self.np_random.integers(self._mean // 2, self._mean + self._mean // 2 + 1))
        return observation(features).astype(np.float32), {}

    def step(
        self, action: Float[np.ndarray, " 2"]
    ) -> tuple[Float[np.ndarray, " 28"], float, bool, bool, dict[str, Any]]:
        """Advance one control step with the policy's commands."""
        command = np.clip((np.asarray(action, float) + 1) / 2, 0.0, 1.0)
        self.robot.step(command.tolist())
        features, com = self.robot.observe()
        finite = bool(np.isfinite(features).all())
        velocity = (com - self._com) / CONTROL_TIMESTEP
        reward = float(self._task.reward(Step(velocity, features, command))) if finite else 0.0  # pyright: ignore
        self._com = com
        self._remaining -= 1
        seen = observation(features) if finite else np.zeros(OBSERVATIONS)
        return seen.astype(np.float32), reward, not finite, self._remaining <= 0, {"reward": reward}

    def close(self) -> None:
        """Close the Bullet world."""
        self.robot.close()
