"""Locomotion tasks: rewards, observations, randomized simulators and residual forces."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from ballu_mjx.ballu.actuators import ActuatorParameters
from ballu_mjx.ballu.features import foot_positions
from ballu_mjx.ballu.model import CONTROL_TIMESTEP, KNEES, MOTORS, standing_qpos
from ballu_mjx.policies.closed_loop import ClosedLoop
from ballu_mjx.policies.domain_randomization import make_simulator_setting
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.locomotion_env import LocomotionEnv, LocomotionState, locomotion_observation, locomotion_state
from ballu_mjx.policies.tasks import TASKS, Step
from ballu_mjx.residuals.aerodynamics import Aerodynamics, AirParameters
from ballu_mjx.residuals.network import NetworkResidual
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_loads import load_units
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.residuals.training_range import MARGIN, FadingResidual, TrainingRange
from ballu_mjx.rl import ppo
from ballu_mjx.rl.learner import Learner
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.observation import HISTORY, heading_rotation
from ballu_mjx.sim.step import count_substeps, state_at

BALLU = load_robot()
MODEL = BALLU.load_model()
FORCES = ForceNetworkConfig(force_scale=0.05, force_limit=1.0)
UNIT = load_units(FORCES, BALLU)[0]
"""Force (N) of an action of 1."""
INPUTS = 87
"""Size of the residual's input: 27 features and two commands for each of three control steps."""


def make_residual(action: np.ndarray, width: float = 1e6) -> TrainedResidual:
    """Return a residual whose policy always gives `action`, with a training range of -`width` to `width`."""
    bound = np.full(INPUTS, width, np.float32)
    forces = NetworkResidual(
        FORCES,
        load_robot(),
        infer=lambda params, seen: jnp.asarray(action, jnp.float32),
        sample=lambda params, seen, key: jnp.asarray(action, jnp.float32) + jax.random.normal(key, (3,)),
    )
    return TrainedResidual(
        forces,
        params=None,
        observed=TrainingRange(-bound, bound),
        step=0,
        actuators=None,
    )


def inner(state) -> LocomotionState:
    return locomotion_state(state)


PLAIN = LocomotionEnv(BALLU, TASKS["walk"], LocomotionConfig())
RESET, STEP = jax.jit(lambda setting, key: PLAIN._start(setting, key)), jax.jit(PLAIN.step)
"""Compiled once: parameters that differ between simulators are part of the state."""


def test_rewards_are_velocities_in_the_direction_of_the_task():
    step = Step(jnp.array([0.3, -0.2, 0.1]), jnp.zeros(27), jnp.zeros(2))
    rewards = {name: float(task.reward(step)) for name, task in TASKS.items()}
    assert rewards == pytest.approx({"walk": 0.3, "turn": -0.2, "turn-right": 0.2, "walk-backward": -0.3})


@pytest.mark.slow
def test_reward_is_the_mean_velocity_of_the_centre_of_mass_in_c_mujoco():
    state = RESET(PLAIN.setting, jax.random.key(0))
    data = mujoco.MjData(MODEL)
    for number in range(20):
        # Both start each step from the same state. Otherwise a foot may make contact a step earlier in one of them.
        physics = inner(state).rollout.physics
        data.qpos[:], data.qvel[:] = physics.qpos, physics.qvel
        mujoco.mj_forward(MODEL, data)
        before = data.subtree_com[1].copy()
        action = np.array([1.0, -1.0]) if number % 10 < 5 else np.array([-1.0, 0.2])
        state = STEP(state, jnp.asarray(action, jnp.float32))
        data.ctrl[:] = (action + 1) / 2
        mujoco.mj_step(MODEL, data, round(CONTROL_TIMESTEP / MODEL.opt.timestep))
        mujoco.mj_forward(MODEL, data)
        speed = (data.subtree_com[1] - before) / CONTROL_TIMESTEP
        assert float(state.reward) == pytest.approx(speed[0], abs=0.01)
    assert np.abs(speed[0]) > 0.02


def test_observation_is_independent_of_position_and_includes_heading():
    rng = np.random.default_rng(0)
    seen = rng.normal(size=27).astype(np.float32)
    yaw, shift = 0.7, np.array([3.0, -2.0, 0.0])
    turn = np.array(heading_rotation(jnp.array(yaw)))
    vectors = np.concatenate([seen[:6], seen[9:]]).reshape(-1, 3) @ turn.T
    vectors[::2] += shift
    moved = np.concatenate([vectors[:2].ravel(), seen[6:9] + [0, 0, yaw], vectors[2:].ravel()]).astype(np.float32)
    one, other = (np.asarray(locomotion_observation(jnp.asarray(x))) for x in (seen, moved))
    np.testing.assert_allclose(other[:-2], one[:-2], atol=1e-5)
    np.testing.assert_allclose(other[-2:], [np.cos(seen[8] + yaw), np.sin(seen[8] + yaw)], atol=1e-6)


