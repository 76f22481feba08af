"""Locomotion tasks of a robot that is not BALLU. Its description and model set sizes, command ranges, starting states
and friction."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from rover import write_rover

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.rotations import quaternion_conjugate, quaternion_product
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.parameters import IdentifiedParameters
from ballu_mjx.policies.domain_randomization import draw_start, make_simulator_setting
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.locomotion_env import LocomotionEnv, locomotion_state
from ballu_mjx.policies.tasks import TASKS
from ballu_mjx.residuals.fluid import FluidParameters, FluidResidual
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.sim.residual import BoundResidual
from ballu_mjx.sim.simulator import Simulator

BALLOON = Path(__file__).parents[2] / "experiments" / "tethered_balloon" / "balloon.robot.json"
RANDOMIZED = LocomotionConfig(domain_randomization=True, start_angle=30.0)


@pytest.fixture(scope="module")
def rover(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    return write_rover(tmp_path_factory.mktemp("rover"))


def test_sizes_and_commands_follow_the_description_of_the_robot(rover: RobotDescription):
    env = LocomotionEnv(rover, TASKS["walk"], LocomotionConfig())
    assert (env.observation_size, env.action_size) == (9 + 6 + 1, 2)
    for action, command in (([-1.0, -1.0], [-0.4, 0.0]), ([1.0, 3.0], [0.6, 10.0]), ([0.0, 0.0], [0.1, 5.0])):
        np.testing.assert_allclose(env.command_of(jnp.array(action)), command, atol=1e-6)


def test_starting_states_are_drawn_about_the_keyframe_within_joint_ranges(rover: RobotDescription):
    model = rover.load_model()
    env = LocomotionEnv(rover, TASKS["walk"], RANDOMIZED)
    draw = jax.jit(jax.vmap(env.reset))
    now = locomotion_state(draw(jax.random.split(jax.random.key(0), 300)))
    qpos, home = np.asarray(now.rollout.physics.qpos), model.key("home").qpos
    shoulder, rod, lid = qpos[:, 7:].T
    # Offsets of 30 deg exceed both limits of the joint.
    assert shoulder.min() == pytest.approx(-0.4) and shoulder.max() == pytest.approx(0.6)
    assert 0.003 < rod.std() < 0.006 and rod.min() >= 0.0  # a slide joint, in metres
    np.testing.assert_allclose(lid, home[9], atol=1e-6)  # a held joint keeps its angle
    yaw = 2 * np.arctan2(qpos[:, 6], qpos[:, 3])
    assert np.rad2deg(np.abs(yaw - np.pi / 2)).max() <= RANDOMIZED.start_yaw + 2.5  # about the keyframe's heading
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1.0, atol=1e-5)
    assert np.asarray(now.rollout.physics.qvel).std(axis=0)[[0, 7]] == pytest.approx([0.03, 0.03], rel=0.2)
    np.testing.assert_allclose(now.rollout.commands[:, 0], np.tile(model.key("home").ctrl, (300, 1)))

    plain = make_simulator_setting(rover, model, LocomotionConfig(), None)
    still = locomotion_state(jax.jit(lambda key: env._start(plain, key))(jax.random.key(1)))
    np.testing.assert_allclose(still.rollout.physics.qpos, home, atol=1e-6)
    np.testing.assert_allclose(still.friction, [0.7, 0.8, 0.6], atol=1e-6)  # floor, hull and arm have their own values
    assert 0.5 <= now.friction.min() and now.friction.max() <= 1.1 and np.ptp(now.friction, axis=1).max() == 0


def test_a_control_step_and_its_reward_agree_with_c_mujoco(rover: RobotDescription):
    model = rover.load_model()
    env = LocomotionEnv(rover, TASKS["turn"], LocomotionConfig())
    state = env.reset(jax.random.key(0))
    state = jax.jit(env.step)(state, jnp.array([0.5, -0.2]))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    before = data.subtree_com[1].copy()
    data.ctrl[:] = 0.35, 4.0
    mujoco.mj_step(model, data, 4)  # 0.04 s
    now = locomotion_state(state)
    np.testing.assert_allclose(now.rollout.physics.qpos, data.qpos, atol=2e-3)  # MJX's contacts differ slightly
    mujoco.mj_forward(model, data)
    assert float(state.reward) == pytest.approx((data.subtree_com[1] - before)[1] / 0.04, abs=0.02)


@pytest.mark.parametrize("largest", [20.0, 90.0, 170.0])
def test_starting_headings_reach_the_stated_angle(rover: RobotDescription, largest: float):
    config = dataclasses.replace(RANDOMIZED, start_yaw=largest, start_tilt=0.0)
    setting = make_simulator_setting(rover, rover.load_model(), config, None)
    draw = jax.jit(jax.vmap(lambda key: draw_start(setting, rover, key)))
    qpos = np.asarray(draw(jax.random.split(jax.random.key(0), 2000)).qpos)
    heading = np.rad2deg(2 * np.arctan2(qpos[:, 6], qpos[:, 3])) - 90.0  # about the keyframe's heading
    turned = (heading + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose([turned.min(), turned.max()], [-largest, largest], rtol=0.01)


def test_pushes_are_independent_of_the_starting_tilt(rover: RobotDescription):
    config = dataclasses.replace(RANDOMIZED, push_force=1.0, push_torque=0.1)
    setting = make_simulator_setting(rover, rover.load_model(), config, None)
    draw = jax.jit(jax.vmap(lambda key: draw_start(setting, rover, key)))
    starts = draw(jax.random.split(jax.random.key(0), 2000))
    home = quaternion_conjugate(np.broadcast_to(rover.load_model().key("home").qpos[3:7], (2000, 4)))
    tilt = quaternion_product(np.asarray(starts.qpos[:, 3:7], float), home)[:, 1:]
    together = np.corrcoef(np.asarray(starts.push)[:, [0, 1, 5]].T, tilt.T)[:3, 3:]
    assert np.abs(together).max() < 0.1


@pytest.mark.slow
def test_policies_move_the_mass_that_identification_and_residual_give_together(tmp_path: Path):
    rover = write_rover(tmp_path)
    content = json.loads(rover.file.read_text())
    rover.file.write_text(json.dumps(content | {"identify": [{"body": "hull", "field": "mass"}]}))
    rover = read_description(rover.file)
    actuators = IdentifiedParameters(jnp.array([2.0]), declared_parameters(rover, rover.load_model()))
    model = FluidResidual(rover, rover.load_model(actuators), "linear", added_mass=True)
    params = dataclasses.replace(
        FluidParameters.without_added_mass(jnp.zeros((len(model.terms), 6))),
        added_mass=jnp.float32(3.0),
        added_inertia=jnp.full(3, 0.05),
    )
    improved = Simulator(rover, actuators).with_residual(BoundResidual(model, params))
    residual = TrainedResidual.of(improved)
    env = LocomotionEnv(rover, TASKS["walk"], LocomotionConfig(), actuators=actuators, residual=residual)
    state = env.reset(jax.random.key(0))
    start = locomotion_state(state).rollout
    launched = start._replace(physics=start.physics._replace(qpos=start.physics.qpos.at[2].add(1.0)))
    state = dataclasses.replace(state, pipeline_state=cast(Any, locomotion_state(state)._replace(rollout=launched)))
    after = locomotion_state(jax.jit(env.step)(state, jnp.array([0.5, 1.0]))).rollout
    expected = jax.jit(env.simulator.step)(launched, env.command_of(jnp.array([0.5, 1.0]))).state
    np.testing.assert_allclose(after.physics.qvel, expected.physics.qvel, atol=1e-5)
    lighter = Simulator(rover, actuators).with_residual(None)
    other = jax.jit(lighter.step)(launched, env.command_of(jnp.array([0.5, 1.0]))).state
    assert np.abs(other.physics.qvel - expected.physics.qvel).max() > 1e-3


@pytest.mark.parametrize("task", list(TASKS))
def test_tasks_refuse_an_anchored_robot(task: str):
    with pytest.raises(InputError, match=f"^{task} needs a free-floating robot; tethered balloon is anchored"):
        LocomotionEnv(read_description(BALLOON), TASKS[task], LocomotionConfig())
