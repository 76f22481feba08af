"""Forces by regression and by gradients: derivatives of control steps, and recovery of a known force and torque."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from ballu_mjx.ballu.actuators import ActuatorParameters
from ballu_mjx.ballu.model import CONTROL_TIMESTEP, load_model, standing_qpos
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.motion_windows import MotionWindows, cut_motion_windows
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.residuals import force_gradients, force_regression
from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.residuals.force_gradients import AnalyticConfig, check_analytic_config, resolve_windows
from ballu_mjx.residuals.force_regression import SupervisedConfig, check_supervised_config
from ballu_mjx.residuals.network import NetworkResidual
from ballu_mjx.residuals.network_input import num_inputs, recorded_inputs
from ballu_mjx.residuals.network_loads import load_units, num_loads
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.linearize import ControlSteps, Linearized, Linearizer
from ballu_mjx.sim.observation import HISTORY
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.sim.step import count_substeps

BALLU = load_robot()
SIMULATOR = Simulator(BALLU)
MODEL = SIMULATOR.mj_model
PUSH = np.array([0.02, -0.03, 0.015])
"""Force on the balloon (N, world frame)."""
TWIST = np.array([1e-3, -1.5e-3, 2e-3])
"""Torque on the balloon (N m, world frame)."""
CLOSE = 0.05 * float(np.linalg.norm(PUSH))
CLOSE_TWIST = 0.05 * float(np.linalg.norm(TWIST))
SECONDS = 0.5
INPUTS = num_inputs(EnvMimicConfig(), load_robot())
NETWORK = PPOConfig(policy_layers=(16,), value_layers=(4,))
WRENCH = EnvMimicConfig(forces="wrench", force_scale=0.05, torque_scale=0.005, force_limit=1.0, force_cost=20.0)
ACTIONS = num_loads(WRENCH, BALLU)
FORCES = NetworkResidual(WRENCH, BALLU, ppo.make_inference({ppo.STATE: (INPUTS,)}, ACTIONS, NETWORK), name="analytic")


def pushed(name: str, height: float, model: mujoco.MjModel = MODEL, twist: float = 0.0, steps: int = 60) -> Motion:
    """Simulate the nominal robot in C MuJoCo with `PUSH` and `twist` times `TWIST` on the balloon.

    - `height`: distance (m) of the start above the floor. The robot steps if it is 0, and falls otherwise.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    mujoco.mj_step(model, data, 100)
    data.qpos[2] += height
    data.xfrc_applied[model.body("balloon").id] = np.r_[PUSH, twist * TWIST]
    time = np.arange(steps) * CONTROL_TIMESTEP
    command = np.where((time[:, None] / 1.2 + np.array([0.0, 0.5])) % 1.0 < 0.4, 0.7, 0.0)
    states = [(data.qpos.copy(), data.qvel.copy())]
    for row in command:
        data.ctrl[:] = row
        mujoco.mj_step(model, data, count_substeps(model, CONTROL_TIMESTEP))
        states.append((data.qpos.copy(), data.qvel.copy()))
    qpos, qvel = (np.array(x) for x in zip(*states, strict=True))
    times = np.arange(steps + 1) * CONTROL_TIMESTEP
    return Motion(name=name, time=times, command=command, qpos=qpos, qvel=qvel, fit_error_mm={})


@pytest.fixture(scope="module")
def motions() -> list[Motion]:
    return [pushed("stepping", 0.0), pushed("falling", 10.0)]


@pytest.fixture(scope="module")
def recorded(motions: list[Motion]) -> MotionWindows:
    return cut_motion_windows(SIMULATOR, motions, SECONDS, SECONDS)


@pytest.fixture(scope="module")
def linearize() -> Linearizer:
    return Linearizer(SIMULATOR, joints=BALLU.joints, forces="wrench")


@pytest.fixture(scope="module")
def inputs(motions: list[Motion], recorded: MotionWindows) -> np.ndarray:
    """Network inputs for the states in the windows."""
    reference, _ = stack_motions(SIMULATOR, motions)
    seen = np.asarray(recorded_inputs(reference, EnvMimicConfig(), BALLU)).reshape(len(motions), -1, INPUTS)
    states = recorded.features.shape[0] * recorded.features.shape[1] // len(motions)
    return seen[:, :states].reshape(-1, INPUTS)


@pytest.fixture(scope="module")
def start(inputs: np.ndarray) -> ppo.Params:
    return ppo.initial_policy(inputs, ACTIONS, NETWORK)