@pytest.mark.slow
def test_randomization_of_friction_and_starting_state_is_off_by_default():
    keys = jax.random.split(jax.random.key(1), 200)
    draw = jax.jit(jax.vmap(PLAIN._start, in_axes=(None, 0)))
    plain = inner(draw(PLAIN.setting, keys))
    assert np.unique(plain.friction).tolist() == pytest.approx([0.9])
    assert np.ptp(plain.rollout.physics.qpos, axis=0).max() == 0 and np.abs(plain.rollout.physics.qvel).max() == 0

    config = LocomotionConfig(domain_randomization=True)
    drawn = inner(draw(make_simulator_setting(BALLU, MODEL, config, None), keys))
    low, high = config.friction
    assert low <= drawn.friction.min() < low + 0.05 and high - 0.05 < drawn.friction.max() <= high
    yaw = np.rad2deg(np.asarray(drawn.rollout.history)[:, -1, 8])
    assert config.start_yaw * 0.9 < yaw.max() <= config.start_yaw + 1 and yaw.min() < -config.start_yaw * 0.9
    knees = np.asarray(drawn.rollout.physics.qpos)[:, 7:][:, KNEES]
    assert (knees >= standing_qpos(MODEL)[7:][KNEES] - 1e-6).all()


def test_friction_of_a_residual_scales_the_friction_of_episodes():
    slippery = dataclasses.replace(AirParameters.none(), friction=jnp.asarray(-0.4))
    residual = TrainedResidual(Aerodynamics(BALLU, MODEL), slippery, TrainingRange.unbounded(), 0, None)
    for randomized, expected in ((False, (0.54, 0.54)), (True, (0.3, 0.66))):
        config = LocomotionConfig(domain_randomization=randomized, friction=(0.5, 1.1))
        env = LocomotionEnv(BALLU, TASKS["walk"], config, residual=residual)
        np.testing.assert_allclose(env.setting.friction, np.tile(expected, (3, 1)), rtol=1e-5)  # floor and feet


@pytest.mark.slow
def test_lower_friction_lets_the_robot_slide_further():
    """A robot with a horizontal starting velocity slides further on a floor with lower friction."""
    state = RESET(PLAIN.setting, jax.random.key(0))
    distances = []
    for friction in (0.2, 1.0):
        thrown = inner(state).rollout.physics
        thrown = thrown._replace(qvel=thrown.qvel.at[0].set(1.0))
        rollout = inner(state).rollout._replace(physics=thrown)
        pushed = inner(state)._replace(friction=jnp.full_like(inner(state).friction, friction), rollout=rollout)
        now = dataclasses.replace(state, pipeline_state=pushed)
        for _ in range(10):
            now = STEP(now, -jnp.ones(2))
        distances.append(float(inner(now).rollout.history[-1, 15]))
    assert distances[0] > distances[1] + 0.02


@pytest.mark.slow
def test_pushes_are_drawn_anew_for_every_episode():
    keys = jax.random.split(jax.random.key(2), 400)
    draw = jax.jit(jax.vmap(PLAIN._start, in_axes=(None, 0)))
    config = LocomotionConfig(push_force=0.02, push_torque=0.003)
    off = make_simulator_setting(BALLU, MODEL, config, None)
    assert np.abs(inner(draw(off, keys)).push).max() == 0
    on = make_simulator_setting(BALLU, MODEL, dataclasses.replace(config, domain_randomization=True), None)
    spread = np.std(inner(draw(on, keys)).push, axis=0)
    np.testing.assert_allclose(spread, [0.02, 0.02, 0, 0, 0, 0.003], rtol=0.15)


