"""Fluid forces: symmetry, files, and known drag and lift found again in flights that C MuJoCo made."""

from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from robot_files import write_robot

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.residuals.fluid import (
    AXES,
    FluidCoefficients,
    FluidForces,
    mirrored,
    read_fluid,
    terms_of,
)
from ballu_mjx.residuals.fluid_fit import FluidConfig, FluidFit, check_fluid_config, fit_fluid_forces
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.observation import HISTORY
from ballu_mjx.sim.simulator import Simulator

GLIDER = """
<mujoco><option timestep="0.01"/><worldbody><body name="hull" pos="0 0 1" gravcomp="1"><freejoint/>
<inertial pos="0 0 0" mass="0.2" diaginertia="0.01 0.012 0.015"/><geom size="0.1" contype="0" conaffinity="0"/>
<site name="hull"/><site name="left" pos="0 0.2 0"/><site name="right" pos="0 -0.2 0"/></body></worldbody>
<actuator><general name="left" site="left" gear="1 0 0 0 0 0" ctrlrange="0 1" gainprm="0.1"/>
<general name="right" site="right" gear="1 0 0 0 0 0" ctrlrange="0 1" gainprm="0.1"/></actuator></mujoco>
"""
LINEAR = np.array([0.08, 0.25, 0.3])
TURNING = np.array([0.02, 0.03, 0.012])
LIFT = 0.15
"""N s^2/m^2, of the product of forward and downward velocity."""


@pytest.fixture(scope="module")
def glider(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    folder = tmp_path_factory.mktemp("glider")
    commands = {"left": "left", "right": "right"}
    return write_robot(folder, "glider", GLIDER, tracked="hull", commands=commands, mirror={"left": "right"})


def flights(robot: RobotDescription, seed: int, count: int) -> list[Motion]:
    """Fly in C MuJoCo, with air that acts in every physics step."""
    model, rng = robot.load_model(), np.random.default_rng(seed)
    data, substeps, found = mujoco.MjData(model), 5, []
    for number in range(count):
        mujoco.mj_resetData(model, data)
        data.qvel[:] = rng.normal(size=6) * [0.3, 0.1, 0.1, 0.2, 0.2, 0.3]
        sent = np.repeat(rng.uniform(0, 1, (8, 2)), 10, axis=0)
        states = []
        for command in sent:
            states.append((data.qpos.copy(), data.qvel.copy()))
            for _ in range(substeps):
                frame = data.body("hull").xmat.reshape(3, 3)
                velocity = frame.T @ data.qvel[:3]
                force = -LINEAR * velocity - np.array([0, 0, LIFT * velocity[0] * velocity[2]])
                data.xfrc_applied[1] = np.concatenate([frame @ force, frame @ (-TURNING * data.qvel[3:])])
                data.ctrl[:] = command
                mujoco.mj_step(model, data)
        states.append((data.qpos.copy(), data.qvel.copy()))
        qpos, qvel = map(np.array, zip(*states, strict=True))
        found.append(Motion(f"flight-{number}", np.arange(len(qpos)) * 0.05, sent, qpos, qvel, {}))
    return found


@pytest.fixture(scope="module")
def fit(glider: RobotDescription) -> FluidFit:
    config = FluidConfig(terms="quadratic", window_seconds=(0.5, 1.5), steps=5)
    return fit_fluid_forces(Simulator(glider), flights(glider, 0, 16), flights(glider, 1, 2), config)


def test_known_air_is_found_in_flights_of_another_simulator(fit: FluidFit):
    found = fit.coefficients
    names = [term.name for term in terms_of(found.term_set)]
    for axis, names_of, wanted in (
        ("force", ("vx", "vy", "vz"), -LINEAR),
        ("torque", ("wx", "wy", "wz"), -TURNING),
    ):
        own = np.array([found.values[names.index(n), AXES.index(f"{axis}_{n[1]}")] for n in names_of])
        assert np.all(np.abs(own - wanted) < 0.25 * np.abs(wanted)), (own, wanted)
    lift = found.values[names.index("vx*vz"), AXES.index("force_z")]
    assert abs(lift + LIFT) < 0.25 * LIFT


def test_held_out_flights_are_predicted(fit: FluidFit):
    assert fit.symmetric
    assert fit.scores["quadratic"] < 0.15 * fit.scores["none"]


def test_the_mirror_image_of_a_motion_gets_the_mirror_image_of_the_wrench(glider: RobotDescription):
    forces = FluidForces(glider, glider.load_model(), "cubic")
    rng = np.random.default_rng(2)
    params = jnp.asarray(rng.normal(size=(len(forces.terms), 6)) * mirrored(forces.terms), jnp.float32)
    history = np.cumsum(rng.normal(size=(HISTORY, glider.features)) * 0.05, axis=0)
    flip = np.array([1, -1, 1, 1, -1, 1, -1, 1, -1])
    commands = jnp.zeros((HISTORY, 2))
    one, other = (np.asarray(forces.act(params, jnp.asarray(x), commands).wrench)[0] for x in (history, history * flip))
    assert np.abs(one).max() > 0.01
    np.testing.assert_allclose(other, one * np.array([1, -1, 1, -1, 1, -1]), rtol=2e-3, atol=2e-4)


def test_the_wrench_turns_with_the_body_s_heading(glider: RobotDescription):
    forces = FluidForces(glider, glider.load_model(), "cubic")
    rng = np.random.default_rng(3)
    params = jnp.asarray(rng.normal(size=(len(forces.terms), 6)), jnp.float32)
    history = np.cumsum(rng.normal(size=(HISTORY, 9)) * 0.05, axis=0)
    turned, angle = history.copy(), 0.7
    c, s = np.cos(angle), np.sin(angle)
    frame = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    turned[:, :3], turned[:, 3:6] = history[:, :3] @ frame.T, history[:, 3:6] @ frame.T
    turned[:, 8] += angle
    commands = jnp.zeros((HISTORY, 2))
    one, other = (np.asarray(forces.act(params, jnp.asarray(x), commands).wrench)[0] for x in (history, turned))
    np.testing.assert_allclose(other.reshape(2, 3), one.reshape(2, 3) @ frame.T, rtol=2e-3, atol=2e-4)


def test_a_file_gives_back_what_was_written_and_damaged_ones_are_refused(fit: FluidFit, tmp_path: Path):
    path = tmp_path / "fluid.json"
    path.write_text(fit.coefficients.to_json())
    found = read_fluid(path)
    assert isinstance(found, FluidCoefficients)
    np.testing.assert_array_equal(found.values, fit.coefficients.values)
    whole = json.loads(path.read_text())
    for damage, word in (
        ({"format": "other/1"}, "format"),
        ({"terms": "every"}, "format"),
        ({"coefficients": {"force_w": {}}}, "coefficients"),
        ({"coefficients": {"force_x": {"ux": {"value": 1, "standard_error": 0}}}}, "ux"),
        ({"coefficients": {"force_x": {"vx": {"value": "1", "standard_error": 0}}}}, "vx"),
    ):
        path.write_text(json.dumps(whole | damage))
        with pytest.raises(InputError, match=word):
            read_fluid(path)


@pytest.mark.parametrize(
    ("change", "option"),
    [({"window_seconds": ()}, "window-seconds"), ({"window_seconds": (0.01,)}, "window"), ({"steps": 0}, "steps")],
)
def test_options_out_of_range_are_named(change: dict, option: str):
    with pytest.raises(InputError, match=option):
        check_fluid_config(FluidConfig(**change), 0.05)
