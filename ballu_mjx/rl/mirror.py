"""Policies for symmetric robots: the mirror image of an observation leads to the mirror image of the action."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.networks import FeedForwardNetwork
from jaxtyping import Array, Float


class SignedPermutation(NamedTuple):
    """Mirror image of an array. Entry i of the image is `signs[i]` times entry `order[i]`. It is its own inverse."""

    order: tuple[int, ...]
    signs: tuple[float, ...]

    def __call__(self, x: Float[Array | np.ndarray, "*batch n"]) -> Float[Array, "*batch n"]:
        """Return the mirror image along the last axis."""
        return jnp.asarray(x)[..., np.array(self.order, int)] * np.array(self.signs, np.float32)

    @property
    def matrix(self) -> Float[np.ndarray, "n n"]:
        """Matrix that multiplies a column from the left."""
        matrix = np.zeros((len(self.order),) * 2)
        matrix[np.arange(len(self.order)), list(self.order)] = self.signs
        return matrix


def join_permutations(parts: Sequence[SignedPermutation]) -> SignedPermutation:
    """Return the mirror image of an array that consists of parts with these mirror images."""
    starts = np.cumsum([0, *(len(part.order) for part in parts)])
    order = [int(start) + place for start, part in zip(starts, parts, strict=False) for place in part.order]
    return SignedPermutation(tuple(order), tuple(sign for part in parts for sign in part.signs))


class Mirror(NamedTuple):
    """Mirror images of a policy's observations and actions."""

    observation: SignedPermutation
    action: SignedPermutation


OFFSET = "offset"
"""Name of the parameter that `symmetric_policy` adds: mean actions in addition to the symmetric ones."""


def symmetric_policy(network: FeedForwardNetwork, mirror: Mirror, key: str) -> FeedForwardNetwork:
    """Return a policy network whose mean actions are symmetric, apart from a constant.

    They are the mean of `network`'s actions and of the mirrored actions for the mirrored observation, plus the
    parameter `OFFSET`, which is learned, too. A robot whose asymmetry is a constant load therefore keeps it.

    **Arguments**

    - `network`: Brax policy network with a standard deviation that is independent of the state.
    - `mirror`: mirror images.
    - `key`: name of the part of an observation that the policy sees.
    """

    def init(random: Any) -> Any:
        policy = network.init(random)
        offset = jnp.zeros(len(mirror.action.order))
        return {**policy, "params": {**policy["params"], OFFSET: offset}}

    def apply(processor: Any, policy: Any, observation: Any) -> tuple[Array, Array]:
        layers = dict(policy["params"])
        offset = layers.pop(OFFSET)
        inner = {**policy, "params": layers}
        mean, std = even_moments(processor.mean[key], processor.std[key], mirror.observation)
        summed = {key: processor.summed_variance[key]}
        even = RunningStatisticsState(count=processor.count, mean={key: mean}, std={key: std}, summed_variance=summed)
        seen = observation[key]
        (action, deviation), (mirrored, _) = (
            network.apply(even, inner, {**observation, key: each}) for each in (seen, mirror.observation(seen))
        )
        return (action + mirror.action(mirrored)) / 2 + offset, deviation

    return FeedForwardNetwork(init=init, apply=apply)


def even_moments(
    mean: Float[Array | np.ndarray, " n"], std: Float[Array | np.ndarray, " n"], image: SignedPermutation
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return mean and standard deviation of observations that are as frequent as their mirror images, about.

    With these, normalization and mirror image commute.
    """
    variance = jnp.asarray(std) ** 2
    return (jnp.asarray(mean) + image(mean)) / 2, jnp.sqrt((variance + variance[np.array(image.order, int)]) / 2)


def unfold_layers(
    layers: Sequence[tuple[np.ndarray, np.ndarray]], offset: Float[np.ndarray, " actions"], mirror: Mirror
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return kernels and biases of one plain network that computes the mean actions of `symmetric_policy`.

    Its hidden layers are twice as wide: one half sees the observation, the other half its mirror image.
    """
    (first, bias), *hidden, (last, last_bias) = layers
    seen, acts = mirror.observation.matrix, mirror.action.matrix
    unfolded = [(np.hstack([first, seen.T @ first]), np.tile(bias, 2))]
    for kernel, each in hidden:
        zero = np.zeros_like(kernel)
        unfolded.append((np.block([[kernel, zero], [zero, kernel]]), np.tile(each, 2)))
    even = (last_bias + acts @ last_bias) / 2 + offset
    return [*unfolded, (np.vstack([last, last @ acts.T]) / 2, even)]
