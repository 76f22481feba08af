"""The residual methods on a robot that is not BALLU: an anchored balloon on a tether, with commands in any unit."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from rover import write_rover
from tethered import PUSH, ROBOT, STEPS, flight

from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.open_loop import evaluate
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.motion_windows import cut_motion_windows
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.residuals import force_gradients, force_regression
from ballu_mjx.residuals.aerodynamics import Aerodynamics, AirParameters
from ballu_mjx.residuals.aerodynamics_fit import AirConfig, identify_air
from ballu_mjx.residuals.envmimic import EnvMimicConfig, resolve_envmimic, start_spread
from ballu_mjx.residuals.envmimic_training import started_from
from ballu_mjx.residuals.force_gradients import AnalyticConfig, check_analytic_config, resolve_windows
from ballu_mjx.residuals.force_regression import SupervisedConfig
from ballu_mjx.residuals.force_training import fit_analytic, fit_supervised, resolve_joint_spreads
from ballu_mjx.residuals.network import NetworkResidual
from ballu_mjx.residuals.network_input import num_inputs, recorded_inputs
from ballu_mjx.residuals.network_loads import load_units, num_loads
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.residuals.training_range import TrainingRange
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.sim.linearize import Linearizer
from ballu_mjx.sim.observation import HISTORY, ObservationLayout
from ballu_mjx.sim.residual import BoundResidual, add_to_base
from ballu_mjx.sim.simulator import Simulator

SIMULATOR = Simulator(ROBOT)
CONFIG = EnvMimicConfig(forces="force", force_scale=0.05, force_limit=1.0, force_cost=20.0)
PRIORS = SupervisedConfig(force_spread=0.3, force_change=0.1, torque_spread=0.05)
NETWORK = PPOConfig(policy_layers=(16,), value_layers=(4,))
AIR = TrainedResidual(Aerodynamics(ROBOT, SIMULATOR.mj_model), AirParameters.none(), TrainingRange.unbounded(), 0, None)


@pytest.fixture(scope="module")
def motions() -> list[Motion]:
    return [flight(seed=seed) for seed in range(2)]


@pytest.fixture(scope="module")
def linearize() -> Linearizer:
    return Linearizer(SIMULATOR)


@pytest.mark.slow
def test_labels_recover_a_known_force(motions: list[Motion], linearize: Linearizer):
    """Labels of an anchored robot are in the world frame, independent of the balloon's heading."""
    labels = force_regression.ForceLabeller(linearize, PRIORS, CONFIG)(motions[0])
    np.testing.assert_allclose(np.median(labels, axis=0), PUSH, atol=0.1 * float(np.linalg.norm(PUSH)))
    _, actions = force_regression.examples(SIMULATOR, motions[:1], [np.tile(PUSH, (STEPS, 1))], CONFIG)
    np.testing.assert_allclose(load_units(CONFIG, ROBOT) * actions, np.tile(PUSH, (len(actions), 1)), atol=1e-6)
    yaw = stack_motions(SIMULATOR, motions)[0].features[0, :, ObservationLayout.yaw]
    assert np.ptp(np.asarray(yaw)) > 0.1  # so actions in a heading frame would differ


@pytest.mark.slow
def test_gradients_through_the_simulation_recover_a_known_force(motions: list[Motion], linearize: Linearizer):
    reference, _ = stack_motions(SIMULATOR, motions)
    inputs = np.asarray(recorded_inputs(reference, CONFIG, ROBOT))
    sizes = {ppo.STATE: (num_inputs(CONFIG, ROBOT),)}, num_loads(CONFIG, ROBOT), NETWORK
    forces = NetworkResidual(CONFIG, ROBOT, ppo.make_inference(*sizes), name="analytic")
    start = ppo.initial_policy(inputs, num_loads(CONFIG, ROBOT), NETWORK)
    settings = AnalyticConfig(
        relinearizations=2, updates=150, validate_every=150, observation_noise=0.0, start_noise=0.0,
    )  # fmt: skip
    windows = cut_motion_windows(SIMULATOR, motions, 0.5, 0.5)
    found = []
    force_gradients.train(
        forces,
        lambda policy: start._replace(policy=policy),
        start.policy,
        windows,
        np.std(inputs, axis=0),
        settings,
        lambda step, policy, metrics: found.append((policy, metrics)),
        linearize,
    )
    policy, metrics = found[-1]
    actions = np.asarray(forces.infer(start._replace(policy=policy), jnp.asarray(inputs)))
    found_push = (load_units(CONFIG, ROBOT) * actions).mean(axis=0)
    # A force along the taut tether does not move the balloon, so only the horizontal force can be identified.
    np.testing.assert_allclose(found_push[:2], PUSH[:2], atol=0.05 * float(np.linalg.norm(PUSH)))
    assert metrics["loss"] < 0.1 * found[0][1]["loss"]


