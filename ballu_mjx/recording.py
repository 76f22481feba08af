"""Recordings of the robot, format `ballu-recording/1`: the one door for data, motion capture or not.

A recording is `NAME.csv` (or `NAME.csv.gz`) with `NAME.json` beside it. SI units and radians; world frame z up with
the floor at 0, x forward and y left at the start. Columns, in any order:

- `time` (s), at 50 Hz or more, steady or jittered;
- `command_left`, `command_right` in [0, 1], as sent, held until the next row;
- `balloon_x`, `balloon_y`, `balloon_z` and `balloon_qw` ... `balloon_qz`: the model's site `balloon`;
- `base_x` ... `base_z`, and optionally `base_qw` ... `base_qz`: the model's site `base`;
- `foot_left_x` ... `foot_right_z`: centres of the foot spheres;
- optionally `motor_left`, `motor_right`, `knee_left`, `knee_right` (rad).

Other robots (`robot_description.py`) have a command for each of theirs, the tracked site instead of the balloon's,
their points instead of base and feet, and angles of joints by the joint's name.

An empty cell is a missing sample. The JSON holds `format`, `kind` ("free", or "suspended": feet off the ground, where
motor and knee are mandatory and balloon, base and feet optional), `robot` and `notes`; further keys are the user's own.
"""

from __future__ import annotations

import array
import csv
import dataclasses
import difflib
import gzip
import io
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal, NoReturn

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation, Slerp

from ballu_mjx import files, robot
from ballu_mjx.errors import InputError
from ballu_mjx.robot_description import RobotDescription

FORMAT = "ballu-recording/1"

Kind = Literal["free", "suspended"]
Split = Literal["training", "validation", "test", "suspended"]

MINIMUM_RATE = 50.0
"""Hz."""
LONGEST_GAP = 0.5
"""Longest stretch (s) without a sample that is filled in."""
SHORTEST = 1.0
"""Shortest recording (s)."""
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "time": ("time",),
    "command": ("command_left", "command_right"),
    "balloon_position": tuple(f"balloon_{axis}" for axis in "xyz"),
    "balloon_quaternion": tuple(f"balloon_q{axis}" for axis in "wxyz"),
    "base_position": tuple(f"base_{axis}" for axis in "xyz"),
    "base_quaternion": tuple(f"base_q{axis}" for axis in "wxyz"),
    "foot_position": tuple(f"foot_{side}_{axis}" for side in robot.SIDES for axis in "xyz"),
    "motor": tuple(f"motor_{side}" for side in robot.SIDES),
    "knee": tuple(f"knee_{side}" for side in robot.SIDES),
}
"""Columns of BALLU's recordings by field of `Recording`, in the order in which they are written."""

_POSITIONS = ("balloon_position", "base_position", "foot_position")
_QUATERNIONS = ("balloon_quaternion", "base_quaternion")
_ANGLES = ("motor", "knee")
_MANDATORY = {
    "free": ("time", "command", "balloon_position", "balloon_quaternion", "base_position", "foot_position"),
    "suspended": ("time", "command", "motor", "knee"),
}

# What no BALLU in a room can exceed; all else may be true.
_LARGEST_ANGLE = 3.5  # rad
_LARGEST_DISTANCE = 100.0  # m, along x and y
_HEIGHTS = {"free": (-0.5, 3.0), "suspended": (-0.5, 10.0)}  # m
_LARGEST_STEP, _LARGEST_SPEED = 0.02, 8.0  # m and m/s: noise and motion between two samples, along an axis
_QUATERNION_TOLERANCE = 0.02
_FLOOR_TOLERANCE = 0.1  # m
_SMALLEST_STANCE = 0.02  # m

_ENDINGS = (".csv", ".csv.gz")
_COMMAND_DECIMALS = 4

_Column = Float[np.ndarray, " T"]


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


