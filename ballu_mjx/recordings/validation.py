"""Checks of a recording's columns. Their messages name the file, the row and the fix."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.recording import Column, ColumnGroup, Kind, Quantity, Recording
from ballu_mjx.robots.description import RobotDescription

LONGEST_GAP = 0.5
"""Longest time (s) without a sample that is interpolated."""
TIME_TOLERANCE = 1e-6
"""Relative tolerance of durations. Differences of written times are rounded."""
SHORTEST = 1.0
"""Minimum duration of a recording (s)."""
_LARGEST_STEP = 0.02
"""Largest change of a position between two samples (m, per axis) due to noise. The robot's motion adds to it."""
_LARGEST_BEND = {"position": (0.1, 1000.0), "quaternion": (0.5, 600.0)}
"""Largest deviation of a sample from motion at constant velocity (m, rad), and largest acceleration (m/s^2, rad/s^2). A
sample must exceed both to be refused, as samples with mixed-up markers do."""
_BURST = 3.0
"""Time between two samples above which it is a gap between bursts, in units of the median."""
_LARGEST_BURST_SHARE = 0.5
"""Largest share of the recording's time in gaps between bursts."""
_LARGEST_RECURRING = 0.02
"""Share of poses that recur to the last digit above which digits are too coarse to detect held poses."""
_HELD_JUMP = 2.0
"""Smallest jump at the end of a held pose, in units of the 95th percentile of movements between samples. A rest ends
with a smaller movement."""
QUATERNION_TOLERANCE = 0.02
"""Largest deviation of a quaternion's length from 1."""


# ---- files ----


def refuse_recording(
    path: Path, problem: str, fix: str, *, column: str | None = None, row: int | None = None
) -> NoReturn:
    """Raise an `InputError` with place, problem and fix.

    `row` counts samples from 0, and -1 is the header. The message counts as a spreadsheet does: the header is row 1.
    """
    place = [str(path)]
    if column is not None:
        place.append(f"column {column}")
    if row is not None:
        place.append(f"row {row + 2}")
    raise InputError(f"{', '.join(place)}: {problem}; {fix}.")


# ---- validation ----


def present_groups(
    path: Path, columns: dict[str, Column], known: Sequence[ColumnGroup], kind: Kind
) -> list[ColumnGroup]:
    """Return the column groups that the file holds.

    **Raises** `InputError` for a mandatory group that is missing, and for a group that is incomplete.
    """
    present = []
    for group in known:
        missing = [name for name in group.names if name not in columns]
        if not missing:
            present.append(group)
        elif kind in group.mandatory:
            refuse_recording(
                path, f"the column is missing, and {kind} recordings need it", "add it", column=missing[0], row=-1
            )
        elif len(missing) < len(group.names):
            others = ", ".join(name for name in group.names if name in columns)
            refuse_recording(path, "the column is missing", f"add it or delete {others}", column=missing[0], row=-1)
    return present


def check_time(path: Path, time: Column, robot: RobotDescription) -> None:
    """Check that times increase, do not come in bursts, are dense enough, and last `SHORTEST`.

    A recording needs at least one sample per control step. **Raises** `InputError` otherwise.
    """
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
    problem = describe_slow(steps, robot.control_timestep)
    if problem is not None:
        refuse_recording(path, problem, "record faster, or convert to seconds if this is milliseconds", column="time")
    long = steps[(steps > _BURST * np.median(steps)) & (steps <= LONGEST_GAP)] if len(steps) else steps
    if long.sum() > _LARGEST_BURST_SHARE * (time[-1] - time[0]):
        problem = (
            f"samples come in bursts: half of the steps are of {1e3 * np.median(steps):.3g} ms or less, and "
            f"{len(long)} of {1e3 * long.min():.3g} ms or more make up most of the time"
        )
        fix = "record the times of capture, not the times of arrival"
        row = first_true(steps > _BURST * np.median(steps))
        refuse_recording(path, problem, fix, column="time", row=None if row is None else row + 1)
    if time[-1] - time[0] < SHORTEST * (1 - TIME_TOLERANCE):
        problem = f"{time[-1] - time[0]:.3g} s are shorter than {SHORTEST:g} s"
        refuse_recording(path, problem, "record longer or leave it out", column="time", row=len(time) - 1)


