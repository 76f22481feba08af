"""Does PPO learn, restart where it should, treat time limits as such, and repeat itself?"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State
from brax.training.agents.ppo.losses import compute_gae

from ballu_mjx import ppo
from ballu_mjx.errors import InputError

# Brax 0.14.2 places parameters with a function that newer JAX means to drop.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:brax")


class Follower(Env):
    """A point mass pushed along a line, rewarded for staying at a place drawn at the start."""

    limit = 10

    def reset(self, rng: jax.Array) -> State:
        goal = jax.random.uniform(rng, (), minval=-1.0, maxval=1.0)
        physics = {"position": jnp.zeros(()), "velocity": jnp.zeros(()), "goal": goal, "time": jnp.zeros((), jnp.int32)}
        zero = jnp.zeros(())
        return State(
            physics,  # pyright: ignore
            self._observe(physics),
            zero,
            zero,
            {"distance": zero},
            {"truncation": zero},
        )

    def step(self, state: State, action: jax.Array) -> State:
        s = physics(state)
        velocity = 0.5 * s["velocity"] + action[0]
        s = s | {"velocity": velocity, "position": s["position"] + velocity, "time": s["time"] + 1}
        distance = jnp.abs(s["position"] - s["goal"])
        escaped = jnp.abs(s["position"]) > 3.0
        late = s["time"] >= self.limit
        return dataclasses.replace(
            state,
            pipeline_state=s,
            obs=self._observe(s),
            reward=jnp.exp(-4.0 * distance),
            done=jnp.asarray(escaped | late, jnp.float32),
            metrics={"distance": distance},
            info=state.info | {"truncation": jnp.asarray(late & ~escaped, jnp.float32)},
        )

    def _observe(self, s: dict) -> jax.Array:
        return jnp.stack([s["position"] - s["goal"], s["velocity"]])

    @property
    def observation_size(self) -> int:
        return 2

    @property
    def action_size(self) -> int:
        return 1

    @property
    def backend(self) -> str:
        return "none"


def physics(state: State) -> dict[str, Any]:
    return state.pipeline_state  # pyright: ignore


SMALL = ppo.PPOConfig(
    num_timesteps=40_000,
    num_envs=64,
    unroll_length=10,
    batch_size=64,
    num_minibatches=4,
    learning_rate=3e-3,
    activation="tanh",
    averaging=1,
    policy_layers=(16,),
    value_layers=(16,),
)


@pytest.fixture(scope="module")
def trained() -> tuple[ppo.Params, list[tuple[int, ppo.Params, dict[str, float]]]]:
    calls = []
    params, last = ppo.train(Follower(), SMALL, lambda *call: calls.append(call))
    assert last == calls[-1][2]
    return params, calls


def test_learning_curve_rises(trained):
    _, calls = trained
    rewards = [metrics["reward"] for _, _, metrics in calls[1:]]
    assert np.mean(rewards[-3:]) > 1.5 * rewards[0]
    distances = [metrics["distance"] for _, _, metrics in calls[1:]]
    assert np.mean(distances[-3:]) < 0.5 * distances[0]


def test_policy_used_alone_gains_what_training_reported(trained):
    params, calls = trained
    env = Follower()
    policy = ppo.make_inference(env.observation_size, env.action_size, SMALL)

    @jax.jit
    @jax.vmap
    def mean_reward(key):
        def step(state, _):
            state = env.step(state, policy(params, state.obs))
            return state, state.reward

        return jnp.mean(jax.lax.scan(step, env.reset(key), length=env.limit)[1])

    alone = float(jnp.mean(mean_reward(jax.random.split(jax.random.key(7), 256))))
    assert alone > calls[-1][2]["reward"] - 0.03  # without exploration no worse, but for chance


def test_calls_count_every_control_step_once(trained):
    _, calls = trained
    size = SMALL.batch_size * SMALL.num_minibatches * SMALL.unroll_length
    assert [step for step, *_ in calls] == list(range(0, SMALL.num_timesteps + size, size))
    assert calls[0][2] == {}
    assert calls[-1][1].normalizer.count == calls[-1][0]


def test_same_seed_same_policy_and_another_seed_another():
    config = dataclasses.replace(SMALL, num_timesteps=5000)
    policies = [
        jax.tree.leaves(ppo.train(Follower(), dataclasses.replace(config, seed=seed))[0].policy) for seed in (3, 3, 4)
    ]
    for first, second in zip(policies[0], policies[1], strict=True):
        np.testing.assert_array_equal(first, second)
    assert any(not np.array_equal(a, b) for a, b in zip(policies[0], policies[2], strict=True))


def test_training_goes_on_from_restored_parameters(trained):
    params, calls = trained
    restored = ppo.from_tree(ppo.as_tree(params))
    steps = []
    again, metrics = ppo.train(
        Follower(),
        dataclasses.replace(SMALL, num_timesteps=2560),
        lambda step, params, metrics: steps.append((step, params)),
        restore=restored,
        first_step=100,
    )
    assert [step for step, _ in steps] == [100, 2660]
    for kept, given in zip(jax.tree.leaves(steps[0][1]), jax.tree.leaves(params), strict=True):
        np.testing.assert_array_equal(kept, given)
    assert metrics["reward"] > 0.9 * calls[-1][2]["reward"]
    assert again.normalizer.count == params.normalizer.count + 2560


def test_fresh_policy_pushes_little(trained):
    _, calls = trained
    fresh = calls[0][1]
    policy = ppo.make_inference(2, 1, SMALL)
    observations = 3.0 * jax.random.normal(jax.random.key(0), (1000, 2))
    actions = jax.vmap(policy, in_axes=(None, 0))(fresh, observations)
    assert float(jnp.abs(actions).max()) < 0.1
    std = np.exp(next(x for path, x in jax.tree.leaves_with_path(fresh.policy) if "log_value" in str(path)))
    np.testing.assert_allclose(std, SMALL.initial_std, rtol=1e-6)


def test_every_reset_draws_a_fresh_state():
    env = ppo.wrap_for_training(Follower())
    step = jax.jit(env.step)
    state = jax.jit(env.reset)(jax.random.split(jax.random.key(0), 8))
    goals = [np.asarray(physics(state)["goal"])]
    for _ in range(5 * Follower.limit):
        state = step(state, jnp.zeros((8, 1)))
        if state.done.all():
            goals.append(np.asarray(physics(state)["goal"]))
            # What the policy sees next is the fresh state, and the clock starts anew.
            np.testing.assert_allclose(state.obs["state"][:, 0], -goals[-1], atol=1e-6)
            np.testing.assert_array_equal(physics(state)["time"], 0)
    assert len(np.unique(np.stack(goals))) == 6 * 8


def test_only_finished_environments_are_reset():
    env = ppo.wrap_for_training(Follower())
    state = env.reset(jax.random.split(jax.random.key(0), 2))
    goals = np.asarray(physics(state)["goal"])
    for _ in range(3):
        state = env.step(state, jnp.array([[1.0], [0.0]]))
    # The first is beyond 3 by now, which ends it, and not by time.
    np.testing.assert_array_equal(state.done, [1.0, 0.0])
    np.testing.assert_array_equal(state.info["truncation"], [0.0, 0.0])
    assert physics(state)["goal"][0] != goals[0]
    assert physics(state)["goal"][1] == goals[1]
    assert physics(state)["time"][1] == 3
    # Reward and metrics are the finished episode's, not the fresh one's.
    assert state.reward[0] < 0.01 and state.metrics["distance"][0] > 2.0
    np.testing.assert_allclose(state.obs["progress"], np.stack([state.reward, state.metrics["distance"]], 1))


def test_time_limit_is_told_from_an_end():
    env = ppo.wrap_for_training(Follower())
    state = env.reset(jax.random.split(jax.random.key(0), 2))
    ends = []
    for _ in range(Follower.limit + 1):
        state = env.step(state, jnp.zeros((2, 1)))
        ends.append((float(state.done[0]), float(state.info["truncation"][0])))
    assert ends == [(0.0, 0.0)] * (Follower.limit - 1) + [(1.0, 1.0), (0.0, 0.0)]


def test_truncation_bootstraps_in_brax():
    """What `wrap_for_training` says of Brax's advantages: one value per step, truncated or ended at step 2 of 4."""
    rewards = jnp.array([[1.0], [2.0], [3.0], [4.0]])
    values = jnp.array([[10.0], [20.0], [30.0], [1000.0]])
    end = jnp.array([[0.0], [0.0], [1.0], [0.0]])
    settings = {"lambda_": 0.5, "discount": 0.9}
    none = jnp.zeros_like(end)
    targets, advantages = compute_gae(end, none, rewards, values, jnp.array([50.0]), **settings)
    assert targets[2, 0] == values[2, 0] and advantages[2, 0] == 0.0
    np.testing.assert_allclose(targets[1, 0], rewards[1, 0] + 0.9 * values[2, 0], rtol=1e-6)
    targets, _ = compute_gae(none, end, rewards, values, jnp.array([50.0]), **settings)
    np.testing.assert_allclose(targets[2, 0], rewards[2, 0], rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "option", "mend"),
    [
        ({"num_envs": 100}, "--num-envs", "128 is the nearest"),
        ({"num_envs": 4096}, "--num-envs", "256 is the nearest"),
        ({"num_envs": 1}, "--num-envs", "2 is the nearest"),
        ({"batch_size": 63}, "--batch-size", "64 is the nearest"),
        ({"num_timesteps": 0}, "--num-timesteps", "1 or more"),
        ({"discounting": 1.1}, "--discounting", "between 0 and 1"),
        ({"policy_layers": ()}, "--policy-layers", "width"),
        ({"initial_std": 0.0}, "--initial-std", "greater than 0"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(change, option, mend):
    with pytest.raises(InputError, match=mend) as error:
        ppo.check(dataclasses.replace(SMALL, **change), devices=2)
    assert str(error.value).startswith(option)
