"""Identification of a robot's actuators from suspended recordings, by whatever method its adapter has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.adapter import IdentificationProgress, IdentifiedActuators
from ballu_mjx.robots.description import RobotDescription


def identify_actuators(
    recordings: Sequence[Recording] | Mapping[Path, Recording],
    robot: RobotDescription,
    config: Any = None,
    *,
    levels: int | None = None,
    progress: IdentificationProgress | None = None,
) -> IdentifiedActuators:
    """Identify the actuators of `robot`.

    **Arguments**

    - `recordings`: suspended recordings of one robot; by file, where errors shall name these.
    - `config`: of the method (for BALLU `ballu.leg_parameters.IdentificationConfig`); None: its defaults.
    - `levels`: fewest command levels of each actuator; None: the method's own.
    - `progress`: is told of every iteration.

    **Raises** `InputError` where the recordings cannot be used, or the robot's adapter identifies nothing.
    """
    by_file = recordings if isinstance(recordings, Mapping) else {Path(each.name): each for each in recordings}
    if not by_file:
        raise InputError("There are no suspended recordings to identify actuators from; give some.")
    return robot.adapter.identify_actuators(robot, by_file, config, levels, progress)
