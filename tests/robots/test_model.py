"""Models with identified values, and the MJCF files that are written from them."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from robot_files import write_robot

from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.parameters import IdentifiedParameters
from ballu_mjx.identification.write_back import identified_xml
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.mjcf import write_mjcf
from ballu_mjx.sim.c_model import improved_model
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.sim.step import state_at

DRONE = """
<mujoco>
  <compiler autolimits="true"/>
  <worldbody>
    <body name="drone" pos="0 0 1">
      <freejoint/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.003 0.002 0.004"/>
      <site name="drone"/>
    </body>
  </worldbody>
  <actuator><motor name="lift" site="drone" gear="0 0 1 0 0 0" ctrlrange="0 20"/></actuator>
</mujoco>
"""
"""A robot of one free body, which MuJoCo compiles as simple."""
DOOR = """
<mujoco>
  <compiler angle="degree" autolimits="true"/>
  <worldbody>
    <body name="door">
      <joint name="hinge" axis="0 1 0" stiffness="2" springref="30" range="-90 90"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.003 0.002 0.004"/>
      <site name="door"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
COM = [{"body": "BODY", "field": field, "bounds": [-0.1, 0.1]} for field in ("com_x", "com_y")]


def robot(folder: Path, name: str, model: str, *entries: dict) -> RobotDescription:
    command = {"drone": "lift", "door": "motor"}[name]
    identify = [{key: name if value == "BODY" else value for key, value in entry.items()} for entry in entries]
    return write_robot(folder, name, model, tracked=name, commands={command: command}, identify=identify)


def values(description: RobotDescription, *vector: float) -> IdentifiedParameters:
    return IdentifiedParameters(jnp.asarray(vector), declared_parameters(description, description.load_model()))


def test_a_moved_centre_of_mass_moves_in_mjx_as_in_c_mujoco(tmp_path: Path) -> None:
    """MuJoCo compiles the drone as simple, and MJX would keep the diagonal of its inertia matrix."""
    description = robot(tmp_path, "drone", DRONE, *COM)
    moved = mujoco.MjModel.from_xml_string(DRONE.replace('inertial pos="0 0 0"', 'inertial pos="0.05 -0.02 0"'))
    plain = Simulator(description)
    start = np.r_[plain.mj_model.qpos0], np.r_[np.zeros(3), 0.0, 0.0, 3.0]
    other = plain.with_fields({"body_ipos": jnp.asarray(moved.body_ipos)})
    state = other.step(state_at(*map(jnp.asarray, start)), jnp.asarray([9.81]), jnp.zeros((1, 6)))
    data = mujoco.MjData(moved)
    moved.opt.timestep = plain.mj_model.opt.timestep
    data.qpos[:], data.qvel[:] = start
    data.ctrl[:] = 9.81
    mujoco.mj_step(moved, data, plain.substeps)
    assert np.abs(data.qvel[:2]).max() > 0.05
    np.testing.assert_allclose(state.qvel, data.qvel, atol=2e-4)


def test_a_model_that_is_compiled_as_simple_refuses_another_centre_of_mass(tmp_path: Path) -> None:
    description = robot(tmp_path, "drone", DRONE, *COM)
    simulator = Simulator(description, model=mujoco.MjModel.from_xml_string(DRONE))
    with pytest.raises(ValueError, match="compiled as simple"):
        simulator.with_fields({"body_ipos": jnp.zeros((2, 3))})


def test_the_improved_model_has_the_options_of_an_explicit_model(tmp_path: Path) -> None:
    description = robot(tmp_path, "drone", DRONE, *COM)
    moon = description.load_model()
    moon.opt.gravity[2], moon.opt.timestep, moon.opt.wind[0] = -1.62, 0.0025, 3.0
    found = improved_model(Simulator(description, model=moon).with_residual(None))
    for name in ("gravity", "timestep", "wind", "integrator", "iterations"):
        np.testing.assert_array_equal(getattr(found.opt, name), getattr(moon.opt, name))


def acceleration(model: mujoco.MjModel) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qvel[:] = np.linspace(1.0, 2.0, model.nv)
    data.ctrl[:] = 0.5
    mujoco.mj_forward(model, data)
    return data.qacc.copy()