def read_recording(path: Path | str, robot: RobotDescription | None = None) -> Recording:
    """Read, validate and fill in the recording at `path`, a `.csv` or `.csv.gz` with its `.json` beside it.

    `robot` is whose it is; None: BALLU's.

    Gaps of up to 0.5 s are interpolated, linearly or, for orientations, along the shortest rotation.

    **Raises** `InputError` at the first fault found, with file, column, row (as a spreadsheet counts them, the header
    being row 1) and mend.
    """
    path = Path(path)
    description = description_path(path)
    layout = _layout(robot)
    columns = _read_columns(path, layout)
    kind, made_by, notes = _read_description(description)
    if robot is not None and not robot.is_ballu and kind != "free":
        _refuse(description, f'"kind" is "{kind}"', f'it must be "free" for {robot.name}: only BALLU is suspended')
    groups = _present_groups(path, columns, layout, kind)
    _check_time(path, columns["time"])
    _check_cells(path, columns, layout, kind)
    first, last = _check_gaps(path, columns, groups, layout, kind)
    fields, interpolated = _fill(columns, layout, groups, slice(first, last + 1))
    rows = len(columns["time"])
    recording = Recording(
        name=name_of(path),
        kind=kind,
        robot=made_by,
        notes=notes,
        time=fields["time"][:, 0],
        command=fields["command"],
        balloon_position=fields.get("balloon_position"),
        balloon_quaternion=fields.get("balloon_quaternion"),
        base_position=fields.get("base_position"),
        base_quaternion=fields.get("base_quaternion"),
        foot_position=fields["foot_position"].reshape(-1, 2, 3) if "foot_position" in fields else None,
        motor=fields.get("motor"),
        knee=fields.get("knee"),
        points={name: fields[_POINT + name] for name in layout.points},
        angles={name: fields[_ANGLE + name][:, 0] for name in layout.joints if _ANGLE + name in fields},
        interpolated=interpolated,
        trimmed=(first, rows - 1 - last),
    )
    if kind == "free" and layout.columns is COLUMNS:
        _check_frame(path, recording)
    return recording


def write_recording(
    recording: Recording, path: Path | str, robot: RobotDescription | None = None, *, decimals: int = 5
) -> None:
    """Write `recording` to `path` (`.csv`, or `.csv.gz`: compressed) and its description to the `.json` beside it.

    Positions and angles get `decimals`, quaternions one fewer, commands 4, time 3 to 6, as it needs; NaN becomes an
    empty cell. The same recording always gives the same bytes (compressed ones: with the same zlib).
    `robot` is whose it is; None: BALLU's.

    **Raises** `ValueError` for infinite values or shapes that do not fit; `InputError` for another ending of `path`.
    """
    path = Path(path)
    description = description_path(path)
    length = len(recording.time)
    header: list[str] = []
    cells: list[list[str]] = []
    for field, names in _layout(robot).columns.items():
        value = _value(recording, field)
        if value is None:
            continue
        value = np.asarray(value, float).reshape(length, len(names))
        if np.isinf(value).any():
            raise ValueError(f"{field} is infinite somewhere")
        if field == "time":
            places = _time_decimals(value)
        elif field == "command":
            places = _COMMAND_DECIMALS
        else:
            places = decimals - (field in _QUATERNIONS)
        header += names
        cells += [[_text(x, places) for x in column] for column in value.T.tolist()]
    lines = [",".join(header), *(",".join(row) for row in zip(*cells, strict=True))]
    content = ("\n".join(lines) + "\n").encode()
    if path.name.endswith(".gz"):
        buffer = io.BytesIO()
        with gzip.GzipFile(filename="", mode="wb", compresslevel=9, fileobj=buffer, mtime=0) as stream:
            stream.write(content)
        content = buffer.getvalue()
    files.write(path, content)
    keys = {"format": FORMAT, "kind": recording.kind, "robot": recording.robot, "notes": recording.notes}
    files.write(description, json.dumps(keys, indent=2, ensure_ascii=False) + "\n")


def recordings(paths: Iterable[Path | str]) -> list[Path]:
    """The recordings that `paths` name, each a CSV or a folder of them (sorted by name), every one once.

    **Raises** `InputError` for a path that is missing, is no recording, or is a folder without any.
    """
    found: dict[Path, Path] = {}
    for path in map(Path, paths):
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.name.endswith(_ENDINGS) and not p.name.startswith("."))
            if not inside:
                raise InputError(f"{path}: the folder holds no recording (.csv or .csv.gz); name one that does.")
            twice = [b for a, b in zip(inside, inside[1:], strict=False) if name_of(a) == name_of(b)]
            if twice:
                raise InputError(f"{twice[0]}: stands there a second time, without .gz; delete one of the two.")
        elif path.exists():
            description_path(path)
            inside = [path]
        else:
            raise InputError(f"{path}: there is no such file or folder; check the path.")
        for p in inside:
            found.setdefault(p.resolve(), p)
    return list(found.values())


