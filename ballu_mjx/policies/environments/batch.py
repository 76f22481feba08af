"""A batch of environments for libraries that step from Python.

One compiled program performs a step of the whole batch and resets finished environments.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jaxtyping import Array, Bool, Float

from ballu_mjx.policies.load_simulator import load_simulator
from ballu_mjx.policies.locomotion_config import LocomotionConfig, check_locomotion_config
from ballu_mjx.policies.locomotion_env import LocomotionEnv
from ballu_mjx.policies.policy import environment_of
from ballu_mjx.policies.tasks import find_task
from ballu_mjx.policies.tasks.base import Task
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.sim.sharding import compile_for_devices, device_shardings
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator


class BatchStep(NamedTuple):
    """Result of a step of all environments."""

    observation: Float[np.ndarray, "envs observations"]
    """Observation. For finished environments, it is that of the state after the reset."""
    last_observation: Float[np.ndarray, "envs observations"]
    """Observation before finished environments were reset."""
    reward: Float[np.ndarray, " envs"]
    terminated: Bool[np.ndarray, " envs"]
    """Whether the simulation diverged."""
    truncated: Bool[np.ndarray, " envs"]
    """Whether the episode's time was over."""
    metrics: dict[str, Float[np.ndarray, " envs"]]


class LocomotionBatch:
    """`num_envs` parallel environments of a task in a simulator.

    All devices share the batch if their number divides `num_envs`. Otherwise the first device computes all of it.
    """

    def __init__(self, env: LocomotionEnv, num_envs: int) -> None:
        """Prepare the batch. Nothing is compiled before the first `reset`.

        **Raises** `ValueError` if `num_envs` is less than 1.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}: it must be 1 or more.")
        self.env, self.num_envs = env, num_envs
        devices = jax.local_devices()
        # A batch that the devices cannot share equally stays on one device.
        devices = devices if num_envs % len(devices) == 0 else devices[:1]
        _, self._split = device_shardings(devices)
        self._reset, self._step = (
            compile_for_devices(function, shared=0, devices=devices) for function in (env.reset, self._advance)
        )
        self._key = jax.random.key(np.random.SeedSequence().generate_state(1)[0])
        self._state: State | None = None

    def reset(self, seed: int | None = None) -> Float[np.ndarray, "envs observations"]:
        """Start new episodes in all environments.

        `seed` determines all randomness from here on. Without a seed so far, the system's entropy determines it.
        """
        if seed is not None:
            self._key = jax.random.key(seed)
        self._key, own = jax.random.split(self._key)
        state = self._state = self._reset(self._keys(own))
        return np.array(state.obs)

    def step(self, action: Float[np.ndarray, "envs commands"]) -> BatchStep:
        """Advance all environments by a control step. Actions from -1 to 1 cover the commands' ranges.

        **Raises** `ValueError` before the first `reset`.
        """
        if self._state is None:
            raise ValueError("There is no episode yet; call reset first.")
        self._key, own = jax.random.split(self._key)
        action = jax.device_put(np.asarray(action, np.float32).reshape(self.num_envs, -1), self._split)
        self._state, seen = self._step(self._state, action, self._keys(own))
        return BatchStep(*jax.tree.map(np.array, jax.device_get(seen)))  # libraries write into these arrays

    def _keys(self, key: Array) -> Array:
        return jax.device_put(jax.random.split(key, self.num_envs), self._split)

    def _advance(self, state: State, action: Array, key: Array) -> tuple[State, tuple]:
        after, fresh = self.env.step(state, action), self.env.renew(state, key)
        done = after.done.astype(bool)
        shown = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, after)
        truncated = after.info["truncation"].astype(bool)
        return shown, (shown.obs, after.obs, after.reward, done & ~truncated, truncated, after.metrics)


def make_environment(
    task: str | Task,
    simulator: Simulator | AugmentedSimulator | None = None,
    config: LocomotionConfig | None = None,
    *,
    run: Any = None,
    robot: Any = None,
) -> LocomotionEnv:
    """Return the environment of a task in a simulator, or in that of a run or robot (`load_simulator.load_simulator`).

    **Raises** `InputError` if the task is unknown, an option is out of range, or the robot cannot perform the task.
    """
    augmented = load_simulator(run, robot) if simulator is None else simulator.with_residual(None)
    config = config or LocomotionConfig()
    check_locomotion_config(config, augmented.robot.control_timestep)
    chosen = find_task(task) if isinstance(task, str) else task
    return environment_of(augmented.robot, chosen, config, augmented.actuators, TrainedResidual.of(augmented))
