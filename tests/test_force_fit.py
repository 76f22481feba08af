"""Forces by regression and by gradients: are the derivatives the simulation's, and is a known push found again?"""

from __future__ import annotations

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from ballu_mjx import analytic, envmimic, ppo, robot, robot_description, simulation, supervised, windows
from ballu_mjx.analytic import AnalyticConfig
from ballu_mjx.envmimic import EnvMimicConfig, ForcePolicy
from ballu_mjx.errors import InputError
from ballu_mjx.linearization import ControlSteps, Linearizer
from ballu_mjx.ppo import PPOConfig
from ballu_mjx.reconstruction import Motion
from ballu_mjx.residual import ACTIONS, Residual
from ballu_mjx.supervised import SupervisedConfig
from ballu_mjx.windows import Windows

MODEL = robot.load_model()
PUSH = np.array([0.02, -0.03, 0.015])
"""N, world."""
CLOSE = 0.05 * float(np.linalg.norm(PUSH))
SECONDS = 0.5
INPUTS = envmimic.input_size(EnvMimicConfig(), robot_description.ballu())
NETWORK = PPOConfig(policy_layers=(16,), value_layers=(4,))
FORCES = ForcePolicy(EnvMimicConfig(), ppo.make_inference({ppo.STATE: (INPUTS,)}, ACTIONS, NETWORK), name="analytic")


def pushed(name: str, height: float, steps: int = 60) -> Motion:
    """The nominal robot in C MuJoCo, stepping or, above the floor, falling, with `PUSH` on the balloon."""
    data = mujoco.MjData(MODEL)
    data.qpos[:] = robot.standing_qpos(MODEL)
    mujoco.mj_step(MODEL, data, 100)
    data.qpos[2] += height
    data.xfrc_applied[simulation.balloon_id(MODEL), :3] = PUSH
    time = np.arange(steps) * robot.CONTROL_TIMESTEP
    command = np.where((time[:, None] / 1.2 + np.array([0.0, 0.5])) % 1.0 < 0.4, 0.7, 0.0)
    states = [(data.qpos.copy(), data.qvel.copy())]
    for row in command:
        data.ctrl[:] = row
        mujoco.mj_step(MODEL, data, simulation.substeps(MODEL))
        states.append((data.qpos.copy(), data.qvel.copy()))
    qpos, qvel = (np.array(x) for x in zip(*states, strict=True))
    times = np.arange(steps + 1) * robot.CONTROL_TIMESTEP
    return Motion(name=name, time=times, command=command, qpos=qpos, qvel=qvel, residual_mm={})


@pytest.fixture(scope="module")
def recorded() -> Windows:
    motions = [pushed("stepping", 0.0), pushed("falling", 10.0)]
    return windows.cut(envmimic.Simulator(MODEL), motions, SECONDS, SECONDS)


@pytest.fixture(scope="module")
def linearize() -> Linearizer:
    return Linearizer(MODEL)


@pytest.fixture(scope="module")
def start(recorded: Windows) -> ppo.Params:
    inputs, _ = supervised.examples(recorded, np.zeros((*recorded.features.shape[:2], 3)), EnvMimicConfig())
    return ppo.initial_policy(inputs, ACTIONS, NETWORK)


@pytest.fixture(scope="module")
def unforced(recorded: Windows, start: ppo.Params) -> ControlSteps:
    still = start._replace(policy=jax.tree.map(np.zeros_like, jax.device_get(start.policy)))
    return analytic.simulator(MODEL, FORCES)(still, recorded)[0]


def test_derivatives_are_those_of_c_mujoco(unforced: ControlSteps, linearize: Linearizer):
    """Through contacts and taut cables; where a foot lands within the step, differences of any size are no derivative,
    so most steps must agree, not all."""
    few = jax.tree.map(lambda x: x[::4], unforced)
    linear = linearize(few)
    data, body, nv = mujoco.MjData(MODEL), simulation.balloon_id(MODEL), MODEL.nv
    rng = np.random.default_rng(0)

    def after(place: int, change: np.ndarray) -> np.ndarray:
        mujoco.mj_resetData(MODEL, data)
        data.qpos[:], data.qvel[:] = few.physics.qpos[place], few.physics.qvel[place] + change[nv : 2 * nv]
        data.qacc_warmstart[:] = few.physics.warmstart[place]
        mujoco.mj_integratePos(MODEL, data.qpos, change[:nv], 1.0)
        data.ctrl[:], data.xfrc_applied[body, :3] = few.commands[place, -1], change[2 * nv :]
        mujoco.mj_step(MODEL, data, simulation.substeps(MODEL))
        return np.concatenate([data.qpos, data.qvel])

    wrong = []
    for place in range(len(few.force)):
        direction = (
            rng.normal(size=linearize.directions) * np.r_[np.full(nv, 1e-5), np.full(nv, 1e-4), np.full(3, 1e-3)]
        )
        plus, minus = after(place, direction), after(place, -direction)
        difference = np.zeros(nv)
        mujoco.mj_differentiatePos(MODEL, difference, 1.0, minus[: MODEL.nq], plus[: MODEL.nq])
        measured = np.concatenate([difference, plus[MODEL.nq :] - minus[MODEL.nq :]]) / 2
        found = linear.state[place] @ direction
        wrong.append(np.linalg.norm(found - measured) / np.linalg.norm(measured))
    assert np.median(wrong) < 0.02
    assert np.quantile(wrong, 0.75) < 0.1


