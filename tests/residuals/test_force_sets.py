"""Force sets on a servo arm: their effect in simulation, their labels, and their scales from data."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from plain_push import PlainPush
from robot_files import write_robot
from servo_arm import wandering, write_arm

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.residuals import force_regression
from ballu_mjx.residuals.envmimic import EnvMimicConfig, EnvMimicEnv, tracking_state
from ballu_mjx.residuals.force_regression import SupervisedConfig
from ballu_mjx.residuals.network import NetworkResidual
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_loads import check_load_options, expected_units, load_scales, num_loads
from ballu_mjx.residuals.scales import missing_loads, resolve_scales, round_scale
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.sim.force_sets import ForceSet
from ballu_mjx.sim.linearize import Linearizer
from ballu_mjx.sim.residual import BoundResidual
from ballu_mjx.sim.simulator import RolloutState, Simulator
from ballu_mjx.sim.step import count_substeps, state_at

STEPS = 80
TORQUE = np.array([0.08, -0.03])
"""Torque at shoulder and elbow (N m)."""
SHIFT = np.array([0.05, -0.1])
"""Change of the commands (rad)."""


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def simulator(robot: RobotDescription) -> Simulator:
    return Simulator(robot)


def move(robot: RobotDescription, torque: Any = 0.0, shift: Any = 0.0, friction: float = 0.0) -> Motion:
    """Simulate the arm in C MuJoCo with a joint torque, a shift of its commands, or friction at the shoulder."""
    model, sent = robot.load_model(), 0.8 * wandering(0, STEPS)
    model.dof_frictionloss[0] = friction
    data = mujoco.MjData(model)
    data.qfrc_applied[:] = torque
    states = [(data.qpos.copy(), data.qvel.copy())]
    for command in sent:
        data.ctrl[:] = command + shift
        mujoco.mj_step(model, data, count_substeps(model, robot.control_timestep))
        states.append((data.qpos.copy(), data.qvel.copy()))
    qpos, qvel = map(np.array, zip(*states, strict=True))
    return Motion("near-arm", np.arange(STEPS + 1) * robot.control_timestep, sent, qpos, qvel, {})


def constant(robot: RobotDescription, forces: ForceSet, loads: np.ndarray) -> BoundResidual:
    """Return a residual that always gives `loads`."""
    config = ForceNetworkConfig(forces=forces, force_scale=1.0, force_limit=20.0, scales=(1.0,) * len(loads))
    return BoundResidual(NetworkResidual(config, robot, lambda params, _: params), jnp.asarray(loads, jnp.float32))


def begin(simulator: Simulator, motion: Motion) -> RolloutState:
    reference, _ = stack_motions(simulator, [motion])
    physics = state_at(reference.qpos[0, 2], reference.qvel[0, 2])
    return RolloutState(physics, reference.features[0, :3], reference.command[0, :2])


SETS: list[tuple[ForceSet, np.ndarray, dict[str, Any]]] = [
    ("joints", TORQUE, {"torque": TORQUE}),
    ("commands", SHIFT, {"shift": SHIFT}),
]


@pytest.mark.slow
@pytest.mark.parametrize(("forces", "loads", "truth"), SETS)
def test_a_simulator_with_the_missing_load_follows_the_recording(
    robot: RobotDescription, simulator: Simulator, forces: ForceSet, loads: np.ndarray, truth: dict[str, Any]
):
    """A share scales the residual. The sum of two residuals gives the sum of their loads."""
    motion = move(robot, **truth)
    both = constant(robot, forces, 2 * loads)
    step = jax.jit(lambda share, state, command: simulator.with_residual(both, share).step(state, command).state)
    errors = []
    for share in (0.5, 0.0):
        state = begin(simulator, motion)
        for time in range(2, 42):
            state = step(share, state, jnp.asarray(motion.command[time], jnp.float32))
        errors.append(np.abs(np.asarray(state.physics.qpos) - motion.qpos[42]).max())
    assert errors[0] < 1e-4 and errors[1] > 5e-3
    one, other = constant(robot, forces, loads), BoundResidual(PlainPush(), 1.0)
    seen = state.history, state.with_command(jnp.zeros(2))
    for base in (one.plus(one), one.plus(other).plus(one)):
        action = base.act(*seen)
        for found, kind in ((action.joint_force, "joints"), (action.command_change, "commands")):
            assert found is None if kind != forces else np.allclose(np.asarray(found), 2 * loads)


@pytest.mark.slow
def test_changed_commands_stay_within_their_range(robot: RobotDescription, simulator: Simulator):
    motion = move(robot)
    bound = constant(robot, "commands", np.array([10.0, -10.0]))
    step = jax.jit(lambda share, state, command: simulator.with_residual(bound, share).step(state, command))
    start = begin(simulator, motion)
    one, other = step(1.0, start, jnp.zeros(2)), step(0.0, start, jnp.array([1.0, -1.0]))
    np.testing.assert_allclose(one.state.physics.qvel, other.state.physics.qvel, atol=1e-6)
    np.testing.assert_array_equal(one.state.commands[-1], jnp.zeros(2))  # the history has the command before its change


@pytest.mark.slow
@pytest.mark.parametrize(("forces", "loads", "truth"), SETS)
def test_labels_and_scales_recover_the_missing_load(
    robot: RobotDescription, simulator: Simulator, forces: ForceSet, loads: np.ndarray, truth: dict[str, Any]
):
    motion = move(robot, **truth)
    missing = missing_loads(simulator, [motion], forces)
    np.testing.assert_allclose(missing.mean, loads, rtol=0.1)
    np.testing.assert_allclose(missing.rms, np.abs(loads), rtol=0.1)
    # If a base residual already gives half of the load, the other half is missing.
    base = simulator.with_residual(constant(robot, forces, loads / 2))
    np.testing.assert_allclose(missing_loads(base, [motion], forces).mean, loads / 2, rtol=0.15)
    config = ForceNetworkConfig(forces=forces, force_scale=1.0, force_limit=20.0, scales=tuple(np.abs(loads)))
    labels = force_regression.ForceLabeller(Linearizer(simulator, forces=forces), SupervisedConfig(), config)(motion)
    np.testing.assert_allclose(np.median(labels, axis=0), loads, rtol=0.1)
    _, actions = force_regression.examples(simulator, [motion], [labels], config)
    np.testing.assert_allclose(np.median(actions, axis=0), np.sign(loads), rtol=0.2)


@pytest.mark.slow
def test_the_missing_torque_makes_the_environment_follow_the_recording(robot: RobotDescription, simulator: Simulator):
    motion = move(robot, torque=TORQUE)
    env = EnvMimicEnv(simulator, [motion], EnvMimicConfig(forces="joints", start_noise=0.0))
    scales = load_scales(env.config, robot)
    assert env.action_size == 2 and scales.limit == pytest.approx(20)
    assert env.config.force_cost == pytest.approx(0.05)
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    distances = []
    start = next(s for key in range(99) if tracking_state(s := reset(jax.random.key(key))).time < STEPS - 20)
    for action in (TORQUE / scales.units, np.zeros(2)):
        state = start
        for _ in range(8):
            state = step(state, jnp.asarray(action, jnp.float32))
        tracking = tracking_state(state)
        distances.append(np.abs(tracking.rollout.physics.qpos - env.reference.qpos[0, tracking.time]).max())
    assert distances[0] < 0.02 * distances[1]


def test_given_scales_are_kept(robot: RobotDescription, simulator: Simulator):
    given = ForceNetworkConfig("wrench", 0.9, 0.3, 0.2, expected_loads=(0.0,))
    assert resolve_scales(given, simulator, []) == given
    with pytest.raises(ValueError, match="scales of the forces are open"):
        load_scales(ForceNetworkConfig(forces="joints"), robot)


def test_expected_loads_are_one_for_all_or_one_for_each(robot: RobotDescription):
    config = EnvMimicConfig(forces="joints", force_scale=1.0, force_limit=20.0, scales=(0.5, 2.0))
    for given, units in (((), [0, 0]), ((1.0,), [2, 0.5]), ((1.0, -2.0), [2, -1])):
        found = expected_units(dataclasses.replace(config, expected_loads=given), robot)
        np.testing.assert_allclose(found, units)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"expected_loads": (1.0, 2.0, 3.0)}, "--expected-loads has 3 values: give 2 with --forces joints"),
        ({"scales": (0.5,)}, "--scales has 1 values: give 2 with --forces joints"),
        ({"forces": "wrench"}, "with --forces wrench, give --force-scale"),
        ({"torque_scale": 0.1}, "--torque-scale is for --forces wrench"),
    ],
)
def test_scales_and_expected_loads_that_do_not_fit_the_robot_are_refused(
    robot: RobotDescription, changes: dict[str, Any], message: str
):
    config = EnvMimicConfig(forces="joints", scales=(0.5, 2.0))
    check_load_options(config, robot)
    with pytest.raises(InputError, match=message):
        resolve_scales(dataclasses.replace(config, **changes), Simulator(robot), [])


@pytest.mark.parametrize(
    ("size", "scale"), [(0.053, 0.05), (0.0085, 0.01), (0.15, 0.2), (0.097, 0.1), (3.0, 2.0), (3.3, 5.0), (1e-6, 1e-6)]
)
def test_scales_are_rounded_to_one_two_or_five(size: float, scale: float):
    assert round_scale(size) == scale


def test_friction_at_a_joint_gives_a_missing_load_at_that_joint(robot: RobotDescription, simulator: Simulator):
    missing = missing_loads(simulator, [move(robot, friction=0.1)], "joints").rms
    assert 0.03 < missing[0] < 0.11 and missing[1] < 0.2 * missing[0]


MOTE = """<mujoco><option timestep="0.01" integrator="implicitfast" gravity="0 0 0"/><worldbody><body name="mote">
  <freejoint/><geom size="{radius} {radius} {radius}" type="box" density="100"/><site name="mote"/>
  <body name="flap"><joint name="flap" axis="0 0 1" damping="1"/><geom size="{radius}" mass="1e-9"/></body>
