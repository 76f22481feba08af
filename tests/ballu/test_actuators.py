"""Identified actuators of BALLU: their file, simulators with their values, and invalid values."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from ballu_mjx.ballu.actuators import SERVO_RANGE, ActuatorParameters
from ballu_mjx.ballu.actuators_file import actuators_to_json, read_actuators, write_actuators
from ballu_mjx.ballu.model import load_model, standing_qpos
from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.open_loop import nominal_model
from ballu_mjx.residuals.aerodynamics import AIR_PARAMETERS
from ballu_mjx.residuals.aerodynamics_training import fit_aerodynamics
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.drivetrain import drivetrain_of
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.sim.step import make_data

NOMINAL = ActuatorParameters.nominal(load_model())
DYNAMIC = {
    "knee_friction": (3e-4, 5e-4),
    "motor_friction": (2e-3, 1e-3),
    "delay": (0.03, 0.04),
    "lag": (0.02, 0.0),
    "backlash": (0.03, 0.05),
}
FOUND = dataclasses.replace(
    NOMINAL,
    motor_travel=jnp.array([0.8, 0.95]),
    cable_stiffness=jnp.array([1500.0, 2500.0]),
    knee_spring_reference=jnp.array([-0.8, -0.7]),
    **{name: jnp.array(pair) for name, pair in DYNAMIC.items()},
)


def test_nominal_actuators_give_the_nominal_model_without_a_drivetrain() -> None:
    model = load_model()
    for name, values in NOMINAL.fields(model).items():
        np.testing.assert_allclose(values, getattr(model, name), rtol=1e-5, atol=1e-7, err_msg=name)
    assert drivetrain_of(NOMINAL) is None


def test_simulators_have_the_values_of_the_actuators_file(tmp_path: Path) -> None:
    write_actuators(tmp_path / "actuators.json", "robot", FOUND, {})
    name, read = read_actuators(tmp_path / "actuators.json")
    assert name == "robot" and actuators_to_json(read) == actuators_to_json(FOUND)
    simulator = Simulator(load_robot(), read)
    model, drivetrain = simulator.mj_model, simulator.drivetrain
    assert drivetrain is not None
    assert drivetrain.delay == pytest.approx(DYNAMIC["delay"]) and drivetrain.lag == pytest.approx(DYNAMIC["lag"])
    # The backlash is that of the motor's target. In command units, it is wider if a command moves the motor less.
    assert drivetrain.backlash * SERVO_RANGE * np.array([0.8, 0.95]) == pytest.approx(np.array(DYNAMIC["backlash"]))
    for kind in ("knee", "motor"):
        dofs = [model.joint(f"{kind}_{side}").dofadr[0] for side in ("left", "right")]
        assert model.dof_frictionloss[dofs] == pytest.approx(DYNAMIC[f"{kind}_friction"])
    targets = -model.actuator_gainprm[:, 0] / model.actuator_biasprm[:, 1]
    assert targets == pytest.approx(np.array([0.8, 0.95]) * SERVO_RANGE, rel=1e-5)
    assert model.tendon_stiffness == pytest.approx([1500.0, 2500.0])


def test_solver_iterations_suffice_for_dry_friction() -> None:
    """Random commands of 2 s are simulated, and compared with a solver that has converged."""
    commands = np.random.default_rng(0).uniform(size=(8, 8, 2)).repeat(25, axis=1)

    def walk(iterations: int | None) -> np.ndarray:
        model = load_model(FOUND)
        if iterations is not None:
            model.opt.iterations, model.opt.tolerance = iterations, 0.0
        ends = []
        for run in commands:
            data = mujoco.MjData(model)
            data.qpos[:] = standing_qpos(model)
            for command in run:
                data.ctrl[:] = command
                mujoco.mj_step(model, data)
            ends.append(data.qpos[:3].copy())
        return np.array(ends)

    converged = walk(100)
    error, nominal_error = (float(np.median(np.linalg.norm(walk(n) - converged, axis=1))) for n in (None, 3))
    assert load_model().opt.iterations == 3 and error < 3e-4 < nominal_error


def test_files_of_the_first_format_get_nominal_values_for_missing_parameters(tmp_path: Path) -> None:
    pairs = actuators_to_json(FOUND)
    first = ("knee_spring_stiffness", "motor_gain", "default_motor_angle", "default_knee_angle", "torque_limit")
    content = {"format": "ballu-actuators/1", "robot": "old", "parameters": {name: pairs[name] for name in first}}
    (tmp_path / "old.json").write_text(json.dumps({**content, "drivetrain": {"delay": [0.04, 0.04]}}))
    read = read_actuators(tmp_path / "old.json")[1]
    assert drivetrain_of(read) is None and read.motor_travel is None


@pytest.mark.parametrize(
    ("name", "pair", "message"),
    [("delay", [40.0, 40.0], "in seconds"), ("backlash", [-0.1, 0.0], "0 or more"), ("motor_travel", [0, 1], "than 0")],
)
def test_impossible_values_are_refused(tmp_path: Path, name: str, pair: list[float], message: str) -> None:
    content = {"format": "ballu-actuators/2", "robot": "r", "parameters": {**actuators_to_json(FOUND), name: pair}}
    (tmp_path / "actuators.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=f"{name}.*{message}"):
        read_actuators(tmp_path / "actuators.json")


def test_nominal_model_has_the_constraint_rows_of_the_identified_model() -> None:
    """One compiled program simulates both. MJX treats a row with dry friction 0 as a joint that never slips."""
    simulator = Simulator(load_robot(), FOUND)
    nominal = nominal_model(simulator)
    assert make_data(nominal)._impl.efc_J.shape == make_data(simulator.mj_model)._impl.efc_J.shape  # pyright: ignore
    assert nominal.dof_frictionloss.max() < 1e-8 < simulator.mj_model.dof_frictionloss.max()


def test_aerodynamic_fit_refuses_to_fit_the_delay_of_identified_actuators() -> None:
    others = [name for name in AIR_PARAMETERS if name != "delay"]
    with pytest.raises(InputError, match=f"no parameter that is unknown; give one or more of {', '.join(others)}\\."):
        fit_aerodynamics(Simulator(load_robot(), FOUND), [], free=("delay",))
