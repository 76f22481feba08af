"""The improved simulator's step, against the same operations written out one by one."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jaxtyping import Array, Float
from plain_push import PlainPush
from robot_files import write_robot

from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.observation import HISTORY, ObservationLayout
from ballu_mjx.sim.residual import Action, BoundResidual, Fields, Residual
from ballu_mjx.sim.simulator import AugmentedSimulator, RolloutState, Simulator
from ballu_mjx.sim.step import PhysicsState, state_at

ROBOT = load_robot()
SIMULATOR = Simulator(ROBOT)
LAYOUT = ObservationLayout.of(ROBOT)
BODY = SIMULATOR.mj_model.body("balloon").id


class Springs(Residual):
    """A residual that uses all effects: it adds mass, delays commands by a step, and pulls to an earlier position."""

    @property
    def name(self) -> str:
        return "springs"

    def inputs(self, history: Array, commands: Array) -> Array:
        return jnp.concatenate([history.ravel(), commands.ravel()])

    def fields(self, params: Array) -> Fields:
        mass = jnp.asarray(SIMULATOR.mj_model.body_mass)
        return {"body_mass": mass.at[BODY].add(0.05 * params)}

    def command(self, params: Array, commands: Array) -> Array:
        return commands[-2:-1]

    def act(self, params: Array, history: Array, commands: Array, key: Array | None = None) -> Action:
        pull = params * (history[0, LAYOUT.position] - history[-1, LAYOUT.position]) + 0.01 * commands.sum()
        return Action(jnp.concatenate([pull, jnp.zeros(3)])[None])


@pytest.fixture(scope="module")
def start() -> RolloutState:
    model = SIMULATOR.mj_model
    qpos = jnp.asarray(ROBOT.adapter.initial_qpos(ROBOT, model), jnp.float32)
    physics = state_at(qpos, jnp.zeros(model.nv))
    features, _ = jax.jit(SIMULATOR.observe)(physics)
    history = jnp.stack([features.at[0].add(-0.01 * age) for age in (2, 1, 0)])
    return RolloutState(physics, history, jnp.array([[0.2, 0.9], [0.6, 0.1]]))


COMMAND = jnp.array([0.3, 0.8])
PARAMS = jnp.float32(1.5)


@jax.jit
def written_out(start: RolloutState, scale: Float[Array, ""]) -> tuple[PhysicsState, Array, Array, Array]:
    kind, commands = Springs(), jnp.concatenate([start.commands, COMMAND[None]])
    mass = jnp.asarray(SIMULATOR.mj_model.body_mass, jnp.float32)
    altered = SIMULATOR.with_fields({"body_mass": (1 - scale) * mass + scale * kind.fields(PARAMS)["body_mass"]})
    wrench = scale * kind.act(PARAMS, start.history, commands).wrench
    command = (1 - scale) * COMMAND + scale * kind.command(PARAMS, commands)
    physics = altered.step(start.physics, command, wrench)
    features, com = altered.observe(physics)
    return physics, features, com, wrench


@jax.jit
def stepped(start: RolloutState, scale: Float[Array, ""]) -> Any:
    return SIMULATOR.with_residual(BoundResidual(Springs(), PARAMS), scale).step(start, COMMAND)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 0.4, 0.0])
def test_a_step_applies_the_residual_simulates_and_updates_the_history(start: RolloutState, scale: float):
    physics, features, com, wrench = written_out(start, jnp.float32(scale))
    after = stepped(start, jnp.float32(scale))
    # Two programs round differently. Accelerations, the warm start, differ by up to 0.01 m/s^2.
    for found, expected, tolerance in zip(after.state.physics, physics, (1e-5, 1e-5, 1e-2), strict=True):
        np.testing.assert_allclose(found, expected, atol=tolerance)
    np.testing.assert_allclose(after.state.history[:-1], start.history[1:])
    np.testing.assert_allclose(after.state.features, features, atol=1e-5)
    np.testing.assert_allclose(after.com, com, atol=1e-6)
    np.testing.assert_allclose(after.action.wrench, wrench, atol=1e-6)
    np.testing.assert_array_equal(after.state.commands, jnp.stack([start.commands[1], COMMAND]))
    if scale == 1.0:
        whole = jax.jit(lambda state: SIMULATOR.with_residual(BoundResidual(Springs(), PARAMS)).step(state, COMMAND))
        np.testing.assert_allclose(whole(start).state.physics.qvel, physics.qvel, atol=1e-4)  # another compiled program
        plain = jax.jit(lambda state: SIMULATOR.with_residual(None).step(state, COMMAND))
        assert np.abs(plain(start).state.physics.qvel - physics.qvel).max() > 1e-3


@pytest.mark.slow
def test_wrenches_of_residuals_and_actions_add_up(start: RolloutState):
    """The wrench is the sum of two residuals, which are scaled, and of another wrench on the base."""

    def both(simulator: Simulator | AugmentedSimulator) -> AugmentedSimulator:
        return simulator.with_residual(BoundResidual(Springs(), PARAMS)).with_residual(BoundResidual(PlainPush(), 0.02))

    more = jnp.zeros((2, 6)).at[1, 2].set(0.1)
    half = dataclasses.replace(both(SIMULATOR), scale=0.5)
    after = jax.jit(lambda state: half.step(state, COMMAND, Action(more)))(start)
    own = Springs().act(PARAMS, start.history, start.with_command(COMMAND)).wrench
    expected = more.at[0].add(0.5 * (own[0] + 0.02 * jnp.eye(1, 6)[0]))
    np.testing.assert_allclose(after.action.wrench, expected, atol=1e-6)
    altered = both(SIMULATOR)
    np.testing.assert_allclose(
        altered.simulator.model.body_mass[BODY], SIMULATOR.mj_model.body_mass[BODY] + 0.05 * PARAMS, rtol=1e-6
    )
    assert altered.residual is not None and altered.residual.model.name == "springs+push"
    with pytest.raises(ValueError, match="Both residuals change body_mass"):
        altered.with_residual(BoundResidual(Springs(), PARAMS))


def test_a_state_that_is_not_finite_is_replaced_by_the_earlier_state(start: RolloutState):
    broken = start._replace(physics=start.physics._replace(qvel=start.physics.qvel.at[0].set(jnp.nan)))
    instead = start.features + 1.0
    kept, finite = broken.keep_finite(start, instead)
    assert not finite
    np.testing.assert_array_equal(kept.physics.qvel, start.physics.qvel)
    np.testing.assert_array_equal(kept.features, instead)
    same, finite = start.keep_finite(broken, instead)
    assert finite
    np.testing.assert_array_equal(same.features, start.features)


def test_layout_names_the_features():
    model = SIMULATOR.mj_model
    rng = np.random.default_rng(0)
    qpos = ROBOT.adapter.initial_qpos(ROBOT, model)
    qvel = rng.normal(0, 0.3, model.nv)
    features, _ = SIMULATOR.observe_all(jnp.asarray(qpos[None], jnp.float32), jnp.asarray(qvel[None], jnp.float32))
    assert features.shape[-1] == LAYOUT.size and HISTORY == 3

    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    for site, place, speed in (
        (ROBOT.tracked, LAYOUT.position, LAYOUT.velocity),
        *((point, LAYOUT.point_position(point), LAYOUT.point_velocity(point)) for point in ROBOT.points),
    ):
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, model.site(site).id, velocity, 0)
        np.testing.assert_allclose(features[0, place], data.site(site).xpos, atol=1e-5)
        np.testing.assert_allclose(features[0, speed], velocity[3:], atol=1e-4)


FIVE_BAR = """
<mujoco><compiler angle="radian"/><option timestep="0.01"/><worldbody>
  <geom type="plane" size="2 2 0.1"/>
  <body name="ramp" pos="3 0 0"><geom type="box" size="1 1 0.2"/></body>
  <body name="pedestal" pos="0 0 1"><geom type="box" size="0.1 0.1 0.1" mass="5"/>
    <body name="left"><joint name="left" axis="0 1 0"/><geom type="sphere" size="0.01" pos="0 0 -0.1" mass="0.2"/>
      <body name="rod" pos="0 0 -0.3"><joint name="rod" axis="0 1 0"/>
        <geom type="sphere" size="0.01" pos="0.1 0 0" mass="0.1"/><site name="hand" pos="0.2 0 -0.1"/></body></body>
  </body>
  <body name="right" pos="0.4 0 1"><joint name="right" axis="0 1 0"/>
    <geom type="sphere" size="0.01" pos="0 0 -0.2" mass="0.3"/><site name="elbow" pos="0.05 0 -0.3"/></body>
  <body name="ball" pos="-2 0 1"><joint name="ball" type="slide" axis="1 0 0"/><geom size="0.1" mass="40"/></body>
