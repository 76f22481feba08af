"""Parameters identified on public recordings of real robots, replayed on recordings that no fit used."""

from pathlib import Path

import numpy as np
import pytest

from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.fit_robot import replay
from ballu_mjx.identification.parameters import ParameterSet
from ballu_mjx.robots.description import read_description

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "real"
EXPERIMENTS = ROOT / "experiments" / "real"

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings of real robots in {DATA}")


def declared(name: str) -> ParameterSet:
    robot = read_description(EXPERIMENTS / name / f"{name}.robot.json")
    return declared_parameters(robot, robot.load_model())


def vector(parameters: ParameterSet, **values: float) -> np.ndarray:
    return np.array([values.get(p.name, p.nominal) for p in parameters.parameters])


def test_descriptions_of_the_real_robots_declare_their_parameters():
    assert len(declared("double_pendulum")) == 9
    assert len(declared("go1")) == 5


@needs_data
def test_motor_parameters_from_three_loads_predict_a_fourth_load(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(EXPERIMENTS / "go1")
    import go1  # pyright: ignore[reportMissingImports]

    parameters = declared("go1")
    identified = vector(parameters, motor_frictionloss=0.158, motor_damping=0.015, motor_armature=0.0074, goal_kp=9.36)
    nominal, found = replay(parameters, go1.load(DATA, 3), [parameters.nominal, identified], go1.SECONDS, 12.0)
    mean = [np.rad2deg(np.abs(errors.errors[..., 0]).mean()) for errors in (nominal, found)]
    assert mean[1] < 1.5 < mean[0]


@needs_data
def test_identified_parameters_predict_the_double_pendulum(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(EXPERIMENTS / "double_pendulum")
    import double_pendulum  # pyright: ignore[reportMissingImports]

    parameters = declared("double_pendulum")
    identified = vector(
        parameters,
        shoulder_frictionloss=0.278,
        elbow_frictionloss=0.166,
        shoulder_armature=0.0040,
        elbow_armature=0.0034,
        delay=0.0077,
    )
    motions = double_pendulum.load(DATA / "double_pendulum" / "recordings", double_pendulum.VALIDATION)
    nominal, found = replay(parameters, motions, [parameters.nominal, identified], 1.0, 0.5)
    assert (np.rad2deg(found.final_median[:2]) < [2.35, 3.45]).all()
    assert (found.final_median[:2] < 0.25 * nominal.final_median[:2]).all()
