"""Detection of steps: which feet are planted, and how often the planted foot changes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from ballu_mjx.ballu.model import CONTROL_TIMESTEP

_HEIGHT, _SPEED = 0.012, 0.1
"""Upper bounds of a planted foot's height (m) and horizontal speed (m/s)."""


def planted_feet(feet: Float[np.ndarray, "T 2 3"]) -> Bool[np.ndarray, "T 2"]:
    """Return whether each foot is planted: near the floor and at rest.

    The height alone does not suffice, because a swinging foot may graze the floor.

    **Arguments** `feet`: positions (m, world frame) of the left and the right foot at the control rate, in two or more
    states.
    """
    speed = np.linalg.norm(np.gradient(feet[..., :2], CONTROL_TIMESTEP, axis=0), axis=-1)
    return (feet[..., 2] < _HEIGHT) & (speed < _SPEED)


def count_steps(feet: Float[np.ndarray, "T 2 3"]) -> Int[np.ndarray, " T"]:
    """Return the number of steps up to each state.

    A step counts when one foot alone is planted after the other foot alone was. The number is therefore 0 for a robot
    that rests, slides, hops or flies. The argument is that of `planted_feet`.
    """
    down = planted_feet(feet)
    alone = np.flatnonzero(down[:, 0] != down[:, 1])
    steps = np.zeros(len(feet), int)
    steps[alone[1:]] = np.diff(down[alone, 1].astype(int)) != 0
    return np.cumsum(steps)