@pytest.mark.slow
def test_a_push_acts_over_the_whole_episode_and_is_no_residual():
    """Two equal and opposite pushes move the robot apart by as much as C MuJoCo says. The next episode has another."""
    state = RESET(PLAIN.setting, jax.random.key(0))
    ends = []
    for sign in (1.0, -1.0):
        push = sign * jnp.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.02])
        now = dataclasses.replace(state, pipeline_state=inner(state)._replace(push=push))
        for _ in range(10):
            now = STEP(now, -jnp.ones(2))
        assert float(now.metrics["force"]) == pytest.approx(0.0, abs=1e-6)
        ends.append(np.asarray(inner(now).rollout.physics.qvel))
    data = mujoco.MjData(MODEL)
    expected = []
    for sign in (1.0, -1.0):
        mujoco.mj_resetData(MODEL, data)
        data.qpos[:] = standing_qpos(MODEL)
        data.xfrc_applied[MODEL.site_bodyid[MODEL.site(BALLU.tracked).id]] = sign * np.array([0, 0.3, 0, 0, 0, 0.02])
        mujoco.mj_step(MODEL, data, nstep=10 * count_substeps(MODEL, CONTROL_TIMESTEP))
        expected.append(data.qvel.copy())
    np.testing.assert_allclose(ends[0] - ends[1], expected[0] - expected[1], atol=0.05)
    assert abs(expected[0][1] - expected[1][1]) > 0.2


@pytest.mark.slow
def test_identified_actuators_act_in_every_episode():
    nominal = ActuatorParameters.nominal(MODEL)
    weak = dataclasses.replace(nominal, torque_limit=nominal.torque_limit * jnp.array([0.1, 1.0]))
    reached = []
    for setting in (PLAIN.setting, make_simulator_setting(BALLU, MODEL, LocomotionConfig(), weak)):
        state = STEP(RESET(setting, jax.random.key(0)), jnp.ones(2))
        state = RESET(inner(state).setting, jax.random.key(1))
        for _ in range(20):
            state = STEP(state, jnp.ones(2))
        reached.append(np.asarray(inner(state).rollout.physics.qpos)[7:][MOTORS])
    left, right = np.rad2deg(reached[0] - reached[1])
    assert left > 15 and abs(right) < left / 3


@pytest.mark.slow
def test_residual_force_has_its_units_and_is_in_the_heading_frame():
    action, yaw = np.array([0.5, 0.2, -0.1]), 2.0
    env = LocomotionEnv(BALLU, TASKS["walk"], LocomotionConfig(), residual=make_residual(action))
    simulator, zeros = env.simulator.simulator, jnp.zeros(MODEL.nv)
    qpos = standing_qpos(MODEL)
    qpos[3:7] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    qpos = jnp.asarray(qpos, jnp.float32)
    state = jax.jit(lambda qpos: env.step(env.at(qpos, zeros, jax.random.key(0)), -jnp.ones(2)))(qpos)

    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    force = turn @ (UNIT * action)
    pushed = jax.jit(lambda wrench: simulator.step(state_at(qpos, zeros), jnp.zeros(2), wrench))
    expected = pushed(jnp.asarray([[*force, 0, 0, 0]], jnp.float32))
    # The two are compiled into different programs, which round differently.
    np.testing.assert_allclose(inner(state).rollout.physics.qvel, expected.qvel, atol=5e-5)
    assert np.abs(np.asarray(expected.qvel - pushed(jnp.zeros((1, 6))).qvel)).max() > 1e-3
    assert float(state.metrics["force"]) == pytest.approx(np.linalg.norm(force), rel=1e-5)


@pytest.mark.slow
def test_residual_force_fades_outside_its_training_range():
    history = jnp.zeros((HISTORY, 27)).at[-1, 2].set(2.0)  # only the balloon's height is out of range
    history = history.at[:-1].set(history[-1])
    commands = jnp.zeros((HISTORY, 2))
    width = 1.0
    residual = make_residual(np.array([1.0, 0.0, 0.0]), width)
    expected = (2.0 - width) / (2 * width) - MARGIN
    assert float(residual.out_of_range(history, commands)) == pytest.approx(expected, rel=1e-5)
    assert float(residual.out_of_range(jnp.zeros((HISTORY, 27)), commands)) == 0.0

    forces = []
    params = residual.params, residual.observed
    fading = dataclasses.replace(residual, model=FadingResidual(residual.model, 0.5), params=params)
    for chosen in (residual, fading):
        env = LocomotionEnv(BALLU, TASKS["walk"], LocomotionConfig(), residual=chosen)
        state = PLAIN.reset(jax.random.key(0))
        rollout = inner(state).rollout._replace(history=history)
        state = jax.jit(env.step)(
            dataclasses.replace(state, pipeline_state=inner(state)._replace(rollout=rollout)), -jnp.ones(2)
        )
        assert float(state.metrics["excess"]) == pytest.approx(expected, rel=1e-5)
        forces.append(float(state.metrics["force"]))
    assert forces[0] == pytest.approx(UNIT, rel=1e-5)
    assert forces[1] == pytest.approx(forces[0] * np.exp(-((expected / 0.5) ** 4)), rel=1e-5)