@pytest.mark.parametrize(
    ("horizons", "episode", "window"),
    [
        ((), 3.0, 8.0),
        ((0.2, 0.4, 1.0), 0.4, 1.0),
        ((0.5, 1.0), 0.5, 1.0),
        ((5.0, 10.0, 20.0), 3.0, 8.0),
        ((ROBOT.control_timestep,), 2 * ROBOT.control_timestep, 2 * ROBOT.control_timestep),
    ],
)
def test_robots_with_short_horizons_learn_from_short_motions(
    horizons: tuple[float, ...], episode: float, window: float
):
    """On a robot whose errors saturate after a second, episodes of 3 s do not show which force is better."""
    robot = dataclasses.replace(ROBOT, horizons=horizons)
    given = dataclasses.replace(CONFIG, expected_loads=(0.0,))
    assert resolve_envmimic(given, Simulator(robot), []).episode_seconds == episode
    long = dataclasses.replace(given, episode_seconds=4.0)
    assert resolve_envmimic(long, Simulator(robot), []).episode_seconds == 4.0
    found = resolve_windows(AnalyticConfig(), robot)
    assert (found.window_seconds, found.interval_seconds) == (window, window)
    check_analytic_config(found, robot.control_timestep)
    chosen = resolve_windows(AnalyticConfig(window_seconds=0.5, interval_seconds=0.25), robot)
    assert (chosen.window_seconds, chosen.interval_seconds) == (0.5, 0.25)


def position_errors(learned: TrainedResidual, motions: list[Motion]) -> tuple[float, float]:
    """Return the position errors after 1 s (m) without and with a residual."""
    found = evaluate(SIMULATOR.with_residual(learned), motions)
    vanilla, residual = (np.mean([e.position[1.0][0] for e in side]) for side in (found.vanilla, found.residual))
    return float(vanilla), float(residual)


@pytest.mark.slow
def test_regression_returns_a_residual_that_follows_the_recordings(motions: list[Motion]):
    config = dataclasses.replace(PRIORS, updates=600, force_shares=(1.0,))
    learned = fit_supervised(SIMULATOR, motions, config)
    vanilla, residual = position_errors(learned, motions)
    assert residual < 0.5 * vanilla
    assert "Labels, training" in learned.report


def network_of(forces: EnvMimicConfig, base: BoundResidual | None = None) -> TrainedResidual:
    """Return an untrained network for the balloon, in addition to a base residual."""
    sizes = num_inputs(forces, ROBOT), num_loads(forces, ROBOT)
    infer = ppo.make_inference({ppo.STATE: sizes[:1]}, sizes[1], NETWORK)
    params = ppo.initial_policy(np.random.default_rng(0).normal(size=(50, sizes[0])), sizes[1], NETWORK)
    model, with_base = add_to_base(base, NetworkResidual(forces, ROBOT, infer, network=NETWORK))
    return TrainedResidual(model, with_base(params), TrainingRange.unbounded(), 1, None)


