"""Aerodynamics of the balloon: equations, frames, and recovery of known parameters from recordings."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, load_model, standing_qpos
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.residuals.aerodynamics import (
    AERODYNAMICS_FILE,
    AERODYNAMICS_FORMAT,
    AIR_PARAMETERS,
    LEAST_FRICTION,
    Aerodynamics,
    AirParameters,
    air_parameters_to_json,
    longest_delay,
    read_air_parameters,
)
from ballu_mjx.residuals.aerodynamics_fit import (
    AirConfig,
    AirFit,
    Optimum,
    air_scales,
    along_friction,
    at_whole_delay,
    identify_air,
)
from ballu_mjx.robots.model import set_fields
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.observation import HISTORY, euler_to_matrix, heading_rotation
from ballu_mjx.sim.simulator import Simulator

pytestmark = [pytest.mark.optimized, pytest.mark.slow]

SIMULATOR = Simulator(load_robot())
MODEL = SIMULATOR.mj_model
AIR = AirParameters(
    added_mass=jnp.array(0.12),
    added_inertia=jnp.array(3e-3),
    lift=jnp.array(-0.12),
    centre=jnp.array([0.004, 0.013, 0.0]),
    linear_drag=jnp.array([0.04, 0.03, 0.05]),
    quadratic_drag=jnp.array([0.25, 0.15, 0.2]),
    turning_drag=jnp.array([2e-3, 3e-3, 4e-3]),
    delay=jnp.array(0.05),
    friction=jnp.array(0.0),
)
SLIPPERY = dataclasses.replace(AIR, friction=jnp.array(-0.3))
"""The same air with lower friction, which is one of the values that the search tries."""
CONFIG = AirConfig(window_seconds=0.5, interval_seconds=0.5)
"""In windows this short, contacts hardly amplify errors."""
COMMANDS = jnp.zeros((HISTORY, 2))


def windy_model(friction: float = 0.0) -> mujoco.MjModel:
    """Return C MuJoCo's model of the robot with the mass, inertia, centre and lift of `AIR`, from their definitions.

    `friction` is the share by which contacts have more friction than in the robot's model.
    """
    model = load_model()
    body = model.body("balloon").id
    lift = model.body_gravcomp[body] * model.body_mass[body] * 9.81 - 0.12 + 0.12 * 9.81
    model.body_mass[body] += 0.12
    model.body_inertia[body] += 3e-3
    model.body_ipos[body] += [0.004, 0.013, 0.0]
    model.geom_friction[:, 0] *= 1 + friction
    model.body_gravcomp[body] = lift / (model.body_mass[body] * 9.81)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def blown(name: str, period: float, phase: float, steps: int = 160, friction: float = 0.0) -> Motion:
    """Simulate the nominal robot in `AIR` in C MuJoCo. Drag uses MuJoCo's velocities in every physics step."""
    model = windy_model(friction)
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    body, site = model.body("balloon").id, model.site("balloon").id
    mujoco.mj_step(model, data, 100)
    time = np.arange(steps) * CONTROL_TIMESTEP
    phases = time[:, None] / period + np.array([0.0, phase])
    command = np.where(phases % 1.0 < 0.45, 0.9, 0.0)
    states = [(data.qpos.copy(), data.qvel.copy())]
    for row in np.concatenate([command[:1], command[:-1]]):  # commands arrive one control step late
        data.ctrl[:] = row
        for _ in range(round(CONTROL_TIMESTEP / model.opt.timestep)):
            mujoco.mj_forward(model, data)
            velocity = np.zeros(6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 1)
            turning, linear = velocity[:3], velocity[3:]
            frame = data.site_xmat[site].reshape(3, 3)
            force = -(np.array([0.04, 0.03, 0.05]) + np.array([0.25, 0.15, 0.2]) * np.linalg.norm(linear)) * linear
            data.xfrc_applied[body, :3] = frame @ force
            data.xfrc_applied[body, 3:] = frame @ (-np.array([2e-3, 3e-3, 4e-3]) * turning)
            mujoco.mj_step(model, data)
        states.append((data.qpos.copy(), data.qvel.copy()))
    qpos, qvel = (np.array(x) for x in zip(*states, strict=True))
    times = np.arange(steps + 1) * CONTROL_TIMESTEP
    return Motion(name=name, time=times, command=command, qpos=qpos, qvel=qvel, fit_error_mm={})


