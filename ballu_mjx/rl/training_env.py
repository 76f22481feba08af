"""Environments as PPO trains in them: vectorized, reset when an episode ends, and without numbers that are none."""

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
"""Where `State.info` has a step's reward and metrics, before any reset."""
_DIVERGED = "diverged"


def initial_state(inner: Any, observation: Any, metrics: Iterable[str]) -> State:
    """Return an environment's state at the start of an episode: not done, reward and metrics (by name) 0."""
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
    """`env` vectorized, with every finished environment reset to a newly drawn state.

    Brax's own auto-reset goes back to a cached first state for ever. Here all environments are reset in every step,
    and the finished ones take the result: for environments whose reset costs nothing beside their step.

    An `env` may have `contents`, a tree of arrays, and a method `with_contents(contents)` that gives the same with
    others: a `Learner` hands them to its program, which so serves all environments that differ in nothing else.

    An `env` with a method `renew(state, key)` is reset by it: what tells one variant of an environment from another can
    then be handed on from state to state, instead of being a constant of the compiled program.

    `env` ends its episodes itself, by time also: it sets `done` and, where only time ran out,
    `info["truncation"]`, in both `reset` and `step`. What Brax's `compute_gae` makes of a truncated transition
    `t`: its advantage is 0 and its value's target the value itself, so that it teaches nothing; the transition before
    bootstraps from `V(s_t)`, as if the episode went on; the fresh state behind it never enters. So values are unbiased
    at the price of one transition in an episode. A `done` without truncation is a termination, with 0 to come.

    A step whose observation, reward or metrics are not all finite ends its episode with a reward of 0, and the numbers
    that are none become 0: one robot that explodes must not spoil what all learn. The metric `diverged` is 1 there, and
    otherwise the environment's own, if it has one.

    The observation becomes a dictionary: `state` for the policy, `critic` for the value function where `env` gives both
    by these names (else `state` serves both). `info["measured"]` has the step's reward and metrics, before any reset.
    """
    return _Training(env)


class _Training(Wrapper):
    """See `wrap_for_training`."""

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
        """Name the observations, and add the keys of the resets and the outcome's reward and metrics."""
        measured = {"reward": outcome.reward} | outcome.metrics
        info = shown.info | {"reset_key": keys, MEASURED: jax.tree.map(jnp.float32, measured)}
        named = dict(shown.obs) if isinstance(shown.obs, Mapping) else {STATE: shown.obs}
        return dataclasses.replace(shown, obs=named, info=info)


def _only_finite(state: State) -> State:
    """What `wrap_for_training` says of numbers that are none; `state` is a batch."""
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
    """`new` for the environments that are done, `old` for the others."""

    def select(new: Array, old: Array) -> Array:
        return jnp.where(done.reshape(done.shape + (1,) * (old.ndim - 1)), new, old)

    return jax.tree.map(select, new, old)
