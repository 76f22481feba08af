"""Symmetric policies: mirrored observations lead to mirrored actions, also after export."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballu_mjx.rl import ppo
from ballu_mjx.rl.mirror import Mirror, SignedPermutation, join_permutations
from ballu_mjx.rl.network_export import network_arrays

VECTOR = SignedPermutation((0, 1, 2), (1.0, -1.0, 1.0))
SWAP = SignedPermutation((1, 0), (1.0, 1.0))
MIRROR = Mirror(join_permutations([VECTOR, SWAP, VECTOR]), join_permutations([SWAP, VECTOR]))
CONFIG = ppo.PPOConfig(policy_layers=(16, 8), activation="tanh")
OFFSET = np.arange(1.0, 6.0)


@pytest.fixture(scope="module")
def params() -> ppo.Params:
    """Parameters of a random network of order 1, with unequal scales of the inputs, and with an offset."""
    rng = np.random.default_rng(0)
    start = ppo.initial_policy(rng.normal(1.0, np.exp(rng.normal(size=8)), (50, 8)), 5, CONFIG, MIRROR)
    policy: Any = jax.device_get(start.policy)
    policy["params"]["Dense_0"] = {"kernel": rng.normal(size=(8, 5)), "bias": rng.normal(size=5)}
    return start._replace(policy=ppo.with_mean(policy, OFFSET))


def test_joined_mirror_images():
    image = np.asarray(MIRROR.observation(np.arange(8.0)))
    np.testing.assert_array_equal(image, [0, -1, 2, 4, 3, 5, -6, 7])
    np.testing.assert_array_equal(MIRROR.observation.matrix @ np.arange(8.0), image)


def test_mean_actions_are_symmetric_about_the_offset(params: ppo.Params):
    infer = ppo.make_inference(8, 5, CONFIG, MIRROR)
    seen = jnp.asarray(3.0 * np.random.default_rng(1).normal(size=(20, 8)), jnp.float32)
    action = np.asarray(infer(params, seen)) - OFFSET
    image = np.asarray(infer(params, MIRROR.observation(seen))) - OFFSET
    assert np.abs(action - MIRROR.action(action)).max() > 0.5
    np.testing.assert_allclose(image, MIRROR.action(action), atol=1e-5)


def test_a_share_of_the_policy_is_a_share_of_the_offset_too(params: ppo.Params):
    infer = ppo.make_inference(8, 5, CONFIG, MIRROR)
    seen = jnp.asarray(np.random.default_rng(1).normal(size=(20, 8)), jnp.float32)
    part = params._replace(policy=ppo.with_share(params.policy, 0.25))
    np.testing.assert_allclose(infer(part, seen), 0.25 * np.asarray(infer(params, seen)), atol=1e-5)


def test_the_exported_network_is_a_plain_one(params: ppo.Params):
    """Far inputs are clipped, so the clip must commute with the mirror image."""
    seen = jnp.asarray(30.0 * np.random.default_rng(1).normal(size=(20, 8)), jnp.float32)
    stored = network_arrays(params, CONFIG, MIRROR)
    x = np.clip((seen - stored["mean"]) / stored["std"], -CONFIG.observation_clip, CONFIG.observation_clip)
    for i in range(3):
        x = x @ stored[f"kernel_{i}"] + stored[f"bias_{i}"]
        x = np.tanh(x) if i < 2 else x
    np.testing.assert_allclose(x, ppo.make_inference(8, 5, CONFIG, MIRROR)(params, seen), atol=1e-4)
