"""Replay of a residual and identified actuators with another load or link of the robot (`evaluate --robot`)."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from servo_arm import identified, write_arm

from ballu_mjx.cli import evaluate
from ballu_mjx.common.errors import InputError
from ballu_mjx.residuals.fluid import FLUID_FILE, FluidEstimate, FluidParameters, FluidResidual, terms_of
from ballu_mjx.residuals.fluid_fit import FluidConfig
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_input import num_inputs
from ballu_mjx.residuals.run_config import check_compatible_robot, describe_run
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.residuals.training_range import TrainingRange
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.runs.folder import Run


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def run(robot: RobotDescription) -> Path:
    """A run of fluid forces on the arm, with identified actuators."""
    folder = robot.file.parent / "run"
    nothing = FluidParameters.without_added_mass(np.zeros((len(terms_of("drag")), 6)))
    actuators = identified(robot, elbow_damping=0.3, shoulder_delay=0.02)
    config = describe_run("fluid", {"fit": FluidConfig()}, {}, [], actuators, robot)
    with Run(folder, config | {"residual": None}) as made:
        TrainingRange.of(np.zeros((2, num_inputs(ForceNetworkConfig(), robot)))).write(made)
        made.write(FLUID_FILE, FluidEstimate("drag", nothing, nothing).to_json())
    return folder


def altered(robot: RobotDescription, folder: Path, old: str, new: str, **keys: object) -> RobotDescription:
    """Return the arm with a text of its model replaced, and other keys in its description."""
    text = robot.model.read_text()
    assert old in text
    (folder / "other.xml").write_text(text.replace(old, new))
    content = json.loads(robot.file.read_text()) | {"model": "other.xml", **keys}
    (folder / "other.robot.json").write_text(json.dumps(content))
    return read_description(folder / "other.robot.json")


def test_residual_and_actuators_apply_to_the_robot_with_another_load(
    robot: RobotDescription, run: Path, tmp_path: Path
):
    heavier = altered(robot, tmp_path, 'mass="0.15"', 'mass="0.4"', name="heavier arm")
    with pytest.raises(InputError, match="is of the robot arm, not of heavier arm"):
        TrainedResidual.load(run, heavier)
    found = TrainedResidual.load(run, heavier, other_model=True)
    assert isinstance(found.model, FluidResidual) and found.model.robot is heavier
    # The identified actuators apply to the new model, too.
    assert heavier.load_model(found.actuators).dof_damping[1] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("old", "new", "keys", "message"),
    [
        ('kp="6" kv="0.1" ctrlrange="-1 1"', 'kp="6" kv="0.1" ctrlrange="-2 2"', {}, "commands' ranges differ"),
        ('name="tip"', 'name="tip"', {"control_timestep": 0.02}, "control time step differ"),
        ('name="tip" pos', 'name="end" pos', {"tracked": "end"}, "tracked site differ"),
        ('name="tip"', 'name="tip"', {"force_joints": ["elbow"]}, "joints that forces act along differ"),
    ],
)
def test_a_robot_with_another_interface_is_refused(
    robot: RobotDescription, run: Path, tmp_path: Path, old: str, new: str, keys: dict, message: str
):
    other = altered(robot, tmp_path, old, new, **keys)
    with pytest.raises(InputError, match=f"cannot stand in for arm.*{message}") as refused:
        TrainedResidual.load(run, other, other_model=True)
    assert str(refused.value).count(". ") == 0


def test_a_robot_with_other_mirror_images_is_refused_by_symmetric_networks(robot: RobotDescription, tmp_path: Path):
    other = dataclasses.replace(robot, mirror={"shoulder": "elbow", "elbow": "shoulder"})
    own = dataclasses.replace(robot, mirror={})
    for config in ({}, {"env": {"mirror": False}}):
        check_compatible_robot(other, own, config, tmp_path)
    check_compatible_robot(own, own, {"env": {"mirror": True}}, tmp_path)
    with pytest.raises(InputError, match="cannot stand in for arm.*mirror images differ"):
        check_compatible_robot(other, own, {"env": {"mirror": True}}, tmp_path)


def test_option_robot_requires_recordings(robot: RobotDescription, run: Path, capsys: pytest.CaptureFixture[str]):
    assert evaluate.main([str(run), "--robot", str(robot.file)]) == 2
    assert "--robot goes with --recordings" in capsys.readouterr().err
