"""Simulation of windows of reconstructed motions, for robots with a free joint."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from ballu_mjx.identification.measured_motion import measured_from_motion
from ballu_mjx.identification.parameters import FieldTarget, Parameter, ParameterSet
from ballu_mjx.identification.window_simulator import WindowSimulator, cut_windows
from ballu_mjx.recordings.motion import Motion, ReconstructionParameters

MODEL = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.01" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="base">
      <freejoint/>
      <geom type="box" size="0.1 0.08 0.05" mass="1" contype="0" conaffinity="0"/>
      <site name="base"/>
      <body name="arm" pos="0.1 0 0">
        <joint name="arm" axis="0 1 0" damping="0.05"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.2" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="arm" joint="arm" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def floating(seconds: float = 2.0) -> tuple[mujoco.MjModel, Motion]:
    """Simulate a tumbling base with a driven arm in C MuJoCo, and sample its states at 20 Hz."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    data, rng, states = mujoco.MjData(model), np.random.default_rng(0), []
    data.qvel[:] = [0.1, 0.2, 0, 1.0, 2.0, -1.5, 0]
    commands = rng.uniform(-0.2, 0.2, (round(seconds / 0.05), 1))
    for command in commands:
        states.append((data.qpos.copy(), data.qvel.copy()))
        data.ctrl[:] = command
        mujoco.mj_step(model, data, 5)
    states.append((data.qpos.copy(), data.qvel.copy()))
    qpos, qvel = map(np.array, zip(*states, strict=True))
    return model, Motion("floating", np.arange(len(qpos)) * 0.05, commands, qpos, qvel, {})


def test_windows_follow_the_recording_and_their_starting_states_may_be_moved():
    model, motion = floating()
    damping = Parameter("damping", "", 0.05, (0.0, 1.0), 0.1, False, (FieldTarget("dof_damping", (6,), 1.0),))
    measured = [measured_from_motion(motion, model)]
    with jax.enable_x64(True):
        simulator = WindowSimulator(ParameterSet([damping], 1), measured, cut_windows(measured, 0.5))
        assert simulator.count == 4
        true = np.array([0.05])
        # Differences are in units of the noise: half a millimetre and a third of a degree.
        assert np.abs(simulator.differences(true)).max() < 1e-3
        assert np.abs(simulator.differences(2 * true)).max() > 1
        start = np.zeros((4, 14))
        start[:, [1, 4, 6, 9, 12]] = [1.0, 2.0, -1.0, 0.5, 0.3]
        moved = simulator.differences(true, start)
        np.testing.assert_allclose(moved[:, 0], start, atol=1e-3)  # in units of the noise


def test_a_slide_has_the_noise_of_a_displacement_and_a_hinge_that_of_an_angle():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><freejoint/><geom size="0.05" mass="0.3"/>
        <body><joint type="slide"/><geom size="0.05" mass="0.1"/></body>
        <body><joint type="hinge"/><geom size="0.05" mass="0.1"/></body></body></worldbody></mujoco>"""
    )
    still = np.tile(model.qpos0, (5, 1))
    motion = Motion("still", np.arange(5) * 0.02, np.zeros((4, 0)), still, np.zeros((5, model.nv)), {})
    parameters = ReconstructionParameters(position_noise=0.001, rotation_noise=0.02, joint_noise=0.03)
    noise = measured_from_motion(motion, model, parameters).position_noise
    np.testing.assert_allclose(noise, [0.001] * 3 + [0.02] * 3 + [0.001, 0.03])


def test_difference_of_positions_inverts_a_change_of_position():
    model, motion = floating(0.5)
    with jax.enable_x64(True):
        measured = [measured_from_motion(motion, model)]
        simulator = WindowSimulator(ParameterSet([], 1), measured, cut_windows(measured, 0.5))
        change = jnp.array([0.1, -0.2, 0.3, 0.01, -0.02, 0.03, 0.2])
        moved = simulator._moved(jnp.asarray(motion.qpos[3]), change)
        np.testing.assert_allclose(simulator._difference(moved, jnp.asarray(motion.qpos[3])), change, atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(moved[3:7]), 1)
        opposite = moved.at[3:7].multiply(-1)
        np.testing.assert_allclose(simulator._difference(opposite, jnp.asarray(motion.qpos[3])), change, atol=1e-5)


def test_a_robot_without_an_identified_drivetrain_gets_the_recorded_commands():
    model, motion = floating(0.5)
    with jax.enable_x64(True):
        measured = [measured_from_motion(motion, model)]
        simulator = WindowSimulator(ParameterSet([], 1), measured, cut_windows(measured, 0.25))
        ctrl, jacobian = map(np.asarray, simulator._ctrl_slopes(jnp.zeros(0)))
        np.testing.assert_allclose(simulator._of_windows(ctrl).ravel(), np.repeat(motion.command[:, 0], 5))
        assert simulator._of_windows(jacobian).shape == (2, 25, 0)
