"""Recordings of a robot's motion: commands, positions, orientations and joint angles over time.

The robot's description defines which columns its recordings have. `csv_format` defines the file format.
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
    """A recording of a robot with T samples, in the world frame (z up), in SI units and radians.

    A recording from `read_recording` has strictly increasing times, no missing values, and unit quaternions without
    jumps of sign. The angles of its hinges without a range do not restart each turn. A recording to be written may hold
    NaN for missing samples.
    """

    name: str
    """Name. For a recording from a file, the file's name without its extension."""
    kind: Kind
    """free: the robot moves. suspended: its root is held. A suspended recording needs no position or orientation."""
    robot: str
    """Specimen that was recorded."""
    notes: str = ""
    time: Float[np.ndarray, " T"]
    """Times (s) from any origin."""
    command: Float[np.ndarray, "T commands"]
    """Commands in the units of the description's actuators. Each is held until the next sample."""
    tracked_position: Float[np.ndarray, "T 3"] | None = None
    """Positions of the tracked site (m). None only in suspended recordings."""
    tracked_quaternion: Float[np.ndarray, "T 4"] | None = None
    """Orientations (w, x, y, z) of the tracked site's body. None only in suspended recordings."""
    points: Mapping[str, Float[np.ndarray, "T 3"]] = dataclasses.field(default_factory=dict)
    """Positions of points (m), by site. Free recordings hold all points of the description."""
    orientations: Mapping[str, Float[np.ndarray, "T 4"]] = dataclasses.field(default_factory=dict)
    """Orientations (w, x, y, z) of some of the description's `oriented_points`, by site."""
    joint_angles: Mapping[str, Float[np.ndarray, " T"]] = dataclasses.field(default_factory=dict)
    """Angles of hinges (rad) and displacements of slides (m), by joint. Free recordings hold some of the description's
    joints, suspended recordings all."""
    interpolated: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Number of interpolated samples, by column. Columns without any are left out."""
    held: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Number of samples that repeat the one before, so they were not seen, by site. Sites without any are left out."""
    trimmed: tuple[int, int] = (0, 0)
    """Number of rows cut off at the file's start and at its end, where a column has no sample."""


def cut(recording: Recording, rows: slice) -> Recording:
    """Return the recording with only the samples in `rows`."""

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
    """Columns of which a file holds all or none."""

    quantity: Quantity
    part: str
    """Site or joint of the columns. Empty for time and commands."""
    names: tuple[str, ...]
    mandatory: tuple[Kind, ...]
    """Kinds of recordings that must have these columns."""


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
    """Return the values of a column group, or None if the recording does not hold it."""
    tracked = group.part == robot.tracked
    if group.quantity == "position":
        return recording.tracked_position if tracked else recording.points.get(group.part)
    if group.quantity == "quaternion":
        return recording.tracked_quaternion if tracked else recording.orientations.get(group.part)
    if group.quantity == "command":
        return recording.command
    column = recording.time if group.quantity == "time" else recording.joint_angles.get(group.part)
    return None if column is None else column[:, None]