def history(euler: np.ndarray, velocity: np.ndarray, turning: np.ndarray) -> jnp.ndarray:
    """Return features of a balloon that moves and turns.

    - `euler`: roll, pitch and yaw (rad).
    - `velocity`: linear velocity (m/s, world frame).
    - `turning`: angular velocity (rad/s, body frame).
    """
    now = euler_to_matrix(jnp.asarray(euler))
    hat = np.array([[0, -turning[2], turning[1]], [turning[2], 0, -turning[0]], [-turning[1], turning[0], 0]])

    def angles(age: int) -> jnp.ndarray:
        matrix = now @ jax.scipy.linalg.expm(jnp.asarray(-age * CONTROL_TIMESTEP * hat))
        roll, yaw = jnp.arctan2(matrix[2, 1], matrix[2, 2]), jnp.arctan2(matrix[1, 0], matrix[0, 0])
        return jnp.array([roll, jnp.arcsin(-matrix[2, 0]), yaw])

    seen = jnp.zeros((HISTORY, 27)).at[:, 3:6].set(jnp.asarray(velocity))
    return seen.at[:, 6:9].set(jnp.stack([angles(age) for age in (2, 1, 0)]))


def test_parameters_without_air_leave_the_nominal_model():
    air, none = Aerodynamics(load_robot(), MODEL), AirParameters.none()
    for name, value in air.fields(none).items():
        np.testing.assert_allclose(value, getattr(MODEL, name), rtol=1e-6, atol=1e-8)
    seen = history(np.array([0.1, 0.2, 0.3]), np.array([0.3, -0.2, 0.1]), np.array([0.1, 0.2, 0.3]))
    assert not np.any(air.act(none, seen, COMMANDS).wrench)


def test_added_mass_has_no_weight_and_lift_is_a_vertical_force():
    model = load_model()
    set_fields(model, Aerodynamics(load_robot(), MODEL).fields(SLIPPERY))
    for name in ("body_mass", "body_inertia", "body_ipos", "body_gravcomp", "geom_friction"):
        np.testing.assert_allclose(getattr(model, name), getattr(windy_model(-0.3), name), rtol=1e-5, atol=1e-7)

    def net_vertical_force(model: mujoco.MjModel) -> float:
        """Return the net vertical force (N) of weight and lift on the whole robot, above the floor and at rest."""
        data = mujoco.MjData(model)
        data.qpos[2] += 5.0
        mujoco.mj_forward(model, data)
        return float(data.qfrc_passive[2] - data.qfrc_bias[2])

    assert net_vertical_force(model) - net_vertical_force(MODEL) == pytest.approx(-0.12, rel=1e-3)


def test_command_delay_is_resolved_in_physics_steps():
    air, sent = Aerodynamics(load_robot(), MODEL), jnp.array([[0.0, 0.2], [1.0, 0.4], [0.0, 1.0]])
    for delay, ages in ((0.0, [0] * 5), (0.05, [1] * 5), (0.02, [1, 1, 0, 0, 0]), (0.08, [2, 2, 2, 1, 1])):
        late = dataclasses.replace(AIR, delay=jnp.array(delay))
        np.testing.assert_array_equal(air.command(late, sent), sent[2 - np.array(ages)])


