"""Does a fit say which parameter is missing, and is it silent where none is?"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from servo_arm import TRUTH, record_arm, write_arm

from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.declared import measure_recording
from ballu_mjx.identification.fit_robot import FitConfig, RobotFit, fit_robot
from ballu_mjx.identification.measured_motion import MeasuredMotion, SamplingConfig
from ballu_mjx.identification.undeclared import candidate_entries, suggest_parameters, suggestions_table
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.registry import load_robot

NOISE, FRICTION = 0.3, 1.0
"""deg"""
CONFIG = FitConfig(window_seconds=0.6, starts=1)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    return write_arm(tmp_path_factory.mktemp("arm"))


def motions(arm: RobotDescription, folder: Path, friction: float) -> list[MeasuredMotion]:
    model, sampling = arm.load_model(), SamplingConfig(angle_noise=float(np.deg2rad(NOISE)))
    paths = [
        record_arm(folder, arm, f"motion-{seed}", seed, "suspended", noise=NOISE, friction=friction)
        for seed in range(2)
    ]
    return [measure_recording(read_recording(path, arm), arm, model, sampling) for path in paths]


@pytest.fixture(scope="module")
def rubbing(arm: RobotDescription, tmp_path_factory: pytest.TempPathFactory) -> list[MeasuredMotion]:
    return motions(arm, tmp_path_factory.mktemp("rubbing"), FRICTION)


@pytest.fixture(scope="module")
def fit(arm: RobotDescription, rubbing: list[MeasuredMotion]) -> RobotFit:
    return fit_robot(declared_parameters(arm, arm.load_model()), rubbing, rubbing, CONFIG)


def test_friction_that_is_not_declared_is_named_with_its_size(
    arm: RobotDescription, rubbing: list[MeasuredMotion], fit: RobotFit
):
    found = suggest_parameters(arm, fit, rubbing, CONFIG)
    assert {each.parameter.name for each in found} == {"shoulder_frictionloss", "elbow_frictionloss"}
    strength = {"shoulder_frictionloss": 6.0, "elbow_frictionloss": 4.0}
    for each in found:
        # From the first order at no friction, where other parameters stand in for it.
        assert each.value == pytest.approx(strength[each.parameter.name] * np.deg2rad(FRICTION), rel=0.4)
        assert f'"{each.parameter.name.split("_")[0]}", "field": "frictionloss"' in suggestions_table(found)
    assert 0.2 < sum(each.explained for each in found) < 1
    # As the report says it, it can be declared.
    named = dataclasses.replace(arm, identify=tuple(each.entry for each in found))
    assert [p.nominal for p in declared_parameters(named, arm.load_model()).parameters] == [0.0, 0.0]


def test_where_the_model_has_all_nothing_is_proposed(arm: RobotDescription, tmp_path: Path, fit: RobotFit):
    true = np.array([TRUTH[name] for name in fit.parameters.names])
    right = dataclasses.replace(fit, values=true, scatter=np.ones(2))
    assert suggest_parameters(arm, right, motions(arm, tmp_path, 0.0), CONFIG) == ()


def test_candidates_are_of_the_elements_that_a_model_names():
    robot = load_robot("ballu")
    model = robot.load_model()
    entries = candidate_entries(robot, model)
    assert {"joint": "knee_left", "field": "frictionloss"} in entries
    assert {"command": robot.commands[0], "field": "delay"} in entries
    assert not any(entry.get("joint") == model.joint(0).name for entry in entries), "the free joint has no friction"