def test_a_training_takes_open_options_from_the_network_that_it_starts_with():
    network, vanilla = network_of(CONFIG), SIMULATOR.with_residual(None)
    open_options = EnvMimicConfig(forces="force", start_noise=0.0)
    config, params = started_from(network, vanilla, open_options, NETWORK)
    assert (config.force_scale, config.force_limit) == (CONFIG.force_scale, CONFIG.force_limit)
    assert (config.force_cost, config.start_noise) == (None, 0.0)  # not of the network's input and output
    assert params is network.params
    base = network.bound
    improved = SIMULATOR.with_residual(base)
    assert started_from(network_of(CONFIG, base), improved, open_options, NETWORK)[0] == config
    for other, simulator, forces, layers, message in (
        (network, vanilla, EnvMimicConfig(), NETWORK, "--forces is wrench, but the network of --start-from has force"),
        (network, vanilla, dataclasses.replace(open_options, force_scale=1.0), NETWORK, "--force-scale is 1.0"),
        (network, vanilla, open_options, PPOConfig(), "--policy-layers"),
        (network, improved, open_options, NETWORK, "another --residual, or with none"),
        (network_of(CONFIG, base), vanilla, open_options, NETWORK, "another --residual, or with none"),
        (network_of(CONFIG, network_of(CONFIG).bound), SIMULATOR.with_residual(halved(base)), open_options, NETWORK,
         "another --residual, or with none"),
        (AIR, vanilla, open_options, NETWORK, "whose loads a network computes"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            started_from(other, simulator, forces, layers)


def halved(residual: BoundResidual) -> BoundResidual:
    """Return a residual with half of the parameters."""
    return BoundResidual(residual.model, jax.tree.map(lambda x: 0.5 * x, residual.params))


@pytest.mark.slow
def test_gradients_return_a_residual_that_follows_the_recordings(motions: list[Motion]):
    config = AnalyticConfig(
        window_seconds=0.5, interval_seconds=0.5, relinearizations=2, updates=150, validate_every=150
    )
    vanilla, residual = position_errors(fit_analytic(SIMULATOR, motions, config), motions)
    assert residual < 0.5 * vanilla


@pytest.mark.slow
def test_aerodynamic_fit_recovers_a_known_added_mass():
    flights = [flight(push=np.zeros(3), added_mass=0.03, seed=seed) for seed in range(2)]
    config = AirConfig(window_seconds=1.0, interval_seconds=1.0)
    fit = identify_air(SIMULATOR, flights, config, free=("added_mass",))
    assert float(fit.parameters.added_mass) == pytest.approx(0.03, rel=0.05)
    assert fit.cost[1] < 0.05 * fit.cost[0]


def test_aerodynamics_refuse_a_robot_without_buoyancy(tmp_path: Path):
    robot = altered(tmp_path, ' gravcomp="1.631"', "")
    with pytest.raises(InputError, match=r"balloon\.xml: the body balloon has no buoyancy.*gravcomp"):
        Aerodynamics(robot, robot.load_model())


def altered(folder: Path, *texts: str) -> RobotDescription:
    """Return the robot with an altered model. `texts` are pairs of an old text and its replacement."""
    shutil.copy(ROBOT.file, folder)
    text = ROBOT.model.read_text()
    for old, new in zip(texts[::2], texts[1::2], strict=True):
        assert old in text
        text = text.replace(old, new)
    (folder / "balloon.xml").write_text(text)
    return read_description(folder / ROBOT.file.name)


@pytest.mark.slow
def test_learning_does_not_depend_on_the_unit_of_commands(tmp_path: Path):
    """With commands of -2 to 2 instead of 0 to 1, motion, inputs and learned forces stay the same."""
    twin = altered(
        tmp_path, 'gainprm="0.04" ctrlrange="0 1"', 'gainprm="0.01" biastype="affine" biasprm="0.02" ctrlrange="-2 2"'
    )
    assert twin.command_ranges == ((-2.0, 2.0), (-2.0, 2.0))
    learned = []
    for robot, simulator in ((ROBOT, SIMULATOR), (twin, Simulator(twin))):
        motion = flight(robot, push=np.zeros(3))
        reference, _ = stack_motions(simulator, [motion])
        inputs = np.asarray(recorded_inputs(reference, CONFIG, robot))
        assert inputs[:, -2 * HISTORY :].min() >= 0 and inputs[:, -2 * HISTORY :].max() <= 1
        actions = np.random.default_rng(0).normal(size=(len(inputs), 3)).astype(np.float32)
        sizes = {ppo.STATE: (inputs.shape[1],)}, 3, NETWORK
        infer, start = ppo.make_inference(*sizes), ppo.initial_policy(inputs, 3, NETWORK)
        forces = jax.jit(lambda policy, seen, infer=infer, start=start: infer(start._replace(policy=policy), seen))
        policies = []
        force_regression.regress(
            forces, start.policy, (inputs, actions), SupervisedConfig(updates=20, validate_every=20), 1.0,
            lambda step, policy, error, policies=policies: policies.append(policy),
        )  # fmt: skip
        windows = cut_motion_windows(simulator, [motion], 1.0, 1.0)
        network = NetworkResidual(CONFIG, robot, infer)
        rollout = force_gradients.compile_rollout(simulator.with_residual(None), network)
        _, features = rollout(start._replace(policy=policies[-1]), windows)
        learned.append((motion.qpos, inputs, np.asarray(features)))
    for one, other, tolerance in zip(*learned, (1e-9, 1e-4, 1e-3), strict=True):
        np.testing.assert_allclose(one, other, atol=tolerance)


def test_command_delay_of_the_air_uses_the_robot_s_control_time_step(tmp_path: Path):
    """With steps of 0.02 s and a delay of 0.03 s, the command of two steps ago acts first, then the previous one."""
    description = json.loads(ROBOT.file.read_text()) | {"control_timestep": 0.02, "model": str(ROBOT.model)}
    (tmp_path / "fast.robot.json").write_text(json.dumps(description))
    fast = read_description(tmp_path / "fast.robot.json")
    air = dataclasses.replace(AirParameters.none(), delay=jnp.array(0.03))
    sent = jnp.array([[0.0, 0.0], [0.5, 0.5], [1.0, 1.0]])
    arrived = np.asarray(Aerodynamics(fast, fast.load_model()).command(air, sent))
    np.testing.assert_array_equal(arrived[:, 0], [0.0, 0.5])


def test_torques_of_hinges_and_forces_of_slides_have_spreads_of_their_own(tmp_path: Path):
    robot = dataclasses.replace(write_rover(tmp_path), joints=("shoulder", "rod"))
    model, push = robot.load_model(), np.zeros(robot.directions)
    model.dof_damping[model.joint("rod").dofadr] = 60.0  # so that the rod does not reach its stop
    simulator, data = Simulator(robot, model=model), mujoco.MjData(model)
    for joint, force in (("shoulder", 0.02), ("rod", 0.8)):  # N m, N
        push[model.joint(joint).dofadr[0]] = force
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qfrc_applied[:] = push
    states = [(data.qpos.copy(), data.qvel.copy())]
    for _ in range(STEPS):
        mujoco.mj_step(model, data, 4)
        states.append((data.qpos.copy(), data.qvel.copy()))
    qpos, qvel = map(np.array, zip(*states, strict=True))
    command = np.tile(data.ctrl, (STEPS, 1))
    motions = [Motion("drive", np.arange(STEPS + 1) * robot.control_timestep, command, qpos, qvel, {})]
    found = resolve_joint_spreads(SupervisedConfig(), "force", simulator, motions)
    assert found.torque_spread == pytest.approx(0.02, rel=0.2)
    assert found.slide_force_spread == pytest.approx(0.8, rel=0.2)
    given = resolve_joint_spreads(SupervisedConfig(slide_force_spread=3.0), "force", simulator, motions)
    assert (given.torque_spread, given.slide_force_spread) == (found.torque_spread, 3.0)


def test_starting_states_of_held_joints_hardly_vary(tmp_path: Path):
    robot = dataclasses.replace(write_rover(tmp_path), held=("lid", "rod"))
    model = robot.load_model()
    spread = start_spread(model, robot)
    place = {name: model.joint(name).dofadr[0] for name in ("shoulder", "rod", "lid")}
    assert spread[place["shoulder"]] == pytest.approx(np.deg2rad(0.5))
    assert spread[place["lid"]] == pytest.approx(np.deg2rad(1e-3))
    assert spread[place["rod"]] == pytest.approx(1e-6)  # a slide joint, in metres
    assert spread[: model.nv].max() == pytest.approx(np.deg2rad(0.5))