def describe_slow(steps: Float[np.ndarray, " steps"], control_timestep: float) -> str | None:
    """Return the problem if most `steps` (s) between samples are longer than a control step. None if they are not."""
    if not len(steps) or np.median(steps) <= 1.001 * control_timestep:
        return None
    rate, least = 1 / np.median(steps), 1 / control_timestep
    return f"{rate:.3g} samples per second are fewer than {least:.3g}, one per control step"


def check_cells(
    path: Path, columns: dict[str, Column], groups: Sequence[ColumnGroup], robot: RobotDescription, kind: Kind
) -> None:
    """Check values against the description's limits. NaN passes, except in commands.

    **Raises** `InputError` for a missing command, and for values that only wrong units or a wrong order explain.
    """

    def check(name: str, bad: np.ndarray, problem: str, fix: str) -> None:
        row = first_true(bad)
        if row is not None:
            refuse_recording(path, f"{columns[name][row]:g} {problem}", fix, column=name, row=row)

    def names(quantity: Quantity) -> list[str]:
        return [name for group in groups if group.quantity == quantity for name in group.names]

    for name, (low, high) in zip(names("command"), robot.command_ranges, strict=True):
        value = columns[name]
        row = first_true(np.isnan(value))
        if row is not None:
            refuse_recording(
                path, "the command is missing", "fill in the command that was being sent", column=name, row=row
            )
        fix = "convert it to the actuator's units, or give its range in the robot's description"
        check(name, (value < low) | (value > high), f"is outside {low:g} to {high:g}", fix)
    bounds = _angle_bounds(robot)
    for name in names("angle"):
        low, high = bounds.get(name, (-np.inf, np.inf))
        fix = "convert degrees to radians (millimetres to metres), or correct the description's limits"
        outside = (columns[name] < low) | (columns[name] > high)
        check(name, outside, f"is beyond {low:g} to {high:g} rad or m", fix)
    limits, positions = robot.limits, names("position")
    if limits.height is not None and kind == "free":
        low, high = limits.height
        fix = "convert millimetres to metres, or correct the frame: z up, the floor at 0"
        for name in positions:
            if name.endswith("_z"):
                outside = (columns[name] < low) | (columns[name] > high)
                check(name, outside, f"m is not a height between {low:g} and {high:g} m", fix)
    for name in positions:
        if limits.distance is not None:
            far = np.abs(columns[name]) > limits.distance
            check(name, far, f"m is farther than {limits.distance:g} m", "convert millimetres to metres")
        if limits.speed is not None:
            _check_jumps(path, name, columns, limits.speed)
    for group in groups:
        if group.quantity in _LARGEST_BEND:
            _check_bends(path, group, columns)


def _check_jumps(path: Path, name: str, columns: dict[str, Column], speed: float) -> None:
    """Refuse jumps of a position that are farther than the robot's speed (m/s) and noise explain."""
    value = columns[name]
    seen = np.flatnonzero(~np.isnan(value))
    steps = np.abs(np.diff(value[seen]))
    row = first_true(steps > _LARGEST_STEP + speed * np.diff(columns["time"][seen]))
    if row is not None:
        fix = "convert millimetres to metres, or empty the cells where markers were mixed up"
        problem = f"jumps by {steps[row]:.3g} m, farther than the robot can move between samples"
        refuse_recording(path, problem, fix, column=name, row=int(seen[row + 1]))


