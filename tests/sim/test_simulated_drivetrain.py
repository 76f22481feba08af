"""The identified drivetrain in the simulator, in rollouts, windows, episodes and policies."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jaxtyping import Array
from rover import write_rover
from servo_arm import TRUTH, identified, true_path, wandering, write_arm

from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.parameters import IdentifiedParameters
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.locomotion_env import LocomotionEnv, locomotion_state
from ballu_mjx.policies.tasks import TASKS
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.motion_windows import cut_motion_windows, start_motion_window
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.residuals.envmimic import EnvMimicConfig, EnvMimicEnv, tracking_state
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.sim.drivetrain import DrivetrainParameters
from ballu_mjx.sim.linearize import ControlSteps, Linearizer
from ballu_mjx.sim.observation import HISTORY
from ballu_mjx.sim.residual import BoundResidual, Residual
from ballu_mjx.sim.simulator import AugmentedSimulator, RolloutState, Simulator
from ballu_mjx.sim.step import state_at

STEPS = 30


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def simulator(robot: RobotDescription) -> Simulator:
    return Simulator(robot, identified(robot, **TRUTH))


def begin(simulator: Simulator, command: Array) -> RolloutState:
    physics = state_at(jnp.zeros(2), jnp.zeros(2))
    features, _ = simulator.observe(physics)
    history, commands = jnp.tile(features, (HISTORY, 1)), jnp.tile(command, (HISTORY - 1, 1))
    return RolloutState(physics, history, commands, simulator.drivetrain_at_rest(command))


def run(simulator: AugmentedSimulator, start: RolloutState, commands: Array) -> tuple[Array, Array]:
    def step(state: RolloutState, command: Array) -> tuple[RolloutState, tuple[Array, Array]]:
        after = simulator.step(state, command).state
        return after, (after.physics.qpos, after.physics.qvel)

    return jax.lax.scan(step, start, commands)[1]


def test_control_steps_agree_with_c_mujoco_under_filtered_commands(robot: RobotDescription, simulator: Simulator):
    commands = wandering(0, STEPS)
    qpos, qvel = true_path(robot, identified(robot, **TRUTH), commands)
    start = begin(simulator, jnp.asarray(commands[0]))
    ours = jax.jit(lambda start, commands: run(simulator.with_residual(None), start, commands))
    found = ours(start, jnp.asarray(commands))
    np.testing.assert_allclose(found[0], qpos[9::10], atol=2e-4)
    np.testing.assert_allclose(found[1], qvel[9::10], atol=5e-3)
    without = {name: TRUTH[name] for name in ("elbow_damping", "mass")}
    assert np.abs(true_path(robot, identified(robot, **without), commands)[0] - qpos).max() > 0.2


@pytest.mark.slow
def test_derivatives_by_drivetrain_parameters_agree_with_finite_differences(robot: RobotDescription):
    places = np.array([0, 4, 6, 10])  # scale, delay, backlash and lag of the shoulder
    with jax.enable_x64(True):
        simulator, commands = Simulator(robot, identified(robot, **TRUTH)), jnp.asarray(wandering(0, 8, hold=1))
        assert simulator.drivetrain is not None
        whole = jnp.array([*np.ravel(simulator.drivetrain[:4]), 1e3, 1e3, 0.01, 0.01], float)

        def angles(values: Array) -> Array:
            driven = simulator.with_drivetrain(DrivetrainParameters(*whole.at[places].set(values).reshape(6, 2)))
            return run(driven.with_residual(None), begin(driven, commands[0]), commands)[0][-1]

        both = jax.jit(lambda values: (jax.jacfwd(angles)(values), angles(values)))
        jacobian = np.asarray(both(whole[places])[0])
        for place in range(len(places)):
            step = jnp.zeros(len(places)).at[place].set(1e-6)
            change = np.asarray(both(whole[places] + step)[1] - both(whole[places] - step)[1]) / 2e-6
            np.testing.assert_allclose(jacobian[:, place], change, atol=0.01, rtol=0.02)
            assert np.abs(jacobian[:, place]).max() > 0.03


@pytest.mark.slow
def test_a_simulator_without_a_drivetrain_has_no_drivetrain_state(robot: RobotDescription):
    commands = jnp.asarray(wandering(0, STEPS), jnp.float32)
    nominal, same = Simulator(robot), Simulator(robot, identified(robot))
    assert same.drivetrain is None and begin(same, commands[0]).drivetrain is None

    def program(simulator: Simulator) -> Any:
        return jax.jit(lambda start, commands: run(simulator.with_residual(None), start, commands))

    start = begin(nominal, commands[0])
    for one, other in zip(program(nominal)(start, commands), program(same)(start, commands), strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(ValueError, match="has a drivetrain"):
        Simulator(robot, identified(robot, **TRUTH)).with_residual(None).step(start, commands[0])


class Scaled(Residual):
    """Residual that multiplies commands by a parameter and gives no forces."""

    @property
    def name(self) -> str:
        return "scaled"

    def command(self, params: Array, commands: Array) -> Array:
        return params * commands[-1:]

    def inputs(self, history: Array, commands: Array) -> Array:
        return commands.ravel()


@pytest.mark.slow
def test_a_residual_changes_commands_before_the_drivetrain(simulator: Simulator):
    commands, start = jnp.asarray(wandering(1, 6)), begin(simulator, jnp.zeros(2))
    halving = BoundResidual(Scaled(), jnp.float32(0.5))
    ours = run(simulator.with_residual(halving), start, commands)
    halved = run(simulator.with_residual(None), start, commands / 2)
    np.testing.assert_allclose(ours[0], halved[0], atol=1e-6)


@pytest.fixture(scope="module")
def motion(robot: RobotDescription) -> Motion:
    """Motion of the true arm over 4 s, from the rest pose."""
    commands = wandering(2, 80)
    qpos, qvel = true_path(robot, identified(robot, **TRUTH), commands)
    qpos, qvel = (np.concatenate([np.zeros((1, 2)), x[9::10]]) for x in (qpos, qvel))
    return Motion(name="near", time=np.arange(81) * 0.05, command=commands, qpos=qpos, qvel=qvel, fit_error_mm={})


@pytest.mark.slow
def test_replay_follows_the_recording_from_any_starting_state(simulator: Simulator, motion: Motion):
    evaluator, params = OpenLoopEvaluator(simulator, [motion], Scaled()), jnp.float32(1.0)
    (ours,), (nominal,) = evaluator.errors(evaluator.replay(params)), evaluator.nominal_errors(params)
    assert ours.position[1.0][0] < 1e-3
    assert nominal.position[1.0][0] > 10e-3


@pytest.mark.slow
def test_windows_and_episodes_start_with_the_recorded_drivetrain_state(simulator: Simulator, motion: Motion):
    def after(state: RolloutState, commands: Array) -> np.ndarray:
        return np.asarray(run(simulator.with_residual(None), state, commands)[0])

    windows = cut_motion_windows(simulator, [motion], 0.5, 0.5)
    for number in (0, 3):
        state, commands = start_motion_window(jax.tree.map(lambda x, number=number: x[number], windows))
        first = HISTORY - 1 + 10 * number
        np.testing.assert_allclose(after(state, commands), motion.qpos[first + 1 : first + 11], atol=1e-3)

    env = EnvMimicEnv(simulator, [motion], EnvMimicConfig(start_noise=0.0, observation_noise=0.0))
    env = env.with_parameters(env.parameters)
    state = jax.jit(env.reset)(jax.random.key(3))
    begun = tracking_state(state)
    reached = tracking_state(jax.jit(env.step)(state, jnp.zeros(env.action_size)))
    np.testing.assert_allclose(reached.rollout.physics.qpos, motion.qpos[int(begun.time) + 1], atol=1e-3)
    assert np.asarray(stack_motions(simulator, [motion])[0].steps) == [80]


@pytest.mark.slow
def test_linearization_uses_the_state_of_the_drivetrain(simulator: Simulator, motion: Motion):
    states, commands = jax.vmap(start_motion_window)(cut_motion_windows(simulator, [motion], 0.1, 0.5))
    linear = Linearizer(simulator)(ControlSteps(states, commands[:, 0], np.zeros((len(commands), 3))))
    first = HISTORY - 1 + 10 * np.arange(len(commands))
    np.testing.assert_allclose(linear.qpos, motion.qpos[first + 1], atol=1e-3)
    assert np.isfinite(linear.state).all() and np.abs(linear.state).max() > 0.1


@pytest.mark.slow
def test_policies_are_trained_with_the_identified_delay(tmp_path: Path):
    path = write_rover(tmp_path).file
    content = json.loads(path.read_text()) | {"identify": [{"command": "push", "field": "delay"}]}
    path.write_text(json.dumps(content))
    rover = read_description(path)
    declared = declared_parameters(rover, rover.load_model())
    late = IdentifiedParameters(jnp.array([0.06]), declared)
    env = LocomotionEnv(rover, TASKS["walk"], LocomotionConfig(), actuators=late)
    prompt = LocomotionEnv(rover, TASKS["walk"], LocomotionConfig())
    rods = []
    for each in (env, prompt):
        state, step = jax.jit(each.reset)(jax.random.key(0)), jax.jit(each.step)
        path = []
        for _ in range(4):
            state = step(state, jnp.ones(2))
            path.append(float(locomotion_state(state).rollout.physics.qvel[7]))
        rods.append(np.array(path))
    late_rod, rod = rods
    resting = late_rod[0]
    assert abs(rod[0] - resting) > 0.05  # the push acts at once, or one and a half control steps later
    assert abs(late_rod[1] - rod[1]) > 0.05


def test_derived_constants_follow_from_identified_masses(robot: RobotDescription):
    spec = mujoco.MjSpec.from_file(str(robot.model))
    lower = spec.body("lower")
    lower.mass, lower.inertia = 0.2, lower.inertia * 0.2 / 0.15
    compiled, ours = spec.compile(), robot.load_model(identified(robot, mass=0.2))
    for name in ("body_mass", "body_invweight0", "dof_invweight0", "body_subtreemass"):
        np.testing.assert_allclose(getattr(ours, name), getattr(compiled, name), rtol=1e-6)
    assert np.abs(ours.dof_invweight0 / robot.load_model().dof_invweight0 - 1).max() > 0.05
