"""Recording files, format `ballu-recording/1`: a CSV with one row per sample, and a JSON description beside it."""

from __future__ import annotations

import array
import csv
import difflib
import gzip
import io
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation, Slerp

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.filters import count_turns, turns_freely
from ballu_mjx.recordings.recording import Column, ColumnGroup, Kind, Recording, Split, column_groups, values_of
from ballu_mjx.recordings.recording_hooks import hooks_of
from ballu_mjx.recordings.validation import (
    blank_held,
    check_cells,
    check_gaps,
    check_lengths,
    check_time,
    has_sample,
    present_groups,
    refuse_recording,
)
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import assets

RECORDING_FORMAT = "ballu-recording/1"

_ENDINGS = (".csv", ".csv.gz")
_COMMAND_DECIMALS = 4


def read_recording(path: Path | str, robot: RobotDescription) -> Recording:
    """Read the recording of `robot` at `path`, validate it, and fill its gaps.

    `path` is a `.csv` or `.csv.gz` file with its `.json` description beside it. Gaps of up to 0.5 s are interpolated
    linearly, orientations along the shortest rotation. If the angle of a hinge without a range restarts each turn, its
    turns are counted first, so that a gap adds no full turn. A pose that repeats to the last digit is a gap too, since
    streaming clients repeat the last pose of a body that they do not see.

    **Raises** `InputError` for the first fault found, with file, column, row and fix. The header is row 1, as in a
    spreadsheet.
    """
    path = Path(path)
    description, known = sidecar_path(path), column_groups(robot)
    columns = _read_columns(path, known)
    kind, made_by, notes = _read_description(description)
    groups = present_groups(path, columns, known, kind)
    check_time(path, columns["time"], robot)
    check_lengths(path, columns, groups)
    held = blank_held(path, columns, groups)
    check_cells(path, columns, groups, robot, kind)
    first, last = check_gaps(path, columns, groups, kind)
    values, interpolated = _fill(columns, groups, slice(first, last + 1), _turning(groups, robot))

    def by_part(quantity: str) -> dict[str, np.ndarray]:
        return {group.part: value for group, value in values.items() if group.quantity == quantity}

    positions, quaternions = by_part("position"), by_part("quaternion")
    recording = Recording(
        name=recording_name(path),
        kind=kind,
        robot=made_by,
        notes=notes,
        time=by_part("time")[""][:, 0],
        command=by_part("command")[""],
        tracked_position=positions.pop(robot.tracked, None),
        tracked_quaternion=quaternions.pop(robot.tracked, None),
        points=positions,
        orientations=quaternions,
        joint_angles={joint: value[:, 0] for joint, value in by_part("angle").items()},
        interpolated=interpolated,
        held=held,
        trimmed=(first, len(columns["time"]) - 1 - last),
    )
    hooks_of(robot).check_recording(path, recording)
    return recording


def write_recording(recording: Recording, path: Path | str, robot: RobotDescription, *, decimals: int = 5) -> None:
    """Write `recording` of `robot` to `path`, and its description to a `.json` file beside it.

    `path` ends in `.csv`, or in `.csv.gz` for a compressed file. Numbers of decimals are:

    - positions and angles: `decimals`;
    - quaternions: one fewer;
    - commands: 4 after the first digit of the width of their range, and at least 4. A command that rounds as a bound of
      its range does is written as this bound, with all of its digits;
    - time: 3 to 6, as few as represent it exactly.

    NaN becomes an empty cell. The same recording always gives the same bytes. Those of compressed files also depend on
    the version of zlib.

    **Raises** `ValueError` for infinite values or shapes that do not fit. **Raises** `InputError` for another ending of
    `path`.
    """
    path = Path(path)
    description = sidecar_path(path)
    length = len(recording.time)
    header: list[str] = []
    cells: list[list[str]] = []
    for group in column_groups(robot):
        value = values_of(recording, group, robot)
        if value is None:
            continue
        value = np.asarray(value, float).reshape(length, len(group.names))
        if np.isinf(value).any():
            raise ValueError(f"{', '.join(group.names)}: a value is infinite")
        header += group.names
        columns = value.T.tolist()
        if group.quantity == "command":
            ranges = zip(columns, robot.command_ranges, strict=True)
            cells += [[_command_text(x, *limits) for x in column] for column, limits in ranges]
        else:
            places = _time_decimals(value) if group.quantity == "time" else decimals - (group.quantity == "quaternion")
            cells += [[_text(x, places) for x in column] for column in columns]
    lines = [",".join(header), *(",".join(row) for row in zip(*cells, strict=True))]
    content = ("\n".join(lines) + "\n").encode()
    if path.name.endswith(".gz"):
        buffer = io.BytesIO()
        with gzip.GzipFile(filename="", mode="wb", compresslevel=9, fileobj=buffer, mtime=0) as stream:
            stream.write(content)
        content = buffer.getvalue()
    files.write(path, content)
    keys = {"format": RECORDING_FORMAT, "kind": recording.kind, "robot": recording.robot, "notes": recording.notes}
    files.write(description, json.dumps(keys, indent=2, ensure_ascii=False) + "\n")


