"""Virtual robots on which unimproved policies do about as badly as the paper's did on its hardware.

On the robots of `robot.draw_robot`, every policy walks several metres in 24 s. The paper's baselines moved 0.3 to 0.6 m
forward, over 0.6 to 1.2 m in total, and turned left (Sontakke et al. 2023, Table I). The robots of this module have the
actuators of `draw_robot`, and these differences:

- Lift: 0.77 to 0.78 of the weight, instead of 0.83 to 0.85. It is set by the baselines' distances in Table I: 0.27 to
  0.56 m along x, and 0.60 to 1.24 m in total.
- Friction of the right foot: 0.2 to 0.3, with 0.9 to 1.0 of the left one. It is set by the ratio of these distances,
  and by "turn left significantly" in the text.
- Offset of the balloons: to the right, because the turn is to the left.
- Drag: 0.3 N at 1 m/s, instead of 0.26. It is set by a public control script for BALLU, F = -0.3 v abs(v).
- Actuators: unchanged. No figure was used.

The first two were set with policies that were trained for the robots 0 and 1 of `draw_robot`, in vanilla+sysid,
vanilla+dr and vanilla+sysid+dr. No residual was learned on these robots before the values were set.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ballu_mjx.ballu.virtual.robot import VirtualRobot, draw_robot

_SEMI_AXES = (0.366, 0.388, 0.410)
"""Semi-axes (m) of the displaced air: those of `draw_robot`, enlarged until drag along x is 0.3 N at 1 m/s."""


def draw_paper_robot(seed: int) -> VirtualRobot:
    """Draw one robot of the family. It has the actuators, added mass and latency of `draw_robot(seed)`."""
    rng = np.random.default_rng([seed, 4])
    drawn = draw_robot(seed)
    fore, side, up = drawn.balloon_offset
    return dataclasses.replace(
        drawn,
        name=f"paper-ballu-{seed}",
        buoyancy=float(rng.uniform(0.77, 0.78)),
        foot_friction=(float(rng.uniform(0.9, 1.0)), float(rng.uniform(0.2, 0.3))),
        balloon_offset=(fore, -abs(side), up),
        balloon_semi_axes=_SEMI_AXES,
    )