</worldbody>
<equality><connect body1="rod" body2="right" anchor="0.4 0 0"/></equality>
<actuator><motor name="m" joint="left" ctrlrange="0 1"/></actuator></mujoco>
"""
"""A robot of two kinematic trees that a closed loop connects, beside a ramp and a heavy ball."""


def test_robots_of_several_trees_are_observed_without_the_scene(tmp_path: Path):
    robot = write_robot(tmp_path, "five-bar", FIVE_BAR, tracked="hand", points=["elbow"], commands={"m": "m"})
    simulator, model = Simulator(robot), robot.load_model()
    qpos, qvel = np.array([0.3, -0.2, 0.1, 0.5]), np.array([1.0, -2.0, 3.0, -4.0])
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    features, com = jax.jit(simulator.observe)(state_at(jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)))

    layout = ObservationLayout.of(robot)
    for site, place in (("hand", layout.velocity), ("elbow", layout.point_velocity("elbow"))):
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jacobian, None, model.site(site).id)
        np.testing.assert_allclose(features[place], jacobian @ qvel, atol=1e-5)
    bodies = [model.body(name).id for name in ("left", "rod", "right")]
    np.testing.assert_allclose(com, np.average(data.xipos[bodies], axis=0, weights=model.body_mass[bodies]), atol=1e-6)


def test_without_its_residual_a_simulator_keeps_its_other_changes() -> None:
    """Training runs on the changed simulator, so that validation must, too."""
    damping = jnp.asarray(SIMULATOR.mj_model.dof_damping, jnp.float32)
    changed = SIMULATOR.with_fields({"dof_damping": 2 * damping})
    residual = BoundResidual(Springs(), jnp.asarray(1.0))
    improved = changed.with_residual(residual)
    further = improved.with_residual(BoundResidual(PlainPush(), 0.02)).with_fields({"dof_damping": 3 * damping})
    for simulator, times in ((improved, 2), (further, 3)):
        for each in (simulator.simulator, simulator.without_residual()):
            np.testing.assert_array_equal(each.model.dof_damping, times * damping)
        plain = simulator.without_residual()
        np.testing.assert_array_equal(plain.model.body_mass, SIMULATOR.model.body_mass)
    with pytest.raises(ValueError, match="with a scale takes no further one"):
        changed.with_residual(residual, 0.5).with_residual(residual)


@pytest.mark.parametrize(("commands", "force"), [(1, None), (3, None), (2, 1)])
def test_arguments_of_a_wrong_size_are_refused(start: RolloutState, commands: int, force: int | None):
    """JAX would apply a single number to all actuators or joints."""
    joint_force = None if force is None else jnp.zeros(force)
    with pytest.raises(ValueError, match="entries along its last axis"):
        SIMULATOR.step(start.physics, jnp.zeros(commands), jnp.zeros((1, 6)), joint_force)
