"""What a locomotion task is: a name, a reward, and how long a trial of it lasts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Array, Float


class Step(NamedTuple):
    """One control step, as rewards see it (world frame: x forward, y left, z up)."""

    velocity: Float[Array, " 3"]
    """Of the centre of mass, mean over the control step (m/s)."""
    features: Float[Array, " features"]
    """`observation.observe_features` at the step's end."""
    command: Float[Array, " commands"]
    """Commands, in the actuators' units."""


@dataclasses.dataclass(frozen=True)
class Task:
    """What a policy is trained for. `reward` is pure, per control step, and of the order of 0.1 m/s."""

    name: str
    """The subcommand of `python -m ballu_mjx.train`."""
    summary: str
    """One line for its help."""
    reward: Callable[[Step], Float[Array, ""]]
    trial_seconds: float
    """Length of a trial on the robot (s)."""
