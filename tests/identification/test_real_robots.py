"""Parameters identified on public recordings of real robots, replayed on recordings that no fit used."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from experiment_modules import EXPERIMENTS, REAL_DATA, needs_real_data

from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.fit_robot import replay
from ballu_mjx.identification.parameters import ParameterSet
from ballu_mjx.robots.description import read_description

REAL = EXPERIMENTS / "real"


def declared(name: str) -> ParameterSet:
    robot = read_description(REAL / name / f"{name}.robot.json")
    return declared_parameters(robot, robot.load_model())


def vector(parameters: ParameterSet, **values: float) -> np.ndarray:
    return np.array([values.get(p.name, p.nominal) for p in parameters.parameters])


def test_descriptions_of_the_real_robots_declare_their_parameters():
    assert len(declared("double_pendulum")) == 15
    assert len(declared("go1")) == 5
    assert len(declared("compass_gait")) == 4


def test_steps_of_a_walker_keep_its_leg_angles_and_motor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(REAL / "compass_gait")
    import compass_gait  # pyright: ignore[reportMissingImports]

    time = np.arange(200) * 0.005
    inner_leg, outer_leg, outer_stands = 0.3 * np.sin(5 * time), 0.2 * np.cos(4 * time), time < 0.5
    table = np.stack([time, np.full(200, 0.8), outer_stands, inner_leg, outer_leg - inner_leg], axis=1)
    np.savetxt(
        tmp_path / "walk-00.csv.gz",
        table,
        delimiter=",",
        header="time,command_motor,command_inner,inner,outer",
        comments="",
    )

    (first_stance, first), (second_stance, second) = compass_gait.cut_steps(
        compass_gait.read_walk(tmp_path, 0), "walk-00"
    )
    assert (first_stance, second_stance) == ("outer", "inner")
    for step, stance, swing in ((first, outer_leg, inner_leg), (second, inner_leg, outer_leg)):
        rows = np.isin(time, step.time)
        assert step.time[0] >= (0.0 if step is first else 0.5) + compass_gait.SETTLE - 1e-6
        np.testing.assert_allclose(step.joint_angles["stance"], stance[rows])
        np.testing.assert_allclose(step.joint_angles["stance"] + step.joint_angles["swing"], swing[rows])
    # The voltage acts on the outer leg relative to the inner leg, so the change of legs inverts its sign.
    np.testing.assert_allclose([first.command.mean(), second.command.mean()], [0.8, 0.2])


def test_walker_model_exchanges_its_legs_with_the_stance_leg(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(REAL / "compass_gait")
    import compass_gait  # pyright: ignore[reportMissingImports]

    inner, outer = (compass_gait.model_of(leg) for leg in ("inner", "outer"))
    hip = compass_gait.LENGTH
    for one, other in ((inner, outer), (outer, inner)):
        stance, swing = one.body("stance"), other.body("swing")
        assert hip - stance.ipos[2] == pytest.approx(-swing.ipos[2])
        np.testing.assert_allclose(stance.inertia, swing.inertia)
    assert inner.body("swing").ipos[2] != outer.body("swing").ipos[2]
    as_written = mujoco.MjModel.from_xml_path(str(REAL / "compass_gait" / "compass_gait.xml"))
    np.testing.assert_allclose(as_written.body_ipos, outer.body_ipos)
    np.testing.assert_allclose(as_written.body_inertia, outer.body_inertia)


@needs_real_data
def test_motor_parameters_from_three_loads_predict_a_fourth_load(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(REAL / "go1")
    import go1  # pyright: ignore[reportMissingImports]

    parameters = declared("go1")
    identified = vector(parameters, motor_frictionloss=0.158, motor_damping=0.015, motor_armature=0.0074, goal_kp=9.36)
    nominal, found = replay(parameters, go1.load(REAL_DATA, 3), [parameters.nominal, identified], go1.SECONDS, 12.0)
    mean = [np.rad2deg(np.abs(errors.errors[..., 0]).mean()) for errors in (nominal, found)]
    assert mean[1] < 1.5 < mean[0]


@pytest.mark.slow
@needs_real_data
def test_identified_parameters_predict_the_double_pendulum(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(REAL / "double_pendulum")
    import double_pendulum  # pyright: ignore[reportMissingImports]

    parameters = declared("double_pendulum")
    identified = vector(
        parameters,
        shoulder_frictionloss=0.26,
        elbow_frictionloss=0.18,
        elbow_armature=0.0050,
        upper_mass=0.415,
        upper_com_x=0.0034,
        upper_com_z=0.0037,
        upper_stretch_z=1.09,
        lower_com_x=0.0013,
        lower_com_z=-0.0019,
        lower_stretch_z=0.90,
        delay=0.0086,
    )
    motions = double_pendulum.load(REAL_DATA / "double_pendulum" / "recordings", double_pendulum.VALIDATION)
    nominal, found = replay(parameters, motions, [parameters.nominal, identified], 1.0, 0.5)
    assert (np.rad2deg(found.final_median[:2]) < [2.35, 3.45]).all()
    assert (found.final_median[:2] < 0.25 * nominal.final_median[:2]).all()


@needs_real_data
def test_the_walker_swings_its_leg_as_recorded(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(REAL / "compass_gait")
    import compass_gait  # pyright: ignore[reportMissingImports]

    parameters = declared("compass_gait")
    identified = vector(parameters, hip_frictionloss=0.0077, motor_strength=1.05, motor_delay=0.0078)
    motions = compass_gait.load(REAL_DATA / "compass_gait" / "recordings", compass_gait.VALIDATION[:1])
    points = [parameters.nominal, vector(parameters, **compass_gait.PUBLISHED), identified]
    found = replay(parameters, motions, points, compass_gait.HORIZONS[-1], 1.0)
    timestep = motions[0].sample_timestep
    nominal, published, own = (compass_gait.root_mean_squares(errors, timestep) for errors in found)
    assert (own[:, 1] < 0.6 * nominal[:, 1]).all()
    assert own[-1, 1] < published[-1, 1]
    assert (own[:, 0] < [0.5, 1.0, 2.0]).all()  # the stance leg hardly depends on the hip
