"""Checks of a recording's columns, each with the file, the row and the fix in its message."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Bool
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.model import SIDES
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.recording import COLUMNS, QUATERNIONS, Column, ColumnLayout, Kind, Recording

MINIMUM_RATE = 50.0
"""Hz."""
LONGEST_GAP = 0.5
"""Longest stretch (s) without a sample that is filled in."""
SHORTEST = 1.0
"""Shortest recording (s)."""

# What no BALLU in a room can exceed; all else may be true.
_LARGEST_ANGLE = 3.5  # rad
_LARGEST_DISTANCE = 100.0  # m, along x and y
_HEIGHTS = {"free": (-0.5, 3.0), "suspended": (-0.5, 10.0)}  # m
_LARGEST_STEP, _LARGEST_SPEED = 0.02, 8.0  # m and m/s: noise and motion between two samples, along an axis
_QUATERNION_TOLERANCE = 0.02
_FLOOR_TOLERANCE = 0.1  # m
_SMALLEST_STANCE = 0.02  # m


# ---- files ----


def refuse_recording(
    path: Path, problem: str, mend: str, *, column: str | None = None, row: int | None = None
) -> NoReturn:
    """Raise the sentence; `row` counts samples from 0."""
    place = [str(path)]
    if column is not None:
        place.append(f"column {column}")
    if row is not None:
        place.append(f"row {row + 2}")
    raise InputError(f"{', '.join(place)}: {problem}; {mend}.")


# ---- validation ----


def present_groups(path: Path, columns: dict[str, Column], layout: ColumnLayout, kind: Kind) -> list[str]:
    """Fields of `Recording` that the file holds, each with all its columns."""
    present = []
    for field, names in layout.columns.items():
        missing = [name for name in names if name not in columns]
        if not missing:
            present.append(field)
        elif field in layout.mandatory[kind]:
            refuse_recording(
                path, f"the column is missing, and {kind} recordings need it", "add it", column=missing[0], row=-1
            )
        elif len(missing) < len(names):
            others = ", ".join(name for name in names if name in columns)
            refuse_recording(path, "the column is missing", f"add it or delete {others}", column=missing[0], row=-1)
    return present


def check_time(path: Path, time: Column) -> None:
    row = first_true(np.isnan(time))
    if row is not None:
        refuse_recording(path, "the time is missing", "fill it in or delete the row", column="time", row=row)
    with np.errstate(over="ignore"):
        steps = np.diff(time)
    row = first_true(steps <= 0)
    if row is not None:
        backwards = f"time runs back, from {time[row]:g} to {time[row + 1]:g} s"
        problem = "time stands still" if steps[row] == 0 else backwards
        refuse_recording(path, problem, "sort the rows by time and delete repeated ones", column="time", row=row + 1)
    if len(steps) and np.median(steps) > 1.001 / MINIMUM_RATE:
        rate = 1 / np.median(steps)
        problem = f"{rate:.3g} samples per second are fewer than {MINIMUM_RATE:g}"
        refuse_recording(path, problem, "record faster, or convert to seconds if this is milliseconds", column="time")
    if time[-1] - time[0] < SHORTEST * (1 - 1e-6):
        problem = f"{time[-1] - time[0]:.3g} s are shorter than {SHORTEST:g} s"
        refuse_recording(path, problem, "record longer or leave it out", column="time", row=len(time) - 1)


def check_cells(path: Path, columns: dict[str, Column], layout: ColumnLayout, kind: Kind) -> None:
    """Ranges, steps and lengths that only wrong units or a wrong order explain. NaN passes."""

    def check(name: str, bad: np.ndarray, problem: str, mend: str) -> None:
        row = first_true(bad)
        if row is not None:
            refuse_recording(path, f"{columns[name][row]:g} {problem}", mend, column=name, row=row)

    def held(fields: Iterable[str]) -> list[str]:
        return [name for field in fields for name in layout.columns.get(field, ()) if name in columns]

    for name in layout.columns["command"]:
        value = columns[name]
        row = first_true(np.isnan(value))
        if row is not None:
            refuse_recording(path, "the command is missing", "fill in what was being sent", column=name, row=row)
        most = "90 deg" if layout.columns is COLUMNS else "the most"
        check(
            name, (value < 0) | (value > 1), "is outside 0 to 1", f"scale the commands to 0 for rest and 1 for {most}"
        )
    for name in held(layout.angles):
        mend = "convert degrees to radians"
        check(name, np.abs(columns[name]) > _LARGEST_ANGLE, f"is beyond {_LARGEST_ANGLE:g} rad", mend)
    lowest, highest = _HEIGHTS[kind]
    mend = "convert millimetres to metres, or mend the frame: z up, the floor at 0"
    for name in held(layout.positions):
        if name.endswith("_z"):
            value = columns[name]
            problem = f"m is not a height between {lowest:g} and {highest:g} m"
            check(name, (value < lowest) | (value > highest), problem, mend)
    for name in held(layout.positions):
        far = np.abs(columns[name]) > _LARGEST_DISTANCE
        check(name, far, f"m is farther than {_LARGEST_DISTANCE:g} m", "convert millimetres to metres")
        seen = np.flatnonzero(~np.isnan(columns[name]))
        steps = np.abs(np.diff(columns[name][seen]))
        row = first_true(steps > _LARGEST_STEP + _LARGEST_SPEED * np.diff(columns["time"][seen]))
        if row is not None:
            mend = "convert millimetres to metres, or empty the cells where markers were mixed up"
            problem = f"jumps by {steps[row]:.3g} m, farther than the robot can move between samples"
            refuse_recording(path, problem, mend, column=name, row=int(seen[row + 1]))
    for field in QUATERNIONS:
        names = held([field])
        if names:
            with np.errstate(over="ignore"):
                length = np.linalg.norm(np.stack([columns[name] for name in names], 1), axis=1)
            row = first_true(np.abs(length - 1) > _QUATERNION_TOLERANCE)
            if row is not None:
                problem = f"the quaternion {names[0]} ... {names[-1]} has length {length[row]:.3g} instead of 1"
                refuse_recording(path, problem, "export unit quaternions in w, x, y, z order", column=names[0], row=row)


def check_gaps(
    path: Path, columns: dict[str, Column], groups: list[str], layout: ColumnLayout, kind: Kind
) -> tuple[int, int]:
    """First and last row between which every column can be interpolated."""
    time = columns["time"]
    spacing = float(np.median(np.diff(time)))
    longest = LONGEST_GAP + 1e-6
    step = first_true(np.diff(time) - spacing > longest)
    if step is not None:
        problem = f"rows are missing, {time[step + 1] - time[step]:.3g} s since the row before"
        refuse_recording(path, problem, "cut the recording there", column="time", row=step + 1)
    first, last = 0, len(time) - 1
    for field in groups:
        names = layout.columns[field]
        mend = "cut the recording there"
        if field not in layout.mandatory[kind]:
            mend += f", or delete {', '.join(names)}"
        # A quaternion is seen or missing as a whole, all else column by column.
        for together in [names] if field in QUATERNIONS else [(name,) for name in names]:
            seen = np.flatnonzero(has_sample(columns, together))
            # The time that each gap lacks: from the sample before to the sample after, less one spacing.
            edges = np.concatenate([[time[0] - spacing], time[seen], [time[-1] + spacing]])
            lacking = np.diff(edges) - spacing
            gap = first_true(lacking > longest)
            if gap is not None:
                row = int(seen[gap - 1]) + 1 if gap else 0
                name = next(n for n in together if np.isnan(columns[n][row]))
                problem = f"{lacking[gap]:.3g} s are missing in a row, more than {LONGEST_GAP:g} s"
                refuse_recording(path, problem, mend, column=name, row=row)
            first, last = max(first, int(seen[0])), min(last, int(seen[-1]))
    if time[last] - time[first] < SHORTEST * (1 - 1e-6):
        problem = f"all columns have samples for {max(0.0, time[last] - time[first]):.3g} s only"
        refuse_recording(path, problem, f"record {SHORTEST:g} s or longer", column="time", row=first)
    return first, last


def has_sample(columns: dict[str, Column], names: Iterable[str]) -> Bool[np.ndarray, " T"]:
    return ~np.any([np.isnan(columns[name]) for name in names], axis=0)


def check_frame(path: Path, recording: Recording) -> None:
    """Refuse what at the start is surely not: z up, x forward, y left, the robot on a floor at z = 0."""
    balloon, quaternion = recording.balloon_position, recording.balloon_quaternion
    base, feet = recording.base_position, recording.foot_position
    assert balloon is not None and quaternion is not None and base is not None and feet is not None
    row = recording.trimmed[0]
    if not balloon[0, 2] > base[0, 2] > feet[0, :, 2].max():
        column = "balloon_z" if balloon[0, 2] <= base[0, 2] else "base_z"
        problem = "at the start the balloon is not above the base and the base not above the feet"
        refuse_recording(path, problem, "put the axes in the order x forward, y left, z up", column=column, row=row)
    lowest = feet[:, :, 2].min(axis=0)
    if abs(lowest.min()) > _FLOOR_TOLERANCE:
        side = int(lowest.argmin())
        problem = f"the feet come down to {lowest[side]:.3g} m and not to the floor at 0"
        sample = row + int(feet[:, side, 2].argmin())
        column = f"foot_{SIDES[side]}_z"
        mend = "put the origin of the frame on the floor, or import with floor = 'feet' in the mapping file"
        refuse_recording(path, problem, mend, column=column, row=sample)
    rotation = Rotation.from_quat(quaternion[0], scalar_first=True).as_matrix()
    if rotation[2, 2] < 0 or rotation[0, 0] < 0:
        problem = "at the start the balloon does not stand upright and look forward along x"
        mend = "write the quaternion in w, x, y, z order, in a frame with x forward, y left, z up"
        refuse_recording(path, problem, mend, column="balloon_qw", row=row)
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    apart = feet[0, 0] - feet[0, 1]
    if apart @ np.array([-np.sin(yaw), np.cos(yaw), 0.0]) < _SMALLEST_STANCE:
        problem = "at the start the left foot is not to the left of the right one, seen along the balloon's x"
        mend = "swap the feet, or mend the frame: x forward, y left"
        refuse_recording(path, problem, mend, column="foot_left_y", row=row)


def first_true(bad: np.ndarray) -> int | None:
    """Index of the first true entry."""
    return int(bad.argmax()) if bad.any() else None
