"""Trials on the virtual robot: the exported controller drives it, with rate limit and time-out."""

from __future__ import annotations

import numpy as np
import pytest

from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.ballu.virtual.trials import ExportedPolicy
from ballu_mjx.policies.deploy.controller import observation_names
from ballu_mjx.policies.deploy.estimator import Capture


def constant_policy(command: float) -> dict[str, np.ndarray]:
    """Return the exported arrays of a policy whose output is the same command for both legs at all times."""
    size = len(observation_names(virtual_robot.NAMES))
    return {
        "names": np.array(virtual_robot.NAMES),
        "commands": np.array(["left", "right"]),
        "anchored": np.array(False),
        "command_low": np.zeros(2),
        "command_high": np.ones(2),
        "command_rest": np.zeros(2),
        "control_timestep": np.array(0.05),
        "full_travel": np.array(0.2),
        "mean": np.zeros(size),
        "std": np.ones(size),
        "observation_clip": np.array(5.0),
        "activation": np.array("tanh"),
        "kernel_0": np.zeros((size, 2)),
        "bias_0": np.full(2, 2 * command - 1),
    }


def test_trials_apply_the_rate_limit_of_the_exported_controller():
    robot, trial = virtual_robot.draw_robot(0), virtual_robot.draw_trial(3)
    controller = ExportedPolicy(constant_policy(0.9))
    recording = virtual_robot.record(robot, trial, controller, 1.0, "trial")
    np.testing.assert_allclose(recording.command[:40:5, 0], [0.25, 0.5, 0.75, 0.9, 0.9, 0.9, 0.9, 0.9], atol=1e-9)
    assert controller.controller.steps == 20 and controller.controller.status == "running"


def test_commands_of_a_policy_that_jumps_change_by_the_rate_limit_at_most():
    stored, rng = constant_policy(0.5), np.random.default_rng(1)
    stored["kernel_0"] = 100.0 * rng.normal(size=stored["kernel_0"].shape)
    controller = ExportedPolicy(stored)
    robot, trial = virtual_robot.draw_robot(0), virtual_robot.draw_trial(3)
    recording = virtual_robot.record(robot, trial, controller, 4.0, "trial")
    changes = np.diff(recording.command[::5], axis=0)
    assert np.abs(changes).max() < 0.25 + 1e-9
    at_limit = np.abs(np.abs(changes) - 0.25) < 1e-9
    assert (at_limit & (changes > 0)).any() and (at_limit & (changes < 0)).any(), "the policy must jump both ways"


@pytest.mark.parametrize("marker", range(len(virtual_robot.NAMES)))
def test_trials_command_rest_after_a_marker_is_lost(marker: int):
    """The controller receives every frame, including the frames between two control steps."""
    controller, rng = ExportedPolicy(constant_policy(1.0)), np.random.default_rng(0)
    capture, commands = Capture(virtual_robot.NAMES), []
    for frame in range(121):
        position = rng.normal(size=(4, 3))
        position[marker] = np.nan if frame > 50 else position[marker]
        capture.time.append(frame * 0.01)
        capture.position.append(position)
        capture.quaternion.append(np.array([1.0, *rng.normal(0, 0.1, 3)]))
        if frame % 5 == 0:
            commands.append(controller(capture))
    assert commands[10].tolist() == [1.0, 1.0] and commands[-1].tolist() == [0.0, 0.0]
