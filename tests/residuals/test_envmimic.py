"""The EnvMimic task: reward, observations, frames, resets and open-loop evaluation."""

import copy
import dataclasses
import json

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_motion import simulate_motion

from ballu_mjx.ballu.actuators import ActuatorParameters
from ballu_mjx.ballu.model import CONTROL_TIMESTEP, load_model, standing_qpos
from ballu_mjx.evaluation.errors import Errors, Evaluation, mean_by_group
from ballu_mjx.evaluation.errors_file import evaluation_to_json
from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.residuals.envmimic import EnvMimicConfig, EnvMimicEnv, reward_terms, tracking_state
from ballu_mjx.residuals.network import NetworkResidual
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_input import network_input
from ballu_mjx.residuals.network_loads import load_units, world_loads
from ballu_mjx.rl.learner import Learner
from ballu_mjx.rl.ppo import PPOConfig, make_inference
from ballu_mjx.rl.training_state import params
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.force_sets import ForceSet
from ballu_mjx.sim.observation import HISTORY, euler_angles, heading_observation, heading_rotation
from ballu_mjx.sim.simulator import RolloutState, Simulator
from ballu_mjx.sim.step import state_at
from ballu_mjx.viz import artifacts, robot_meshes

STEPS = 30
SCALED = EnvMimicConfig(expected_loads=(0.0,), force_scale=0.05, torque_scale=0.005, force_limit=1.0, force_cost=20.0)
"""Options with scales, so that no recordings are needed to find them."""


def make_motion(force: np.ndarray, name: str = "made", steps: int = STEPS) -> Motion:
    """Simulate the stepping nominal robot in C MuJoCo at the training time step, with a constant force on the balloon
    (N, world frame)."""
    model = load_model()
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    mujoco.mj_step(model, data, 100)
    time = np.arange(steps) * CONTROL_TIMESTEP
    command = np.stack([(time % 1.2 < 0.5), ((time + 0.6) % 1.2 < 0.5)], axis=1) * 0.9
    data.xfrc_applied[model.body("balloon").id, :3] = force
    return simulate_motion(name, model, data, command, CONTROL_TIMESTEP)


@pytest.fixture(scope="module")
def still() -> Motion:
    return make_motion(np.zeros(3))


@pytest.fixture(scope="module")
def pushed() -> Motion:
    return make_motion(np.array([0.04, 0.0, 0.02]))


def test_reward_is_that_of_the_paper():
    config = EnvMimicConfig(fine_position_weight=0.0, fine_orientation_weight=0.0)
    seen, target = np.zeros(27, np.float32), np.zeros(27, np.float32)
    seen[:3] = [0.1, -0.2, 0.05]
    seen[6:9] = [0.1, 0.2, np.pi - 0.05]
    target[6:9] = [0.0, 0.0, -np.pi + 0.05]
    terms = reward_terms(jnp.array(seen), jnp.array(target), config)
    assert float(terms["position"]) == pytest.approx(np.exp(-10 * (0.1**2 + 0.2**2 + 0.05**2)), rel=1e-5)
    # The yaw difference is 0.1 rad across the wrap, not 2 pi - 0.1.
    weighted = 0.2 * 0.1**2 + 0.4 * 0.2**2 + 0.4 * 0.1**2
    assert float(terms["orientation"]) == pytest.approx(np.exp(-2 * weighted), rel=1e-4)
    assert float(terms["tracking"]) == pytest.approx(0.7 * float(terms["position"]) + 0.3 * float(terms["orientation"]))


def test_euler_angles_are_intrinsic_zyx():
    for seed in range(20):
        rotation = Rotation.random(rng=np.random.default_rng(seed))
        ours = euler_angles(jnp.array(rotation.as_quat(scalar_first=True), jnp.float32))
        np.testing.assert_allclose(ours, rotation.as_euler("ZYX")[::-1], atol=2e-3)