def test_labels_are_the_push(recorded: Windows, unforced: ControlSteps, linearize: Linearizer):
    """All of it in the air; on its legs the robot does not show what lifts it."""
    config = SupervisedConfig(window_seconds=SECONDS, force_spread=0.3, position_noise=2e-4, angle_noise=0.02)
    labels = supervised.labels(MODEL, recorded, linearize(unforced), config)
    stepping, falling = labels.reshape(2, -1, 3).mean(axis=1)
    np.testing.assert_allclose(falling, PUSH, atol=CLOSE)
    np.testing.assert_allclose(stepping[:2], PUSH[:2], atol=CLOSE)


def test_examples_are_in_the_balloon_s_heading(recorded: Windows):
    """Seen by a robot that has turned, a force keeps its side."""
    force = np.tile(np.float32(PUSH), (*recorded.features.shape[:2], 1))
    seen, actions = supervised.examples(recorded, force, EnvMimicConfig())
    yaw = float(recorded.features[0, 6, 8])  # the next control step starts there
    assert abs(yaw) > 1e-3
    x = np.cos(yaw) * PUSH[0] + np.sin(yaw) * PUSH[1]
    y = np.cos(yaw) * PUSH[1] - np.sin(yaw) * PUSH[0]
    np.testing.assert_allclose(0.05 * actions[7], [x, y, PUSH[2]], rtol=1e-4)
    assert seen.shape == (force.size // 3, INPUTS)


def test_gradients_find_the_push(recorded: Windows, start: ppo.Params):
    config = AnalyticConfig(
        window_seconds=SECONDS, rounds=2, updates=300, validate_every=300, learning_rate=3e-3, observation_noise=0.0
    )
    found: list[tuple[object, dict[str, float]]] = []
    analytic.train(
        MODEL,
        FORCES,
        lambda policy: start._replace(policy=policy),
        start.policy,
        recorded,
        np.ones(INPUTS, np.float32),
        config,
        lambda step, policy, metrics: found.append((policy, metrics)),
    )
    policy, metrics = found[-1]
    seen, _ = supervised.examples(recorded, np.zeros((*recorded.features.shape[:2], 3)), EnvMimicConfig())
    force = 0.05 * np.asarray(FORCES.infer(start._replace(policy=policy), jnp.asarray(seen)))
    stepping, falling = force.reshape(2, -1, 3).mean(axis=1)
    np.testing.assert_allclose(falling, PUSH, atol=CLOSE)
    np.testing.assert_allclose(stepping[:2], PUSH[:2], atol=CLOSE)
    assert metrics["loss"] < 0.2 * found[0][1]["loss"]  # of the second simulation, beside the first


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (AnalyticConfig(rounds=0), "--rounds is 0"),
        (AnalyticConfig(window_seconds=0.01), "--window-seconds"),
        (SupervisedConfig(force_change=-1.0), "--force-change is -1"),
        (SupervisedConfig(interval_seconds=float("inf")), "--interval-seconds"),
    ],
)
def test_options_out_of_range_are_refused(config: AnalyticConfig | SupervisedConfig, says: str):
    with pytest.raises(InputError, match=says):
        (analytic if isinstance(config, AnalyticConfig) else supervised).check(config)  # pyright: ignore[reportArgumentType]


def test_a_run_is_read_as_its_kind(tmp_path: Path, start: ppo.Params):
    """What `force_fit` leaves, `Residual.load` understands."""
    from ballu_mjx import runs
    from ballu_mjx.residual import write_observed

    sections = {"env": EnvMimicConfig(), "ppo": NETWORK, "fit": SupervisedConfig()}
    with runs.Run(tmp_path, runs.describe("supervised", sections, {}, []) | {"residual": None}) as run:
        write_observed(run, np.zeros((2, INPUTS)))
        run.save(5, ppo.as_tree(start), 0.5)
    loaded = Residual.load(tmp_path)
    assert (loaded.model.name, loaded.step) == ("supervised", 5)
    assert json.loads((tmp_path / "config.json").read_text())["task"] == "supervised"
    wrench = loaded.wrench(jnp.zeros((envmimic.HISTORY, 27)), jnp.zeros((envmimic.HISTORY, 2)))
    assert np.all(np.isfinite(wrench))
