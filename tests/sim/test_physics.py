"""BALLU's physics: MJX against C MuJoCo, symmetry, cables, servos, weight, and effects of the actuator parameters."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jaxtyping import Array, Float
from mujoco import mjx
from mujoco.mjx._src.solver import Context

from ballu_mjx.ballu.actuators import CABLE_SLACK, ActuatorParameters, actuator_fields, cable_length
from ballu_mjx.ballu.model import CONTROL_TIMESTEP, KNEES, MOTORS, SIDES, buoyancy_ratio, load_model, standing_qpos
from ballu_mjx.robots.model import set_fields, with_fields
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.constraint_solver import _newton_step, _solve
from ballu_mjx.sim.step import (
    control_step,
    count_substeps,
    load_state,
    make_data,
    physics_step,
    put_model,
    state_at,
)

CABLES = [f"cable_{side}" for side in SIDES]
FIELDS = [f.name for f in dataclasses.fields(ActuatorParameters) if f.default is dataclasses.MISSING]


def tight_model() -> mujoco.MjModel:
    """Return the robot's model with a contact solver that runs to convergence."""
    model = load_model()
    model.opt.iterations, model.opt.tolerance = 100, 1e-14
    model.opt.ls_iterations, model.opt.ls_tolerance = 50, 1e-6
    return model


def advance(model: mujoco.MjModel, data: mujoco.MjData, command: np.ndarray, seconds: float) -> None:
    data.ctrl[:] = command
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)


def weightless() -> mujoco.MjModel:
    """Return a model for tests of the actuators alone: without gravity and contacts, with a strongly damped base."""
    model = load_model()
    model.opt.gravity[:] = 0
    model.dof_damping[:6] = 5
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT  # compiles faster
    return model