def test_features_agree_with_c_mujoco(still: Motion):
    model = load_model()
    data = mujoco.MjData(model)
    simulator = Simulator(load_robot(), model=model)
    rng = np.random.default_rng(0)
    data.qpos[:] = still.qpos[17]
    data.qvel[:] = rng.normal(0, 1.0, model.nv)
    mujoco.mj_forward(model, data)
    ours, com = simulator.observe(state_at(*(jnp.array(x, jnp.float32) for x in (data.qpos, data.qvel))))
    frames = []
    for site in ("balloon", "base", "foot_left", "foot_right"):
        velocity = np.zeros(6)
        index = model.site(site).id
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, index, velocity, 0)
        frames += [data.site(site).xpos, velocity[3:]]
    euler = Rotation.from_quat(data.body("balloon").xquat, scalar_first=True).as_euler("ZYX")[::-1]
    np.testing.assert_allclose(ours, np.concatenate([*frames[:2], euler, *frames[2:]]), atol=1e-4)
    np.testing.assert_allclose(com, data.subtree_com[1], atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_observation_is_relative_and_force_is_in_the_heading_frame(still: Motion, seed: int):
    """A motion moved horizontally and turned about the vertical has the same observation, and its force is turned."""
    rng = np.random.default_rng(seed)
    simulator = Simulator(load_robot())
    reference, _ = stack_motions(simulator, [still])
    turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
    moved_qpos, moved_qvel = still.qpos.copy(), still.qvel.copy()
    moved_qpos[:, :3] = turn.apply(still.qpos[:, :3]) + [rng.normal(), rng.normal(), 0]
    start = Rotation.from_quat(still.qpos[:, 3:7], scalar_first=True)
    moved_qpos[:, 3:7] = (turn * start).as_quat(scalar_first=True)
    moved_qvel[:, :3] = turn.apply(still.qvel[:, :3])
    moved, _ = stack_motions(simulator, [dataclasses.replace(still, qpos=moved_qpos, qvel=moved_qvel)])
    here, there = reference.features[0, 10:13], moved.features[0, 10:13]
    np.testing.assert_allclose(heading_observation(here), heading_observation(there), atol=2e-4)
    config, action = SCALED, jnp.array([1.0, -0.5, 0.3, 0.4, 0.2, -0.6])
    loads, moved_loads = (
        world_loads(action, history[-1, 8], config, load_robot()).reshape(2, 3) for history in (here, there)
    )
    np.testing.assert_allclose(turn.apply(loads), moved_loads, atol=1e-5)


def test_options_give_the_paper_s_observation_and_force_in_the_world_frame(still: Motion):
    """Without relative observation and heading frame, inputs are plain features and forces are in the world frame."""
    config = dataclasses.replace(
        SCALED, forces="force", relative_observation=False, heading_frame=False, observe_command=False
    )
    robot = load_robot()
    reference, _ = stack_motions(Simulator(robot), [still])
    history = np.array(reference.features[0, 5 : 5 + HISTORY])
    history[:, :3] += [3.0, -2.0, 0.0]
    seen = network_input(jnp.asarray(history), jnp.zeros((HISTORY, 2)), config, robot)
    features = np.concatenate([history[:, :6], history[:, 9:], history[:, 6:9]], axis=1)
    np.testing.assert_allclose(np.asarray(seen).reshape(HISTORY, -1), features, atol=1e-5)
    action = jnp.array([0.5, -0.2, 0.1])
    loads = [world_loads(action, jnp.asarray(yaw), config, robot) for yaw in (0.0, 2.0)]
    np.testing.assert_allclose(loads[0], loads[1], atol=1e-7)


@pytest.mark.parametrize(("spread", "lengths"), [(0.0, {10}), (0.5, set(range(5, 16)))])
def test_episode_lengths_follow_the_options(spread: float, lengths: set[int], still: Motion):
    config = EnvMimicConfig(episode_seconds=10 * CONTROL_TIMESTEP, episode_spread=spread)
    env = EnvMimicEnv(Simulator(load_robot()), [still], config)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 200))
    assert set(np.asarray(tracking_state(state).remaining).tolist()) == lengths


def test_force_and_torque_stay_within_their_limits():
    config = SCALED
    loads = world_loads(jnp.array([1e6, -1e6, 0.0, 1e6, 0.0, -1e6]), jnp.zeros(()), config, load_robot())
    np.testing.assert_allclose(loads, [1.0, -1.0, 0.0, 0.1, 0.0, -0.1], rtol=1e-6)


