"""Simulated recordings of the tethered balloon, a small robot whose programs compile in seconds."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from simulated_motion import simulate_motion

from ballu_mjx.recordings.motion import Motion
from ballu_mjx.robots.description import RobotDescription, read_description

FOLDER = Path(__file__).parents[1] / "experiments" / "tethered_balloon"
ROBOT = read_description(FOLDER / "balloon.robot.json")
PUSH = np.array([0.02, -0.03, 0.015])
"""Force on the balloon (N, world frame)."""
STEPS = 60
"""Number of control steps of a flight."""


def flight(robot: RobotDescription = ROBOT, push: np.ndarray = PUSH, added_mass: float = 0.0, seed: int = 0) -> Motion:
    """Simulate the balloon in C MuJoCo under random commands.

    - `push`: force on the balloon (N, world frame).
    - `added_mass`: mass (kg) of air that moves with the balloon. It has no weight.
    """
    model, rng = robot.load_model(), np.random.default_rng(seed)
    body = model.body("balloon").id
    lift = model.body_gravcomp[body] * model.body_mass[body] + added_mass
    model.body_mass[body] += added_mass
    model.body_gravcomp[body] = lift / model.body_mass[body]
    data = mujoco.MjData(model)
    data.xfrc_applied[body, :3] = push
    low, high = np.array(robot.command_ranges).T
    command = low + (high - low) * np.repeat(rng.uniform(size=(STEPS // 5, 2)), 5, axis=0)
    return simulate_motion(f"flight-{seed}", model, data, command, robot.control_timestep)