def _check_bends(path: Path, group: ColumnGroup, columns: dict[str, Column]) -> None:
    """Refuse jumps of positions and orientations that no robot's motion explains."""
    seen = np.flatnonzero(has_sample(columns, group.names))
    moved = _movements(np.stack([columns[name][seen] for name in group.names], axis=1), group.quantity)
    if len(moved) < 2:
        return
    steps = np.diff(columns["time"][seen])
    speed = moved / np.maximum(steps, np.median(steps))[:, None]
    with np.errstate(over="ignore"):
        bend = np.linalg.norm(moved[1:] - speed[:-1] * steps[1:, None], axis=1)
    least, acceleration = _LARGEST_BEND[group.quantity]
    sample = first_true(bend > np.maximum(least, acceleration * steps[:-1] * steps[1:]))
    if sample is None:
        return
    size = np.linalg.norm(moved, axis=1)
    step = sample + int(size[sample + 1] > 2 * size[sample])  # Around a single outlier, both steps are large.
    within = f"within {1e3 * steps[step]:.3g} ms, which no robot does"
    name, row = group.names[0], int(seen[step + 1])
    if group.quantity == "quaternion":
        fix = "empty the cells where the capture confused the body's orientation"
        refuse_recording(path, f"turned by {np.rad2deg(size[step]):.0f} deg {within}", fix, column=name, row=row)
    fix = "empty the cells where markers were mixed up, or convert millimetres to metres"
    refuse_recording(path, f"jumps by {size[step]:.3g} m {within}", fix, column=name, row=row)


def _movements(values: Float[np.ndarray, "T columns"], quantity: Quantity) -> Float[np.ndarray, "steps 3"]:
    """Return the movement from each sample to the next: displacements (m), or rotation vectors (rad, body frame)."""
    if quantity != "quaternion":
        return np.diff(values, axis=0)
    turned = Rotation.from_quat(values, scalar_first=True)
    return (turned[:-1].inv() * turned[1:]).as_rotvec() if len(values) > 1 else np.zeros((0, 3))


def check_lengths(path: Path, columns: dict[str, Column], groups: Sequence[ColumnGroup]) -> None:
    """Check that quaternions have unit length.

    **Raises** `InputError` that names the column and the row otherwise.
    """
    for group in groups:
        if group.quantity != "quaternion":
            continue
        names = group.names
        with np.errstate(over="ignore"):
            length = np.linalg.norm(np.stack([columns[name] for name in names], 1), axis=1)
        row = first_true(np.abs(length - 1) > QUATERNION_TOLERANCE)
        if row is not None:
            problem = f"the quaternion {names[0]} ... {names[-1]} has length {length[row]:.3g} instead of 1"
            refuse_recording(path, problem, "export unit quaternions in w, x, y, z order", column=names[0], row=row)


def _angle_bounds(robot: RobotDescription) -> dict[str, tuple[float, float]]:
    """Return bounds (rad or m) by joint.

    They are the description's limit, or else the model's range, widened on both sides by its own width. Degrees taken
    for radians are far outside these bounds. A slightly wrong zero is inside.
    """
    if robot.limits.angle is not None:
        return dict.fromkeys(robot.joints, (-robot.limits.angle, robot.limits.angle))
    model = robot.load_model()
    limited = [joint for joint in robot.joints if model.jnt_limited[model.joint(joint).id]]
    ranges = {joint: tuple(map(float, model.joint(joint).range)) for joint in limited}
    return {joint: (2 * low - high, 2 * high - low) for joint, (low, high) in ranges.items()}