def list_recordings(paths: Iterable[Path | str]) -> list[Path]:
    """Return the recordings in `paths`, each once. A path is a recording or a folder of recordings (sorted by name).

    **Raises** `InputError` for a path that does not exist, is not a recording, or is a folder without recordings.
    """
    found: dict[Path, Path] = {}
    for path in map(Path, paths):
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.name.endswith(_ENDINGS) and not p.name.startswith("."))
            if not inside:
                raise InputError(f"{path}: the folder holds no recording (.csv or .csv.gz); give a folder that does.")
            twice = [b for a, b in zip(inside, inside[1:], strict=False) if recording_name(a) == recording_name(b)]
            if twice:
                raise InputError(f"{twice[0]}: the same recording exists without .gz; delete one of the two files.")
        elif path.exists():
            sidecar_path(path)
            inside = [path]
        else:
            raise InputError(f"{path}: there is no such file or folder; check the path.")
        for p in inside:
            found.setdefault(p.resolve(), p)
    return list(found.values())


def list_bundled(split: Split) -> list[Path]:
    """Return the recordings of a bundled set, sorted by name."""
    return list_recordings([assets() / "recordings" / split])


def check_new(path: Path) -> None:
    """Check that a new recording can be written to `path`.

    **Raises** `InputError` with the fix if `path` is not the name of a recording, if it exists, or if its folder cannot
    be written to.
    """
    for each in (path, sidecar_path(path)):
        if each.exists():
            raise InputError(f"{each}: exists already; delete it, or give another --output.")
    files.check_folder(path.parent)


def recording_name(path: Path) -> str:
    """Return the name of the recording in a file, which is the file's name without its ending."""
    return path.name.removesuffix(".gz").removesuffix(".csv")


def sidecar_path(path: Path) -> Path:
    """Return the path of the description of the recording in `path`.

    **Raises** `InputError` if `path` is not the name of a recording.
    """
    if not path.name.endswith(_ENDINGS) or not recording_name(path):
        raise InputError(f"{path}: not the name of a recording; it must end in .csv or .csv.gz.")
    return path.with_name(recording_name(path) + ".json")


def _read_description(path: Path) -> tuple[Kind, str, str]:
    """Read a description, and return kind, robot and notes."""
    example = f'{{"format": "{RECORDING_FORMAT}", "kind": "free", "robot": "...", "notes": "..."}}'
    if not path.is_file():
        refuse_recording(path, "there is no description beside the recording", f"write one like {example}")
    keys = files.read_json(path, f"write it like {example}")
    if keys.get("format") != RECORDING_FORMAT:
        refuse_recording(
            path,
            f'"format" is {_quote(keys, "format")}',
            f'it must be "{RECORDING_FORMAT}", the format this version reads',
        )
    kind, made_by, notes = keys.get("kind"), keys.get("robot"), keys.get("notes", "")
    if kind not in ("free", "suspended"):
        refuse_recording(path, f'"kind" is {_quote(keys, "kind")}', 'write "free", or "suspended" if the root is held')
    if not isinstance(made_by, str) or not made_by.strip():
        refuse_recording(path, f'"robot" is {_quote(keys, "robot")}', "write the name of the recorded robot, as text")
    if not isinstance(notes, str):
        refuse_recording(path, f'"notes" is {_quote(keys, "notes")}', "write text there")
    return kind, made_by, notes


def _quote(keys: dict, key: str) -> str:
    if key not in keys:
        return "missing"
    text = json.dumps(keys[key])
    return text if len(text) <= 40 else text[:40] + "..."


def _read_columns(path: Path, groups: Sequence[ColumnGroup]) -> dict[str, Column]:
    """Read the CSV's columns by name, with NaN for missing samples."""
    text = files.read_text(path)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    values = array.array("d")
    header: list[str] | None = None
    rows = blank = 0
    try:
        for cells in reader:
            if header is None:
                header = _check_header(path, groups, [name.strip() for name in cells])
                continue
            if not any(map(str.strip, cells)):
                blank += 1  # Blank lines are allowed only at the end of the file.
                continue
            if blank:
                refuse_recording(path, "the row is blank", "delete it or fill it in", column="time", row=rows)
            values.extend(_parse_row(path, header, cells, rows))
            rows += 1
    except csv.Error as error:
        row = None if header is None else rows + blank
        refuse_recording(path, f"not readable as a table ({error})", "save it as plain CSV", row=row)
    if header is None:
        refuse_recording(path, "the file is empty", "record again or leave it out")
    if not rows:
        refuse_recording(path, "there is no sample below the header", "record again or leave it out", row=0)
    table = np.frombuffer(values, float).reshape(rows, len(header))
    return {name: table[:, i] for i, name in enumerate(header)}


