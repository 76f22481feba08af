"""The defaults of the residual methods on robots for which they were not chosen, with forces that are known."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest
from experiment_modules import EXPERIMENTS, experiment_module
from simulated_motion import simulate_motion

from ballu_mjx.evaluation.open_loop import evaluate
from ballu_mjx.recordings.csv_format import list_recordings, read_recording
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct_for_simulator
from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.residuals.envmimic_training import train_envmimic
from ballu_mjx.residuals.force_regression import SupervisedConfig
from ballu_mjx.residuals.force_training import fit_analytic, fit_supervised
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.sim.simulator import Simulator

pytestmark = pytest.mark.slow

FRICTION = 0.25, 0.19
"""Dry friction of shoulder and elbow (N m), which the pendulum's model lacks."""


@pytest.fixture(scope="module")
def tethered() -> Iterator[ModuleType]:
    with experiment_module(EXPERIMENTS / "tethered_balloon" / "tethered_balloon.py") as module:
        yield module


def swing(robot: RobotDescription, seed: int, steps: int = 300) -> Motion:
    """Simulate the double pendulum with friction in C MuJoCo, under random torques."""
    model, rng = robot.load_model(), np.random.default_rng(seed)
    model.dof_frictionloss[:] = FRICTION
    model.opt.iterations = 50
    data = mujoco.MjData(model)
    data.qpos[:] = rng.uniform(-0.5, 0.5, 2)
    command = 0.5 + 0.03 * np.repeat(rng.uniform(-1, 1, (steps // 20, 2)), 20, axis=0)
    return simulate_motion(f"swing-{seed}", model, data, command, robot.control_timestep)


def test_envmimic_learns_the_wind_on_a_tethered_balloon(tethered: ModuleType, tmp_path: Path):
    robot = read_description(tethered.DESCRIPTION)
    tethered.record_all(robot, tmp_path, quick=False)
    simulator = Simulator(robot)
    motions = {
        use: [
            reconstruct_for_simulator(read_recording(path, robot), simulator)
            for path in list_recordings([tmp_path / use])
        ]
        for use in ("training", "validation")
    }
    learned = train_envmimic(
        simulator,
        motions["training"],
        ppo_config=PPOConfig(num_timesteps=1_200_000),
        validation=motions["validation"],
        validate_every=200_000,
    )
    assert evaluate(simulator.with_residual(learned), motions["validation"]).score < 0.5


@pytest.fixture(scope="module")
def pendulum() -> Simulator:
    return Simulator(read_description(EXPERIMENTS / "real" / "double_pendulum" / "double_pendulum.robot.json"))


@pytest.fixture(scope="module")
def swings(pendulum: Simulator) -> list[Motion]:
    return [swing(pendulum.robot, seed) for seed in range(8)]


def test_envmimic_starts_with_a_regression_and_does_not_lose_it(pendulum: Simulator, swings: list[Motion]):
    """Dry friction changes sign with the velocity. Regression with much noise on its input cannot learn it."""
    uses: dict[str, Any] = {"motions": swings[:6], "validation": swings[6:]}
    supervised = fit_supervised(pendulum, forces="joints", **uses)
    noisy = fit_supervised(pendulum, config=SupervisedConfig(observation_noise=(1.0,)), forces="joints", **uses)
    learned = train_envmimic(
        pendulum,
        config=EnvMimicConfig(forces="joints"),
        ppo_config=PPOConfig(num_timesteps=100_000),
        validate_every=20_000,
        start_from=supervised,
        **uses,
    )
    regression, much_noise = (evaluate(pendulum.with_residual(each), swings[6:]).score for each in (supervised, noisy))
    assert regression < 0.5 and regression < 0.9 * much_noise
    assert evaluate(pendulum.with_residual(learned), swings[6:]).score < 1.01 * regression


def test_gradients_learn_the_friction_of_a_double_pendulum(pendulum: Simulator, swings: list[Motion]):
    simulator, motions = pendulum, swings
    learned = fit_analytic(simulator, motions[:6], forces="joints", validation=motions[6:])
    assert evaluate(simulator.with_residual(learned), motions[6:]).score < 0.5
