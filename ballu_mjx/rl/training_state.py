"""State of a PPO training between two training steps, as a tree on the devices and as arrays on the host."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import State
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo.losses import PPONetworkParams
from brax.training.types import UInt64
from jaxtyping import Array, Int, UInt32

from ballu_mjx.rl import distributed
from ballu_mjx.rl.ppo import Normalizer, Params


class TrainingState(NamedTuple):
    """State of a training on the devices. The environments are distributed over the devices, the rest is on each.

    - `networks`: current parameters of policy and value function.
    - `averaged`: the averaged policy, which is saved (see `PPOConfig.averaging`), in the shape of `networks.policy`.
    - `averaged_steps`: number of training steps in this average, without the initial policy.
    - `optimizer`: state of the optax optimizer, with Adam's moments and the current learning rate.
    - `normalizer`: running statistics of the observations, by name.
    - `environments`: states of all environments (leaves of shape (num_envs, ...)), with the keys of their resets.
    - `key`: random key of all later training steps.
    - `steps`: control steps done, summed over all environments.
    """

    networks: PPONetworkParams
    averaged: Any
    averaged_steps: Int[Array, ""]
    optimizer: optax.OptState
    normalizer: RunningStatisticsState
    environments: State
    key: UInt32[Array, 2]
    steps: UInt64


Stored = Mapping[str, np.ndarray]
"""A `TrainingState` on the host: arrays by `array_name` of their place in the tree."""


def params(state: TrainingState) -> Params:
    """Return the parameters of `state`, with the averaged policy, copied to the host."""
    statistics = state.normalizer
    count = np.array(int(statistics.count), np.float32)  # pyright: ignore[reportArgumentType]
    moments = _copied((statistics.mean, statistics.std, statistics.summed_variance))
    return Params(Normalizer(count, *moments), *_copied((state.averaged, state.networks.value)))


def stored(state: TrainingState) -> dict[str, np.ndarray]:
    """Return all arrays of `state`, copied to the host, for `Learner.resume`. All processes must call this function.

    Empty arrays are left out, because checkpoints cannot hold them.
    """
    arrays = {array_name(path): distributed.on_host(leaf) for path, leaf in jax.tree.leaves_with_path(state)}
    return {name: array for name, array in arrays.items() if array.size}


def with_learning_rate(stored: Stored, rate: float) -> dict[str, np.ndarray]:
    """Return `stored` with another learning rate."""
    name = next(name for name in stored if name.endswith("hyperparams.learning_rate"))
    return {**stored, name: np.full_like(stored[name], rate)}


def with_own_memory(state: TrainingState) -> TrainingState:
    """Return `state` with a separate buffer for each array and without weak types, as the compiled step needs it.

    A shared buffer would be donated twice, and weak types would compile a second program.
    """
    return jax.tree.map(lambda x: jnp.array(x, jnp.asarray(x).dtype, copy=True), state)


def _copied(tree: Any) -> Any:
    """Return a copy of all arrays on the host."""
    return jax.tree.map(np.array, tree)


def array_name(path: Any) -> str:
    """Return the stored name of the array at `path` in a tree."""
    return jax.tree_util.keystr(path, simple=True, separator=".")


def to_uint64(count: int) -> UInt64:
    """Return a count as two numbers of 32 bits, as Brax stores it."""
    high, low = divmod(count, 2**32)
    return UInt64(hi=high, lo=low)  # pyright: ignore[reportCallIssue]
