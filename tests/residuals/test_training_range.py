"""Training range of a residual's inputs, and loads that fade outside of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.residuals.envmimic import EnvMimicConfig, EnvMimicEnv, check_envmimic_config, tracking_state
from ballu_mjx.residuals.network_input import recorded_inputs
from ballu_mjx.residuals.network_loads import load_units, num_loads
from ballu_mjx.residuals.run_config import describe_run
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.residuals.training_range import MARGIN, TrainingRange
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.description import read_description
from ballu_mjx.runs.folder import Run
from ballu_mjx.sim.observation import HISTORY
from ballu_mjx.sim.simulator import Simulator

ROBOT = read_description(Path(__file__).parents[2] / "experiments" / "tethered_balloon" / "balloon.robot.json")
SIMULATOR = Simulator(ROBOT)
CONFIG = EnvMimicConfig(
    forces="force", force_scale=0.05, force_limit=1.0, force_cost=20.0, expected_loads=(0.02,), fade_width=1.0
)
NETWORK = PPOConfig(policy_layers=(8,), value_layers=(4,))


@pytest.fixture(scope="module")
def motions() -> list[Motion]:
    """Unrelated states near the initial pose, with random commands."""
    model, steps = ROBOT.load_model(), 60
    qpos = ROBOT.adapter.initial_qpos(ROBOT, model)
    time = np.arange(steps + 1) * ROBOT.control_timestep
    command = np.random.default_rng(0).uniform(size=(steps, len(ROBOT.commands)))
    qpos = qpos + 0.05 * np.random.default_rng(1).normal(size=(steps + 1, model.nq))
    return [Motion("poses", time, command, qpos, np.zeros((steps + 1, model.nv)), {})]


def test_distance_is_in_widths_of_the_range_and_begins_behind_a_margin():
    observed = TrainingRange.of(np.array([[0.0, 10.0], [2.0, 30.0]]))
    for inputs, expected in (
        ([1.0, 20.0], 0.0),
        ([2.0 + 2 * MARGIN, 30.0], 0.0),
        ([4.0, 20.0], 1.0 - MARGIN),
        ([-1.0, 70.0], 2.0 - MARGIN),  # the farthest input counts
    ):
        assert float(observed.excess(jnp.array(inputs))) == pytest.approx(expected, abs=1e-6)


def test_loads_are_whole_in_the_range_and_vanish_far_outside():
    observed = TrainingRange.of(np.array([[0.0], [1.0]]))
    along = [float(observed.fade(jnp.array([x]), 0.5)) for x in (0.3, 1.0, 1.0 + MARGIN, 1.4, 1.6, 3.0)]
    assert along[:3] == [1.0] * 3
    assert 1 > along[3] > along[4] > along[5] and along[5] < 1e-6


@pytest.mark.slow
def test_forces_of_a_training_fade_outside_of_its_recordings(motions: list[Motion]):
    env = EnvMimicEnv(SIMULATOR, motions, CONFIG)
    step = jax.jit(env.step)
    state = env.reset(jax.random.key(0))
    tracking = tracking_state(state)
    far = tracking._replace(rollout=tracking.rollout._replace(history=tracking.rollout.history + 50.0))
    effect = []
    for start in (tracking, far):
        state = dataclasses.replace(state, pipeline_state=start)
        pushed, still = (tracking_state(step(state, push * jnp.ones(3))).rollout.physics.qvel for push in (1, 0))
        effect.append(float(np.abs(pushed - still).max()))
    assert effect[0] > 1e-3 and effect[1] == 0.0


@pytest.mark.slow
def test_the_loads_of_a_stored_network_fade(motions: list[Motion], tmp_path: Path):
    config = describe_run("envmimic", {"env": CONFIG, "ppo": NETWORK}, {}, [], None, ROBOT)
    reference, _ = stack_motions(SIMULATOR, motions)
    seen = np.asarray(recorded_inputs(reference, CONFIG, ROBOT))
    with Run(tmp_path / "run", config | {"residual": None}) as run:
        TrainingRange.of(seen).write(run)
        policy = ppo.initial_policy(seen, num_loads(CONFIG, ROBOT), NETWORK)
        policy = policy._replace(policy=ppo.with_mean(policy.policy, np.ones(3)))
        run.save(0, ppo.as_tree(policy), 0.5)
    learned = TrainedResidual.load(tmp_path / "run", ROBOT)
    history, commands = reference.features[0, :HISTORY], reference.command[0, :HISTORY]
    unit = load_units(CONFIG, ROBOT)[0]
    near, far = (learned.bound.act(history + shift, commands).wrench[0, :3] for shift in (0.0, 50.0))
    np.testing.assert_allclose(near, unit, rtol=0.05)
    np.testing.assert_allclose(far, 0.0, atol=1e-9)


def test_a_width_of_zero_is_refused():
    with pytest.raises(InputError, match="--fade-width is 0.0: it must be greater than 0"):
        check_envmimic_config(dataclasses.replace(CONFIG, fade_width=0.0), ROBOT.control_timestep)