def afloat(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    data.qpos[2] += 1
    return data


# ---- MJX against C MuJoCo ----


@dataclasses.dataclass(frozen=True)
class Samples:
    """States along walks with random forces, commands and forces of the next step, and the regimes of each state."""

    qpos: np.ndarray
    qvel: np.ndarray
    command: np.ndarray
    force: np.ndarray
    contact: np.ndarray
    taut: np.ndarray
    saturated: np.ndarray


@functools.cache
def samples() -> Samples:
    model = tight_model()
    balloon, rng = model.body("balloon").id, np.random.default_rng(0)
    rows = []
    for _ in range(8):
        data = mujoco.MjData(model)
        data.qpos[:] = standing_qpos(model)
        for _ in range(8):
            advance(model, data, rng.integers(0, 2, 2), rng.uniform(0.05, 0.3))
            data.xfrc_applied[balloon, :3] = rng.uniform(-0.5, 0.5, 3)
            data.ctrl[:] = rng.integers(0, 2, 2)
            mujoco.mj_forward(model, data)
            length = data.ten_length - model.tendon_lengthspring[:, 1]
            rows.append(
                (
                    data.qpos.copy(),
                    data.qvel.copy(),
                    data.ctrl.copy(),
                    data.xfrc_applied[balloon, :3].copy(),
                    data.ncon > 0,
                    length > 0,
                    np.abs(data.actuator_force) > 0.0849,
                )
            )
    return Samples(*(np.array(column) for column in zip(*rows, strict=True)))


def test_samples_include_contact_taut_cables_and_saturated_servos() -> None:
    s = samples()
    for regime in (s.contact, s.taut, s.saturated):
        assert 0.1 < regime.mean() < 0.95


def test_mjx_agrees_with_c_mujoco_over_a_control_step() -> None:
    """MJX computes a step in float32, and C MuJoCo in double precision. A wrench acts on the balloon, and forces act at
    base and feet."""
    s, model = samples(), load_model()
    count, balloon = count_substeps(model, CONTROL_TIMESTEP), model.body("balloon").id
    points = tuple(model.site(name).id for name in load_robot().points)
    bodies = (balloon, *model.site_bodyid[list(points)].tolist())
    mjx_model, template = put_model(model), make_data(model)

    @jax.jit
    @jax.vmap
    def step(qpos: Array, qvel: Array, command: Array, wrench: Array) -> tuple[Array, Array]:
        state = state_at(qpos, qvel)
        state = control_step(mjx_model, template, state, command, wrench, bodies=bodies, points=points, count=count)
        return state.qpos, state.qvel

    wrench = np.zeros((len(s.force), len(bodies), 6))
    wrench[:, 0] = np.concatenate([s.force, 0.1 * s.force[:, ::-1]], axis=1)
    wrench[:, 1:, :3] = np.random.default_rng(1).uniform(-0.05, 0.05, (len(s.force), len(points), 3))
    inputs = [jnp.asarray(x, jnp.float32) for x in (s.qpos, s.qvel, s.command, wrench)]
    qpos, qvel = (np.asarray(x) for x in step(*inputs))
    expected_qpos, expected_qvel = [], []
    for i in range(len(s.qpos)):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = s.qpos[i], s.qvel[i]
        data.ctrl[:], data.xfrc_applied[balloon] = s.command[i], wrench[i, 0]
        for _ in range(count):
            mujoco.mj_step1(model, data)
            data.qfrc_applied[:] = 0
            for point, body, push in zip(points, bodies[1:], wrench[i, 1:, :3], strict=True):
                mujoco.mj_applyFT(model, data, push, np.zeros(3), data.site_xpos[point], body, data.qfrc_applied)
            mujoco.mj_step2(model, data)
        expected_qpos.append(data.qpos.copy())
        expected_qvel.append(data.qvel.copy())
    position = np.abs(qpos - expected_qpos).max(axis=1)
    speed = np.abs(qvel - expected_qvel).max(axis=1)
    assert position.max() < 5e-5
    assert speed.max() < 5e-3


@pytest.mark.parametrize("limit", [0.1, 100.0])
def test_velocity_feedback_acts_only_below_the_force_limit(limit: float) -> None:
    """`implicitfast` treats velocity feedback implicitly, which would slow down an actuator at its limit."""
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><option timestep="0.01" integrator="implicitfast"/><worldbody><body>
          <joint name="j" axis="0 1 0" armature="0.001"/><geom size="0.02" mass="0.1" pos="0.05 0 0"/></body>
        </worldbody>
        <actuator><position joint="j" kp="5" kv="1" forcerange="{-limit} {limit}"/></actuator></mujoco>""")
    data = mujoco.MjData(model)
    data.ctrl[:], data.qvel[:] = 1.0, -0.5
    start = state_at(jnp.asarray(data.qpos, jnp.float32), jnp.asarray(data.qvel, jnp.float32))
    inputs = make_data(model).replace(ctrl=jnp.asarray(data.ctrl, jnp.float32))  # pyright: ignore
    found = jax.jit(physics_step)(put_model(model), inputs, start)
    mujoco.mj_step(model, data)
    np.testing.assert_allclose(found.qvel, data.qvel, rtol=1e-4)


# ---- symmetry ----


def mirrored_qpos(qpos: np.ndarray) -> np.ndarray:
    """Return the reflection in the plane y = 0, which exchanges left and right."""
    neck, left, right = np.split(qpos[7:], [1, 4])
    return np.concatenate([qpos[:7] * [1, -1, 1, 1, -1, 1, -1], neck, right, left])


def mirrored_qvel(qvel: np.ndarray) -> np.ndarray:
    neck, left, right = np.split(qvel[6:], [1, 4])
    return np.concatenate([qvel[:6] * [1, -1, 1, -1, 1, -1], neck, right, left])


def test_mirrored_states_and_commands_give_mirrored_motion() -> None:
    s, model = samples(), tight_model()
    worst = 0.0
    for qpos, qvel, command in zip(s.qpos[::4], s.qvel[::4], s.command[::4], strict=True):
        one, other = mujoco.MjData(model), mujoco.MjData(model)
        one.qpos[:], one.qvel[:] = qpos, qvel
        other.qpos[:], other.qvel[:] = mirrored_qpos(qpos), mirrored_qvel(qvel)
        for data, pair in ((one, command), (other, command[::-1])):
            advance(model, data, pair, 0.2)
        assert np.abs(one.qpos - qpos).max() > 1e-3
        worst = max(worst, np.abs(mirrored_qpos(one.qpos) - other.qpos).max())
    assert worst < 1e-9


# ---- cable and servo ----


def test_a_cable_pulls_when_taut_and_never_pushes() -> None:
    model = load_model()
    cut = load_model()
    cut.tendon_stiffness[:] = 0
    data, without = mujoco.MjData(model), mujoco.MjData(cut)
    seen = set()
    for knee in np.deg2rad(np.arange(28, 100, 8.0)):
        for motor in np.deg2rad(np.arange(0, 91, 10.0)):
            for m, d in ((model, data), (cut, without)):
                d.qpos[7:][KNEES], d.qpos[7:][MOTORS] = knee, motor
                mujoco.mj_forward(m, d)
            cable = data.qfrc_passive - without.qfrc_passive
            taut = data.ten_length > model.tendon_lengthspring[:, 1]
            seen |= set(taut)
            # A pull flexes the knee (positive) and turns the arm back towards 0 (negative).
            assert np.all(np.where(taut, cable[6:][KNEES] > 0, cable[6:][KNEES] == 0))
            assert np.all(cable[6:][MOTORS][~taut] == 0)
            assert np.all(cable[6:][MOTORS][taut] <= 0)
    assert seen == {True, False}


def test_a_slack_cable_transmits_no_force_at_any_velocity() -> None:
    """MuJoCo's tendon damping would transmit a force of 0.04 to 0.06 N here. A taut cable carries 0.8 N."""
    model = load_model()
    cut = load_model()
    cut.tendon_stiffness[:] = cut.tendon_damping[:] = 0
    accelerations = []
    for each in (model, cut):
        data = mujoco.MjData(each)
        data.qpos[:] = standing_qpos(each)
        data.qpos[7:][KNEES] = np.deg2rad([60.0, 75.0])
        data.qvel[6:][KNEES], data.qvel[6:][MOTORS] = [3.0, -2.0], [-2.0, 5.0]
        mujoco.mj_forward(each, data)
        assert np.all(data.ten_length < model.tendon_lengthspring[:, 1])
        assert np.all(np.abs(data.ten_velocity) > 0.04)
        accelerations.append(data.qacc.copy())
    np.testing.assert_allclose(accelerations[0], accelerations[1], atol=1e-9)


def test_cable_length_agrees_with_the_model() -> None:
    model = load_model()
    data = mujoco.MjData(model)
    knee, motor = np.array([0.6, 1.2]), np.array([0.3, 1.4])
    data.qpos[7:][KNEES], data.qpos[7:][MOTORS] = knee, motor
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(cable_length(model, jnp.asarray(knee), jnp.asarray(motor)), data.ten_length, rtol=1e-6)


def test_rest_length_of_the_cables_gives_the_stated_slack() -> None:
    model = load_model()
    nominal = ActuatorParameters.nominal(model)
    np.testing.assert_allclose(nominal.cable_slack, CABLE_SLACK, atol=1e-5)
    rest = actuator_fields(model, nominal)["tendon_lengthspring"][:, 1]
    np.testing.assert_allclose(model.tendon_lengthspring[:, 1], rest, atol=1e-7)
    looser = dataclasses.replace(nominal, cable_slack=nominal.cable_slack + jnp.array([1e-3, 0.0]))
    longer = actuator_fields(model, looser)["tendon_lengthspring"][:, 1] - rest
    np.testing.assert_allclose(longer, [1e-3, 0.0], atol=1e-7)


def test_servo_saturates_at_its_torque_limit() -> None:
    model = load_model()
    data = mujoco.MjData(model)
    data.ctrl[:] = [1.0, 0.05]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_force, [0.085, 0.5 * 0.05 * np.pi / 2], rtol=1e-5)
    data.qpos[7:][MOTORS] = 1.5
    data.ctrl[:] = 0
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_force, -0.085, rtol=1e-6)


