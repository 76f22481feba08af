"""What a training step of PPO hands to the next: one tree on the devices, and its arrays on the host."""

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
    """All that a training step hands to the next, on the devices: environments spread over them, the rest on each.

    - `networks`: policy and value function as they learn.
    - `averaged`: the policy that is handed out (see `PPOConfig.averaging`), in the shape of `networks.policy`.
    - `averaged_steps`: training steps in that average, the starting point not counted.
    - `optimizer`: optax's; Adam's moments, and the learning rate where it has got to.
    - `normalizer`: running statistics of the observations, by name.
    - `environments`: every environment's state, leaves of shape (num_envs, ...), with the keys of its resets.
    - `key`: all randomness of the training steps to come.
    - `steps`: control steps done, all environments together.
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
"""A `TrainingState` on the host: its arrays by their place in it."""


def params(state: TrainingState) -> Params:
    """What `state` has learned so far, with the averaged policy, copied to the host."""
    statistics = state.normalizer
    count = np.array(int(statistics.count), np.float32)  # pyright: ignore[reportArgumentType]
    moments = _copied((statistics.mean, statistics.std, statistics.summed_variance))
    return Params(Normalizer(count, *moments), *_copied((state.averaged, state.networks.value)))


def stored(state: TrainingState) -> dict[str, np.ndarray]:
    """All of `state`, copied to the host, for `Learner.resume`; all processes must ask for it. Arrays without entries
    are left out, which checkpoints cannot hold."""
    arrays = {array_name(path): distributed.on_host(leaf) for path, leaf in jax.tree.leaves_with_path(state)}
    return {name: array for name, array in arrays.items() if array.size}


def with_learning_rate(stored: Stored, rate: float) -> dict[str, np.ndarray]:
    """`stored` with another learning rate to go on with."""
    name = next(name for name in stored if name.endswith("hyperparams.learning_rate"))
    return {**stored, name: np.full_like(stored[name], rate)}


def with_own_memory(state: TrainingState) -> TrainingState:
    """`state` as the compiled step takes it: no two arrays the same one (memory given away twice), and no type that
    only Python's numbers have (a second program)."""
    return jax.tree.map(lambda x: jnp.array(x, jnp.asarray(x).dtype, copy=True), state)


def _copied(tree: Any) -> Any:
    """On the host, in memory of its own."""
    return jax.tree.map(np.array, tree)


def array_name(path: Any) -> str:
    """Return what the array at a place of a tree is called when it is stored."""
    return jax.tree_util.keystr(path, simple=True, separator=".")


def to_uint64(count: int) -> UInt64:
    """Return a count as Brax keeps it: in two numbers of 32 bits."""
    high, low = divmod(count, 2**32)
    return UInt64(hi=high, lo=low)  # pyright: ignore[reportCallIssue]