def test_reset_starts_at_recorded_states_with_their_history(still: Motion, pushed: Motion):
    env = EnvMimicEnv(Simulator(load_robot()), [still, pushed], EnvMimicConfig(start_noise=0.0))
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 256))
    s = tracking_state(states)
    recording, time = np.asarray(s.recording), np.asarray(s.time)
    assert set(recording) == {0, 1}
    assert set(time) == set(range(HISTORY - 1, STEPS))
    motions = [still, pushed]
    for run in range(0, 256, 16):
        np.testing.assert_allclose(s.rollout.physics.qpos[run], motions[recording[run]].qpos[time[run]], atol=1e-6)
        expected = env.reference.features[recording[run], time[run] - 2 : time[run] + 1]
        np.testing.assert_array_equal(s.rollout.history[run], expected)


def test_start_noise_stays_small_and_keeps_the_quaternion_a_unit(still: Motion):
    env = EnvMimicEnv(Simulator(load_robot()), [still], EnvMimicConfig(start_noise=1.0))
    states = tracking_state(jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), 256)))
    recorded = np.asarray(env.reference.qpos)[0, np.asarray(states.time)]
    qpos = np.asarray(states.rollout.physics.qpos)
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1.0, atol=1e-5)
    angle = 2 * np.arccos(np.clip(np.abs(np.sum(qpos[:, 3:7] * recorded[:, 3:7], axis=1)), 0, 1))
    assert 0.3 < np.rad2deg(angle).mean() < 1.5
    hinges = np.rad2deg(qpos[:, 7:] - recorded[:, 7:])
    assert 0.4 < hinges[:, 0].std() < 0.6
    assert np.abs(hinges[:, 3]).max() == 0.0  # motors have no noise


@pytest.mark.slow
def test_time_limits_truncate_and_divergence_terminates(still: Motion):
    env = EnvMimicEnv(Simulator(load_robot()), [still], EnvMimicConfig(episode_seconds=0.4, start_noise=0.0))
    step = jax.jit(env.step)
    many = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 200))
    lengths = tracking_state(many).remaining
    assert (lengths.min(), lengths.max()) == (4, 12)
    state = jax.jit(env.reset)(jax.random.key(3))
    time, remaining = int(tracking_state(state).time), int(tracking_state(state).remaining)
    for elapsed in range(1, min(remaining, STEPS - time) + 1):
        state = step(state, jnp.zeros(env.action_size))
        over = float(elapsed == remaining or time + elapsed == STEPS)
        assert (float(state.done), float(state.info["truncation"])) == (over, over)

    state = jax.jit(env.reset)(jax.random.key(3))
    s = tracking_state(state)
    physics = s.rollout.physics._replace(qvel=s.rollout.physics.qvel.at[3].set(jnp.nan))
    broken = state.replace(pipeline_state=s._replace(rollout=s.rollout._replace(physics=physics)))
    state = step(broken, jnp.zeros(env.action_size))
    assert (float(state.done), float(state.info["truncation"])) == (1.0, 0.0)
    assert float(state.metrics["diverged"]) == 1.0
    assert all(np.isfinite(x).all() for x in state.obs.values()) and np.isfinite(float(state.reward))