def test_settled_knee_angle_increases_with_the_command() -> None:
    """Left and right knees agree. They move from the stop, at the command where the cable becomes taut, to 72 deg."""
    model = weightless()
    knees = []
    for command in np.linspace(0, 1, 9):
        data = afloat(model)
        advance(model, data, np.full(2, command), 4.0)
        knees.append(np.rad2deg(data.qpos[7:][KNEES]))
    knees = np.array(knees)
    np.testing.assert_allclose(knees[:, 0], knees[:, 1], atol=1e-6)
    np.testing.assert_allclose(knees[0], 27.35, atol=0.3)
    np.testing.assert_allclose(knees[-1], 72, atol=1)
    assert np.all(np.diff(knees[:, 0]) > 0)
    assert knees[3, 0] > 30  # no dead zone up to 0.35


# ---- weight ----


def test_net_force_is_buoyancy_minus_weight() -> None:
    model = load_model()
    assert model.body_mass.sum() == pytest.approx(0.28679, abs=1e-9)
    assert buoyancy_ratio(model) == pytest.approx(0.84, abs=1e-4)
    for ratio in (0.84, 0.5):
        balloon = model.body("balloon").id
        model.body_gravcomp[balloon] = ratio * model.body_mass.sum() / model.body_mass[balloon]
        data = afloat(model)
        mujoco.mj_forward(model, data)
        acceleration = sum(model.body_mass) * 9.81 * (ratio - 1)
        # Without contacts, the net force on the robot is lift minus weight.
        momentum = np.zeros((3, model.nv))
        mujoco.mj_jacSubtreeCom(model, data, momentum, 1)
        force = model.body_subtreemass[1] * momentum @ data.qacc
        np.testing.assert_allclose(force, [0, 0, acceleration], atol=1e-4)


