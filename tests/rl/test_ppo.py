"""PPO: learning, resets, time limits, reproducibility and resuming."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import State
from brax.training.agents.ppo import train as brax_ppo
from brax.training.agents.ppo.losses import compute_gae
from follower import Follower, physics

from ballu_mjx.common.errors import InputError
from ballu_mjx.rl import learner, ppo, training_env, training_state
from ballu_mjx.rl.learner import Learner

SMALL = ppo.PPOConfig(
    num_timesteps=40_000,
    num_envs=64,
    unroll_length=10,
    batch_size=64,
    num_minibatches=4,
    learning_rate=3e-3,
    reward_scaling=1.0,
    initial_std=0.5,
    activation="tanh",
    averaging=3,
    policy_layers=(16,),
    value_layers=(16,),
)


Calls = list[tuple[int, ppo.Params, dict[str, float]]]


@pytest.fixture(scope="module")
def trained() -> tuple[dict[str, np.ndarray], Calls]:
    """The complete last state, and the arguments of every callback."""
    calls: Calls = []
    last, metrics = learner.train(
        Follower(), SMALL, lambda step, state, metrics: calls.append((step, training_state.params(state), metrics))
    )
    assert metrics == calls[-1][2]
    return training_state.stored(last), calls


def test_orthogonal_hidden_layers_keep_lengths():
    """Hidden layers are orthogonal times the root of 2, as in Stable-Baselines3. The output layer is not affected."""
    config = dataclasses.replace(SMALL, orthogonal_init=True, policy_layers=(24, 16))
    layers = ppo.make_networks({ppo.STATE: (32,)}, 3, config).policy_network.init(jax.random.key(0))["params"]
    hidden = [np.asarray(x) for x in jax.tree.leaves(layers) if x.shape in ((32, 24), (24, 16))]
    squares = [kernel.T @ kernel for kernel in hidden]
    assert len(squares) == 2
    for square in squares:
        np.testing.assert_allclose(square, 2 * np.eye(len(square)), atol=1e-5)


def test_learning_curve_rises(trained):
    _, calls = trained
    rewards = [metrics["reward"] for _, _, metrics in calls[1:]]
    assert np.mean(rewards[-3:]) > 1.5 * rewards[0]
    distances = [metrics["distance"] for _, _, metrics in calls[1:]]
    assert np.mean(distances[-3:]) < 0.5 * distances[0]


def test_policy_alone_gains_the_reward_that_training_reported(trained):
    _, calls = trained
    params = calls[-1][1]
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
    assert alone > calls[-1][2]["reward"] - 0.03  # without exploration, the reward is not lower, except for noise


def test_callbacks_count_every_control_step_once(trained):
    _, calls = trained
    size = SMALL.batch_size * SMALL.num_minibatches * SMALL.unroll_length
    assert [step for step, *_ in calls] == list(range(0, SMALL.num_timesteps + size, size))
    assert calls[0][2] == {}
    assert calls[-1][1].normalizer.count == calls[-1][0]


class BraxTraining(training_env._Training):
    """Environment with the additional entries that only Brax's own loop reads."""

    def _with_extras(self, shown: State, outcome: State, keys: jax.Array) -> State:
        state = super()._with_extras(shown, outcome, keys)
        return dataclasses.replace(state, info=state.info | {"episode_done": state.done, "episode_metrics": {}})