GAIN = ppo.Params(ppo.Normalizer(np.zeros(()), {}, {}, {}), None, np.float32(0.8))
"""Parameters of policies that are not networks."""


@pytest.mark.slow
def test_residuals_of_one_kind_share_one_compiled_program():
    action, network = 3, PPOConfig(policy_layers=(4,), value_layers=(4,))
    infer = ppo.make_inference({ppo.STATE: (INPUTS,)}, action, network)
    nominal = ActuatorParameters.nominal(MODEL)
    weak = dataclasses.replace(nominal, torque_limit=0.5 * nominal.torque_limit)
    sizes = dataclasses.replace(
        network, num_envs=8, batch_size=8, num_minibatches=1, unroll_length=2, num_updates_per_batch=1
    )
    training, closed_loop = [], []
    for seed, actuators in ((0, nominal), (1, weak)):
        inputs = np.random.default_rng(seed).normal(size=(50, INPUTS)).astype(np.float32)
        params = ppo.initial_policy(inputs, action, dataclasses.replace(network, seed=seed))
        seen = TrainingRange.of(inputs)
        learned = TrainedResidual(NetworkResidual(FORCES, load_robot(), infer), params, seen, 0, actuators)
        env = LocomotionEnv(BALLU, TASKS["walk"], LocomotionConfig(), actuators=actuators, residual=learned)
        learner = Learner(env, sizes)
        state = jax.eval_shape(learner._first, jax.random.PRNGKey(0), learner._parameters)
        training.append(learner._step.lower(state, learner._parameters).as_text())
        loop = ClosedLoop(env, lambda params, seen: params.value * seen[:2])
        state = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), 8))
        closed_loop.append(loop._run.lower(GAIN, env.parameters, state).as_text())
    assert training[0] == training[1]
    assert closed_loop[0] == closed_loop[1]


def test_the_initial_pose_is_not_drawn():
    """Exported open-loop commands begin there."""
    env = LocomotionEnv(BALLU, TASKS["walk"], LocomotionConfig(domain_randomization=True))
    loop = ClosedLoop(env, lambda params, seen: params.value * seen[:2])
    qpos, qvel = loop.initial()
    np.testing.assert_allclose(qpos[0], BALLU.adapter.initial_qpos(BALLU, MODEL), atol=1e-6)
    assert qpos.shape == (1, MODEL.nq) and qvel.shape == (1, MODEL.nv) and not qvel.any()


@pytest.mark.slow
def test_closed_loop_agrees_with_steps_of_the_environment():
    infer = lambda params, seen: params.value * jnp.sin(10 * seen[:2])  # noqa: E731
    env = LocomotionEnv(BALLU, TASKS["walk"], LocomotionConfig(domain_randomization=True))
    loop = ClosedLoop(env, infer)
    still, start = (inner(RESET(x.setting, jax.random.key(k))).rollout.physics for x, k in ((PLAIN, 0), (env, 3)))
    qpos, qvel = (np.stack([x] * 8 + [y]) for x, y in ((still.qpos, start.qpos), (still.qvel, start.qvel)))
    rollout = loop(GAIN, qpos, qvel, 5)  # the last state is in a second batch
    state = jax.jit(env.at)(jnp.asarray(qpos[-1]), jnp.asarray(qvel[-1]), jax.random.key(0))
    for number in range(5):
        action = 0.8 * jnp.sin(10 * jnp.asarray(state.obs)[:2])
        np.testing.assert_allclose(rollout.command[-1, number], (action + 1) / 2, atol=1e-5)
        state = STEP(state, action)
        np.testing.assert_allclose(rollout.com[-1, number + 1], inner(state).com, atol=1e-4)
        assert rollout.reward[-1, number] == pytest.approx(float(state.reward), abs=1e-3)
    assert rollout.qpos.shape == (9, 6, MODEL.nq) and rollout.reward.shape == (9, 5)
    data = mujoco.MjData(MODEL)
    data.qpos[:] = rollout.qpos[-1, -1]
    mujoco.mj_kinematics(MODEL, data)
    standing = [data.site(f"foot_{side}").xpos for side in ("left", "right")]
    np.testing.assert_allclose(foot_positions(rollout.features)[-1, -1], standing, atol=1e-4)
    assert rollout.divergence is None
    qvel[4] = 1e20
    broken = loop(GAIN, qpos, qvel, 5)
    assert broken.diverged.any(axis=1).tolist() == [number == 4 for number in range(9)]
    assert "diverged in 1 of 9 simulations" in str(broken.divergence) and np.isfinite(broken.com).all()
