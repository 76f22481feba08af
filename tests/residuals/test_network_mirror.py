"""Networks of symmetric robots: a mirrored motion of BALLU has the mirrored loads."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.open_loop import Evaluators
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.residuals import force_gradients
from ballu_mjx.residuals.envmimic import EnvMimicConfig, EnvMimicEnv
from ballu_mjx.residuals.envmimic_training import check_resumes
from ballu_mjx.residuals.force_gradients import AnalyticConfig
from ballu_mjx.residuals.force_training import fit_analytic
from ballu_mjx.residuals.network import NetworkResidual
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_input import num_inputs, recorded_inputs
from ballu_mjx.residuals.network_loads import num_loads
from ballu_mjx.residuals.network_mirror import network_mirror
from ballu_mjx.rl import ppo
from ballu_mjx.rl.resume_point import ResumePoint
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs.checkpoints import Checkpoint
from ballu_mjx.sim.force_sets import ForceSet
from ballu_mjx.sim.observation import HISTORY
from ballu_mjx.sim.residual import Residual
from ballu_mjx.sim.simulator import Simulator

BALLU = load_robot()
NETWORK = ppo.PPOConfig(policy_layers=(16, 8))
SIGNS = np.array([1.0, -1.0, 1.0])
STATES = HISTORY + 3
"""Number of states of a motion."""


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator(BALLU)


def mirrored(motion: Motion, model: mujoco.MjModel) -> Motion:
    """Return the mirror image about the xz plane. All of BALLU's joints turn about y axes, so they keep their signs."""
    places = {model.joint(i).name: i for i in range(model.njnt)}
    swapped = [places[name.replace("left", "RIGHT").replace("right", "left").lower()] for name in list(places)[1:]]
    hinges = np.array(swapped) - 1
    qpos, qvel = motion.qpos.copy(), motion.qvel.copy()
    qpos[:, 1] *= -1
    qpos[:, [4, 6]] *= -1
    qvel[:, :3] *= SIGNS
    qvel[:, 3:6] *= -SIGNS
    qpos[:, 7:], qvel[:, 6:] = motion.qpos[:, 7 + hinges], motion.qvel[:, 6 + hinges]
    return dataclasses.replace(motion, qpos=qpos, qvel=qvel, command=motion.command[:, ::-1])


@pytest.fixture(scope="module")
def motion(simulator: Simulator) -> Motion:
    """A tumbling robot: nothing about it is symmetric."""
    rng = np.random.default_rng(0)
    model = simulator.mj_model
    qpos = np.tile(model.key_qpos[0] if model.nkey else model.qpos0, (STATES, 1))
    qpos[:, :3] += rng.normal(size=(STATES, 3))
    qpos[:, 3:7] = rng.normal([1.0, 0.0, 0.0, 1.0], 0.3, (STATES, 4))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    qpos[:, 7:] += 0.2 * rng.normal(size=qpos[:, 7:].shape)
    qvel = rng.normal(size=(STATES, model.nv))
    low, high = np.array(BALLU.command_ranges).T
    command = rng.uniform(low, high, (STATES - 1, len(BALLU.commands)))
    return Motion("tumble", np.arange(STATES) * BALLU.control_timestep, command, qpos, qvel, {})


def loads(simulator: Simulator, motion: Motion, config: ForceNetworkConfig) -> Any:
    """Return the action (world frame) of a random symmetric network after the first control steps of a motion."""
    mirror = network_mirror(config, BALLU)
    assert mirror is not None
    sizes = num_inputs(config, BALLU), num_loads(config, BALLU), NETWORK, mirror
    params = ppo.initial_policy(np.random.default_rng(0).normal(size=(50, sizes[0])), *sizes[1:])
    policy: Any = jax.device_get(params.policy)
    policy["params"]["Dense_0"]["kernel"] = 100.0 * policy["params"]["Dense_0"]["kernel"]
    model = NetworkResidual(config, BALLU, ppo.make_inference(*sizes))
    reference, _ = stack_motions(simulator, [motion])
    acts = model.act(params._replace(policy=policy), reference.features[0, :HISTORY], reference.command[0, :HISTORY])
    return jax.device_get(acts)