@pytest.fixture(scope="module")
def unforced(recorded: MotionWindows, start: ppo.Params) -> ControlSteps:
    still = start._replace(policy=jax.tree.map(np.zeros_like, jax.device_get(start.policy)))
    return force_gradients.compile_rollout(SIMULATOR.with_residual(None), FORCES)(still, recorded)[0]


@pytest.mark.slow
def test_derivatives_of_control_steps_agree_with_c_mujoco(unforced: ControlSteps, linearize: Linearizer):
    """Steps include contacts and taut cables. Where a foot lands within a step, finite differences do not approximate
    the derivative. So most steps must agree, not all."""
    few = jax.tree.map(lambda x: x[::4], unforced)
    linear = linearize(few._replace(loads=np.zeros((len(few.loads), linearize.loads))))
    data, body, nv = mujoco.MjData(MODEL), MODEL.body("balloon").id, MODEL.nv
    joints = [MODEL.joint(name).dofadr[0] for name in BALLU.joints]
    sizes = np.r_[np.full(nv, 1e-5), np.full(nv, 1e-4), np.full(3, 1e-3), np.full(3 + len(joints), 1e-5)]
    rng = np.random.default_rng(0)

    def after(place: int, change: np.ndarray) -> np.ndarray:
        mujoco.mj_resetData(MODEL, data)
        data.qpos[:], data.qvel[:] = few.state.physics.qpos[place], few.state.physics.qvel[place] + change[nv : 2 * nv]
        data.qacc_warmstart[:] = few.state.physics.warmstart[place]
        mujoco.mj_integratePos(MODEL, data.qpos, change[:nv], 1.0)
        data.ctrl[:], data.xfrc_applied[body] = few.command[place], change[2 * nv :][:6]
        data.qfrc_applied[joints] = change[2 * nv + 6 :]
        mujoco.mj_step(MODEL, data, count_substeps(MODEL, CONTROL_TIMESTEP))
        return np.concatenate([data.qpos, data.qvel])

    wrong = []
    for place in range(len(few.loads)):
        direction = rng.normal(size=linearize.directions) * sizes
        plus, minus = after(place, direction), after(place, -direction)
        difference = np.zeros(nv)
        mujoco.mj_differentiatePos(MODEL, difference, 1.0, minus[: MODEL.nq], plus[: MODEL.nq])
        measured = np.concatenate([difference, plus[MODEL.nq :] - minus[MODEL.nq :]]) / 2
        found = linear.state[place] @ direction
        wrong.append(np.linalg.norm(found - measured) / np.linalg.norm(measured))
    assert np.median(wrong) < 0.02
    assert np.quantile(wrong, 0.75) < 0.1


@pytest.mark.slow
def test_labels_recover_a_known_force_and_torque(linearize: Linearizer):
    """The motions have no noise, and the model is correct except for the force. In the air, all components are
    recovered. On its legs, the robot does not show vertical forces."""
    config = SupervisedConfig(
        position_noise=1e-5,
        angle_noise=1e-3,
        held_angle_noise=1e-3,
        velocity_noise=1e-4,
        rotation_noise=0.05,
        joint_noise=1.0,
        torque_spread=1e-4,
    )
    label = force_regression.ForceLabeller(linearize, config, WRENCH)
    motions = [pushed("stepping", 0.0, twist=1.0), pushed("falling", 10.0, twist=1.0)]
    stepping, falling = (label(motion).mean(axis=0) for motion in motions)
    np.testing.assert_allclose(falling[:3], PUSH, atol=CLOSE)
    np.testing.assert_allclose(falling[3:], TWIST, atol=CLOSE_TWIST)
    # On legs, a sixth of the horizontal force is missed, because the torques of the legs are unknown, too.
    np.testing.assert_allclose(stepping[:2], PUSH[:2], atol=3 * CLOSE)


@pytest.mark.slow
def test_labels_tolerate_legs_that_differ_from_the_model(linearize: Linearizer):
    """Knee springs are stiffer than the model's by a fifth. Joint torques are separate unknowns, so the labels do not
    absorb them. The test uses the median, because labels may be wrong where a foot lands within a step."""
    nominal = ActuatorParameters.nominal(MODEL)
    stiffer = dataclasses.replace(nominal, knee_spring_stiffness=1.2 * nominal.knee_spring_stiffness)
    motion = pushed("stiff knees", 0.0, load_model(stiffer))

    def wrong(config: SupervisedConfig) -> float:
        labels = force_regression.ForceLabeller(linearize, config, WRENCH)(motion)
        return float(np.median(np.linalg.norm(labels[:, :3] - PUSH, axis=1)))

    assert wrong(SupervisedConfig(torque_spread=0.05)) < 0.5 * wrong(SupervisedConfig(torque_spread=1e-5))


