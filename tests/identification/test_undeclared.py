"""Suggestions of parameters that the description does not declare but the recordings need."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from servo_arm import TRUTH, record_arm, write_arm

from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.declared import measure_recording
from ballu_mjx.identification.fit_robot import FitConfig, RobotFit, fit_robot
from ballu_mjx.identification.measured_motion import MeasuredMotion, SamplingConfig
from ballu_mjx.identification.parameters import Parameter, ParameterSet
from ballu_mjx.identification.undeclared import _select, candidate_entries, suggest_parameters, suggestions_table
from ballu_mjx.identification.window_objective import ReducedResiduals
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.registry import load_robot

pytestmark = pytest.mark.slow

NOISE, FRICTION = 0.3, 1.0
"""Noise of the measured angles, and largest offset from its target at which dry friction holds a joint (deg)."""
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
def recorded(arm: RobotDescription, tmp_path_factory: pytest.TempPathFactory) -> list[MeasuredMotion]:
    return motions(arm, tmp_path_factory.mktemp("recorded"), FRICTION)


@pytest.fixture(scope="module")
def fit(arm: RobotDescription, recorded: list[MeasuredMotion]) -> RobotFit:
    return fit_robot(declared_parameters(arm, arm.load_model()), recorded, recorded, CONFIG)


def test_dry_friction_that_is_not_declared_is_suggested_with_its_size(
    arm: RobotDescription, recorded: list[MeasuredMotion], fit: RobotFit
):
    found = suggest_parameters(arm, fit, recorded, CONFIG)
    assert {each.parameter.name for each in found} == {"shoulder_frictionloss", "elbow_frictionloss"}
    strength = {"shoulder_frictionloss": 6.0, "elbow_frictionloss": 4.0}
    for each in found:
        # The estimate is of first order about zero friction, where other parameters explain part of the friction.
        assert each.value == pytest.approx(strength[each.parameter.name] * np.deg2rad(FRICTION), rel=0.4)
        assert f'"{each.parameter.name.split("_")[0]}", "field": "frictionloss"' in suggestions_table(found)
    assert 0.2 < sum(each.explained for each in found) < 1
    # Suggested entries can be copied to the description.
    named = dataclasses.replace(arm, identify=tuple(each.entry for each in found))
    assert [p.nominal for p in declared_parameters(named, arm.load_model()).parameters] == [0.0, 0.0]


def test_a_complete_model_gets_no_suggestion(arm: RobotDescription, tmp_path: Path, fit: RobotFit):
    true = np.array([TRUTH[name] for name in fit.parameters.names])
    right = dataclasses.replace(fit, values=true, scatter=np.ones(2))
    assert suggest_parameters(arm, right, motions(arm, tmp_path, 0.0), CONFIG) == ()


def test_held_out_windows_do_not_influence_suggestions(
    arm: RobotDescription, recorded: list[MeasuredMotion], fit: RobotFit
):
    fitted = np.arange(len(fit.windows.first)) % 4 != 3
    windows = fit.windows._replace(motion=fit.windows.motion[fitted], first=fit.windows.first[fitted])
    fit = dataclasses.replace(fit, windows=windows)
    other = []
    for number, motion in enumerate(recorded):
        used = np.zeros(len(motion.qpos), bool)
        for first in windows.first[windows.motion == number]:
            used[first : first + windows.samples] = True
        assert not used.all()
        other.append(dataclasses.replace(motion, qpos=np.where(used[:, None], motion.qpos, 1.0)))
    one, two = (
        [(each.parameter.name, each.value) for each in suggest_parameters(arm, fit, motions, CONFIG)]
        for motions in (recorded, other)
    )
    assert one and one == two


@pytest.mark.parametrize("truth", [-0.05, 0.05])
def test_offsets_of_both_signs_are_suggested_and_negative_friction_is_not(truth: float):
    rng = np.random.default_rng(0)
    windows, rows = 12, 30
    slopes = rng.normal(size=(windows, rows, 3))
    values = -truth * slopes[..., 1] + 0.05 * slopes[..., 2] + 0.001 * rng.normal(size=(windows, rows))
    reduced = ReducedResiduals(values, slopes, np.zeros((windows, 0)), np.zeros((windows, 0, 3)))
    declared, offset, friction = (
        Parameter(name, "1", nominal, bounds, np.inf, False, ())
        for name, nominal, bounds in (
            ("mass", 1.0, (0.1, 9.0)),
            ("offset", 0.0, (-0.25, 0.25)),
            ("friction", 0.0, (0, 1)),
        )
    )
    ((place, value, _),) = _select(reduced, ParameterSet([declared], 0), [offset, friction])
    assert place == 0 and value == pytest.approx(truth, rel=0.1)


def test_one_window_supports_no_suggestion(arm: RobotDescription, recorded: list[MeasuredMotion], fit: RobotFit):
    windows = fit.windows._replace(motion=fit.windows.motion[:1], first=fit.windows.first[:1])
    assert suggest_parameters(arm, dataclasses.replace(fit, windows=windows), recorded, CONFIG) == ()


def test_candidates_are_parameters_of_named_model_elements():
    robot = load_robot("ballu")
    model = robot.load_model()
    entries = candidate_entries(robot, model)
    assert {"joint": "knee_left", "field": "frictionloss"} in entries
    assert {"command": robot.commands[0], "field": "delay"} in entries
    assert not any(entry.get("joint") == model.joint(0).name for entry in entries), "the free joint has no friction"