</body></worldbody><actuator><motor name="flap" joint="flap" ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.mark.parametrize("radius", [0.02, 0.2])
def test_missing_forces_and_torques_are_found_on_small_and_on_large_robots(radius: float, tmp_path: Path):
    """The same torque turns a small body far more than the same force moves it, per newton metre and per newton."""
    xml = MOTE.format(radius=radius)
    robot = write_robot(tmp_path, "mote", xml, tracked="mote", points=[], commands={"flap": "flap"})
    model = robot.load_model()
    mass, inertia = model.body_mass[1], model.body_inertia[1, 0]
    load = np.array([1.0, -2.0, 0.5, 0.0, 0.0, 3.0]) * np.r_[[0.1 * mass] * 3, [0.1 * inertia] * 3]
    data = mujoco.MjData(model)
    data.xfrc_applied[1] = load
    states = [(data.qpos.copy(), data.qvel.copy())]
    for _ in range(20):
        mujoco.mj_step(model, data, count_substeps(model, robot.control_timestep))
        states.append((data.qpos.copy(), data.qvel.copy()))
    qpos, qvel = map(np.array, zip(*states, strict=True))
    motion = Motion("drift", np.arange(21) * robot.control_timestep, np.zeros((20, 1)), qpos, qvel, {})
    simulator = Simulator(robot)
    missing = missing_loads(simulator, [motion], "wrench", heading_frame=False)
    np.testing.assert_allclose(missing.mean, load, rtol=0.02, atol=1e-3 * np.abs(load).min(initial=1, where=load != 0))
    # A constant load is large for the policy, too. It can correct a mean that is wrong.
    config = resolve_scales(EnvMimicConfig(heading_frame=False), simulator, [motion])
    assert config.force_scale == round_scale(float(np.sqrt(np.mean(load[:3] ** 2))))