@pytest.mark.slow
def test_the_missing_force_earns_more_reward_than_zero_or_opposite_force(pushed: Motion):
    """A constant force acts on the reference robot, so this test detects errors of sign and frame. Among the forces at
    balloon, base and feet, only the first is not zero."""
    env = EnvMimicEnv(
        Simulator(load_robot()), [pushed], EnvMimicConfig(start_noise=0.0, force_cost=0.0, forces="multi")
    )
    state = jax.jit(env.reset)(jax.random.key(5))
    s = tracking_state(state)
    start = 2
    rollout = RolloutState(
        state_at(env.reference.qpos[0, start], env.reference.qvel[0, start]),
        env.reference.features[0, start - 2 : start + 1],
        env.reference.command[0, start - 2 : start],
    )
    state = state.replace(pipeline_state=s._replace(rollout=rollout, time=jnp.asarray(start, s.time.dtype)))
    step = jax.jit(env.step)

    def total(force: np.ndarray) -> float:
        run, reward = state, 0.0
        for _ in range(20):
            heading = np.asarray(heading_rotation(tracking_state(run).rollout.features[8]))
            action = jnp.zeros(env.action_size).at[:3].set(heading.T @ force / load_units(env.config, env.robot)[:3])
            run = step(run, action)
            reward += float(run.reward)
        return reward

    force = np.array([0.04, 0.0, 0.02])
    assert total(force) > total(np.zeros(3)) + 0.05 > total(-force) + 0.1
    best = env.config.position_weight + env.config.orientation_weight
    best += env.config.fine_position_weight + env.config.fine_orientation_weight
    assert total(force) > 20 * 0.99 * best


@pytest.mark.slow
@pytest.mark.parametrize("forces", ["force", "wrench"])
def test_an_untrained_policy_gives_the_mean_force_that_the_model_lacks(forces: ForceSet):
    """A robot that lost lift lacks a constant force. Its recording is followed without training, and costs nothing."""
    lost = np.array([0.0, 0.0, -0.16])
    motion = make_motion(lost, steps=50)
    env = EnvMimicEnv(Simulator(load_robot()), [motion], EnvMimicConfig(forces=forces, start_noise=0.0))
    np.testing.assert_allclose(np.array(env.config.expected_loads)[:3], lost, atol=0.02)
    sizes = PPOConfig(num_envs=8, batch_size=8, num_minibatches=1, unroll_length=2, num_updates_per_batch=1)
    state = Learner(env, sizes).init(0)
    infer = make_inference(env.observation_size, env.action_size, sizes)
    observed = jax.jit(env.reset)(jax.random.key(0)).obs["state"]
    action = infer(params(state), observed)
    loads = load_units(env.config, env.robot) * action
    np.testing.assert_allclose(loads[:3], lost, atol=0.02)
    run = jax.jit(env.reset)(jax.random.key(1))
    free = EnvMimicEnv(Simulator(load_robot()), [motion], dataclasses.replace(env.config, force_cost=0.0))
    rewards = [float(jax.jit(each.step)(run, env.initial_action).reward) for each in (env, free)]
    assert rewards[0] == pytest.approx(rewards[1], abs=1e-6) and rewards[0] > 2.2


FORCE = np.array([0.04, 0.0, 0.02])
"""Force on the balloon (N, world frame)."""


@pytest.fixture(scope="module")
def evaluator() -> OpenLoopEvaluator:
    """Evaluator on a recording without and a shorter one with `FORCE`. The residual's parameters are its force (N)."""
    config = ForceNetworkConfig(force_scale=0.05, force_limit=1.0)
    motions = [make_motion(np.zeros(3), "near-own", 60), make_motion(FORCE, "far-pushed", 50)]
    constant = NetworkResidual(config, load_robot(), lambda params, _: params / load_units(config, load_robot()))
    return OpenLoopEvaluator(Simulator(load_robot()), motions, constant)


@pytest.mark.slow
def test_evaluation_finds_errors_only_where_a_force_is_missing(evaluator: OpenLoopEvaluator):
    result = evaluator(jnp.array(FORCE))
    own, pushed = result.vanilla
    assert own.group == "near" and pushed.group == "far"
    assert own.position[1.0][0] < 1e-3 and own.orientation[1.0][0] < 0.1
    assert pushed.position[2.0][0] > 0.03
    # The true force removes the error on its recording. On the other recording, the error exceeds the bound.
    assert result.ratio("far", "position", 2.0) < 0.1
    assert result.excess()[0] > 0 and "near-own" in result.excess()[1]