def test_rounding_a_delay_adjusts_correlated_parameters():
    """The cost is quadratic, so its optimum is known."""
    step, truth = 0.01, np.array([0.062, 0.12])
    covariance = np.array([[4e-5, -9e-5], [-9e-5, 2.5e-4]])  # of (delay, mass)
    precision = np.linalg.inv(covariance)

    def fitted(vector: np.ndarray) -> Optimum:
        mass = truth[1] - precision[0, 1] / precision[1, 1] * (vector[0] - truth[0])
        off = np.array([vector[0], mass]) - truth
        return Optimum(off + truth, np.zeros((2, 2)), float(off @ precision @ off) / 2)

    found = at_whole_delay(Optimum(truth, covariance, 0.0), np.array([True, False]), step, fitted)
    assert found.vector == pytest.approx(fitted(np.array([0.06, 0.0])).vector)
    rounding = np.array([1.0, covariance[0, 1] / covariance[0, 0]]) ** 2 * step**2 / 12
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(covariance) + rounding, rtol=1e-6)


@pytest.mark.parametrize("best", [-0.66, -0.37, 0.0, 0.24, 0.47])
def test_friction_is_found_beyond_a_flat_part_of_the_cost(best: float):
    """The cost is flat but for small waves, until the friction is near the best one. The other parameter follows."""
    number = 0

    def fitted(vector: np.ndarray) -> Optimum:
        nonlocal number
        number += 1
        cost = min(abs(vector[0] - best), 0.12) + 0.001 * np.cos(2 * np.pi * vector[0] / 0.03)
        return Optimum(np.array([vector[0], 3 * vector[0]]), np.zeros((2, 2)), float(cost))

    found = along_friction(fitted(np.zeros(2)), np.array([True, False]), 9, fitted)
    assert found.vector[0] == pytest.approx(best, abs=0.051)
    assert found.vector[1] == 3 * found.vector[0]
    assert number <= 10


def test_friction_never_vanishes():
    found = along_friction(
        Optimum(np.full(1, -0.5), np.zeros((1, 1)), 0.0),
        np.array([True]),
        20,
        lambda vector: Optimum(vector, np.zeros((1, 1)), float(vector[0])),
    )
    assert LEAST_FRICTION <= found.vector[0] < -0.7


def test_drag_opposes_the_motion_for_any_heading():
    air = Aerodynamics(load_robot(), MODEL)
    velocity, turning = np.array([0.4, -0.3, 0.2]), np.array([0.3, -0.5, 0.7])
    level = np.asarray(air.act(AIR, history(np.zeros(3), velocity, turning), COMMANDS).wrench)[0]
    speed = np.linalg.norm(velocity)
    expected = -(np.array(AIR.linear_drag) + np.array(AIR.quadratic_drag) * speed) * velocity
    np.testing.assert_allclose(level[:3], expected, rtol=1e-4)
    np.testing.assert_allclose(level[3:], -np.array(AIR.turning_drag) * turning, rtol=2e-2)

    yaw = 2.0
    turned = np.asarray(heading_rotation(jnp.array(yaw)))
    seen = history(np.array([0.0, 0.0, yaw]), turned @ velocity, turning)
    wrench = np.asarray(air.act(AIR, seen, COMMANDS).wrench)[0]
    np.testing.assert_allclose(wrench[:3], turned @ level[:3], rtol=1e-4)
    np.testing.assert_allclose(wrench[3:], turned @ level[3:], rtol=2e-2, atol=1e-6)


GAITS = {"one": (1.2, 0.5), "two": (1.7, 0.35), "three": (0.9, 0.6)}


@pytest.fixture(scope="module")
def motions() -> list[Motion]:
    return [blown(name, *gait) for name, gait in GAITS.items()]


@pytest.fixture(scope="module")
def slippery_motions() -> list[Motion]:
    return [blown(name, *gait, friction=-0.3) for name, gait in GAITS.items()]


@pytest.fixture(scope="module")
def found(motions: list[Motion]) -> AirFit:
    return identify_air(SIMULATOR, motions, CONFIG, free=AIR_PARAMETERS)