def test_robot_stands_with_its_feet_on_the_floor() -> None:
    model = load_model()
    qpos = standing_qpos(model)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    for side in SIDES:
        assert data.geom(f"foot_{side}").xpos[2] == pytest.approx(0.004, abs=1e-6)
    advance(model, data, np.zeros(2), 3.0)
    upright = data.body("balloon").xmat[8]
    assert 0.69 < data.body("base").xpos[2] < 0.74
    assert upright > 0.99
    assert data.ncon == 2


# ---- parameters ----


@functools.cache
def settled_in_mjx() -> tuple[np.ndarray, np.ndarray]:
    """Return settled knee angles [case, knee] and their derivatives with respect to the actuator parameters.

    Angles are in rad. Derivatives have the axes [case, field, parameter's side, knee]. All `CASES` are simulated in
    one batch, each with its own parameters.
    """
    model = weightless()
    mjx_model = put_model(model)
    data = afloat(model)
    template, start = make_data(model), state_at(jnp.asarray(data.qpos), jnp.zeros(model.nv))

    def knees(parameters: ActuatorParameters, command: Float[Array, " 2"]) -> Array:
        moved = with_fields(mjx_model, actuator_fields(model, parameters))
        bodies, no_force = (model.body("balloon").id,), jnp.zeros((1, 6))
        state = control_step(moved, template, start, command, no_force, bodies=bodies, count=SETTLING_STEPS)
        return state.qpos[7:][KNEES]

    cases = [(case_parameters(case), case[0]) for case in CASES]
    rows = cases + [(p, c) for base, c in cases for f in FIELDS for i in range(2) for p in changed(base, f, i)]
    parameters = jax.tree.map(lambda *x: jnp.stack(x), *(row[0] for row in rows))
    found = np.asarray(jax.jit(jax.vmap(knees))(parameters, jnp.asarray([row[1] for row in rows])), float)
    settled, pairs = found[: len(CASES)], found[len(CASES) :].reshape(len(CASES), len(FIELDS), 2, 2, 2)
    sizes = np.array([[[change_of(p, name, side) for side in range(2)] for name in FIELDS] for p, _ in cases])
    return settled, (pairs[:, :, :, 0] - pairs[:, :, :, 1]) / (2 * sizes[..., None])


def change_of(parameters: ActuatorParameters, name: str, side: int) -> float:
    """Return the step of finite differences: 2 % of a parameter, 5 mrad for an angle of 0, and 0.05 mm for slack."""
    return 5e-5 if name == "cable_slack" else 0.02 * abs(float(getattr(parameters, name)[side])) or 5e-3


def changed(parameters: ActuatorParameters, name: str, side: int) -> list[ActuatorParameters]:
    """Return the parameters with one of them increased, and decreased, on one side."""
    value, change = getattr(parameters, name), change_of(parameters, name, side)
    return [dataclasses.replace(parameters, **{name: value.at[side].add(sign * change)}) for sign in (1, -1)]


SETTLING_STEPS = 200
CASES = (
    ((0.0, 0.0), {}),  # both at their stops
    ((0.8, 0.5), {}),  # cables taut
    (
        (0.7, 0.9),
        {"knee_spring_stiffness": (0.012, 0.02), "motor_gain": (0.05, 0.3), "default_knee_angle": (0.5, 0.44)},
    ),
    ((1.0, 1.0), {"knee_spring_stiffness": (0.08, 0.09)}),  # servos saturated by strong springs
)
"""Commands, and parameters that differ from nominal."""
SATURATED = 3