def bundled(split: Split) -> list[Path]:
    """The recordings that come with the package, sorted by name."""
    return recordings([robot.assets() / "recordings" / split])


# ---- robots ----

_POINT, _ANGLE = "point ", "angle "
"""What the fields of other robots' points and joints begin with."""


@dataclasses.dataclass(frozen=True)
class _Layout:
    """Columns by field, and which fields are what: those of BALLU, or of another robot's description."""

    columns: Mapping[str, tuple[str, ...]]
    mandatory: Mapping[str, tuple[str, ...]]
    positions: tuple[str, ...]
    angles: tuple[str, ...]
    points: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()


def _layout(robot: RobotDescription | None) -> _Layout:
    if robot is None or robot.is_ballu:
        return _Layout(COLUMNS, _MANDATORY, _POSITIONS, _ANGLES)
    columns = {
        "time": ("time",),
        "command": tuple(f"command_{name}" for name in robot.commands),
        "balloon_position": tuple(f"{robot.tracked}_{axis}" for axis in "xyz"),
        "balloon_quaternion": tuple(f"{robot.tracked}_q{axis}" for axis in "wxyz"),
    }
    columns |= {_POINT + name: tuple(f"{name}_{axis}" for axis in "xyz") for name in robot.points}
    mandatory = {"free": tuple(columns)}
    columns |= {_ANGLE + name: (name,) for name in robot.joints}
    positions = ("balloon_position", *(_POINT + name for name in robot.points))
    return _Layout(
        columns, mandatory, positions, tuple(_ANGLE + name for name in robot.joints), robot.points, robot.joints
    )


def _value(recording: Recording, field: str) -> np.ndarray | None:
    if field.startswith(_POINT):
        return recording.points[field.removeprefix(_POINT)]
    if field.startswith(_ANGLE):
        return recording.angles.get(field.removeprefix(_ANGLE))
    return getattr(recording, field)


# ---- files ----


def _refuse(path: Path, problem: str, mend: str, *, column: str | None = None, row: int | None = None) -> NoReturn:
    """Raise the sentence; `row` counts samples from 0."""
    place = [str(path)]
    if column is not None:
        place.append(f"column {column}")
    if row is not None:
        place.append(f"row {row + 2}")
    raise InputError(f"{', '.join(place)}: {problem}; {mend}.")


def name_of(path: Path) -> str:
    """The name of the recording in a file: the file's, without its ending."""
    return path.name.removesuffix(".gz").removesuffix(".csv")


def description_path(path: Path) -> Path:
    """Where the description of the recording in `path` stands.

    **Raises** `InputError` where that is not a recording's name.
    """
    if not path.name.endswith(_ENDINGS) or not name_of(path):
        raise InputError(f"{path}: not a recording's name; it must end in .csv or .csv.gz.")
    return path.with_name(name_of(path) + ".json")


def _read_description(path: Path) -> tuple[Kind, str, str]:
    """Kind, robot and notes."""
    example = f'{{"format": "{FORMAT}", "kind": "free", "robot": "...", "notes": "..."}}'
    if not path.is_file():
        _refuse(path, "there is no description beside the recording", f"write one such as {example}")
    keys = files.read_json(path, f"write it such as {example}")
    if keys.get("format") != FORMAT:
        _refuse(path, f'"format" is {_quote(keys, "format")}', f'it must be "{FORMAT}", the format this version reads')
    kind, made_by, notes = keys.get("kind"), keys.get("robot"), keys.get("notes", "")
    if kind not in ("free", "suspended"):
        _refuse(
            path, f'"kind" is {_quote(keys, "kind")}', 'write "free", or "suspended" if the feet are off the ground'
        )
    if not isinstance(made_by, str) or not made_by.strip():
        _refuse(path, f'"robot" is {_quote(keys, "robot")}', "write which robot was recorded, as text")
    if not isinstance(notes, str):
        _refuse(path, f'"notes" is {_quote(keys, "notes")}', "write text there")
    return kind, made_by, notes


def _quote(keys: dict, key: str) -> str:
    if key not in keys:
        return "missing"
    text = json.dumps(keys[key])
    return text if len(text) <= 40 else text[:40] + "..."


