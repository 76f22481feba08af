"""Files of identified parameters: MJCF for plain MuJoCo, and JSON."""

import json
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from robot_files import write_robot
from test_parameters import EVERYTHING, arm

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.parameters import IdentifiedParameters
from ballu_mjx.identification.write_back import identified_to_json, identified_xml, read_identified
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.robots.model import set_fields


def identified(folder: Path, *entries: dict) -> tuple[RobotDescription, IdentifiedParameters]:
    parameters, _ = arm(folder, *entries)
    values = parameters.draw(3, 2)[1].astype(np.float32)
    return read_description(folder / "arm.robot.json"), IdentifiedParameters(jnp.asarray(values), parameters)


def test_plain_mujoco_simulates_the_written_model_identically(tmp_path: Path):
    robot, found = identified(tmp_path, *EVERYTHING)
    text = identified_xml(robot, found)
    assert f"delay {float(found.drivetrain().delay[0]):.6g}" in text
    fitted = robot.load_model()
    set_fields(fitted, found.fields(fitted))
    mujoco.mj_setConst(fitted, mujoco.MjData(fitted))
    written = mujoco.MjModel.from_xml_string(text)
    nominal = robot.load_model()
    ends = []
    for model in (fitted, written, nominal):
        data = mujoco.MjData(model)
        data.qpos[:], data.ctrl[:] = [0.5, -0.8], [0.7, 0.2]
        for _ in range(50):
            mujoco.mj_step(model, data)
        ends.append(data.qpos.copy())
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-4)
    assert np.abs(ends[2] - ends[0]).max() > 0.01


def test_values_on_a_bound_are_read_back(tmp_path: Path):
    robot, found = identified(tmp_path, {"command": "left", "field": "delay", "bounds": [0, 0.1]})
    assert float(np.float32(0.1)) > 0.1
    path = tmp_path / "identified.json"
    path.write_text(identified_to_json(robot, IdentifiedParameters(jnp.array([0.1], jnp.float32), found.declared)))
    np.testing.assert_allclose(read_identified(path, robot).values, 0.1)


def test_a_field_that_mjcf_cannot_express_is_refused(tmp_path: Path):
    robot, found = identified(tmp_path, {"geom": "rod", "field": "geom_rbound"})
    with pytest.raises(InputError, match="geom_rbound cannot be written as MJCF"):
        identified_xml(robot, found)


WHEEL = """
<mujoco>
  <compiler autolimits="true" COMPILER/>
  <worldbody>
    <body name="wheel">
      <joint name="axle" axis="0 1 0" JOINT/>
      <inertial pos="0.1 0 0" mass="1" INERTIAL/>
      <site name="hub"/>
    </body>
  </worldbody>
  <actuator><position name="motor" joint="axle" ctrlrange="-1 1" kp="3" SERVO/></actuator>
</mujoco>
"""
ORIENTATIONS = ("quat='1 2 3 4'", "euler='30 20 10'", "axisangle='1 2 3 40'", "xyaxes='1 1 0 -1 1 1'", "zaxis='1 2 3'")


def wheel(folder: Path, *entries: dict, **attributes: str) -> tuple[RobotDescription, IdentifiedParameters]:
    """Return a robot and values that differ from nominal. `attributes` replace the words in capitals of `WHEEL`."""
    model = WHEEL
    for word in ("COMPILER", "JOINT", "INERTIAL", "SERVO"):
        model = model.replace(word, attributes.get(word.lower(), {"INERTIAL": "diaginertia='1 2 2.5'"}.get(word, "")))
    robot = write_robot(folder, "wheel", model, tracked="hub", commands={"axle": "motor"}, identify=list(entries))
    parameters = declared_parameters(robot, robot.load_model())
    return robot, IdentifiedParameters(jnp.asarray(parameters.draw(3, 2)[1].astype(np.float32)), parameters)


@pytest.mark.parametrize(
    "inertial", [*(f"diaginertia='1 2 2.5' {each}" for each in ORIENTATIONS), "fullinertia='2 2 2 .3 .2 .1'"]
)
def test_written_inertias_do_not_depend_on_how_the_model_file_states_them(tmp_path: Path, inertial: str):
    robot, found = wheel(tmp_path, {"body": "wheel", "field": "mass_properties"}, inertial=inertial)
    written = mujoco.MjModel.from_xml_string(identified_xml(robot, found))
    wanted = robot.load_model(found)
    inertias = []
    for model in (written, wanted, robot.load_model()):
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, model.body_iquat[1])
        axes = axes.reshape(3, 3)
        inertias.append(axes @ np.diag(model.body_inertia[1]) @ axes.T)
    np.testing.assert_allclose(inertias[0], inertias[1], atol=1e-4)
    assert np.abs(inertias[2] - inertias[1]).max() > 0.1


@pytest.mark.parametrize("attributes", [{"servo": "dampratio='0.7'"}, {"joint": "springdamper='0.5 0.8'"}])
def test_values_that_mujoco_computes_from_masses_are_written_as_they_were_fitted(
    tmp_path: Path, attributes: dict[str, str]
):
    """The fit holds nominal damping, although the model file states it as a ratio that depends on the mass."""
    robot, found = wheel(
        tmp_path, {"body": "wheel", "field": "mass"}, {"actuator": "motor", "field": "kp"}, **attributes
    )
    written, wanted = mujoco.MjModel.from_xml_string(identified_xml(robot, found)), robot.load_model(found)
    assert abs(wanted.body_mass[1] - 1) > 0.1 and abs(wanted.actuator_gainprm[0, 0] - 3) > 0.1
    for field in ("actuator_gainprm", "actuator_biasprm", "dof_damping", "jnt_stiffness", "body_mass"):
        np.testing.assert_allclose(getattr(written, field), getattr(wanted, field), rtol=1e-5, err_msg=field)


def test_a_mass_that_the_compiler_would_raise_is_refused(tmp_path: Path):
    robot, found = wheel(tmp_path, {"body": "wheel", "field": "mass"}, compiler="boundmass='1'")
    assert identified_xml(robot, found)
    light = IdentifiedParameters(jnp.array([0.5]), found.declared)
    with pytest.raises(InputError, match=r"wheel\.robot\.json: body_mass cannot be written as MJCF"):
        identified_xml(robot, light)


def test_values_are_read_back_from_json_and_missing_ones_are_nominal(tmp_path: Path):
    robot, found = identified(tmp_path, *EVERYTHING)
    path = tmp_path / "identified.json"
    path.write_text(identified_to_json(robot, found, np.ones(len(found.declared))))
    np.testing.assert_allclose(read_identified(path, robot).values, found.values, rtol=1e-6)
    content = json.loads(path.read_text())
    name = found.declared.names[0]
    del content["parameters"][name]
    path.write_text(json.dumps(content))
    np.testing.assert_allclose(read_identified(path, robot).values[0], found.declared.nominal[0])
    content["parameters"]["knee"] = {"value": 1}
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"identified\.json: arm\.robot\.json identifies no knee"):
        read_identified(path, robot)
    content["parameters"] = {name: {"value": 1e9}}
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=f"{name} is 1000000000.0; write a number from"):
        read_identified(path, robot)