def case_parameters(case: tuple[tuple[float, float], dict[str, tuple[float, float]]]) -> ActuatorParameters:
    nominal = ActuatorParameters.nominal(load_model())
    return dataclasses.replace(nominal, **{name: jnp.asarray(pair) for name, pair in case[1].items()})


def settled_in_c(parameters: ActuatorParameters, command: tuple[float, float]) -> mujoco.MjData:
    model = weightless()
    set_fields(model, actuator_fields(model, parameters))
    data = afloat(model)
    advance(model, data, np.array(command), SETTLING_STEPS * model.opt.timestep)
    return data


@pytest.mark.slow
@pytest.mark.parametrize("case", range(len(CASES)))
def test_settled_knees_and_their_derivatives_agree_with_c_mujoco(case: int) -> None:
    values, derivatives = settled_in_mjx()
    command, parameters = CASES[case][0], case_parameters(CASES[case])
    data = settled_in_c(parameters, command)
    np.testing.assert_allclose(values[case], data.qpos[7:][KNEES], atol=2e-4)
    limit = np.asarray(parameters.torque_limit, float)
    assert np.all(np.abs(data.actuator_force) == limit) == (case == SATURATED)
    for f, name in enumerate(FIELDS):
        for side in range(2):
            delta = change_of(parameters, name, side)
            high, low = (settled_in_c(each, command).qpos for each in changed(parameters, name, side))
            # Change of the knee angle (rad) for 1 % of the parameter, 2.5 mrad of an angle of 0, or 0.025 mm of slack.
            scale = delta / 0.02 * 0.01
            np.testing.assert_allclose(
                derivatives[case, f, side] * scale,
                (high - low)[7:][KNEES] / (2 * delta) * scale,
                rtol=0.05,
                atol=1e-5,
                err_msg=name,
            )


@pytest.mark.slow
def test_each_parameter_moves_the_knee_of_its_side() -> None:
    _, derivatives = settled_in_mjx()
    at_stop, taut, saturated = derivatives[0], derivatives[1], derivatives[SATURATED]
    own, other = np.eye(2, dtype=bool), ~np.eye(2, dtype=bool)
    limit = FIELDS.index("torque_limit")
    # Servos that do not saturate at rest saturate during the motion, so the legs still swing slightly.
    assert np.all(saturated[limit][own] > 1e-2) and np.abs(taut[limit]).max() < 0.1 * saturated[limit][own].min()
    for f, name in enumerate(FIELDS):
        if f == limit:
            continue
        sign = -1 if name in ("knee_spring_stiffness", "cable_slack") else 1
        assert np.all(sign * taut[f][own] > 1e-2), name
        assert np.abs(taut[f][other]).max() < 0.1 * np.abs(taut[f][own]).min(), name
    np.testing.assert_allclose(at_stop[FIELDS.index("default_knee_angle")][own], 1, atol=0.05)
    np.testing.assert_allclose(at_stop[FIELDS.index("motor_gain")], 0, atol=1e-3)  # single precision leaves 4e-4


# ---- the solver's derivative ----


@pytest.mark.slow
def test_the_step_of_the_convergence_check_is_a_newton_step() -> None:
    """The step equals MJX's own search direction at points where the solver stopped too early."""
    s, model = samples(), load_model()
    model.opt.iterations = 1
    mjx_model, template = put_model(model), make_data(model)

    @jax.jit
    @jax.vmap
    def steps(qpos: Array, qvel: Array, command: Array) -> tuple[Array, Array]:
        held = template.replace(ctrl=command)  # pyright: ignore
        data = mjx.fwd_position(mjx_model, load_state(held, state_at(qpos, qvel)))
        for stage in (mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
            data = stage(mjx_model, data)
        found = _solve(mjx_model, data)
        here = Context.create(mjx_model, data.replace(qacc=found.qacc))  # pyright: ignore
        return _newton_step(found, mjx_model, data)[1], here.search

    found, expected = steps(*(jnp.asarray(x, jnp.float32) for x in (s.qpos, s.qvel, s.command)))
    size = np.linalg.norm(expected, axis=1)
    assert np.mean(size > 1.0) > 0.2, "the solver has converged everywhere"
    np.testing.assert_allclose(np.linalg.norm(found - expected, axis=1), 0.0, atol=1e-2 * size.max())
    far = size > 1.0
    np.testing.assert_allclose(np.linalg.norm(found, axis=1)[far] / size[far], 1.0, atol=1e-2)