# Brax 0.14.2 uses a function that JAX has deprecated.
@pytest.mark.filterwarnings("ignore::DeprecationWarning:brax")
def test_training_agrees_with_brax_s_own_loop():
    steps, config = 3, SMALL
    size = config.batch_size * config.num_minibatches * config.unroll_length
    _, params, losses = brax_ppo.train(
        environment=Follower(),
        wrap_env_fn=lambda env, **_: BraxTraining(env),
        network_factory=lambda observation_size, action_size, preprocess_observations_fn=None: ppo.make_networks(
            observation_size, action_size, config
        ),
        num_timesteps=steps * size,
        num_evals=steps + 1,
        run_evals=False,
        num_eval_envs=1,
        episode_length=1,
        num_envs=config.num_envs,
        unroll_length=config.unroll_length,
        batch_size=config.batch_size,
        num_minibatches=config.num_minibatches,
        num_updates_per_batch=config.num_updates_per_batch,
        learning_rate=config.learning_rate,
        learning_rate_schedule="ADAPTIVE_KL",
        desired_kl=config.desired_kl,
        entropy_cost=config.entropy_cost,
        discounting=config.discounting,
        gae_lambda=config.gae_lambda,
        clipping_epsilon=config.clipping_epsilon,
        max_grad_norm=config.max_grad_norm,
        normalize_observations=True,
    )
    state, metrics = learner.train(Follower(), dataclasses.replace(config, num_timesteps=steps * size))
    ours = training_state.params(state)
    statistics, policy, value = jax.device_get(params)
    # The two are different compiled programs, so the last digits may differ.
    close: Any = {"rtol": 1e-3, "atol": 2e-5}
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, **close), (state.networks.policy, ours.value), (policy, value)
    )
    for name in ("mean", "std"):
        np.testing.assert_allclose(getattr(ours.normalizer, name)["state"], getattr(statistics, name)["state"], **close)
    for name, loss in losses.items():
        if name not in ("training/sps", "training/walltime"):
            assert metrics[name.removeprefix("training/")] == pytest.approx(float(loss), rel=1e-3, abs=1e-5)


def same(first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray]) -> bool:
    return first.keys() == second.keys() and all(np.array_equal(first[name], second[name]) for name in first)


@pytest.fixture(scope="module")
def short() -> Learner:
    return Learner(Follower(), SMALL)


def after(learned: Learner, state: training_state.TrainingState, steps: int) -> dict[str, np.ndarray]:
    for _ in range(steps):
        state, _ = learned.step(state)
    return training_state.stored(state)


def test_resuming_from_a_stored_state_equals_uninterrupted_training(short):
    straight = after(short, short.init(3), 5)
    part = after(short, short.init(3), 2)
    other = Learner(Follower(), SMALL)  # as in another process
    state, whole = other.resume(part)
    assert whole and same(after(other, state, 3), straight)
    assert not same(after(short, short.init(4), 5), straight), "another seed should give another result"


def test_the_returned_policy_is_an_average_over_training_steps(short):
    state = short.init(0)
    average: Any = None
    for count in (1, 2, 3, 3, 3):
        state, _ = short.step(state)
        latest = jax.device_get(state.networks.policy)
        average = latest if average is None else jax.tree.map(lambda a, b: a + (b - a) / count, average, latest)  # noqa: B023
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6),
            training_state.params(state).policy,
            average,
        )
    assert not np.array_equal(*(jax.tree.leaves(x)[1] for x in (average, latest)))


def test_the_training_step_is_compiled_once(short):
    state = short.init(0)
    for _ in range(3):
        state, _ = short.step(state)
    state, _ = short.resume(training_state.stored(state))
    short.step(state)
    state = short.init_from(training_state.params(short.init(1)), 100)
    short.step(state)
    assert short._step._cache_size() == 1


def test_the_training_step_is_compiled_once_on_one_device(monkeypatch: pytest.MonkeyPatch):
    first = jax.devices()[:1]
    monkeypatch.setattr(jax, "devices", lambda: first)
    monkeypatch.setattr(jax, "device_count", lambda: 1)
    alone = Learner(Follower(), SMALL)
    state, _ = alone.step(alone.init(0))
    alone.step(state)
    step: Any = alone._step
    assert step._cache_size() == 1


def test_copies_of_a_training_state_survive_later_steps(short):
    state = short.init(0)
    copies = training_state.stored(state), training_state.params(state)
    before = jax.tree.map(np.copy, copies)
    for _ in range(2):
        state, _ = short.step(state)
    jax.tree.map(np.testing.assert_array_equal, copies, before)


def test_the_optimizer_continues_with_another_number_of_environments(short):
    stored = after(short, short.init(0), 2)
    fewer = Learner(Follower(), dataclasses.replace(SMALL, num_envs=32))
    state, whole = fewer.resume(training_state.with_learning_rate(stored, 0.125))
    kept = training_state.stored(state)
    assert not whole
    assert kept["environments.reward"].shape == (32,)
    (rate,) = {float(value) for name, value in kept.items() if name.endswith("hyperparams.learning_rate")}
    assert rate == 0.125
    going = [
        name for name in stored if name.split(".")[0] not in ("environments", "key") and "learning_rate" not in name
    ]
    assert len(going) > 20 and all(np.array_equal(stored[name], kept[name]) for name in going)
    wider = Learner(Follower(), dataclasses.replace(SMALL, value_layers=(17,)))
    with pytest.raises(ValueError, match="another shape"):
        wider.resume(stored)