@pytest.mark.slow
def test_diverged_replays_are_counted_and_not_averaged(evaluator: OpenLoopEvaluator):
    evaluator(jnp.array(FORCE))  # The errors without residual are kept: a share of 0 of these parameters would be NaN.
    result = evaluator(jnp.full(3, jnp.nan))
    for errors in result.residual:
        some, starts = errors.diverged[1.0]
        assert some == starts > 0 and errors.position[1.0] == (np.inf, 0.0) and errors.mean_com_error == np.inf
    assert not any(errors.num_diverged(1.0) for errors in result.vanilla)
    assert result.excess()[0] == result.score == np.inf
    assert "diverged" in result.table() and "nan" not in result.table() + json.dumps(evaluation_to_json(result)).lower()


@pytest.mark.slow
def test_far_away_robots_are_counted_as_diverged_without_a_warning(evaluator: OpenLoopEvaluator):
    """The square of 1e25 m has no value in single precision."""
    replay = evaluator.replay(jnp.array(FORCE))
    for errors in evaluator.errors(replay._replace(position=replay.position + np.float32(1e25))):
        some, starts = errors.diverged[1.0]
        assert some == starts > 0


@pytest.mark.slow
def test_a_replay_of_limited_length_is_the_start_of_a_longer_one(evaluator: OpenLoopEvaluator):
    whole, short = (evaluator.replay(jnp.array(FORCE), seconds=seconds) for seconds in (np.inf, 1.0))
    states = 1 + round(1.0 / evaluator.robot.control_timestep)
    assert short.position.shape[1] == states < whole.position.shape[1]
    np.testing.assert_array_equal(short.position, whole.position[:, :states])


@pytest.mark.slow
def test_first_runs_last_to_the_recordings_end_and_others_to_the_longest_horizon(evaluator: OpenLoopEvaluator):
    shorter = copy.copy(evaluator)
    shorter.robot = dataclasses.replace(evaluator.robot, horizons=(0.5, 1.0))
    shorter = shorter.on(evaluator.motions)
    replay, longest = shorter.replay(jnp.array(FORCE)), round(1.0 / CONTROL_TIMESTEP)
    assert len(shorter.starts) > len(shorter.first_runs) == 2
    for run, (recording, start) in enumerate(shorter.starts):
        steps = len(shorter.motions[recording].command) - start
        states = 1 + (steps if run in shorter.first_runs else min(steps, longest))
        for values in (replay.position, replay.euler_angles, replay.com):
            assert np.isfinite(values[run, :states]).all() and np.isnan(values[run, states:]).all()
        assert np.isfinite(replay.force[run, : states - 1]).all() and np.isnan(replay.force[run, states - 1 :]).all()
    for whole, limited in zip(evaluator(jnp.array(FORCE)).residual, shorter(jnp.array(FORCE)).residual, strict=True):
        assert limited.mean_com_error == pytest.approx(whole.mean_com_error)


@pytest.mark.slow
def test_evaluation_with_identified_actuators_includes_the_nominal_robot(evaluator: OpenLoopEvaluator):
    """The first recording is from the nominal robot, so it has no error only without the identified actuators."""
    assert evaluator(jnp.array(FORCE)).nominal == ()
    nominal = ActuatorParameters.nominal(load_model())
    stiffer = dataclasses.replace(nominal, knee_spring_stiffness=1.5 * nominal.knee_spring_stiffness)
    identified = Simulator(load_robot(), stiffer)
    result = OpenLoopEvaluator(identified, evaluator.motions, evaluator._residual)(jnp.array(FORCE))
    assert list(result.simulators) == ["vanilla", "vanilla+sysid", "envmimic"]
    assert result.nominal[0].position[1.0][0] < 1e-3 < 5e-3 < result.vanilla[0].position[1.0][0]


@pytest.mark.slow
def test_errors_of_starting_states_are_the_distance_between_them(evaluator: OpenLoopEvaluator):
    """A robot whose starting states are moved by 2 cm walks at a distance of 2 cm."""
    assert all(e.position[2.0][0] == 0.0 for e in evaluator.of_starts(evaluator.motions, jnp.array(FORCE)))
    beside = [dataclasses.replace(m, qpos=m.qpos + 0.02 * np.eye(m.qpos.shape[1])[1]) for m in evaluator.motions]
    for errors in evaluator.of_starts(beside, jnp.array(FORCE)):
        assert errors.position[2.0][0] == pytest.approx(0.02, rel=0.02)
        assert errors.orientation[2.0][0] < 0.1 and errors.mean_com_error == pytest.approx(0.02, rel=0.02)