def test_fit_recovers_known_air_from_another_simulator(found: AirFit):
    """Errors of sign and frame in any parameter would be detected."""
    got, errors = found.parameters, found.standard_errors
    assert float(got.delay) == pytest.approx(0.05, abs=1e-6)
    assert float(got.added_mass) == pytest.approx(0.12, rel=0.05)
    assert float(got.added_inertia) == pytest.approx(3e-3, rel=0.1)
    assert float(got.lift) == pytest.approx(-0.12, abs=0.004)
    np.testing.assert_allclose(got.centre[:2], [0.004, 0.013], atol=7e-4)
    speed = 0.3  # the sum of linear and quadratic drag at walking speed is identified better than each of them
    drag, true = (np.array(p.linear_drag + p.quadratic_drag * speed) for p in (got, AIR))
    # Only the forward axis, because the robot hardly moves along the others.
    assert drag[0] == pytest.approx(true[0], rel=0.15)
    assert float(got.friction) == pytest.approx(0.0, abs=0.051)  # the finest step of the search
    assert found.cost[1] < 0.02 * found.cost[0]
    assert 0 < float(errors.added_mass) < 0.3 * float(got.added_mass)


def test_fits_from_different_starting_values_agree(motions: list[Motion], found: AirFit):
    """Delay and added mass have similar effects, so a search could stop at a wrong combination."""
    began = dataclasses.replace(jax.tree.map(lambda x: x / 2, AIR), delay=jnp.array(0.1))
    again = identify_air(SIMULATOR, motions, CONFIG, fixed_from=began, free=AIR_PARAMETERS).parameters
    assert float(again.delay) == pytest.approx(float(found.parameters.delay))
    little = 0.25 * float(found.standard_errors.added_mass)
    assert float(again.added_mass) == pytest.approx(float(found.parameters.added_mass), abs=little)


def test_lift_can_be_fitted_with_all_other_parameters_fixed(motions: list[Motion]):
    """A balloon that loses gas changes one parameter. With the old lift, feet land at other times and the robot is
    elsewhere within 2 s, so derivatives there do not lead to the correct lift."""
    known = dataclasses.replace(AIR, lift=jnp.array(1e-4))
    fit = identify_air(SIMULATOR, motions, AirConfig(), fixed_from=known, free=("lift",))
    assert float(fit.parameters.lift) == pytest.approx(-0.12, abs=0.002)
    np.testing.assert_array_equal(fit.parameters.turning_drag, AIR.turning_drag)
    assert float(fit.standard_errors.turning_drag[0]) == 0.0


def test_friction_is_found_together_with_the_air(slippery_motions: list[Motion]):
    fit = identify_air(SIMULATOR, slippery_motions, CONFIG, free=AIR_PARAMETERS)
    got, errors = fit.parameters, fit.standard_errors
    assert float(got.friction) == pytest.approx(-0.3, abs=0.051)
    assert float(got.delay) == pytest.approx(0.05, abs=1e-6)
    assert float(got.added_mass) == pytest.approx(0.12, abs=float(errors.added_mass))
    assert fit.cost[1] < 0.02 * fit.cost[0]


def test_friction_of_another_floor_can_be_fitted_with_all_other_parameters_fixed(slippery_motions: list[Motion]):
    known = dataclasses.replace(AIR, friction=jnp.array(0.1))
    fit = identify_air(SIMULATOR, slippery_motions, CONFIG, fixed_from=known, free=("friction",))
    assert float(fit.parameters.friction) == pytest.approx(-0.3, abs=0.051)
    np.testing.assert_array_equal(fit.parameters.linear_drag, AIR.linear_drag)
    assert 0.02 < float(fit.standard_errors.friction) < 0.3


def test_fixed_parameters_stay_nominal(motions: list[Motion]):
    """Without other values, the nominal parameters are those without air."""
    fit = identify_air(SIMULATOR, motions, CONFIG, free=("added_mass",))
    assert float(fit.parameters.added_mass) > 0
    assert not any(np.any(getattr(fit.parameters, name)) for name in AIR_PARAMETERS if name != "added_mass")