def _check_header(path: Path, groups: Sequence[ColumnGroup], header: list[str]) -> list[str]:
    known = [name for group in groups for name in group.names]
    if len(header) == 1 and any(mark in header[0] for mark in ";\t"):
        refuse_recording(
            path, "the header has no commas", "save it with commas between cells and decimal points in numbers", row=-1
        )
    foreign = sum(name not in known for name in header) > 1
    for i, name in enumerate(header):
        if name not in known:
            close = difflib.get_close_matches(name[:40].lower(), known, 1)
            fix = (
                f"rename it to {close[0]} or delete it"
                if close
                else "delete it, since the robot's description does not have it"
            )
            if foreign:
                fix += ", or give the recording's own robot (--robot)"
            refuse_recording(
                path, "unknown column", fix, column=_shorten(name) if name else f"{i + 1} (no name)", row=-1
            )
        if name in header[:i]:
            refuse_recording(path, "the column appears twice", "delete one", column=name, row=-1)
    return header


def _parse_row(path: Path, header: list[str], cells: list[str], row: int) -> list[float]:
    if len(cells) < len(header):
        name = header[len(cells)]
        refuse_recording(path, "the row ends before it", "complete the row or delete it", column=name, row=row)
    if any(cell.strip() for cell in cells[len(header) :]):
        name = f"{len(header) + 1} (no name)"
        refuse_recording(
            path,
            "the row has more cells than the header",
            "write decimal points in numbers, not commas",
            column=name,
            row=row,
        )
    numbers = []
    for name, cell in zip(header, cells, strict=False):
        try:
            number = float(cell) if cell else math.nan
            plain = not cell or (math.isfinite(number) and "_" not in cell)
        except ValueError:
            plain, number = not cell.strip(), math.nan
        if not plain:
            fix = "write a finite number, or leave the cell empty if the sample is missing"
            refuse_recording(path, f"{_shorten(cell)!r} is not a finite number", fix, column=name, row=row)
        numbers.append(number)
    return numbers


def _shorten(text: str) -> str:
    return text if len(text) <= 40 else text[:40] + "..."


def _text(value: float, decimals: int) -> str:
    if math.isnan(value):
        return ""
    text = f"{value:.{decimals}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def _command_text(value: float, low: float, high: float) -> str:
    """Return a command as text, within its range `low` to `high`."""
    decimals = _COMMAND_DECIMALS + max(0, -math.floor(math.log10(high - low)))
    text = _text(value, decimals)
    for bound in (low, high):
        if text == _text(bound, decimals):  # The rounded bound may be outside of the range.
            return np.format_float_positional(bound, trim="-")
    return text


def _time_decimals(time: np.ndarray) -> int:
    exact = (d for d in range(3, 6) if np.abs(np.round(time, d) - time).max(initial=0.0) < 1e-9)
    return next(exact, 6)


# ---- gaps ----


def _turning(groups: Sequence[ColumnGroup], robot: RobotDescription) -> set[ColumnGroup]:
    """Return the angles of hinges without a range."""
    angles = [group for group in groups if group.quantity == "angle"]
    if not angles:  # Loading the model takes time.
        return set()
    model = robot.load_model()
    return {group for group in angles if turns_freely(model, group.part)}


def _fill(
    columns: dict[str, Column], groups: Sequence[ColumnGroup], rows: slice, turning: set[ColumnGroup]
) -> tuple[dict[ColumnGroup, Float[np.ndarray, "_ _"]], dict[str, int]]:
    """Fill gaps. Return the values of each group in `rows`, and the number of interpolated samples by column.

    `turning`: angles whose turns are counted.
    """
    time = columns["time"]
    values: dict[ColumnGroup, np.ndarray] = {}
    interpolated: dict[str, int] = {}
    for group in groups:
        value = np.stack([columns[name] for name in group.names], axis=1)
        if group.quantity == "quaternion":
            seen = has_sample(columns, group.names)
            filled = dict.fromkeys(group.names, int((~seen[rows]).sum()))
            value = _fill_quaternions(time, value, seen)[rows]
        else:
            filled = {name: int(np.isnan(columns[name][rows]).sum()) for name in group.names}
            for column in value.T:
                if group in turning:
                    column[:] = count_turns(column)
                gap = np.isnan(column)
                column[gap] = np.interp(time[gap], time[~gap], column[~gap])
            value = value[rows]
        values[group] = value
        interpolated |= {name: count for name, count in filled.items() if count}
    return values, interpolated


def _fill_quaternions(
    time: Column, quaternion: Float[np.ndarray, "T 4"], seen: Bool[np.ndarray, " T"]
) -> Float[np.ndarray, "T 4"]:
    """Return unit quaternions (w, x, y, z), interpolated between the first and the last sample seen.

    Signs do not jump, and the first w is not negative.
    """
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
