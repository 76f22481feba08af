"""Constants that MuJoCo derives from masses: MJX models with altered masses agree with C MuJoCo's."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.robots.model import set_fields
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.sim.step import PhysicsState

BALLOON = Path(__file__).parents[2] / "experiments" / "tethered_balloon" / "balloon.robot.json"
DERIVED = ("body_invweight0", "body_subtreemass", "dof_invweight0", "tendon_invweight0")
ADDED_MASS, ADDED_INERTIA, MOVED = 0.105, 0.0035, np.array([0.0048, 0.0143, 0.0])
"""Added mass (kg), added inertia (kg m^2) and offset (m) of the air that is identified from the bundled recordings."""


def heavier(model: mujoco.MjModel, body: int) -> dict[str, np.ndarray]:
    """Return fields with altered mass, inertia, centre and lift of a body. The added mass has no weight."""
    names = ("body_mass", "body_inertia", "body_ipos", "body_gravcomp")
    fields = {name: getattr(model, name).copy() for name in names}
    lift = fields["body_gravcomp"][body] * fields["body_mass"][body] + ADDED_MASS
    fields["body_mass"][body] += ADDED_MASS
    fields["body_inertia"][body] += ADDED_INERTIA
    fields["body_ipos"][body] += MOVED
    fields["body_gravcomp"][body] = lift / fields["body_mass"][body]
    return fields


def compiled(robot: RobotDescription, fields: dict[str, np.ndarray]) -> mujoco.MjModel:
    model = robot.load_model()
    set_fields(model, fields)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


@pytest.mark.parametrize("robot", [load_robot(), read_description(BALLOON)], ids=lambda robot: robot.name)
def test_constants_agree_with_mj_setconst(robot: RobotDescription) -> None:
    model = robot.load_model()
    altered = {name: jnp.asarray(x) for name, x in heavier(model, model.body("balloon").id).items()}
    found = Simulator(robot, model=model).with_fields(altered).model
    expected = compiled(robot, heavier(model, model.body("balloon").id))
    change = np.abs(np.asarray(found.dof_invweight0) / model.dof_invweight0 - 1).max()
    assert change > 0.1, "the altered masses hardly change the constants"
    for name in DERIVED:
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-3, atol=1e-6, err_msg=name)


def test_constants_agree_with_mj_setconst_after_a_change_of_armature() -> None:
    robot = read_description(BALLOON)
    model = robot.load_model()
    armature = model.dof_armature + 1e-3
    found = Simulator(robot).with_fields({"dof_armature": jnp.asarray(armature)}).model
    expected = compiled(robot, {"dof_armature": armature})
    for name in DERIVED:
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-3, atol=1e-6, err_msg=name)
    assert np.abs(expected.dof_invweight0 / model.dof_invweight0 - 1).max() > 0.01


def test_constants_agree_with_mj_setconst_after_a_turn_of_the_principal_axes() -> None:
    robot = read_description(BALLOON)
    model, body = robot.load_model(), robot.load_model().body("balloon").id
    inertia, axes = model.body_inertia.copy(), model.body_iquat.copy()
    inertia[body] *= [1.0, 3.0, 3.5]
    axes[body] = [np.cos(0.4), np.sin(0.4), 0.0, 0.0]
    found = Simulator(robot).with_fields({"body_inertia": jnp.asarray(inertia), "body_iquat": jnp.asarray(axes)}).model
    expected = compiled(robot, {"body_inertia": inertia, "body_iquat": axes})
    unturned = compiled(robot, {"body_inertia": inertia})
    assert np.abs(expected.dof_invweight0 / unturned.dof_invweight0 - 1).max() > 0.05
    for name in DERIVED:
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-3, atol=1e-6, err_msg=name)


def test_constants_of_unaltered_masses_are_unchanged() -> None:
    robot = load_robot()
    model = robot.load_model()
    found = Simulator(robot).with_fields({"body_mass": jnp.asarray(model.body_mass)}).model
    for name in DERIVED:
        np.testing.assert_allclose(getattr(found, name), getattr(model, name), rtol=1e-6, err_msg=name)


@pytest.mark.slow
def test_derivatives_of_constants_agree_with_mj_setconst() -> None:
    robot = load_robot()
    model = robot.load_model()
    simulator, body = Simulator(robot), model.body("balloon").id

    def weights(added: jax.Array) -> jax.Array:
        return simulator.with_fields(
            {"body_mass": jnp.asarray(model.body_mass).at[body].add(added)}
        ).model.body_invweight0

    derivative = jax.jacfwd(weights)(jnp.array(0.05))
    high, low = (compiled(robot, {"body_mass": model.body_mass + added * (np.arange(model.nbody) == body)})
                 for added in (0.051, 0.049))  # fmt: skip
    expected = (high.body_invweight0 - low.body_invweight0) / 0.002
    np.testing.assert_allclose(derivative, expected, rtol=0.01, atol=1e-3 * np.abs(expected).max())


@pytest.mark.slow
def test_a_robot_with_altered_masses_walks_as_in_c_mujoco() -> None:
    """The walk is open-loop over 5 s, in double precision. With the constants of the original masses, the end would be
    off by 7 mm."""
    robot = load_robot()
    model = robot.load_model()
    fields, qpos = heavier(model, model.body("balloon").id), robot.adapter.initial_qpos(robot, model)
    time = np.arange(100) * robot.control_timestep
    commands = 0.9 * ((time[:, None] / 1.2 + np.array([0.0, 0.5])) % 1.0 < 0.4)
    expected = compiled(robot, fields)
    data = mujoco.MjData(expected)
    data.qpos[:] = qpos
    mujoco.mj_step(expected, data, 200)
    start = data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()
    with jax.enable_x64(True):
        simulator = Simulator(robot).with_fields({name: jnp.asarray(x) for name, x in fields.items()})

        @jax.jit
        def walk(state: PhysicsState, commands: jax.Array) -> jax.Array:
            def step(state: PhysicsState, command: jax.Array) -> tuple[PhysicsState, jax.Array]:
                state = simulator.step(state, command, jnp.zeros((1, 6)))
                return state, simulator.observe(state)[0][:3]

            return jax.lax.scan(step, state, commands)[1]

        found = np.asarray(walk(PhysicsState(*map(jnp.asarray, start)), jnp.asarray(commands)))
    site = model.site(robot.tracked).id
    places = []
    for command in commands:
        data.ctrl[:] = command
        mujoco.mj_step(expected, data, round(robot.control_timestep / model.opt.timestep))
        mujoco.mj_kinematics(expected, data)
        places.append(data.site_xpos[site].copy())
    assert np.linalg.norm(places[-1] - places[0]) > 0.2, "the robot does not walk"
    assert np.linalg.norm(found - places, axis=1).max() < 1e-3