def test_scales_grow_with_the_body_as_geometry_says():
    """A body of eight times the lift has twice the radius."""
    robot = load_robot()
    large = robot.load_model()
    small_scales = air_scales(robot, large)
    large.body_mass[:] *= 8
    large_scales = air_scales(robot, large)
    powers = {"added_mass": 3, "added_inertia": 5, "lift": 3, "centre": 1, "linear_drag": 2, "quadratic_drag": 2}
    powers |= {"turning_drag": 4, "delay": 0, "friction": 0}
    assert set(powers) == set(AIR_PARAMETERS)
    for name, power in powers.items():
        assert large_scales[name].typical == pytest.approx(2**power * small_scales[name].typical)
    model = robot.load_model()
    displaced = float((model.body_gravcomp * model.body_mass).sum())  # kg of air; only the balloon is buoyant
    assert small_scales["added_mass"].typical == pytest.approx(displaced / 2)


def test_recordings_shorter_than_a_window_are_refused(motions: list[Motion]):
    with pytest.raises(InputError, match="--window-seconds"):
        identify_air(SIMULATOR, motions[:1], AirConfig(window_seconds=30.0))


def test_parameters_are_read_back_from_their_file(tmp_path: Path):
    path = tmp_path / AERODYNAMICS_FILE
    path.write_text(json.dumps({"format": AERODYNAMICS_FORMAT, "parameters": air_parameters_to_json(SLIPPERY)}))
    read = read_air_parameters(path, load_robot())
    for name in AIR_PARAMETERS:
        np.testing.assert_allclose(getattr(read, name), getattr(SLIPPERY, name), rtol=1e-6)


def test_files_of_the_first_format_have_the_friction_of_the_model(tmp_path: Path):
    path = tmp_path / AERODYNAMICS_FILE
    parameters = air_parameters_to_json(AIR)
    del parameters["friction"]
    path.write_text(json.dumps({"format": "ballu-air/1", "parameters": parameters}))
    read = read_air_parameters(path, load_robot())
    assert float(read.friction) == 0.0
    assert float(read.delay) == pytest.approx(0.05)
    path.write_text(json.dumps({"format": AERODYNAMICS_FORMAT, "parameters": parameters}))
    with pytest.raises(InputError, match="friction must be a number"):
        read_air_parameters(path, load_robot())


@pytest.mark.parametrize("timestep", [0.05, 0.03333333333])
def test_the_longest_delay_is_read_back_despite_its_rounding(tmp_path: Path, timestep: float):
    """In single precision, two control steps of 0.0333... s are longer than in double precision."""
    robot = dataclasses.replace(load_robot(), control_timestep=timestep)
    path, air = tmp_path / AERODYNAMICS_FILE, dataclasses.replace(AIR, delay=jnp.float32(longest_delay(robot)))
    content = {"format": AERODYNAMICS_FORMAT, "parameters": air_parameters_to_json(air)}
    path.write_text(json.dumps(content))
    assert float(read_air_parameters(path, robot).delay) == pytest.approx(2 * timestep)
    content["parameters"]["delay"] = 2.001 * timestep
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="delay is .* must be .* or less"):
        read_air_parameters(path, robot)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"added_mass": -0.1}, "added_mass is -0.1; it must be 0 or more"),
        ({"centre": [0.0, 0.1]}, "centre must be three numbers"),
        ({"lift": "much"}, "lift must be a number"),
        ({"lift": float("nan")}, "lift must be a number"),
        ({"friction": -1.0}, "friction is -1.0; it must be -0.95 or more"),
        ({"viscosity": 1.0}, "no parameter 'viscosity'"),
    ],
)
def test_damaged_file_is_refused(tmp_path: Path, change: dict, message: str):
    path = tmp_path / AERODYNAMICS_FILE
    path.write_text(json.dumps({"format": AERODYNAMICS_FORMAT, "parameters": air_parameters_to_json(AIR) | change}))
    with pytest.raises(InputError, match=message) as caught:
        read_air_parameters(path, load_robot())
    assert str(path) in str(caught.value)
