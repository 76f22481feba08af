"""Wrapper of environments for PPO: vectorization, reset at the end of an episode, and handling of NaN and infinity."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper
from jaxtyping import Array

from ballu_mjx.rl.ppo import STATE

MEASURED = "measured"
"""Key in `State.info` of a step's reward and metrics, before any reset."""
_DIVERGED = "diverged"


def initial_state(inner: Any, observation: Any, metrics: Iterable[str]) -> State:
    """Return an environment's state at the start of an episode: not done, with reward and named `metrics` 0."""
    zero = jnp.zeros(())
    return State(
        pipeline_state=inner,
        obs=observation,
        reward=zero,
        done=zero,
        metrics={name: zero for name in metrics},
        info={"truncation": zero},
    )


def wrap_for_training(env: Env) -> Wrapper:
    """Return `env` vectorized, with each environment reset to a newly drawn state at the end of its episode.

    **Reset.** Brax's auto-reset always returns to a cached first state. Here all environments are reset in every step,
    and only the finished ones use the result. This suits environments whose reset costs little compared with a step.

    **Parameters.** `env` may have an attribute `parameters`, a tree of arrays, and a method
    `with_parameters(parameters)` that returns the same environment with other parameters. A `Learner` passes them to
    its program as arguments. So one compiled program serves all environments that differ only in their parameters.

    **Variants.** If `env` has a method `renew(state, key)`, it is used for resets. The parameters of a variant of the
    environment can then be part of the state, instead of constants of the compiled program.

    **End of an episode.** `env` itself ends its episodes, also after a time limit. It sets `done` and, at a time limit,
    `info["truncation"]`, in both `reset` and `step`. Brax's `compute_gae` treats a truncated transition `t` as follows.
    Its advantage is 0 and the target of its value is the value itself, so it contributes no gradient. The transition
    before it bootstraps from `V(s_t)`, as if the episode continued. The new state after it is not used. So values are
    unbiased, at the cost of one transition in each episode. A `done` without truncation is a termination, after which
    the return is 0.

    **Divergence.** If the observation, a reward or a metric of a step is not finite, the episode ends with a reward of
    0, and rewards and metrics that are not finite become 0. So one diverged simulation does not corrupt the training.
    The metric `diverged` is then 1. Otherwise it is that of `env`, or 0 if `env` has none.

    **Observation.** The observation becomes a dictionary: `state` for the policy and `critic` for the value function,
    if `env` returns both by these names. Otherwise `state` serves both. `info["measured"]` has the reward and the
    metrics of the step, before any reset.
    """
    return _Training(env)


class _Training(Wrapper):
    """Wrapper that `wrap_for_training` describes."""

    def reset(self, rng: Array) -> State:
        keys = jax.vmap(jax.random.split)(rng)
        state = jax.vmap(self.env.reset)(keys[:, 0])
        state = dataclasses.replace(state, metrics={_DIVERGED: jnp.zeros_like(state.reward)} | state.metrics)
        return self._with_extras(state, state, keys[:, 1])

    def step(self, state: State, action: Array) -> State:
        keys = jax.vmap(jax.random.split)(state.info["reset_key"])
        before = dataclasses.replace(state, done=jnp.zeros_like(state.done))
        after = _only_finite(jax.vmap(self.env.step)(before, action))
        renew = getattr(self.env, "renew", lambda state, key: self.env.reset(key))
        fresh = jax.vmap(renew)(before, keys[:, 0])
        done = after.done.astype(bool)

        truncation = after.info["truncation"]
        info = _where(done, fresh.info, {key: after.info[key] for key in fresh.info})
        shown = dataclasses.replace(
            after,
            pipeline_state=_where(done, fresh.pipeline_state, after.pipeline_state),
            obs=_where(done, fresh.obs, after.obs),
            info=info | {"truncation": truncation},
        )
        return self._with_extras(shown, after, keys[:, 1])

    def _with_extras(self, shown: State, outcome: State, keys: Array) -> State:
        """Return `shown` with named observations, the keys of the resets, and the reward and metrics of `outcome`."""
        measured = {"reward": outcome.reward} | outcome.metrics
        info = shown.info | {"reset_key": keys, MEASURED: jax.tree.map(jnp.float32, measured)}
        named = dict(shown.obs) if isinstance(shown.obs, Mapping) else {STATE: shown.obs}
        return dataclasses.replace(shown, obs=named, info=info)


def _only_finite(state: State) -> State:
    """Return a batch of states with diverged episodes ended, as `wrap_for_training` describes."""
    parts = jax.tree.leaves((state.obs, state.reward, state.metrics))
    good = functools.reduce(jnp.logical_and, (jnp.isfinite(x).reshape(len(x), -1).all(axis=1) for x in parts))
    metrics = {name: jnp.where(jnp.isfinite(x), x, 0.0) for name, x in state.metrics.items()}
    return dataclasses.replace(
        state,
        reward=jnp.where(good, state.reward, 0.0),
        done=jnp.where(good, state.done, 1.0),
        metrics=metrics | {_DIVERGED: jnp.where(good, metrics.get(_DIVERGED, 0.0), 1.0)},
        info=state.info | {"truncation": jnp.where(good, state.info["truncation"], 0.0)},
    )


def _where(done: Array, new: Any, old: Any) -> Any:
    """Return `new` for the environments that are done, `old` for the others."""

    def select(new: Array, old: Array) -> Array:
        return jnp.where(done.reshape(done.shape + (1,) * (old.ndim - 1)), new, old)

    return jax.tree.map(select, new, old)