def test_training_examples_are_in_the_heading_frame(motions: list[Motion]):
    """Forces in the world frame become actions in the heading frame."""
    simulator = SIMULATOR
    loads = [np.tile(np.r_[PUSH, TWIST], (len(motion.command), 1)) for motion in motions]
    seen, actions = force_regression.examples(simulator, motions, loads, WRENCH)
    features, _ = simulator.observe_all(jnp.asarray(motions[0].qpos[40:41]), jnp.asarray(motions[0].qvel[40:41]))
    yaw = float(features[0, 8])
    assert abs(yaw) > 1e-3
    x = np.cos(yaw) * PUSH[0] + np.sin(yaw) * PUSH[1]
    y = np.cos(yaw) * PUSH[1] - np.sin(yaw) * PUSH[0]
    action = actions[40 - HISTORY + 1]
    np.testing.assert_allclose(0.05 * action[:3], [x, y, PUSH[2]], rtol=1e-4)
    np.testing.assert_allclose(0.005 * np.linalg.norm(action[3:]), np.linalg.norm(TWIST), rtol=1e-4)
    assert len(seen) == len(actions)


@pytest.mark.slow
def test_gradients_recover_a_known_force(
    recorded: MotionWindows, inputs: np.ndarray, start: ppo.Params, linearize: Linearizer
):
    config = AnalyticConfig(
        window_seconds=SECONDS,
        relinearizations=4,
        updates=150,
        validate_every=150,
        learning_rate=1e-3,
        observation_noise=0.0,
    )
    found: list[tuple[object, dict[str, float]]] = []
    force_gradients.train(
        FORCES,
        lambda policy: start._replace(policy=policy),
        start.policy,
        recorded,
        np.ones(INPUTS, np.float32),
        config,
        lambda step, policy, metrics: found.append((policy, metrics)),
        linearize,
    )
    policy, metrics = found[-1]
    actions_found = np.asarray(FORCES.infer(start._replace(policy=policy), jnp.asarray(inputs)))
    stepping, falling = (load_units(WRENCH, BALLU) * actions_found).reshape(2, -1, ACTIONS).mean(axis=1)
    np.testing.assert_allclose(falling[:3], PUSH, atol=CLOSE)
    np.testing.assert_allclose(falling[3:], 0.0, atol=CLOSE_TWIST)
    # On legs, other forces and torques that vary between steps move the balloon almost as this force does.
    np.testing.assert_allclose(stepping[:2], PUSH[:2], atol=2 * CLOSE)
    assert metrics["loss"] < 0.05 * found[0][1]["loss"]  # last simulation against first


class MadeUp(Linearizer):
    """Linearizer that returns made-up states and derivatives, without simulation. The steps `diverged` diverge."""

    def __init__(self, diverged: np.ndarray) -> None:
        super().__init__(SIMULATOR, forces="wrench")
        self.diverged = diverged

    def __call__(self, steps: ControlSteps) -> Linearized:
        count, states = len(steps.loads), 2 * MODEL.nv
        rng = np.random.default_rng(0)
        qpos, features = np.tile(standing_qpos(MODEL), (count, 1)), 0.01 * rng.normal(size=(count, 27))
        qvel, state = np.zeros((count, MODEL.nv)), 0.1 * rng.normal(size=(count, states, self.directions))
        seen = 0.1 * rng.normal(size=(count, 27, self.directions))
        for after in (qpos, qvel, features):
            after[self.diverged] = np.nan
        for derivative in (state, seen):  # as a `Linearizer` does
            derivative[self.diverged] = 0.0
        return Linearized(qpos, qvel, features, state, seen)