def test_loads_without_an_effect_are_taken_as_zero(tmp_path: Path):
    """A torque has no effect on a carriage that can only slide, and a force only along its rail."""
    xml = """<mujoco><option timestep="0.01" integrator="implicitfast" gravity="0 0 0"/><worldbody><body>
    <joint name="rail" type="slide" axis="1 0 0"/><geom size="0.1" mass="0.5"/><site name="carriage"/>
    </body></worldbody><actuator><motor name="push" joint="rail" ctrlrange="-1 1"/></actuator></mujoco>"""
    robot = write_robot(tmp_path, "carriage", xml, tracked="carriage", commands={"push": "push"})
    data = mujoco.MjData(robot.load_model())
    data.qfrc_applied[0] = 0.2
    states = [(data.qpos.copy(), data.qvel.copy())]
    for _ in range(20):
        mujoco.mj_step(data.model, data, count_substeps(data.model, robot.control_timestep))
        states.append((data.qpos.copy(), data.qvel.copy()))
    qpos, qvel = map(np.array, zip(*states, strict=True))
    motion = Motion("slide", np.arange(21) * robot.control_timestep, np.zeros((20, 1)), qpos, qvel, {})
    missing = missing_loads(Simulator(robot), [motion], "wrench")
    np.testing.assert_allclose(missing.mean, [0.2, 0, 0, 0, 0, 0], rtol=0.01, atol=1e-9)


def test_joint_forces_need_suitable_joints(robot: RobotDescription, tmp_path: Path):
    content = json.loads(robot.file.read_text()) | {"force_joints": [], "model": str(robot.model)}
    (tmp_path / "stiff.robot.json").write_text(json.dumps(content))
    stiff = read_description(tmp_path / "stiff.robot.json")
    with pytest.raises(InputError, match=r"--forces joints: arm has no hinge or slide.*force_joints"):
        resolve_scales(EnvMimicConfig(forces="joints"), Simulator(stiff), [])
    content["force_joints"] = ["elbow"]
    (tmp_path / "stiff.robot.json").write_text(json.dumps(content))
    one = read_description(tmp_path / "stiff.robot.json")
    assert num_loads(ForceNetworkConfig(forces="joints"), one) == 1
    content["force_joints"] = ["wrist"]
    (tmp_path / "stiff.robot.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="\"force_joints\" names 'wrist', which is no joint of the model"):
        read_description(tmp_path / "stiff.robot.json")
