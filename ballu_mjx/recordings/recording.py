"""The recording of a robot's motion: commands, places, orientations and joint angles over time.

A robot's description says which columns its recordings have. The file format is `csv_format`'s.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Float

from ballu_mjx.robots.description import RobotDescription

Kind = Literal["free", "suspended"]
Split = Literal["training", "validation", "test", "suspended"]
Quantity = Literal["time", "command", "position", "quaternion", "angle"]

Column = Float[np.ndarray, " T"]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """One recording of a robot, T samples. World frame (z up), SI units, radians.

    `read_recording` promises: time strictly increasing, no missing values, quaternions of unit length and continuous
    in sign. A recording that is to be written may hold NaN for missing samples.
    """

    name: str
    kind: Kind
    """free: the robot moves about. suspended: its root is held, and joint angles alone must be recorded."""
    robot: str
    """Which specimen was recorded."""
    notes: str = ""
    time: Float[np.ndarray, " T"]
    """s, from any origin."""
    command: Float[np.ndarray, "T commands"]
    """In the units of the description's actuators, held until the next sample."""
    tracked_position: Float[np.ndarray, "T 3"] | None = None
    """m, of the tracked site. None only in suspended recordings, as is the orientation."""
    tracked_quaternion: Float[np.ndarray, "T 4"] | None = None
    """w, x, y, z: the tracked site's body in the world."""
    points: Mapping[str, Float[np.ndarray, "T 3"]] = dataclasses.field(default_factory=dict)
    """m, by site: all of the description's, but in suspended recordings."""
    orientations: Mapping[str, Float[np.ndarray, "T 4"]] = dataclasses.field(default_factory=dict)
    """w, x, y, z, by site: of some of the description's `oriented_points`."""
    joint_angles: Mapping[str, Float[np.ndarray, " T"]] = dataclasses.field(default_factory=dict)
    """rad (hinges) or m (slides), by joint: of some of the description's, of all in suspended recordings."""
    interpolated: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Samples filled in, by column; columns without any are left out."""
    held: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Samples that repeat the one before, and so were not seen, by site; sites without any are left out."""
    trimmed: tuple[int, int] = (0, 0)
    """Rows cut off the file's start and end, where some column has a gap with a sample on one side only."""


def cut(recording: Recording, rows: slice) -> Recording:
    """Return the samples in `rows`."""

    def some(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {name: value[rows] for name, value in values.items()}

    position, quaternion = recording.tracked_position, recording.tracked_quaternion
    return dataclasses.replace(
        recording,
        time=recording.time[rows],
        command=recording.command[rows],
        tracked_position=None if position is None else position[rows],
        tracked_quaternion=None if quaternion is None else quaternion[rows],
        points=some(recording.points),
        orientations=some(recording.orientations),
        joint_angles=some(recording.joint_angles),
    )


# ---- columns ----


@dataclasses.dataclass(frozen=True)
class ColumnGroup:
    """Columns that a file holds together or not at all."""

    quantity: Quantity
    part: str
    """The site or joint; empty for time and commands."""
    names: tuple[str, ...]
    mandatory: tuple[Kind, ...]
    """Kinds of recordings that need them."""


def column_groups(robot: RobotDescription) -> tuple[ColumnGroup, ...]:
    """Return all columns that recordings of `robot` may have, in the order in which they are written."""

    def position(site: str) -> ColumnGroup:
        return ColumnGroup("position", site, tuple(f"{site}_{axis}" for axis in "xyz"), ("free",))

    def quaternion(site: str, *mandatory: Kind) -> ColumnGroup:
        return ColumnGroup("quaternion", site, tuple(f"{site}_q{axis}" for axis in "wxyz"), mandatory)

    groups = [
        ColumnGroup("time", "", ("time",), ("free", "suspended")),
        ColumnGroup("command", "", tuple(f"command_{name}" for name in robot.commands), ("free", "suspended")),
        position(robot.tracked),
        quaternion(robot.tracked, "free"),
    ]
    for point in robot.points:
        groups.append(position(point))
        if point in robot.oriented_points:
            groups.append(quaternion(point))
    groups += [ColumnGroup("angle", joint, (joint,), ("suspended",)) for joint in robot.joints]
    return tuple(groups)


def values_of(
    recording: Recording, group: ColumnGroup, robot: RobotDescription
) -> Float[np.ndarray, "T columns"] | None:
    """Return a group's columns; None where the recording does not hold them."""
    tracked = group.part == robot.tracked
    if group.quantity == "position":
        return recording.tracked_position if tracked else recording.points.get(group.part)
    if group.quantity == "quaternion":
        return recording.tracked_quaternion if tracked else recording.orientations.get(group.part)
    if group.quantity == "command":
        return recording.command
    column = recording.time if group.quantity == "time" else recording.joint_angles.get(group.part)
    return None if column is None else column[:, None]
