"""Files of identified parameters: MJCF for plain MuJoCo, and JSON."""

import json
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from test_parameters import EVERYTHING, arm

from ballu_mjx.common.errors import InputError
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
    robot, found = identified(tmp_path, {"joint": "left", "field": "dof_invweight0"})
    with pytest.raises(InputError, match="dof_invweight0 cannot be written as MJCF"):
        identified_xml(robot, found)


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