def test_errors_of_a_group_are_means_over_its_recordings():
    """Two recordings exchange their errors. One of them alone exceeds the bound, but the mean does not."""

    def errors(name: str, size: float) -> Errors:
        return Errors(name, "near", {5.0: (size, 0.1)}, {5.0: (10 * size, 1.0)}, size, 10 * size, 0.0)

    vanilla, mimic = (errors("near-1", 1.0), errors("near-2", 3.0)), (errors("near-1", 3.0), errors("near-2", 1.0))
    result = Evaluation(vanilla, mimic)
    worst, place = result.excess()
    assert worst == pytest.approx(3.0 / (1.2 * 1.0 + 0.02) - 1) and "near-1" in place
    means = Evaluation(mean_by_group(vanilla), mean_by_group(mimic))
    worst, place = means.excess()
    assert worst == pytest.approx(2.0 / (1.2 * 2.0 + 0.02) - 1) and "near at 5 s" in place
    assert means.ratio("near", "orientation", 5.0) == result.ratio("near", "orientation", 5.0) == 1.0


@pytest.mark.slow
def test_recordings_and_actuators_share_one_compiled_program(still: Motion, pushed: Motion):
    other = load_model()
    nominal = ActuatorParameters.nominal(other)
    stiffer = dataclasses.replace(nominal, knee_spring_stiffness=1.2 * nominal.knee_spring_stiffness)
    cases = [
        (load_model(), [still]),
        (load_model(stiffer), [make_motion(FORCE, steps=50), pushed, still]),
    ]
    sizes = PPOConfig(num_envs=8, batch_size=8, num_minibatches=1, unroll_length=2, num_updates_per_batch=1)
    training, replaying = [], []
    for model, motions in cases:
        learner = Learner(EnvMimicEnv(Simulator(load_robot(), model=model), motions, SCALED), sizes)
        state = jax.eval_shape(learner._first, jax.random.PRNGKey(0), learner._parameters)
        training.append(learner._step.lower(state, learner._parameters).as_text())
        evaluator = OpenLoopEvaluator(
            Simulator(load_robot(), model=model),
            motions,
            NetworkResidual(dataclasses.replace(SCALED, forces="force"), load_robot(), lambda params, _: params),
        )
        places = np.tile(np.array([0, 2], np.int32), (evaluator._size, 1))
        carry = evaluator._begin(places)
        replaying.append(evaluator._chunk.lower(np.zeros(3), 1.0, *evaluator._fixed, carry, places).as_text())
    assert training[0] == training[1]
    assert replaying[0] == replaying[1]


@pytest.mark.slow
def test_stored_replays_are_those_evaluated(evaluator: OpenLoopEvaluator):
    replays = {"vanilla": evaluator.replay(jnp.array(FORCE), scale=0.0), "envmimic": evaluator.replay(jnp.array(FORCE))}
    takes = artifacts.stored_rollouts(evaluator, replays)
    assert [take.name for take in takes] == ["near-own", "far-pushed"]
    first = HISTORY - 1
    for take, motion, run in zip(takes, evaluator.motions, evaluator.first_runs, strict=True):
        np.testing.assert_array_equal(take.qpos["recording"], motion.qpos[first:])
        assert take.time[0] == pytest.approx(first * CONTROL_TIMESTEP)
        for name, replay in replays.items():
            states = len(take.time)
            seen = robot_meshes.poses(load_model(), load_robot(), take.qpos[name])
            np.testing.assert_allclose(seen.tracked, replay.position[run, :states], atol=1e-4)
            np.testing.assert_allclose(seen.yaw, replay.yaw[run, :states], atol=1e-3)
        assert take.force is not None
        np.testing.assert_allclose(take.force, np.tile(FORCE, (len(take.time) - 1, 1)), atol=0.02)
    # Each recording is reproduced by the simulator that made it.
    for take, name in zip(takes, ("vanilla", "envmimic"), strict=True):
        np.testing.assert_allclose(take.qpos[name], take.qpos["recording"], atol=0.02)
