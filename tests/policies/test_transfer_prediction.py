"""Prediction of a policy's transfer: its motion in other simulators of the robot."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from plain_push import PlainPush
from rover import write_rover

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.locomotion_env import num_observations
from ballu_mjx.policies.policy import Policy
from ballu_mjx.policies.tasks import TASKS
from ballu_mjx.policies.transfer_prediction import (
    TransferPredictor,
    predict_com_errors,
    read_prediction,
    write_prediction,
)
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.residual import BoundResidual
from ballu_mjx.sim.simulator import Simulator


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Policy:
    robot = write_rover(tmp_path_factory.mktemp("rover"))
    config, size = PPOConfig(policy_layers=(8,), value_layers=(4,)), num_observations(robot)
    inputs = np.random.default_rng(0).normal(size=(64, size)).astype(np.float32)
    return Policy(
        task=dataclasses.replace(TASKS["walk"], trial_seconds=4.0),
        config=LocomotionConfig(),
        robot=robot,
        actuators=None,
        residual=None,
        network=config,
        params=ppo.initial_policy(inputs, len(robot.commands), config),
        infer=ppo.make_inference(size, len(robot.commands), config),
        step=0,
    )


@pytest.mark.slow
def test_a_policy_moves_as_expected_in_its_own_simulator_and_otherwise_in_a_pushed_one(policy: Policy) -> None:
    plain = Simulator(policy.robot)
    push = BoundResidual(PlainPush(), jnp.asarray(20.0), None)  # friction holds about 12 N
    found = TransferPredictor({"same": plain, "pushed": plain.with_residual(push)}, starts=2).predict(policy)
    assert found["same"].com_error < 1e-4
    moved = found["pushed"].x_distance - found["same"].x_distance
    assert moved > 1.0
    # The distance grows from 0 to `moved`, so that its mean over time is between the two.
    assert 0.1 * moved < found["pushed"].com_error < moved
    assert found["same"].outside == 0.0


@pytest.mark.slow
def test_predicted_errors_combine_the_distance_to_the_best_simulator_with_its_error(
    policy: Policy, tmp_path: Path
) -> None:
    """The reference is the simulator with the smallest error. A policy trained in it differs from it by nothing."""
    plain = Simulator(policy.robot)
    push = BoundResidual(PlainPush(), jnp.asarray(20.0), None)  # friction holds about 12 N
    pushed = dataclasses.replace(policy, residual=push)
    simulators = {"vanilla+sysid": plain, "envmimic": plain.with_residual(push)}
    policies = {"vanilla+sysid": policy, "vanilla+sysid+dr": policy, "envmimic": pushed}
    found = predict_com_errors(policies, simulators, {"vanilla+sysid": 0.8, "envmimic": 0.3}, starts=2)
    assert found.reference == found.best == "envmimic"
    assert found.com_error["envmimic"] == 0.3
    alone = TransferPredictor(simulators, starts=2).predict(policy)["envmimic"].com_error
    assert alone > 0.1
    assert found.com_error["vanilla+sysid"] == pytest.approx(np.sqrt(alone**2 + 0.09), rel=1e-4)
    assert found.com_error["vanilla+sysid+dr"] == found.com_error["vanilla+sysid"]
    write_prediction(tmp_path / "prediction.json", found)
    assert read_prediction(tmp_path / "prediction.json") == found


@pytest.mark.parametrize(
    "content", ["{}", '{"reference": "a", "com_error": {}}', '{"reference": "a", "com_error": {"a": NaN}}']
)
def test_files_without_predicted_errors_are_refused(content: str, tmp_path: Path) -> None:
    path = tmp_path / "prediction.json"
    path.write_text(content)
    with pytest.raises(InputError, match=r"prediction\.json: .*delete its folder"):
        read_prediction(path)


def test_a_simulator_of_another_robot_is_refused(policy: Policy) -> None:
    with pytest.raises(InputError, match="ballu: is of the robot BALLU, not of rover"):
        TransferPredictor({"ballu": Simulator(load_robot())}, starts=1).predict(policy)
