"""Virtual robots outside of the model class that methods fit: another body, soft parts and cables of another law.

These robots have the servos, friction, lift, added mass and latency of `robot.draw_robot`, and these differences:

- Each body's mass is wrong by up to 3 %, and each leg's lengths by up to 1 %, as measured values are.
- The neck also bends about the roll and yaw axes.
- Six balloons wobble on springs. Each has its own added mass, drag, lift and Magnus force. The cluster has no single
  centre, and its added inertia follows from the places of the balloons.
- A cable's force has two slopes. It pulls softly at first, and its stiffness grows from some stretch on.

The values are assumptions. They were set before any method was run on these robots.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from ballu_mjx.ballu.model import load_model
from ballu_mjx.ballu.virtual.flexible_body import FlexibleBody
from ballu_mjx.ballu.virtual.robot import VirtualRobot, draw_pair, draw_robot


def draw_flexible_robot(seed: int) -> VirtualRobot:
    """Draw one robot of the family."""
    rng = np.random.default_rng([seed, 5])
    pair = functools.partial(draw_pair, rng)

    def ratios(error: float, count: int) -> tuple[float, ...]:
        return tuple(1 + float(each) for each in rng.uniform(-error, error, count))

    flexible = FlexibleBody(
        mass_ratio=ratios(0.03, load_model().nbody - 1),
        thigh_ratio=ratios(0.01, 2),
        shank_ratio=ratios(0.01, 2),
        neck_stiffness=pair(2.0, 6.0),
        neck_damping=float(rng.uniform(0.01, 0.05)),
        balloon_frequency=float(rng.uniform(2.0, 3.0)),
        balloon_damping=float(rng.uniform(0.1, 0.3)),
        cable_stiffness=pair(300.0, 800.0),
        cable_toe=pair(0.5e-3, 1.5e-3),
        cable_hardening=pair(1000.0, 3000.0),
    )
    return dataclasses.replace(draw_robot(seed), name=f"flexible-ballu-{seed}", flexible=flexible)