def _read_columns(path: Path, layout: _Layout) -> dict[str, _Column]:
    """The CSV's columns by name, missing samples as NaN."""
    text = files.read_text(path)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    values = array.array("d")
    header: list[str] | None = None
    rows = blank = 0
    try:
        for cells in reader:
            if header is None:
                header = _check_header(path, layout, [name.strip() for name in cells])
                continue
            if not any(map(str.strip, cells)):
                blank += 1  # Blank lines at the end are no fault; one further up lacks its time.
                continue
            if blank:
                _refuse(path, "the row is blank", "delete it or fill it in", column="time", row=rows)
            values.extend(_parse_row(path, header, cells, rows))
            rows += 1
    except csv.Error as error:
        row = None if header is None else rows + blank
        _refuse(path, f"not readable as a table ({error})", "save it as plain CSV", row=row)
    if header is None:
        _refuse(path, "the file is empty", "record again or leave it out")
    if not rows:
        _refuse(path, "there is no sample below the header", "record again or leave it out", row=0)
    table = np.frombuffer(values, float).reshape(rows, len(header))
    return {name: table[:, i] for i, name in enumerate(header)}


def _check_header(path: Path, layout: _Layout, header: list[str]) -> list[str]:
    known = [name for names in layout.columns.values() for name in names]
    if len(header) == 1 and any(mark in header[0] for mark in ";\t"):
        _refuse(path, "the header has no commas", "save it with commas between cells and points in numbers", row=-1)
    for i, name in enumerate(header):
        if name not in known:
            close = difflib.get_close_matches(name[:40].lower(), known, 1)
            mend = f"rename it to {close[0]} or delete it" if close else f"{FORMAT} does not have it, delete it"
            _refuse(path, "unknown column", mend, column=_shorten(name) if name else f"{i + 1} (no name)", row=-1)
        if name in header[:i]:
            _refuse(path, "the column stands there twice", "delete one", column=name, row=-1)
    return header


def _parse_row(path: Path, header: list[str], cells: list[str], row: int) -> list[float]:
    if len(cells) < len(header):
        name = header[len(cells)]
        _refuse(path, "the row ends before it", "complete the row or delete it", column=name, row=row)
    if any(cell.strip() for cell in cells[len(header) :]):
        name = f"{len(header) + 1} (no name)"
        _refuse(
            path, "the row has more cells than the header", "write points in numbers, not commas", column=name, row=row
        )
    numbers = []
    for name, cell in zip(header, cells, strict=False):
        try:
            number = float(cell) if cell else math.nan
            plain = not cell or (math.isfinite(number) and "_" not in cell)
        except ValueError:
            plain, number = not cell.strip(), math.nan
        if not plain:
            mend = "write a finite number, or leave the cell empty if the sample is missing"
            _refuse(path, f"{_shorten(cell)!r} is not a finite number", mend, column=name, row=row)
        numbers.append(number)
    return numbers


def _shorten(text: str) -> str:
    return text if len(text) <= 40 else text[:40] + "..."


def _text(value: float, decimals: int) -> str:
    if math.isnan(value):
        return ""
    text = f"{value:.{decimals}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def _time_decimals(time: np.ndarray) -> int:
    exact = (d for d in range(3, 6) if np.abs(np.round(time, d) - time).max(initial=0.0) < 1e-9)
    return next(exact, 6)


# ---- validation ----


def _present_groups(path: Path, columns: dict[str, _Column], layout: _Layout, kind: Kind) -> list[str]:
    """Fields of `Recording` that the file holds, each with all its columns."""
    present = []
    for field, names in layout.columns.items():
        missing = [name for name in names if name not in columns]
        if not missing:
            present.append(field)
        elif field in layout.mandatory[kind]:
            _refuse(path, f"the column is missing, and {kind} recordings need it", "add it", column=missing[0], row=-1)
        elif len(missing) < len(names):
            others = ", ".join(name for name in names if name in columns)
            _refuse(path, "the column is missing", f"add it or delete {others}", column=missing[0], row=-1)
    return present


def _check_time(path: Path, time: _Column) -> None:
    row = _first(np.isnan(time))
    if row is not None:
        _refuse(path, "the time is missing", "fill it in or delete the row", column="time", row=row)
    with np.errstate(over="ignore"):
        steps = np.diff(time)
    row = _first(steps <= 0)
    if row is not None:
        backwards = f"time runs back, from {time[row]:g} to {time[row + 1]:g} s"
        problem = "time stands still" if steps[row] == 0 else backwards
        _refuse(path, problem, "sort the rows by time and delete repeated ones", column="time", row=row + 1)
    if len(steps) and np.median(steps) > 1.001 / MINIMUM_RATE:
        rate = 1 / np.median(steps)
        problem = f"{rate:.3g} samples per second are fewer than {MINIMUM_RATE:g}"
        _refuse(path, problem, "record faster, or convert to seconds if this is milliseconds", column="time")
    if time[-1] - time[0] < SHORTEST * (1 - 1e-6):
        problem = f"{time[-1] - time[0]:.3g} s are shorter than {SHORTEST:g} s"
        _refuse(path, problem, "record longer or leave it out", column="time", row=len(time) - 1)