def test_training_can_resume_from_parameters_alone(trained):
    _, calls = trained
    params = ppo.from_tree(ppo.as_tree(calls[-1][1]))
    steps = []
    state, metrics = learner.train(
        Follower(),
        dataclasses.replace(SMALL, num_timesteps=2660),
        lambda step, state, metrics: steps.append((step, training_state.params(state))),
        start=lambda new: new.init_from(params, 100),
    )
    assert [step for step, _ in steps] == [100, 2660]
    for kept, given in zip(jax.tree.leaves(steps[0][1]), jax.tree.leaves(params), strict=True):
        np.testing.assert_array_equal(kept, given)
    assert metrics["reward"] > 0.9 * calls[-1][2]["reward"]
    assert training_state.params(state).normalizer.count == params.normalizer.count + 2560


def test_long_trainings_call_back_less_often_and_resume_at_the_same_intervals():
    size = SMALL.batch_size * SMALL.num_minibatches * SMALL.unroll_length
    config = dataclasses.replace(SMALL, num_timesteps=801 * size)  # more than twice the number of callbacks
    assert learner._schedule(config, 0) == (3, 267)
    assert learner._schedule(config, 300 * size) == (3, 167)
    assert learner.total_timesteps(config, 300 * size) == learner.total_timesteps(config) == 801 * size
    assert learner._schedule(config, 801 * size) == (3, 0)


class Exploding(Follower):
    """Environment whose observation, reward or metric is NaN at positions above 0.5. It does not end the episode."""

    part = "obs"

    def step(self, state: State, action: jax.Array) -> State:
        after = super().step(state, action)
        bad = physics(after)["position"] > 0.5
        broken = jax.tree.map(lambda x: jnp.where(bad, jnp.nan, x), getattr(after, self.part))
        return dataclasses.replace(after, **{self.part: broken})


@pytest.mark.slow
@pytest.mark.parametrize("part", ["obs", "reward", "metrics"])
def test_values_of_nan_reach_neither_learner_nor_metrics(part):
    environment = Exploding()
    environment.part = part
    env = training_env.wrap_for_training(environment)
    state = env.reset(jax.random.split(jax.random.PRNGKey(0), 2))
    before = physics(state)["goal"]
    state = env.step(state, jnp.array([[0.6], [0.1]]))
    np.testing.assert_array_equal(state.done, [1.0, 0.0])
    np.testing.assert_array_equal(state.info["truncation"], 0.0)
    np.testing.assert_array_equal(state.metrics["diverged"], [1.0, 0.0])
    assert state.reward[0] == 0.0 and state.reward[1] > 0.0
    assert physics(state)["goal"][0] != before[0] and physics(state)["goal"][1] == before[1]
    assert all(
        np.isfinite(leaf).all() for leaf in jax.tree.leaves((state.obs, state.reward, state.info, state.metrics))
    )


def test_actions_of_an_untrained_policy_are_small(trained):
    _, calls = trained
    fresh = calls[0][1]
    policy = ppo.make_inference(2, 1, SMALL)
    observations = 3.0 * jax.random.normal(jax.random.key(0), (1000, 2))
    actions = jax.vmap(policy, in_axes=(None, 0))(fresh, observations)
    assert float(jnp.abs(actions).max()) < 0.1
    std = np.exp(next(x for path, x in jax.tree.leaves_with_path(fresh.policy) if "log_value" in str(path)))
    np.testing.assert_allclose(std, SMALL.initial_std, rtol=1e-6)


def test_a_training_that_starts_with_a_policy_has_its_actions_and_explores_like_a_new_one(trained):
    _, calls = trained
    known = calls[-1][1]
    # Policies of regressions have no value function.
    learning = Learner(Follower(), SMALL)
    state = learning.init_with(known._replace(value={}))
    begun = training_state.params(state)
    observations = jax.random.normal(jax.random.key(0), (100, 2))
    infer = jax.vmap(ppo.make_inference(2, 1, SMALL), in_axes=(None, 0))
    expected = infer(known, observations)
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(infer(begun, observations), expected, atol=1e-5)
    np.testing.assert_allclose(
        np.exp(begun.policy["params"]["std_logparam"]["log_value"]), SMALL.initial_std, rtol=1e-6
    )
    after, metrics = learning.step(state)
    assert int(after.steps) == learning.steps_each and np.isfinite(metrics["reward"])
    untrained = calls[1][2]["reward"]
    assert metrics["reward"] > 2 * untrained


