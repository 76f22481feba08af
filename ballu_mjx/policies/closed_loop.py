"""Closed-loop simulation of policies in their own simulator."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jaxtyping import Array, Float

from ballu_mjx.common.compiler_options import FOR_ONE_RUN
from ballu_mjx.policies.domain_randomization import SimulatorSetting, Start, draw_start
from ballu_mjx.policies.locomotion_env import EnvironmentParameters, LocomotionEnv, locomotion_state
from ballu_mjx.rl.ppo import Inference, Params
from ballu_mjx.sim.observation import ObservationLayout
from ballu_mjx.sim.sharding import chunks


class Rollout(NamedTuple):
    """Closed-loop simulations, sampled at the control rate. The first state is the starting state."""

    qpos: Float[np.ndarray, "runs states nq"]
    features: Float[np.ndarray, "runs states features"]
    """Features (`observation.observe_features`)."""
    com: Float[np.ndarray, "runs states 3"]
    """Centre of mass (m, world)."""
    command: Float[np.ndarray, "runs steps commands"]
    """Commands, in the actuators' units."""
    outside: Float[np.ndarray, "runs steps"]
    """1 if the residual's observation was outside its training range, else 0."""
    reward: Float[np.ndarray, "runs steps"]
    """Reward of the task, less the cost of leaving the residual's training range (`LocomotionConfig.outside_cost`)."""
    diverged: Float[np.ndarray, "runs steps"]
    """1 if the physics diverged, else 0. The robot then keeps its state, and gets no reward."""

    @property
    def yaw(self) -> Float[np.ndarray, "runs states"]:
        """Yaw of the tracked body (rad), not unwrapped."""
        return self.features[..., ObservationLayout.yaw]

    @property
    def divergence(self) -> str | None:
        """Sentence about simulations that diverged. None if there are none."""
        count = int(np.count_nonzero(self.diverged.any(axis=1)))
        if not count:
            return None
        return (
            f"Physics diverged in {count} of {len(self.diverged)} simulations of the policy, where the robot then "
            "stands still: its commands or the residual are too extreme for the simulator's time step."
        )


_CHUNK = 100
"""Number of control steps in one call of the compiled program."""
_BATCH = 8
"""Number of runs that it simulates in parallel. Fewer are filled up to this number; more are split into batches."""
_NOISE_SEED = 1
"""Seed of the noise of a residual that is sampled (`LocomotionConfig.sampled_residual`)."""


class ClosedLoop:
    """Closed-loop simulation of policies.

    One compiled program serves any number of runs and steps, and any parameters of the policy. It also serves all
    simulators that differ only in their parameters (`LocomotionEnv.parameters`).
    """

    def __init__(self, env: LocomotionEnv, infer: Inference) -> None:
        self._parameters = env.parameters

        def look(state: State) -> tuple[Array, ...]:
            now = locomotion_state(state)
            return now.rollout.physics.qpos, now.rollout.features, now.com

        def run(params: Params, parameters: EnvironmentParameters, state: State) -> Any:
            here = env.with_parameters(parameters)

            def advance(state: State, _: None) -> tuple[State, Any]:
                action = infer(params, state.obs)  # pyright: ignore[reportArgumentType]
                after = here.step(state, action)
                outside, diverged = (after.metrics[name] for name in ("outside", "diverged"))
                return after, (*look(after), env.command_of(action), outside, after.reward, diverged)

            return jax.lax.scan(advance, state, None, _CHUNK)

        def at(parameters: EnvironmentParameters, qpos: Array, qvel: Array, key: Array) -> State:
            return env.with_parameters(parameters).at(qpos, qvel, key)

        def draw(setting: SimulatorSetting, key: Array) -> Start:
            return draw_start(setting, env.robot, key)

        self._run = jax.jit(jax.vmap(run, in_axes=(None, None, 0)))
        self._at = jax.jit(jax.vmap(at, in_axes=(None, 0, 0, 0)), compiler_options=dict(FOR_ONE_RUN))
        self._look = jax.vmap(look)
        self._draw = jax.jit(jax.vmap(draw, in_axes=(None, 0)))

    def __call__(
        self,
        params: Params,
        qpos: Float[np.ndarray, "runs nq"],
        qvel: Float[np.ndarray, "runs nv"],
        steps: int,
    ) -> Rollout:
        """Simulate `steps` control steps from each of the given states."""
        parts = list(chunks(len(qpos), _BATCH))
        # Not the keys of `standing`, so that the noise of a residual does not depend on the starting state.
        keys = jax.random.split(jax.random.key(_NOISE_SEED), (len(parts), _BATCH))
        rollouts = [
            self._batch(params, qpos[rows], qvel[rows], own, steps, kept)
            for (rows, kept), own in zip(parts, keys, strict=True)
        ]
        return Rollout(*(np.concatenate(parts) for parts in zip(*rollouts, strict=True)))

    def _batch(self, params: Params, qpos: np.ndarray, qvel: np.ndarray, keys: Array, steps: int, runs: int) -> Rollout:
        start = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel))
        state = self._at(self._parameters, *start, keys)
        pieces = [tuple(np.asarray(x)[:, None] for x in self._look(state))]
        outcomes = []
        for _ in range(-(-steps // _CHUNK)):
            state, seen = self._run(params, self._parameters, state)
            state_parts, step_parts = seen[: len(pieces[0])], seen[len(pieces[0]) :]
            pieces.append(tuple(np.asarray(x) for x in state_parts))
            outcomes.append(tuple(np.asarray(x) for x in step_parts))
        states = (np.concatenate(parts, axis=1)[:runs, : steps + 1] for parts in zip(*pieces, strict=True))
        per_step = (np.concatenate(parts, axis=1)[:runs, :steps] for parts in zip(*outcomes, strict=True))
        return Rollout(*states, *per_step)

    def initial(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the initial pose at rest, as one starting state (qpos, qvel). Nothing is drawn."""
        setting = self._parameters.setting
        return np.asarray(setting.initial)[None], np.zeros((1, len(setting.spread.velocity)), np.float32)

    def standing(self, count: int = 1, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return `count` starting states (qpos, qvel), drawn as in training."""
        start = self._draw(self._parameters.setting, jax.random.split(jax.random.key(seed), count))
        return np.asarray(start.qpos), np.asarray(start.qvel)