def _check_cells(path: Path, columns: dict[str, _Column], layout: _Layout, kind: Kind) -> None:
    """Ranges, steps and lengths that only wrong units or a wrong order explain. NaN passes."""

    def check(name: str, bad: np.ndarray, problem: str, mend: str) -> None:
        row = _first(bad)
        if row is not None:
            _refuse(path, f"{columns[name][row]:g} {problem}", mend, column=name, row=row)

    def held(fields: Iterable[str]) -> list[str]:
        return [name for field in fields for name in layout.columns.get(field, ()) if name in columns]

    for name in layout.columns["command"]:
        value = columns[name]
        row = _first(np.isnan(value))
        if row is not None:
            _refuse(path, "the command is missing", "fill in what was being sent", column=name, row=row)
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
        row = _first(steps > _LARGEST_STEP + _LARGEST_SPEED * np.diff(columns["time"][seen]))
        if row is not None:
            mend = "convert millimetres to metres, or empty the cells where markers were mixed up"
            problem = f"jumps by {steps[row]:.3g} m, farther than the robot can move between samples"
            _refuse(path, problem, mend, column=name, row=int(seen[row + 1]))
    for field in _QUATERNIONS:
        names = held([field])
        if names:
            with np.errstate(over="ignore"):
                length = np.linalg.norm(np.stack([columns[name] for name in names], 1), axis=1)
            row = _first(np.abs(length - 1) > _QUATERNION_TOLERANCE)
            if row is not None:
                problem = f"the quaternion {names[0]} ... {names[-1]} has length {length[row]:.3g} instead of 1"
                _refuse(path, problem, "export unit quaternions in w, x, y, z order", column=names[0], row=row)


def _check_gaps(
    path: Path, columns: dict[str, _Column], groups: list[str], layout: _Layout, kind: Kind
) -> tuple[int, int]:
    """First and last row between which every column can be interpolated."""
    time = columns["time"]
    spacing = float(np.median(np.diff(time)))
    longest = LONGEST_GAP + 1e-6
    step = _first(np.diff(time) - spacing > longest)
    if step is not None:
        problem = f"rows are missing, {time[step + 1] - time[step]:.3g} s since the row before"
        _refuse(path, problem, "cut the recording there", column="time", row=step + 1)
    first, last = 0, len(time) - 1
    for field in groups:
        names = layout.columns[field]
        mend = "cut the recording there"
        if field not in layout.mandatory[kind]:
            mend += f", or delete {', '.join(names)}"
        # A quaternion is seen or missing as a whole, all else column by column.
        for together in [names] if field in _QUATERNIONS else [(name,) for name in names]:
            seen = np.flatnonzero(_seen(columns, together))
            # The time that each gap lacks: from the sample before to the sample after, less one spacing.
            edges = np.concatenate([[time[0] - spacing], time[seen], [time[-1] + spacing]])
            lacking = np.diff(edges) - spacing
            gap = _first(lacking > longest)
            if gap is not None:
                row = int(seen[gap - 1]) + 1 if gap else 0
                name = next(n for n in together if np.isnan(columns[n][row]))
                problem = f"{lacking[gap]:.3g} s are missing in a row, more than {LONGEST_GAP:g} s"
                _refuse(path, problem, mend, column=name, row=row)
            first, last = max(first, int(seen[0])), min(last, int(seen[-1]))
    if time[last] - time[first] < SHORTEST * (1 - 1e-6):
        problem = f"all columns have samples for {max(0.0, time[last] - time[first]):.3g} s only"
        _refuse(path, problem, f"record {SHORTEST:g} s or longer", column="time", row=first)
    return first, last


def _seen(columns: dict[str, _Column], names: Iterable[str]) -> Bool[np.ndarray, " T"]:
    return ~np.any([np.isnan(columns[name]) for name in names], axis=0)


