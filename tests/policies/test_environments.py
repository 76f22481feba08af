"""Improved simulators as environments of other libraries: they pass those libraries' checks and train with their
algorithms."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from rover import write_rover

import ballu_mjx.environments as environments
from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.environments.batch import LocomotionBatch, make_environment
from ballu_mjx.policies.environments.brax_env import brax_env
from ballu_mjx.policies.load_simulator import load_simulator
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.locomotion_env import locomotion_state
from ballu_mjx.policies.tasks import TASKS, Task
from ballu_mjx.residuals.fluid import FLUID_FILE, FluidEstimate, FluidParameters, terms_of
from ballu_mjx.residuals.fluid_fit import FluidConfig
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_input import num_inputs
from ballu_mjx.residuals.run_config import describe_run
from ballu_mjx.residuals.training_range import TrainingRange
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.runs.folder import Run

SHORT = LocomotionConfig(episode_seconds=0.4, domain_randomization=True)
PUSH = Task("push", "Push the rod.", lambda step: -abs(step.command[1] - 7.0) / 10, 1.0)
"""A task that is learned in seconds: the best command is always 7."""


@pytest.fixture(scope="module")
def rover(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    return write_rover(tmp_path_factory.mktemp("rover"))


@pytest.fixture(scope="module")
def run(rover: RobotDescription, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a fluid residual whose force of 3 N is directed upwards."""
    folder = tmp_path_factory.mktemp("runs") / "fluid"
    values = np.zeros((len(terms_of("linear")), 6))
    values[2, 2] = -3.0  # along gravity: up
    with Run(folder, describe_run("fluid", {"fit": FluidConfig()}, {}, [], description=rover)) as made:
        made.write(
            FLUID_FILE,
            FluidEstimate("linear", *map(FluidParameters.without_added_mass, (values, 0 * values))).to_json(),
        )
        TrainingRange.of(np.zeros((2, num_inputs(ForceNetworkConfig(), rover)))).write(made)
    return folder


@pytest.fixture(scope="module")
def batch(run: Path) -> LocomotionBatch:
    return LocomotionBatch(make_environment("walk", config=SHORT, run=run), 4)


def test_every_task_is_registered_under_its_name():
    assert list(environments.NAMES) == [
        "ballu_mjx/Walk-v0",
        "ballu_mjx/Turn-v0",
        "ballu_mjx/TurnRight-v0",
        "ballu_mjx/WalkBackward-v0",
    ]
    assert list(environments.NAMES.values()) == list(TASKS)


@pytest.mark.slow
def test_a_batch_resets_each_robot_alone_and_repeats_with_the_same_seed(batch: LocomotionBatch):
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (20, 4, 2))
    passes = []
    for _ in range(2):
        first, steps = batch.reset(seed=3), [batch.step(action) for action in actions]
        passes.append((first, steps))
    for one, other in zip(passes[0][1], passes[1][1], strict=True):
        np.testing.assert_array_equal(one.observation, other.observation)
    first, steps = passes[0]
    assert np.ptp(first, axis=0).max() > 0.01  # starting states differ
    ended = np.array([step.truncated for step in steps])
    assert ended.any(axis=0).all() and not np.array_equal(ended[:, 0], ended[:, 1])
    for step in steps:
        assert not step.terminated.any()
        same = np.all(step.observation == step.last_observation, axis=1)
        np.testing.assert_array_equal(same, ~step.truncated)


@pytest.mark.slow
def test_batches_without_a_seed_differ(batch: LocomotionBatch):
    """Environments of several processes would all learn from the same episodes otherwise."""
    first, second = (LocomotionBatch(batch.env, 4).reset() for _ in range(2))
    assert not np.array_equal(first, second)