@pytest.mark.parametrize("forces", ["force", "wrench", "multi", "commands"])
@pytest.mark.parametrize("options", [{}, {"heading_frame": False, "observe_command": False}], ids=["heading", "world"])
def test_a_mirrored_motion_has_the_mirrored_loads(
    simulator: Simulator, motion: Motion, forces: ForceSet, options: dict[str, Any]
):
    scales = (0.1,) * 2 if forces == "commands" else ()
    config = ForceNetworkConfig(
        forces, force_limit=10.0, force_scale=1.0, torque_scale=0.1, scales=scales, mirror=True, **options
    )
    one = loads(simulator, motion, config)
    other = loads(simulator, mirrored(motion, simulator.mj_model), config)
    body = np.array(one.wrench)
    if one.command_change is None:
        body = body[[0, 1, 3, 2]] if forces == "multi" else body  # balloon, base, feet
        assert np.abs(body[:, 1]).max() > 0.01
        np.testing.assert_allclose(other.wrench, body * [*SIGNS, *-SIGNS], atol=1e-4)
    else:
        assert np.ptp(one.command_change) > 1e-3
        np.testing.assert_allclose(other.command_change, one.command_change[::-1], atol=1e-5)


class Scores(Evaluators):
    """Evaluators that simulate nothing, and return the same score for all parameters."""

    def of(self, residual: Residual, motions: Sequence[Motion]) -> Any:
        return lambda params: SimpleNamespace(score=1.0)


@pytest.mark.parametrize("method", ["envmimic", "analytic"])
def test_mirrored_motions_are_in_the_training_range(
    simulator: Simulator, motion: Motion, method: str, monkeypatch: pytest.MonkeyPatch
):
    """The loads of a symmetric network act on them, although its loads fade outside of the range."""
    options = {"forces": "force", "force_scale": 0.05, "force_limit": 1.0, "expected_loads": (0.0,), "force_cost": 1.0}
    config = EnvMimicConfig(**options, mirror=True, fade_width=0.5)  # pyright: ignore[reportArgumentType]
    reference, _ = stack_motions(simulator, [mirrored(motion, simulator.mj_model)])
    images = recorded_inputs(reference, config, BALLU)
    if method == "envmimic":
        observed = EnvMimicEnv(simulator, [motion], config).observed
        alone = EnvMimicEnv(simulator, [motion], dataclasses.replace(config, mirror=False)).observed
        assert all(alone.excess(image) > 0.5 for image in images)
    else:
        monkeypatch.setattr(force_gradients, "train", lambda *arguments: None)
        seconds = 2 * BALLU.control_timestep
        fit = AnalyticConfig(window_seconds=seconds, interval_seconds=seconds)
        observed = fit_analytic(simulator, [motion], fit, forces=config, evaluators=Scores(simulator)).observed
    assert all(observed.excess(image) == 0.0 for image in images)


def test_mirror_images_that_cannot_be_are_refused():
    assert network_mirror(ForceNetworkConfig(), BALLU) is None
    with pytest.raises(InputError, match='add "mirror" to'):
        network_mirror(ForceNetworkConfig(mirror=True), dataclasses.replace(BALLU, mirror=None))
    with pytest.raises(InputError, match="signs of mirrored joints"):
        network_mirror(ForceNetworkConfig("joints", mirror=True), BALLU)


def test_a_resumed_training_keeps_its_symmetry():
    config = ForceNetworkConfig("force", mirror=True)
    sizes = num_inputs(config, BALLU), num_loads(config, BALLU), NETWORK
    params = ppo.initial_policy(np.zeros((1, sizes[0])), *sizes[1:], network_mirror(config, BALLU))
    start = ResumePoint(Path("runs/earlier"), Checkpoint(0, ppo.as_tree(params), None, {}))
    check_resumes(start, EnvMimicConfig("force", mirror=True), BALLU)
    with pytest.raises(InputError, match="runs/earlier: .*another --mirror"):
        check_resumes(start, EnvMimicConfig("force"), BALLU)
    with pytest.raises(InputError, match="runs/earlier: .*other --forces"):
        check_resumes(start, EnvMimicConfig("wrench", mirror=True), BALLU)