def _check_frame(path: Path, recording: Recording) -> None:
    """Refuse what at the start is surely not: z up, x forward, y left, the robot on a floor at z = 0."""
    balloon, quaternion = recording.balloon_position, recording.balloon_quaternion
    base, feet = recording.base_position, recording.foot_position
    assert balloon is not None and quaternion is not None and base is not None and feet is not None
    row = recording.trimmed[0]
    if not balloon[0, 2] > base[0, 2] > feet[0, :, 2].max():
        column = "balloon_z" if balloon[0, 2] <= base[0, 2] else "base_z"
        problem = "at the start the balloon is not above the base and the base not above the feet"
        _refuse(path, problem, "put the axes in the order x forward, y left, z up", column=column, row=row)
    lowest = feet[:, :, 2].min(axis=0)
    if abs(lowest.min()) > _FLOOR_TOLERANCE:
        side = int(lowest.argmin())
        problem = f"the feet come down to {lowest[side]:.3g} m and not to the floor at 0"
        sample = row + int(feet[:, side, 2].argmin())
        column = f"foot_{robot.SIDES[side]}_z"
        mend = "put the origin of the frame on the floor, or import with floor = 'feet' in the mapping file"
        _refuse(path, problem, mend, column=column, row=sample)
    rotation = Rotation.from_quat(quaternion[0], scalar_first=True).as_matrix()
    if rotation[2, 2] < 0 or rotation[0, 0] < 0:
        problem = "at the start the balloon does not stand upright and look forward along x"
        mend = "write the quaternion in w, x, y, z order, in a frame with x forward, y left, z up"
        _refuse(path, problem, mend, column="balloon_qw", row=row)
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    apart = feet[0, 0] - feet[0, 1]
    if apart @ np.array([-np.sin(yaw), np.cos(yaw), 0.0]) < _SMALLEST_STANCE:
        problem = "at the start the left foot is not to the left of the right one, seen along the balloon's x"
        mend = "swap the feet, or mend the frame: x forward, y left"
        _refuse(path, problem, mend, column="foot_left_y", row=row)


# ---- gaps ----


def _fill(
    columns: dict[str, _Column], layout: _Layout, groups: list[str], rows: slice
) -> tuple[dict[str, Float[np.ndarray, "_ _"]], dict[str, int]]:
    """Fields without gaps over `rows`, and the number of samples filled in by column."""
    time = columns["time"]
    fields: dict[str, np.ndarray] = {}
    interpolated: dict[str, int] = {}
    for field in groups:
        names = layout.columns[field]
        value = np.stack([columns[name] for name in names], axis=1)
        if field in _QUATERNIONS:
            seen = _seen(columns, names)
            filled = dict.fromkeys(names, int((~seen[rows]).sum()))
            value = _fill_quaternions(time, value, seen)[rows]
        else:
            filled = {name: int(np.isnan(columns[name][rows]).sum()) for name in names}
            for column in value.T:
                gap = np.isnan(column)
                column[gap] = np.interp(time[gap], time[~gap], column[~gap])
            value = value[rows]
        fields[field] = value
        interpolated |= {name: count for name, count in filled.items() if count}
    return fields, interpolated


def _fill_quaternions(
    time: _Column, quaternion: Float[np.ndarray, "T 4"], seen: Bool[np.ndarray, " T"]
) -> Float[np.ndarray, "T 4"]:
    """Unit quaternions (w, x, y, z) without gaps between the first and last seen, continuous in sign, first w >= 0."""
    known = np.flatnonzero(seen)
    inside = ~seen & (np.arange(len(time)) >= known[0]) & (np.arange(len(time)) <= known[-1])
    quaternion = quaternion.copy()
    quaternion[seen] /= np.linalg.norm(quaternion[seen], axis=1, keepdims=True)
    if inside.any():
        slerp = Slerp(time[seen], Rotation.from_quat(quaternion[seen], scalar_first=True))
        quaternion[inside] = slerp(time[inside]).as_quat(scalar_first=True)
    kept = quaternion[known[0] : known[-1] + 1]
    turned = np.einsum("ti,ti->t", kept[1:], kept[:-1]) < 0
    start = -1.0 if kept[0, 0] < 0 else 1.0
    kept *= start * np.cumprod(np.concatenate([[1.0], np.where(turned, -1.0, 1.0)]))[:, None]
    return quaternion


def _first(bad: np.ndarray) -> int | None:
    """Index of the first true entry."""
    return int(bad.argmax()) if bad.any() else None
