"""Fluid forces: symmetry, files, and recovery of known drag and lift from flights simulated in C MuJoCo."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from plain_push import PlainPush
from robot_files import write_robot
from scipy import optimize

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.window_errors import pseudo_huber
from ballu_mjx.residuals.deploy.export import export_simulator, rollout_positions
from ballu_mjx.residuals.fluid import (
    AXES,
    FluidEstimate,
    FluidParameters,
    FluidResidual,
    TermSet,
    read_fluid,
    symmetric_mask,
    terms_of,
)
from ballu_mjx.residuals.fluid_fit import (
    FluidConfig,
    FluidFit,
    check_fluid_config,
    fit_fluid_forces,
    robust_least_squares,
)
from ballu_mjx.residuals.fluid_parametrization import PASSIVE_SETS, PassiveCoefficients
from ballu_mjx.residuals.fluid_training import fit_fluid
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.residuals.training_range import TrainingRange
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.observation import HISTORY
from ballu_mjx.sim.residual import BoundResidual
from ballu_mjx.sim.simulator import Simulator

GLIDER = """
<mujoco><option timestep="0.01"/><worldbody><body name="hull" pos="0 0 1" gravcomp="1"><freejoint/>
<inertial pos="0 0 0" mass="0.2" diaginertia="0.01 0.012 0.015"/><geom size="0.1" contype="0" conaffinity="0"/>
<site name="hull"/><site name="left" pos="0 0.2 0"/><site name="right" pos="0 -0.2 0"/></body></worldbody>
<actuator><general name="left" site="left" gear="1 0 0 0 0 0" ctrlrange="0 1" gainprm="0.1"/>
<general name="right" site="right" gear="1 0 0 0 0 0" ctrlrange="0 1" gainprm="0.1"/></actuator></mujoco>
"""
LINEAR = np.array([0.08, 0.25, 0.3])
"""Linear drag (N s/m, body frame)."""
TURNING = np.array([0.02, 0.03, 0.012])
"""Rotary drag (N m s, body frame)."""
ADDED = 0.16, np.array([0.003, 0.004, 0.01])
"""Mass (kg) and moments of inertia (kg m^2) of the air that the glider drags along."""
LIFT = 0.15
"""Lift coefficient (N s^2/m^2): upward force per product of forward and downward velocity."""
NO_TRIM = np.zeros(6)


@pytest.fixture(scope="module")
def glider(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    folder = tmp_path_factory.mktemp("glider")
    commands = {"left": "left", "right": "right"}
    return write_robot(folder, "glider", GLIDER, tracked="hull", commands=commands, mirror={"left": "right"})


def flights(robot: RobotDescription, seed: int, count: int, trim: np.ndarray = NO_TRIM) -> list[Motion]:
    """Simulate flights in C MuJoCo, with added mass, and with drag, lift and a constant wrench in every physics step.

    The wrench `trim` (N, N m) is in the body frame.
    """
    model, rng = robot.load_model(), np.random.default_rng(seed)
    model.body_mass[1] += ADDED[0]
    model.body_inertia[1] += ADDED[1]
    mujoco.mj_setConst(model, mujoco.MjData(model))
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
                forward, _, up = velocity
                # The lift is perpendicular to the velocity.
                force = -LINEAR * velocity + LIFT * up * np.array([up, 0, -forward]) + trim[:3]
                torque = -TURNING * data.qvel[3:] + trim[3:]
                data.xfrc_applied[1] = np.concatenate([frame @ force, frame @ torque])
                data.ctrl[:] = command
                mujoco.mj_step(model, data)
        states.append((data.qpos.copy(), data.qvel.copy()))
        qpos, qvel = map(np.array, zip(*states, strict=True))
        found.append(Motion(f"flight-{number}", np.arange(len(qpos)) * 0.05, sent, qpos, qvel, {}))
    return found


@pytest.fixture(scope="module")
def fit(glider: RobotDescription) -> FluidFit:
    config = FluidConfig(terms="quadratic", window_seconds=(0.5, 1.5), windows=60, steps=6)
    return fit_fluid_forces(Simulator(glider), flights(glider, 0, 16), flights(glider, 1, 2), config)


@pytest.mark.slow
@pytest.mark.optimized
def test_fit_recovers_known_drag_and_lift_from_another_simulator(fit: FluidFit):
    found = fit.estimate
    names = [term.name for term in terms_of(found.term_set)]
    for axis, names_of, wanted in (
        ("force", ("vx", "vy", "vz"), -LINEAR),
        ("torque", ("wx", "wy", "wz"), -TURNING),
    ):
        own = np.array([found.values.coefficients[names.index(n), AXES.index(f"{axis}_{n[1]}")] for n in names_of])
        assert np.all(np.abs(own - wanted) < 0.25 * np.abs(wanted)), (own, wanted)
    for term, axis, wanted in (("vx*vz", "force_z", -LIFT), ("vz*vz", "force_x", LIFT)):
        assert abs(found.values.coefficients[names.index(term), AXES.index(axis)] - wanted) < 0.25 * LIFT, term


@pytest.mark.slow
def test_fit_recovers_the_added_mass(fit: FluidFit):
    """The thrusters turn the glider about the vertical alone. Damping hides the other moments of inertia."""
    found, errors = fit.estimate.values, fit.estimate.standard_errors
    assert found.added_mass == pytest.approx(ADDED[0], rel=0.15)
    assert found.added_inertia[2] == pytest.approx(ADDED[1][2], rel=0.25)
    assert errors.added_mass < 0.2 * ADDED[0]


@pytest.mark.slow
def test_a_trim_is_found_from_one_flight(glider: RobotDescription):
    """The earlier forces are the true ones. Now the robot is heavier, and one thruster is weaker."""
    names = [term.name for term in terms_of("quadratic")]
    table = np.zeros((len(names), 6))
    for axes, factors, values in ((slice(0, 3), "vx vy vz", LINEAR), (slice(3, 6), "wx wy wz", TURNING)):
        table[[names.index(factor) for factor in factors.split()], axes] = -np.diag(values)
    table[names.index("vx*vz"), 2], table[names.index("vz*vz"), 0] = -LIFT, LIFT
    values = FluidParameters(table, np.asarray(ADDED[0]), ADDED[1])
    known = FluidEstimate("quadratic", values, jax.tree.map(np.zeros_like, values))
    trim = np.array([-0.004, 0.0, -0.015, 0.0, 0.0, 0.0008])
    simulator, now, later = Simulator(glider), flights(glider, 2, 1, trim), flights(glider, 3, 2, trim)
    found = fit_fluid_forces(simulator, now, later, FluidConfig(window_seconds=(1.0,), steps=6), fixed_from=known)
    vertical = found.estimate.values.coefficients[names.index("gz")]
    np.testing.assert_allclose(-vertical, trim, atol=0.15 * np.abs(trim).max(), rtol=0.15)
    assert -vertical[5] == pytest.approx(trim[5], rel=0.15)
    others = np.delete(found.estimate.values.coefficients, names.index("gz"), axis=0)
    np.testing.assert_array_equal(others, np.delete(table, names.index("gz"), axis=0))
    assert found.estimate.values.added_mass == ADDED[0] and found.estimate.added_mass
    assert found.scores["with the trim"] < 0.2 * found.scores["earlier"]
    with pytest.raises(InputError, match="--terms cubic differs from quadratic"):
        fit_fluid_forces(simulator, now, later, FluidConfig("cubic", passive=False), fixed_from=known)


def test_a_trim_needs_fluid_forces_with_the_same_actuators(glider: RobotDescription):
    simulator = Simulator(glider)
    other = TrainedResidual(PlainPush(), jnp.zeros(3), TrainingRange.unbounded(), 0, None)
    with pytest.raises(InputError, match="is of the kind push, not fluid"):
        fit_fluid(simulator, [], [], fixed_from=other)


@pytest.mark.slow
def test_added_mass_has_no_weight(glider: RobotDescription):
    """A body of twice the mass under the same thrust has half the acceleration, and does not sink."""
    simulator = Simulator(glider)
    forces = FluidResidual(glider, simulator.mj_model, "linear", added_mass=True)
    still = np.zeros((len(forces.terms), 6), np.float32)
    speeds = []
    for mass in (0.0, 0.2):
        params = FluidParameters(still, jnp.float32(mass), jnp.zeros(3))
        improved = simulator.with_residual(BoundResidual(forces, params))
        qpos, qvel = jnp.asarray(simulator.mj_model.qpos0, jnp.float32), jnp.zeros(6)
        path = np.asarray(jax.jit(partial(rollout_positions, improved))(qpos, qvel, jnp.ones((10, 2))))
        np.testing.assert_allclose(path[:, 2], path[0, 2], atol=1e-6)
        speeds.append(path[-1, 0] - path[-2, 0])
    assert speeds[1] == pytest.approx(speeds[0] / 2, rel=1e-3)


def test_the_solver_sees_the_robust_loss_and_its_gradient():
    rng = np.random.default_rng(0)
    base, slope, bend = (rng.normal(size=(7, 5, *more)) for more in ((), (3,), (3,)))
    norms = np.array([0.0, 1e-9, 0.1, 1.0, 5.0, 20.0, 100.0])[:, None]  # from 0 to far above the threshold

    def errors(x: np.ndarray) -> np.ndarray:
        return norms * (base + slope @ x + bend @ x**2)

    def solve(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        evaluate = robust_least_squares(errors, lambda x: norms[..., None] * (slope + 2 * bend * x))
        (values,), (jacobian,) = evaluate(x[None])
        return values, jacobian

    for point in (np.zeros(3), np.array([0.3, -0.2, 0.5])):
        values, jacobian = solve(point)
        loss = np.sum(pseudo_huber(np.sum(errors(point) ** 2, axis=1))) + point @ point
        assert np.sum(values**2) == pytest.approx(loss)
        sides = [[0.5 * np.sum(solve(x)[0] ** 2) for x in (point - h, point + h)] for h in 1e-6 * np.eye(3)]
        numeric = [(after - before) / 2e-6 for before, after in sides]
        np.testing.assert_allclose(jacobian.T @ values, numeric, rtol=1e-4)


def test_every_point_that_the_solver_may_accept_has_a_jacobian():
    """The solver rejects a decrease that is far smaller than it predicted. It may accept a still smaller one later."""
    evaluate = robust_least_squares(lambda x: x[:, None], lambda x: np.ones((1, 1, 1)))

    def has_jacobian(x: float) -> bool:
        return bool(np.any(evaluate(np.array([[x]]))[1]))

    assert [has_jacobian(x) for x in (2.0, 2.1, 1.995, 1.999, 1.0, 1.5, 0.9)] == [
        *(True, False, True, True),
        *(True, False, True),
    ]


def power(coefficients: np.ndarray, centre: np.ndarray, seed: int) -> np.ndarray:
    """Return the power of the wrench on a body in random motions, divided by the cube of the norm of the motion. The
    wrench acts at the centre of mass `centre`. Terms of gravity are left out."""
    terms, rng = terms_of("cubic"), np.random.default_rng(seed)
    found = []
    for motion in rng.normal(size=(500, 6)) * rng.choice([0.1, 1.0, 10.0], (500, 1)):
        size = np.linalg.norm(motion[:3])
        seen = dict(zip(["vx", "vy", "vz", "wx", "wy", "wz"], motion, strict=True))
        values = [np.prod([seen.get(factor, 0.0) for factor in term.factors]) * size**term.power for term in terms]
        wrench = np.array(values) @ coefficients
        velocity = motion[:3] + np.cross(motion[3:], centre)
        found.append((wrench[:3] @ velocity + wrench[3:] @ motion[3:]) / np.linalg.norm(motion) ** 3)
    return np.array(found)


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("name", PASSIVE_SETS)
def test_passive_coefficients_never_add_energy(name: TermSet, symmetric: bool):
    rng, terms = np.random.default_rng(5), terms_of("cubic")
    prior, centre = rng.uniform(0.1, 3.0, (len(terms), 6)), np.array([-0.04, 0.0 if symmetric else 0.02, 0.01])
    passive = PassiveCoefficients(name, prior, centre, symmetric=symmetric)
    vector = rng.normal(size=len(passive.start))
    table = passive.table(vector)
    assert power(table, centre, 6).max() < 1e-9
    assert power(table, centre + 5.0, 6).max() > 1e-3, "about another point the power should be positive"
    assert not symmetric or np.all(table[~symmetric_mask(terms)] == 0)
    step = 1e-6 * np.eye(len(vector))
    differences = [(passive.table(vector + each) - passive.table(vector - each)) / 2e-6 for each in step]
    np.testing.assert_allclose(passive.directions(vector), differences, atol=1e-7)


def test_any_dissipative_linear_wrench_has_passive_coefficients():
    """The parametrization covers every damping matrix that dissipates energy."""
    rng = np.random.default_rng(7)
    root, skew = rng.normal(size=(2, 6, 6))
    wanted = -(root @ root.T + skew - skew.T)
    passive = PassiveCoefficients("linear", np.ones((len(terms_of("cubic")), 6)), np.zeros(3), symmetric=False)
    found = optimize.least_squares(lambda vector: (passive.table(vector)[3:9].T - wanted).ravel(), passive.start)
    assert np.abs(found.fun).max() < 1e-6


@pytest.mark.slow
def test_a_glider_far_outside_the_recordings_slows_down(glider: RobotDescription, fit: FluidFit):
    """It tumbles and is ten times as fast as any recorded flight."""
    simulator = Simulator(glider)
    forces = fit.estimate.residual(glider, simulator.mj_model)
    improved = simulator.with_residual(BoundResidual(forces, fit.estimate.params))
    qpos, qvel = jnp.asarray(simulator.mj_model.qpos0, jnp.float32), jnp.array([3.0, -2.0, 2.0, 3.0, -3.0, 3.0])
    path = np.asarray(jax.jit(partial(rollout_positions, improved))(qpos, qvel, jnp.zeros((100, 2))))
    speed = np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1) / glider.control_timestep
    assert speed.max() < 1.2 * np.linalg.norm(qvel[:3]) and speed[-1] < 0.2 * speed[0]


@pytest.mark.slow
def test_exported_simulator_has_the_added_mass(glider: RobotDescription, fit: FluidFit, tmp_path: Path):
    simulator = Simulator(glider)
    improved = simulator.with_residual(
        BoundResidual(fit.estimate.residual(glider, simulator.mj_model), fit.estimate.params)
    )
    found = export_simulator(improved, tmp_path / "exported", check_seconds=1.0)
    mass = mujoco.MjModel.from_xml_path(str(found.folder / "identified.xml")).body_mass[1]
    assert mass == pytest.approx(0.2 + fit.estimate.values.added_mass, rel=1e-4)
    assert found.deviation is not None and found.deviation[0] < 1e-6


@pytest.mark.slow
def test_held_out_flights_are_predicted(fit: FluidFit):
    assert fit.symmetric
    assert fit.scores["quadratic"] < 0.15 * fit.scores["none"]


def test_mirrored_motion_gives_the_mirrored_wrench(glider: RobotDescription):
    forces = FluidResidual(glider, glider.load_model(), "cubic")
    rng = np.random.default_rng(2)
    table = jnp.asarray(rng.normal(size=(len(forces.terms), 6)) * symmetric_mask(forces.terms), jnp.float32)
    params = FluidParameters.without_added_mass(table)
    history = np.cumsum(rng.normal(size=(HISTORY, glider.features)) * 0.05, axis=0)
    flip = np.array([1, -1, 1, 1, -1, 1, -1, 1, -1])
    commands = jnp.zeros((HISTORY, 2))
    one, other = (np.asarray(forces.act(params, jnp.asarray(x), commands).wrench)[0] for x in (history, history * flip))
    assert np.abs(one).max() > 0.01
    np.testing.assert_allclose(other, one * np.array([1, -1, 1, -1, 1, -1]), rtol=2e-3, atol=2e-4)


def test_wrench_turns_with_the_heading_of_the_body(glider: RobotDescription):
    forces = FluidResidual(glider, glider.load_model(), "cubic")
    rng = np.random.default_rng(3)
    params = FluidParameters.without_added_mass(jnp.asarray(rng.normal(size=(len(forces.terms), 6)), jnp.float32))
    history = np.cumsum(rng.normal(size=(HISTORY, 9)) * 0.05, axis=0)
    turned, angle = history.copy(), 0.7
    c, s = np.cos(angle), np.sin(angle)
    frame = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    turned[:, :3], turned[:, 3:6] = history[:, :3] @ frame.T, history[:, 3:6] @ frame.T
    turned[:, 8] += angle
    commands = jnp.zeros((HISTORY, 2))
    one, other = (np.asarray(forces.act(params, jnp.asarray(x), commands).wrench)[0] for x in (history, turned))
    np.testing.assert_allclose(other.reshape(2, 3), one.reshape(2, 3) @ frame.T, rtol=2e-3, atol=2e-4)


@pytest.mark.slow
def test_files_are_read_back_and_damaged_files_are_refused(fit: FluidFit, tmp_path: Path):
    path = tmp_path / "fluid.json"
    path.write_text(fit.estimate.to_json())
    found = read_fluid(path)
    assert isinstance(found, FluidEstimate) and found.added_mass
    jax.tree.map(np.testing.assert_array_equal, found.values, fit.estimate.values)
    jax.tree.map(np.testing.assert_array_equal, found.standard_errors, fit.estimate.standard_errors)
    whole = json.loads(path.read_text())
    path.write_text(json.dumps({k: v for k, v in whole.items() if k != "added"} | {"format": "ballu-fluid/1"}))
    assert not read_fluid(path).added_mass
    for damage, word in (
        ({"format": "other/1"}, "format"),
        ({"terms": "every"}, "format"),
        ({"coefficients": {"force_w": {}}}, "coefficients"),
        ({"coefficients": {"force_x": {"ux": {"value": 1, "standard_error": 0}}}}, "ux"),
        ({"coefficients": {"force_x": {"vx": {"value": "1", "standard_error": 0}}}}, "vx"),
        ({"added": {"weight": {"value": 1, "standard_error": 0}}}, "weight"),
        ({"added": {"mass": {"value": -1, "standard_error": 0}}}, "below 0"),
    ):
        path.write_text(json.dumps(whole | damage))
        with pytest.raises(InputError, match=word):
            read_fluid(path)


@pytest.mark.parametrize(
    ("change", "option"),
    [
        ({"window_seconds": ()}, "window-seconds"),
        ({"window_seconds": (0.01,)}, "window"),
        ({"steps": 0}, "steps"),
        ({"terms": "cubic"}, "no-passive"),
    ],
)
def test_error_names_an_option_out_of_range(change: dict, option: str):
    with pytest.raises(InputError, match=option):
        check_fluid_config(FluidConfig(**change), 0.05)