def test_every_reset_draws_a_new_state():
    env = training_env.wrap_for_training(Follower())
    step = jax.jit(env.step)
    state = jax.jit(env.reset)(jax.random.split(jax.random.key(0), 8))
    goals = [np.asarray(physics(state)["goal"])]
    for _ in range(5 * Follower.limit):
        state = step(state, jnp.zeros((8, 1)))
        if state.done.all():
            goals.append(np.asarray(physics(state)["goal"]))
            # The next observation is that of the new state, and its time is 0.
            np.testing.assert_allclose(state.obs["state"][:, 0], -goals[-1], atol=1e-6)
            np.testing.assert_array_equal(physics(state)["time"], 0)
    assert len(np.unique(np.stack(goals))) == 6 * 8


def test_only_finished_environments_are_reset():
    env = training_env.wrap_for_training(Follower())
    state = env.reset(jax.random.split(jax.random.key(0), 2))
    goals = np.asarray(physics(state)["goal"])
    for _ in range(3):
        state = env.step(state, jnp.array([[1.0], [0.0]]))
    # The first position is beyond 3, which terminates the episode without truncation.
    np.testing.assert_array_equal(state.done, [1.0, 0.0])
    np.testing.assert_array_equal(state.info["truncation"], [0.0, 0.0])
    assert physics(state)["goal"][0] != goals[0]
    assert physics(state)["goal"][1] == goals[1]
    assert physics(state)["time"][1] == 3
    # Reward and metrics belong to the finished episode.
    assert state.reward[0] < 0.01 and state.metrics["distance"][0] > 2.0
    np.testing.assert_array_equal(state.info["measured"]["reward"], state.reward)
    np.testing.assert_array_equal(state.info["measured"]["distance"], state.metrics["distance"])


def test_a_time_limit_truncates_the_episode():
    env = training_env.wrap_for_training(Follower())
    state = env.reset(jax.random.split(jax.random.key(0), 2))
    ends = []
    for _ in range(Follower.limit + 1):
        state = env.step(state, jnp.zeros((2, 1)))
        ends.append((float(state.done[0]), float(state.info["truncation"][0])))
    assert ends == [(0.0, 0.0)] * (Follower.limit - 1) + [(1.0, 1.0), (0.0, 0.0)]


def test_brax_bootstraps_at_truncation():
    """Brax's advantages are as the docstring of `wrap_for_training` states. A trajectory of four steps, with one
    value for each, is truncated or terminated at step 2."""
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
    ("change", "option", "fix"),
    [
        ({"num_envs": 100}, "--num-envs", "128 is the nearest"),
        ({"num_envs": 4096}, "--num-envs", "256 is the nearest"),
        ({"num_envs": 1}, "--num-envs", "2 is the nearest"),
        ({"batch_size": 63}, "--batch-size", "64 is the nearest"),
        ({"num_envs": 0}, "--num-envs", "1 is the nearest"),
        ({"num_timesteps": 0}, "--num-timesteps", "1 or more"),
        ({"num_timesteps": -5}, "--num-timesteps", "1 is the nearest"),
        ({"seed": 2**40}, "--seed", "2147483647 is the nearest"),
        ({"desired_kl": -0.1}, "--desired-kl", "0 is the nearest"),
        ({"entropy_cost": float("nan")}, "--entropy-cost", "0 or more"),
        ({"learning_rate": float("inf")}, "--learning-rate", "0.0001 is usual"),
        ({"clipping_epsilon": 0.0}, "--clipping-epsilon", "0.2 is usual"),
        ({"discounting": 1.1}, "--discounting", "between 0 and 1"),
        ({"policy_layers": ()}, "--policy-layers", "width"),
        ({"initial_std": 0.0}, "--initial-std", "greater than 0"),
    ],
)
def test_options_out_of_range_are_refused(change, option, fix):
    with pytest.raises(InputError, match=fix) as error:
        ppo.check(dataclasses.replace(SMALL, **change), devices=2)
    assert str(error.value).startswith(option)
