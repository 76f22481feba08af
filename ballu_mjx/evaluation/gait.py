"""Steps of a gait: which feet are planted, and how often another one is."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from ballu_mjx.robots.model import CONTROL_TIMESTEP

_HEIGHT, _SPEED = 0.012, 0.1
"""A planted foot's greatest height (m) and horizontal speed (m/s)."""


def planted_feet(feet: Float[np.ndarray, "T 2 3"]) -> Bool[np.ndarray, "T 2"]:
    """Whether each foot is near the floor and at rest, for a swinging foot may graze the floor.

    **Arguments** `feet`: positions (m, world) of left and right foot at the control rate, two states or more.
    """
    speed = np.linalg.norm(np.gradient(feet[..., :2], CONTROL_TIMESTEP, axis=0), axis=-1)
    return (feet[..., 2] < _HEIGHT) & (speed < _SPEED)


def count_steps(feet: Float[np.ndarray, "T 2 3"]) -> int:
    """How often a foot stands alone after the other one did: 0 of a robot that rests, slides, hops or flies.

    **Arguments** as of `planted`.
    """
    down = planted_feet(feet)
    alone = np.flatnonzero(down[:, 0] != down[:, 1])
    return int(np.count_nonzero(np.diff(down[alone, 1].astype(int))))