def learned_from(
    windows: MotionWindows, start: ppo.Params, diverged: np.ndarray, patch: pytest.MonkeyPatch
) -> tuple[Any, dict[str, float]]:
    """Return the policy after some gradient steps on made-up simulations of windows, and the last metrics.

    `diverged` are the windows that diverge.
    """
    linearize, steps = MadeUp(np.zeros(0, int)), windows.features.shape[1]

    def rollout(params: Any, recorded: MotionWindows) -> tuple[Any, np.ndarray]:
        drawn = [int(np.argmin(np.abs(windows.features - each).sum(axis=(1, 2)))) for each in recorded.features]
        linearize.diverged = np.repeat(np.isin(drawn, diverged), steps)
        features = np.where(np.isin(drawn, diverged)[:, None, None], np.nan, np.asarray(recorded.features) + 0.01)
        return SimpleNamespace(loads=np.zeros((len(drawn) * steps, ACTIONS))), features

    patch.setattr(force_gradients, "compile_rollout", lambda simulator, forces: rollout)
    found: list[tuple[Any, dict[str, float]]] = []
    force_gradients.train(
        FORCES,
        lambda policy: start._replace(policy=policy),
        start.policy,
        windows,
        np.ones(INPUTS, np.float32),
        AnalyticConfig(relinearizations=2, updates=3, validate_every=3, observation_noise=0.0),
        lambda step, policy, metrics: found.append((policy, metrics)),
        linearize,
    )
    return found[-1]


def test_gradient_steps_leave_out_windows_that_diverge(
    recorded: MotionWindows, start: ppo.Params, monkeypatch: pytest.MonkeyPatch
):
    few = jax.tree.map(lambda x: np.asarray(x)[:3], recorded)
    policy, metrics = learned_from(few, start, np.array([1]), monkeypatch)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(policy))
    moved = jax.tree.map(lambda one, other: float(np.abs(one - other).max()), policy, jax.device_get(start.policy))
    assert max(jax.tree.leaves(moved)) > 0
    assert all(np.isfinite(value) for value in metrics.values())
    with pytest.raises(InputError, match="All 3 windows .* diverge"):
        learned_from(few, start, np.arange(3), monkeypatch)


def test_a_step_that_diverges_leaves_the_other_labels_finite(motions: list[Motion]):
    motion = motions[0]
    labels = []
    for diverged in ([], [20]):
        label = force_regression.ForceLabeller(MadeUp(np.array(diverged, int)), SupervisedConfig(), WRENCH)
        labels.append(label(motion))
    assert np.all(np.isfinite(labels[1]))
    assert 0 < np.abs(labels[1] - labels[0]).max() < np.abs(labels[0]).max()


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (AnalyticConfig(relinearizations=0), "--relinearizations is 0"),
        (AnalyticConfig(window_seconds=0.01), "--window-seconds"),
        (SupervisedConfig(force_change=-1.0), "--force-change is -1"),
        (SupervisedConfig(force_shares=(0.5, 1.5)), "--force-shares is 0.5 1.5"),
        (SupervisedConfig(force_shares=()), "--force-shares"),
        (SupervisedConfig(observation_noise=()), "--observation-noise"),
        (SupervisedConfig(observation_noise=(0.1, -1.0)), "--observation-noise is 0.1 -1.0"),
        (AnalyticConfig(interval_seconds=float("inf")), "--interval-seconds"),
    ],
)
def test_options_out_of_range_are_refused(config: AnalyticConfig | SupervisedConfig, message: str):
    with pytest.raises(InputError, match=message):
        if isinstance(config, AnalyticConfig):
            check_analytic_config(resolve_windows(config, BALLU), 0.05)
        else:
            check_supervised_config(config)


def test_forces_of_a_policy_scale_with_their_share(start: ppo.Params, inputs: np.ndarray):
    whole = np.asarray(FORCES.infer(start, jnp.asarray(inputs)))
    half = np.asarray(FORCES.infer(start._replace(policy=ppo.with_share(start.policy, 0.5)), jnp.asarray(inputs)))
    assert np.abs(whole).max() > 0
    np.testing.assert_allclose(half, 0.5 * whole, rtol=1e-5)


def test_a_supervised_run_is_loaded_as_a_residual(tmp_path: Path, start: ppo.Params):
    """`TrainedResidual.load` reads a run of supervised forces."""
    from ballu_mjx.residuals.run_config import describe_run
    from ballu_mjx.residuals.training_range import TrainingRange
    from ballu_mjx.runs.folder import Run

    sections = {"env": WRENCH, "ppo": NETWORK, "fit": SupervisedConfig()}
    with Run(tmp_path, describe_run("supervised", sections, {}, []) | {"residual": None}) as run:
        TrainingRange.of(np.zeros((2, INPUTS))).write(run)
        run.save(5, ppo.as_tree(start), 0.5)
    loaded = TrainedResidual.load(tmp_path, BALLU)
    assert (loaded.model.name, loaded.step) == ("supervised", 5)
    assert json.loads((tmp_path / "config.json").read_text())["task"] == "supervised"
    wrench = loaded.bound.act(jnp.zeros((HISTORY, 27)), jnp.zeros((HISTORY, 2))).wrench
    assert np.all(np.isfinite(wrench))
