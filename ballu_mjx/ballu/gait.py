"""Steps of a gait: which feet are planted, and how often another one is."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from ballu_mjx.ballu.model import CONTROL_TIMESTEP

_HEIGHT, _SPEED = 0.012, 0.1
"""A planted foot's greatest height (m) and horizontal speed (m/s)."""


def planted_feet(feet: Float[np.ndarray, "T 2 3"]) -> Bool[np.ndarray, "T 2"]:
    """Whether each foot is near the floor and at rest, for a swinging foot may graze the floor.

    **Arguments** `feet`: positions (m, world) of left and right foot at the control rate, two states or more.
    """
    speed = np.linalg.norm(np.gradient(feet[..., :2], CONTROL_TIMESTEP, axis=0), axis=-1)
    return (feet[..., 2] < _HEIGHT) & (speed < _SPEED)


def count_steps(feet: Float[np.ndarray, "T 2 3"]) -> Int[np.ndarray, " T"]:
    """Return how often a foot has stood alone after the other one did, by each state.

    0 of a robot that rests, slides, hops or flies. Arguments as of `planted_feet`.
    """
    down = planted_feet(feet)
    alone = np.flatnonzero(down[:, 0] != down[:, 1])
    steps = np.zeros(len(feet), int)
    steps[alone[1:]] = np.diff(down[alone, 1].astype(int)) != 0
    return np.cumsum(steps)
