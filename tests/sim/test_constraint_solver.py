"""The constraint solver: closed forms, C MuJoCo's minimum, and derivatives against finite differences."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, load_model, standing_qpos
from ballu_mjx.sim.constraint_solver import _solve
from ballu_mjx.sim.step import PhysicsState, control_step, count_substeps, load_state, make_data, put_model, state_at

SLIDER = """
<mujoco>
  <option timestep="0.001" iterations="4" ls_iterations="{searches}" solver="{solver}">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body gravcomp="1"><joint name="x" type="slide" axis="1 0 0" frictionloss="2" damping="0"/>
    <geom type="sphere" size="0.1" mass="3"/></body>
  </worldbody>
  <actuator><motor joint="x"/></actuator>
</mujoco>
"""
"""A mass of 3 kg with dry friction of 2 N."""


@pytest.mark.parametrize("searches", [1, 5, 50])
@pytest.mark.parametrize("solver", ["Newton", "CG"])
def test_a_mass_with_dry_friction_slips_and_sticks(searches: int, solver: str) -> None:
    model = mujoco.MjModel.from_xml_string(SLIDER.format(searches=searches, solver=solver))
    system, template = put_model(model), make_data(model)

    def acceleration(force: jax.Array) -> jax.Array:
        data = mjx.fwd_position(system, template.replace(ctrl=force[None], qvel=jnp.zeros(1)))
        for stage in (mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
            data = stage(system, data)
        return _solve(system, data).qacc[0]

    forces = np.array([-9.0, -2.5, -1.0, 0.0, 0.5, 1.9, 2.4, 3.0, 50.0])
    found = jax.jit(jax.vmap(acceleration))(jnp.asarray(forces, jnp.float32))
    slipping = np.sign(forces) * np.maximum(np.abs(forces) - 2.0, 0.0) / 3.0
    np.testing.assert_allclose(found[np.abs(forces) > 2.2], slipping[np.abs(forces) > 2.2], rtol=1e-5)
    # MuJoCo's friction is soft: a sticking mass creeps by a share of the acceleration that it would have without.
    sticking = np.abs(forces) < 2.0
    assert np.all(np.abs(found[sticking]) <= 0.11 * np.abs(forces[sticking]) / 3.0 + 1e-6)


class Walk(NamedTuple):
    """States of BALLU with dry friction, stepping under random commands."""

    states: PhysicsState
    commands: jax.Array


def with_dry_friction(iterations: int) -> mujoco.MjModel:
    model = load_model()
    model.dof_frictionloss[6:] = 0.003
    model.opt.iterations = iterations
    return model


@functools.cache
def walk() -> Walk:
    """Return states of C MuJoCo, 60 for each of 8 sequences."""
    model, rng = with_dry_friction(100), np.random.default_rng(0)
    rows = []
    for _ in range(8):
        data = mujoco.MjData(model)
        data.qpos[:] = standing_qpos(model)
        for number in range(120):
            if number % 8 == 0:
                data.ctrl[:] = rng.integers(0, 2, 2)
            mujoco.mj_step(model, data)
            if number % 2:
                rows.append((data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy(), data.ctrl.copy()))
    qpos, qvel, warmstart, commands = (np.array(column) for column in zip(*rows, strict=True))
    return Walk(PhysicsState(*(jnp.asarray(x, jnp.float32) for x in (qpos, qvel, warmstart))), jnp.asarray(commands))


@pytest.mark.slow
@pytest.mark.optimized
def test_a_stepping_robot_with_dry_friction_accelerates_as_in_c_mujoco() -> None:
    model = with_dry_friction(6)
    system, template = put_model(model), make_data(model)

    def acceleration(state: PhysicsState, command: jax.Array) -> jax.Array:
        data = mjx.fwd_position(system, load_state(template.replace(ctrl=command), state))
        for stage in (mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
            data = stage(system, data)
        return _solve(system, data).qacc

    states, commands = walk()
    found = np.asarray(jax.jit(jax.vmap(acceleration))(states, commands))
    tight = with_dry_friction(200)
    tight.opt.tolerance, tight.opt.ls_iterations, tight.opt.ls_tolerance = 1e-14, 50, 1e-8
    data, expected = mujoco.MjData(tight), []
    for qpos, qvel, warmstart, command in zip(*map(np.asarray, states), np.asarray(commands), strict=True):
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = qpos, qvel, warmstart, command
        mujoco.mj_forward(tight, data)
        expected.append(data.qacc.copy())
    errors = np.linalg.norm(found - expected, axis=1)
    assert np.linalg.norm(expected, axis=1).mean() > 50.0, "the robot should move"
    assert np.median(errors) < 0.02 and np.max(errors) < 1.0  # m/s^2; a solver that jams is 10 off


@pytest.mark.slow
@pytest.mark.optimized
@pytest.mark.parametrize("iterations", [3, 6])  # derivative of the iterations, and of the minimum
def test_derivatives_of_control_steps_agree_with_finite_differences(iterations: int) -> None:
    model = with_dry_friction(iterations)
    body, count = model.body("balloon").id, count_substeps(model, CONTROL_TIMESTEP)
    with jax.enable_x64(True):
        system, template = put_model(model), make_data(model)

        def after(force: jax.Array, state: PhysicsState, command: jax.Array) -> jax.Array:
            wrench = jnp.concatenate([force, jnp.zeros(3)])[None]
            return control_step(system, template, state, command, wrench, bodies=(body,), count=count).qvel

        kept = slice(0, None, 8)
        states = jax.tree.map(lambda x: jnp.asarray(x[kept], jnp.float64), walk().states)
        states = state_at(states.qpos, states.qvel)
        commands = jnp.asarray(walk().commands[kept], jnp.float64)
        force, change = jnp.array([0.1, -0.05, 0.02]), 1e-6
        jacobian = np.asarray(jax.jit(jax.vmap(jax.jacfwd(after), in_axes=(None, 0, 0)))(force, states, commands))
        moved = jax.jit(jax.vmap(jax.vmap(after, in_axes=(None, 0, 0)), in_axes=(0, None, None)))
        steps = change * np.stack([np.eye(3), -np.eye(3)])
        above, below = (np.asarray(moved(force + step, states, commands)) for step in steps)
    expected = np.moveaxis(above - below, 0, -1) / (2 * change)
    errors = np.linalg.norm(jacobian - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    assert np.median(errors) < 1e-5
    assert np.quantile(errors, 0.9) < 1e-3, "contacts that open or close within the change differ"


PENDULUM = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0" iterations="{iterations}" ls_iterations="20" solver="{solver}">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body><joint name="first" axis="0 1 0" limited="true" range="-90 0"/><geom type="sphere" size="0.1" mass="1"/>
      <body pos="0 0 -0.5"><joint name="second" axis="0 1 0"/><geom type="sphere" size="0.05" mass="0.5"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.2"/></body></body>
  </worldbody>
  <actuator><motor joint="first"/><motor joint="second"/></actuator>
</mujoco>
"""
"""A double pendulum whose first joint rests in its limit."""


@pytest.mark.slow
@pytest.mark.parametrize(("solver", "iterations"), [("Newton", 3), ("CG", 3), ("CG", 100)])
def test_derivatives_in_a_joint_limit_agree_with_finite_differences(solver: str, iterations: int) -> None:
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(solver=solver, iterations=iterations))
    with jax.enable_x64(True):
        system, template = put_model(model), make_data(model)
        state = state_at(jnp.array([0.001, 0.3]), jnp.array([0.1, -0.4]))

        def after(torque: jax.Array) -> jax.Array:
            return control_step(system, template, state, torque, jnp.zeros((1, 6)), bodies=(1,), count=1).qvel

        torque, change = jnp.array([0.2, -0.1]), 1e-5
        found = np.asarray(jax.jit(jax.jacfwd(after))(torque))
        steps = change * np.stack([np.eye(2), -np.eye(2)])
        above, below = np.asarray(jax.jit(jax.vmap(jax.vmap(after)))(torque + steps))
    expected = (above - below).T / (2 * change)
    assert np.abs(expected[0]).max() < 0.1 * np.abs(expected[1]).max(), "the first joint is not in its limit"
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=1e-4)