def blank_held(path: Path, columns: dict[str, Column], groups: Sequence[ColumnGroup]) -> dict[str, int]:
    """Replace samples that a streaming client held by NaN, in place, and return their number by site.

    A held sample repeats the one before to the last digit in all columns of a body. Measurement noise prevents this for
    new samples, with two exceptions: coarse digits (poses from encoders, for example), and a long rest without noise
    (in a simulation). Repeated samples are kept in these cases unless the body then moves on with a jump.

    **Raises** `InputError` for a pose that was held for longer than `LONGEST_GAP`.
    """
    time, counts = columns["time"], {}
    bodies: dict[str, list[ColumnGroup]] = {}
    for group in groups:
        if group.quantity in ("position", "quaternion"):
            bodies.setdefault(group.part, []).append(group)
    for site, parts in bodies.items():
        names = [name for group in parts for name in group.names]
        held, values = np.zeros(len(time), bool), np.stack([columns[name] for name in names], axis=1)
        coarse = _recurring(values) > _LARGEST_RECURRING
        for start, end in _runs(_repeats(values)):
            lasted = float(time[min(end, len(time) - 1)] - time[start - 1])
            inside = end < len(time) and start > 1
            if (lasted <= LONGEST_GAP and inside and not coarse) or _goes_on_with_a_jump(
                columns, parts, start, end, coarse
            ):
                held[start:end] = True
                if lasted > LONGEST_GAP + 2 * float(np.median(np.diff(time))):
                    problem = (
                        f"the pose of {site} repeats for {lasted:.3g} s to the last digit, so it was not seen for more "
                        f"than {LONGEST_GAP:g} s"
                    )
                    refuse_recording(path, problem, "cut the recording there", column=names[0], row=start)
        for name in names:
            columns[name] = np.where(held, np.nan, columns[name])
        if held.any():
            counts[site] = int(held.sum())
    return counts


def _repeats(values: Float[np.ndarray, "T columns"]) -> Bool[np.ndarray, " T"]:
    """Return a mask of samples that equal the one before in all columns, unless chance explains this."""
    moving = values[:, ~(values[1:] == values[:-1]).all(axis=0)]
    found = np.zeros(len(values), bool)
    if not moving.shape[1]:
        return found
    equal = (moving[1:] == moving[:-1]).sum(axis=1)
    found[1:] = equal == moving.shape[1]
    if found.sum() <= (equal == moving.shape[1] - 1).sum():
        # Digits are coarse if repeats in all columns are no more frequent than in all but one. Runs of one are chance.
        for start, end in _runs(found):
            found[start:end] &= end - start > 1
    return found


def _recurring(values: Float[np.ndarray, "T columns"]) -> float:
    """Return the share of poses that equal an earlier one. Repeats of the sample before do not count.

    The share is zero if there is measurement noise.
    """
    seen = values[~np.isnan(values).any(axis=1)]
    left = seen[np.concatenate([[True], (seen[1:] != seen[:-1]).any(axis=1)])] if len(seen) else seen
    return 1 - len(np.unique(left, axis=0)) / len(left) if len(left) else 0.0


def _runs(chosen: Bool[np.ndarray, " T"]) -> list[tuple[int, int]]:
    """Return start and end (exclusive) of each run of true entries."""
    edges = np.diff(np.concatenate([[0], chosen, [0]]))
    return list(zip(np.flatnonzero(edges > 0).tolist(), np.flatnonzero(edges < 0).tolist(), strict=True))


def _goes_on_with_a_jump(
    columns: dict[str, Column], parts: Sequence[ColumnGroup], start: int, end: int, coarse: bool
) -> bool:
    """Return whether the movement after a run of repeats (`start` to `end`) is larger than is usual between samples.

    For a run at the recording's end, return whether the body stopped from one sample to the next.
    """
    ends_there = end == len(columns["time"])
    for group in parts:
        values = np.stack([columns[name] for name in group.names], axis=1)
        values = values[has_sample(columns, group.names)]
        size = np.linalg.norm(_movements(values, group.quantity), axis=1)
        size = size[size > 1e-7]
        if not len(size):
            continue
        ends = [start - 2, start - 1] if ends_there else [start - 1, end]
        if ends[0] < 0:
            continue
        jump = np.linalg.norm(
            _movements(np.stack([columns[name][ends] for name in group.names], axis=1), group.quantity)
        )
        usual = np.median(size) if ends_there and not coarse else _HELD_JUMP * np.percentile(size, 95)
        if jump > usual:
            return True
    return False


