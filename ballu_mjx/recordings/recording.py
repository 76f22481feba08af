"""The recording of a robot's motion: commands, places, orientation and joint angles over time."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.model import SIDES
from ballu_mjx.robots.description import RobotDescription

Kind = Literal["free", "suspended"]
Split = Literal["training", "validation", "test", "suspended"]
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "time": ("time",),
    "command": ("command_left", "command_right"),
    "balloon_position": tuple(f"balloon_{axis}" for axis in "xyz"),
    "balloon_quaternion": tuple(f"balloon_q{axis}" for axis in "wxyz"),
    "base_position": tuple(f"base_{axis}" for axis in "xyz"),
    "base_quaternion": tuple(f"base_q{axis}" for axis in "wxyz"),
    "foot_position": tuple(f"foot_{side}_{axis}" for side in SIDES for axis in "xyz"),
    "motor": tuple(f"motor_{side}" for side in SIDES),
    "knee": tuple(f"knee_{side}" for side in SIDES),
}
"""Columns of BALLU's recordings by field of `Recording`, in the order in which they are written."""

POSITIONS = ("balloon_position", "base_position", "foot_position")
QUATERNIONS = ("balloon_quaternion", "base_quaternion")
ANGLES = ("motor", "knee")
MANDATORY = {
    "free": ("time", "command", "balloon_position", "balloon_quaternion", "base_position", "foot_position"),
    "suspended": ("time", "command", "motor", "knee"),
}

Column = Float[np.ndarray, " T"]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """One recording, T samples. World frame, SI units, radians; pairs are (left, right).

    Of robots that are not built like BALLU, base, feet, motors and knees are None: their parts stand in `points` and
    `angles`.

    `read_recording` promises: time strictly increasing, no missing values, quaternions of unit length and continuous
    in sign. A recording that is to be written may hold NaN for missing samples.
    """

    name: str
    kind: Kind
    robot: str
    """Which robot was recorded."""
    notes: str = ""
    time: Float[np.ndarray, " T"]
    """s, from any origin."""
    command: Float[np.ndarray, "T commands"]
    """In [0, 1], held until the next sample."""
    balloon_position: Float[np.ndarray, "T 3"] | None
    """m, the model's site `balloon` (the tracked one). None only in suspended recordings, as are base and feet."""
    balloon_quaternion: Float[np.ndarray, "T 4"] | None
    """w, x, y, z: the balloon's frame in the world."""
    base_position: Float[np.ndarray, "T 3"] | None
    """m, the model's site `base`."""
    base_quaternion: Float[np.ndarray, "T 4"] | None = None
    """w, x, y, z."""
    foot_position: Float[np.ndarray, "T 2 3"] | None
    """m, centres of the foot spheres."""
    motor: Float[np.ndarray, "T 2"] | None = None
    """rad."""
    knee: Float[np.ndarray, "T 2"] | None = None
    """rad."""
    points: Mapping[str, Float[np.ndarray, "T 3"]] = dataclasses.field(default_factory=dict)
    """m, by site."""
    angles: Mapping[str, Float[np.ndarray, " T"]] = dataclasses.field(default_factory=dict)
    """rad (hinges) or m (slides), by joint."""
    interpolated: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Samples filled in, by column; columns without any are left out."""
    trimmed: tuple[int, int] = (0, 0)
    """Rows cut off the file's start and end, where some column has a gap with a sample on one side only."""


# ---- robots ----

POINT, ANGLE = "point ", "angle "
"""What the fields of other robots' points and joints begin with."""


@dataclasses.dataclass(frozen=True)
class ColumnLayout:
    """Columns by field, and which fields are what: those of BALLU, or of another robot's description."""

    columns: Mapping[str, tuple[str, ...]]
    mandatory: Mapping[str, tuple[str, ...]]
    positions: tuple[str, ...]
    angles: tuple[str, ...]
    points: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()


def column_layout(robot: RobotDescription | None) -> ColumnLayout:
    if robot is None or robot.is_ballu:
        return ColumnLayout(COLUMNS, MANDATORY, POSITIONS, ANGLES)
    columns = {
        "time": ("time",),
        "command": tuple(f"command_{name}" for name in robot.commands),
        "balloon_position": tuple(f"{robot.tracked}_{axis}" for axis in "xyz"),
        "balloon_quaternion": tuple(f"{robot.tracked}_q{axis}" for axis in "wxyz"),
    }
    columns |= {POINT + name: tuple(f"{name}_{axis}" for axis in "xyz") for name in robot.points}
    mandatory = {"free": tuple(columns)}
    columns |= {ANGLE + name: (name,) for name in robot.joints}
    positions = ("balloon_position", *(POINT + name for name in robot.points))
    return ColumnLayout(
        columns, mandatory, positions, tuple(ANGLE + name for name in robot.joints), robot.points, robot.joints
    )