@pytest.mark.slow
def test_the_residual_of_a_run_acts_in_its_environment(run: Path, rover: RobotDescription, batch: LocomotionBatch):
    simulator = load_simulator(run)
    assert simulator.residual is not None and simulator.robot.sha256 == rover.sha256
    batch.reset(seed=0)
    found = batch.step(np.zeros((4, 2)))
    np.testing.assert_allclose(found.metrics["force"], 3.0, rtol=1e-3)
    with pytest.raises(InputError, match="has its own robot"):
        load_simulator(run, "ballu")
    with pytest.raises(InputError, match="no task 'fly'"):
        make_environment("fly", run=run)


@pytest.mark.slow
def test_gymnasium_makes_single_and_vector_environments_by_name(run: Path):
    gymnasium = pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env

    env = gymnasium.make("ballu_mjx/Walk-v0", run=str(run), episode_seconds=0.4)
    with pytest.warns(UserWarning, match="infinity"):  # the observation has no bounds
        check_env(env.unwrapped, skip_render_check=True)
    names = env.unwrapped.observation_names
    assert len(names) == env.observation_space.shape[0] and names[2] == "hull position z, m"
    env.reset(seed=1)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(16)]
    assert any(truncated for _, truncated in ends)
    # These settings reuse the compiled program of `batch`.
    settings = dataclasses.asdict(SHORT)
    vector = gymnasium.make_vec("ballu_mjx/Walk-v0", num_envs=4, run=str(run), **settings)
    observation, _ = vector.reset(seed=1)
    assert vector.observation_space.contains(observation)
    for _ in range(16):
        observation, reward, terminated, truncated, info = vector.step(vector.action_space.sample())
        assert observation.shape == (4, 16) and reward.shape == terminated.shape == (4,)
        if truncated.any():
            assert not np.array_equal(info["final_obs"][truncated], observation[truncated])
            break
    else:
        raise AssertionError("no episode ended")


@pytest.mark.filterwarnings("ignore:jax.device_put_replicated is deprecated:DeprecationWarning")  # in Brax
@pytest.mark.slow
def test_brax_ppo_learns_in_an_improved_simulator(run: Path):
    from brax import envs
    from brax.training.agents.ppo import train as ppo

    env = envs.get_environment("ballu_mjx/Walk-v0", run=run)
    state = env.reset(jax.random.PRNGKey(0))
    assert int(locomotion_state(state).remaining) > 10**6  # the trainer ends episodes
    reports: list[dict[str, Any]] = []
    learned = brax_env(load_simulator(run), PUSH)
    assert learned.episode_length == 25
    ppo.train(
        learned,
        # At greater rates single evaluations fall back to the start; which ones depends on the rounding.
        learning_rate=3e-4,
        num_timesteps=40_000,
        episode_length=learned.episode_length,
        num_envs=64,
        num_eval_envs=32,
        num_evals=5,
        unroll_length=5,
        batch_size=64,
        num_minibatches=4,
        num_updates_per_batch=4,
        normalize_observations=True,
        deterministic_eval=True,
        seed=1,
        progress_fn=lambda steps, found: reports.append(dict(found)),
    )
    before, *after = (float(each["eval/episode_reward"]) for each in reports)
    assert np.mean(after[-2:]) > before + 1.0, (before, after)


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("stable_baselines3") is None,
    reason="not installed: pip install -c constraints.txt stable-baselines3 and PyTorch's build for the CPU",
)
def test_stable_baselines3_learns_in_an_improved_simulator():
    import torch  # pyright: ignore[reportMissingImports]
    from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]

    from ballu_mjx.policies.environments.gym_env import gym_vector_env
    from ballu_mjx.policies.environments.sb3_env import StableBaselinesEnv

    torch.set_num_threads(1)
    env = StableBaselinesEnv(gym_vector_env(task="walk", num_envs=64))
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=256, n_epochs=4, learning_rate=1e-3, gamma=0.97, seed=0)
    model.learn(2048)
    before = np.mean([episode["r"] / episode["l"] for episode in model.ep_info_buffer or [{"r": 0.0, "l": 1}]])
    model.learn(60_000)
    after = np.mean([episode["r"] / episode["l"] for episode in model.ep_info_buffer or []])
    assert after > before + 0.02, (before, after)