def check_gaps(path: Path, columns: dict[str, Column], groups: Sequence[ColumnGroup], kind: Kind) -> tuple[int, int]:
    """Return the first and last row between which every column can be interpolated.

    **Raises** `InputError` for gaps longer than `LONGEST_GAP`, and if less than `SHORTEST` is left.
    """
    time = columns["time"]
    spacing = float(np.median(np.diff(time)))
    longest = LONGEST_GAP + 1e-6
    step = first_true(np.diff(time) - spacing > longest)
    if step is not None:
        problem = f"rows are missing, {time[step + 1] - time[step]:.3g} s since the row before"
        refuse_recording(path, problem, "cut the recording there", column="time", row=step + 1)
    first, last = 0, len(time) - 1
    for group in groups:
        names = group.names
        fix = "cut the recording there"
        if kind not in group.mandatory:
            fix += f", or delete {', '.join(names)}"
        # A quaternion is seen or missing as a whole, other quantities column by column.
        for together in [names] if group.quantity == "quaternion" else [(name,) for name in names]:
            seen = np.flatnonzero(has_sample(columns, together))
            # Duration of each gap: the time from the sample before to the sample after, minus one spacing.
            edges = np.concatenate([[time[0] - spacing], time[seen], [time[-1] + spacing]])
            lacking = np.diff(edges) - spacing
            gap = first_true(lacking > longest)
            if gap is not None:
                row = int(seen[gap - 1]) + 1 if gap else 0
                name = next(n for n in together if np.isnan(columns[n][row]))
                problem = f"{lacking[gap]:.3g} s are missing in a row, more than {LONGEST_GAP:g} s"
                refuse_recording(path, problem, fix, column=name, row=row)
            first, last = max(first, int(seen[0])), min(last, int(seen[-1]))
    if time[last] - time[first] < SHORTEST * (1 - TIME_TOLERANCE):
        problem = f"all columns have samples for {max(0.0, time[last] - time[first]):.3g} s only"
        refuse_recording(path, problem, f"record {SHORTEST:g} s or longer", column="time", row=first)
    return first, last


def has_sample(columns: dict[str, Column], names: Iterable[str]) -> Bool[np.ndarray, " T"]:
    """Return a mask of the rows in which all named columns have a sample."""
    return ~np.any([np.isnan(columns[name]) for name in names], axis=0)


def first_true(bad: np.ndarray) -> int | None:
    """Return the index of the first true entry, or None."""
    return int(bad.argmax()) if bad.any() else None


def check_complete(recording: Recording, robot: RobotDescription) -> None:
    """Check a recording that was made in memory: increasing times, all commands, and no missing values.

    **Raises** `InputError` that names the recording, the column and the row.
    """
    rows = len(recording.time)
    columns = {"time": recording.time[:, None], "command": recording.command}
    for name, value in (("position", recording.tracked_position), ("quaternion", recording.tracked_quaternion)):
        if value is not None:
            columns[f"{name} of {robot.tracked}"] = value
    columns |= {f"position of {site}": value for site, value in recording.points.items()}
    columns |= {f"quaternion of {site}": value for site, value in recording.orientations.items()}
    columns |= {joint: value[:, None] for joint, value in recording.joint_angles.items()}
    if recording.command.shape[-1] != len(robot.commands):
        raise InputError(
            f"{recording.name}: has {recording.command.shape[-1]} commands; {robot.name} has {len(robot.commands)}."
        )
    for name, values in columns.items():
        if len(values) != rows:
            raise InputError(f"{recording.name}: {name} has {len(values)} samples, and time has {rows}.")
        row = first_true(np.asarray(~np.isfinite(values).all(axis=1)))
        if row is not None:
            raise InputError(
                f"{recording.name}: {name} is not finite in row {row}; fill gaps, or write the recording to a file and "
                "read it."
            )
    row = first_true(np.diff(recording.time) <= 0)
    if row is not None:
        raise InputError(f"{recording.name}: time does not increase after row {row}; sort the samples.")