@pytest.mark.parametrize(("name", "mjcf"), [("drone", DRONE), ("door", DOOR)])
def test_a_moved_centre_of_mass_moves_in_c_mujoco_as_if_the_model_file_had_it(
    name: str, mjcf: str, tmp_path: Path
) -> None:
    description = robot(tmp_path, name, mjcf, *COM)
    identified = values(description, 0.05, -0.02)
    moved = mujoco.MjModel.from_xml_string(mjcf.replace('inertial pos="0 0 0"', 'inertial pos="0.05 -0.02 0"'))
    expected = acceleration(moved)
    assert np.abs(expected - acceleration(description.load_model())).max() > 0.1
    np.testing.assert_allclose(acceleration(description.load_model(identified)), expected, rtol=1e-5, atol=1e-5)
    improved = improved_model(Simulator(description, identified).with_residual(None))
    np.testing.assert_allclose(acceleration(improved), expected, rtol=1e-5, atol=1e-5)


def test_identified_moments_of_inertia_of_a_single_free_body_can_be_simulated(tmp_path: Path) -> None:
    description = robot(tmp_path, "drone", DRONE, {"body": "BODY", "field": "inertia"})
    nominal = declared_parameters(description, description.load_model()).nominal
    found = acceleration(description.load_model(values(description, *nominal)))
    np.testing.assert_allclose(found, acceleration(description.load_model()), rtol=1e-5, atol=1e-6)


def test_angles_of_a_model_in_degrees_are_written_in_degrees(tmp_path: Path) -> None:
    file = tmp_path / "door.xml"
    file.write_text(DOOR)
    wanted = mujoco.MjModel.from_xml_path(str(file))
    wanted.qpos_spring[0], wanted.jnt_range[0, 1] = 0.2, 1.0
    (tmp_path / "out").mkdir()
    write_mjcf(file, wanted, tmp_path / "out", "identified.xml")
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "identified.xml"))
    np.testing.assert_allclose(written.qpos_spring, [0.2], rtol=1e-5)
    np.testing.assert_allclose(written.jnt_range, [[-np.pi / 2, 1.0]], rtol=1e-5)


def test_an_identified_spring_reference_of_a_model_in_degrees_is_written_back(tmp_path: Path) -> None:
    description = robot(tmp_path, "door", DOOR, {"joint": "hinge", "field": "springref", "bounds": [-1, 1]})
    written = mujoco.MjModel.from_xml_string(identified_xml(description, values(description, 0.2)))
    np.testing.assert_allclose(written.qpos_spring, [0.2], rtol=1e-5)


GEOMETRIC = """
<mujoco>
  <compiler SETTING autolimits="true"/>
  <worldbody>
    <body name="door">
      <joint name="hinge" axis="0 1 0"/>
      <inertial pos="0.01 0 0" mass="1" diaginertia="0.003 0.002 0.004"/>
      <geom type="box" size="0.3 0.02 0.4" mass="0.5"/>
      <site name="door"/>
      <body name="knob" pos="0.25 0 0">
        <joint name="knob" axis="0 1 0"/>
        <inertial pos="0 0 0" mass="0.2" diaginertia="0.0003 0.0002 0.0004"/>
        <geom type="sphere" size="0.03" mass="0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated:UserWarning")
@pytest.mark.parametrize("setting", ["", 'inertiafromgeom="true"', 'settotalmass="3"'])
def test_identified_masses_are_written_whatever_the_compiler_does_to_masses(tmp_path: Path, setting: str) -> None:
    description = robot(tmp_path, "door", GEOMETRIC.replace("SETTING", setting), {"body": "BODY", "field": "mass"})
    identified = values(description, 0.7)
    written = mujoco.MjModel.from_xml_string(identified_xml(description, identified))
    wanted = description.load_model(identified)
    assert wanted.body_mass[1] == pytest.approx(0.7)
    for field in ("body_mass", "body_ipos", "body_inertia"):
        np.testing.assert_allclose(getattr(written, field), getattr(wanted, field), rtol=1e-4, atol=1e-9)
