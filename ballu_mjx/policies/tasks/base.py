"""Definition of a locomotion task: its name, its reward, and the duration of a trial."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Array, Float


class Step(NamedTuple):
    """One control step, the input of a reward (world frame: x forward, y left, z up)."""

    velocity: Float[Array, " 3"]
    """Mean velocity of the centre of mass over the control step (m/s)."""
    features: Float[Array, " features"]
    """Features (`observation.observe_features`) at the end of the step."""
    command: Float[Array, " commands"]
    """Commands, in the actuators' units."""


def mean_velocity(before: Float[Array, " 3"], after: Float[Array, " 3"], control_timestep: float) -> Float[Array, " 3"]:
    """Return the mean velocity of the centre of mass over a control step (m/s), from its places (m) before and after.

    Rewards are this velocity along a task's direction (paper, section "Policy Training with Improved Simulation").
    """
    return (after - before) / control_timestep


@dataclasses.dataclass(frozen=True)
class Task:
    """A task for which a policy is trained.

    `reward` is a pure function of one control step. Its values are of the order of 0.1 m/s.
    """

    name: str
    """Name of the task, and of its subcommand of `python -m ballu_mjx.train`."""
    summary: str
    """One-line description in the subcommand's help."""
    reward: Callable[[Step], Float[Array, ""]]
    trial_seconds: float
    """Duration of a trial on the robot (s)."""
