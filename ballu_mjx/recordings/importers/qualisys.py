"""Reader of Qualisys Track Manager's TSV exports (https://docs.qualisys.com, "Motion data (.tsv)" and "6DOF data").

    NO_OF_FRAMES<tab>22245
    FREQUENCY<tab>100
    DATA_INCLUDED<tab>6D                        or 3D
    BODY_NAMES<tab>hull<tab>base                or MARKER_NAMES
    Frame<tab>Time<tab>hull X<tab>Y<tab>Z<tab>Roll<tab>Pitch<tab>Yaw<tab>Residual<tab>Rot[0]<tab>...<tab>Rot[8]<tab>
    1<tab>0.00000<tab>...

Lengths are in mm. Rot[0] to Rot[8] are the rotation matrix of the body's frame in the room's, column by column. Roll,
pitch and yaw depend on the export settings and are not used. A body or marker whose numbers are all 0, empty or NULL
was not seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ballu_mjx.common.files import read_text
from ballu_mjx.recordings.importers.capture import Capture, Stream
from ballu_mjx.recordings.importers.mapping import RoomMapping
from ballu_mjx.recordings.importers.text import check_times, parse_number, read_numbers, split_cells
from ballu_mjx.recordings.importers.trajectories import LENGTHS, refuse, shorten

_PROGRAM = "a Qualisys TSV"
_KEYS = ("FILE_VERSION", "NO_OF_FRAMES")
"""A file begins with one of these."""
_FIRST_ROWS = 20
"""Number of rows among which the keys of the header are searched."""
_NAMES = {"3D": "MARKER_NAMES", "6D": "BODY_NAMES"}
_ROTATION = tuple(f"Rot[{i}]" for i in range(9))
_BODY_COLUMNS = ("X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *_ROTATION)
_TOLERANCE = 0.02
"""Tolerance of the orthonormality of a rotation matrix, which the file has with five decimals."""


def recognise_qualisys(path: Path, start: str) -> bool:
    """Return whether a file that begins with `start` is a Qualisys TSV, possibly without its first lines."""
    del path
    keys = {line.partition("\t")[0] for line in start.lstrip("\ufeff").splitlines()[:_FIRST_ROWS]}
    return start.lstrip("\ufeff").startswith(_KEYS) or "DATA_INCLUDED" in keys


def open_qualisys(path: Path, mapping: RoomMapping | None) -> Capture:
    """Return the markers (3D) or bodies (6D) of the TSV at `path`.

    **Raises** `InputError` naming file and line if a part is missing or cut off, if a cell is not a number, or if times
    do not increase.
    """
    lines = read_text(path).splitlines()
    keys: dict[str, list[str]] = {}
    places: dict[str, int] = {}
    first = 0
    for first, line in enumerate(lines):
        cells = split_cells(line, "\t")
        key = cells[0]
        if not (key.replace("_", "").isupper() and key.isascii()):
            break
        keys.setdefault(key, [cell for cell in cells[1:]])
        places.setdefault(key, first + 1)
    included = keys.get("DATA_INCLUDED", [""])[0]
    if included not in _NAMES or _NAMES[included] not in keys:
        problem = f"DATA_INCLUDED is {shorten(included)!r}" + ("" if included not in _NAMES else ", without names")
        refuse(path, "", problem, "export 3D or 6D data with the TSV header")
    names = [name for name in keys[_NAMES[included]] if name]
    doubled = next((name for i, name in enumerate(names) if name in names[:i]), None)
    if doubled is not None:
        place = f"line {places[_NAMES[included]]}"
        refuse(path, place, f"{shorten(doubled)!r} appears twice", "give them different names and export again")
    columns, samples, leading = _columns(path, lines, first, included, names)
    table = read_numbers(path, lines, samples, columns, "\t")
    frames = keys.get("NO_OF_FRAMES", [""])[0]
    stated = parse_number(frames)
    if stated is None:
        problem = f"NO_OF_FRAMES is {shorten(frames)!r}, so the number of frames cannot be checked"
        refuse(path, f"line {places.get('NO_OF_FRAMES', 1)}", problem, "export again with the TSV header")
    if len(table) < stated:
        problem = f"holds {len(table)} of the {stated:g} frames that its header states"
        refuse(path, "", problem, "the file was cut off; copy or export it again")
    frame = 1.0 + np.arange(len(table))
    if "Frame" in leading:
        frame = table[:, leading.index("Frame")]
        check_times(path, frame, samples, "export again, one capture per file")
    if "Time" in leading and (mapping is None or mapping.rate is None):
        time = table[:, leading.index("Time")]
        check_times(path, time, samples, "export again, or write rate = ... in the mapping")
    else:
        rate = _rate(path, places.get("FREQUENCY", 1), keys.get("FREQUENCY", [""])[0], mapping)
        time = (frame - 1) / rate
    unit = LENGTHS["mm"] if mapping is None or mapping.length is None else LENGTHS[mapping.length]
    index = {name: i for i, name in enumerate(columns)}
    bodies = {
        name: _marker(table, index, name, time, unit)
        if included == "3D"
        else _body(path, table, index, name, time, unit)
        for name in names
    }
    notes = [] if "Time" in leading else ["Times are computed from FREQUENCY, because there is no time column."]
    return Capture(path, _PROGRAM, bodies, notes=notes, first_frame=int(frame[0]) if len(frame) else 1)


def _columns(
    path: Path, lines: Sequence[str], first: int, included: str, names: Sequence[str]
) -> tuple[list[str], int, list[str]]:
    """Return the full names of the columns, the line of the first sample, and the leading ones of Frame and Time.

    Without a row of names, the columns are those of the documentation.
    """
    cells = split_cells(lines[first], "\t") if first < len(lines) else []
    while cells and not cells[-1]:
        cells.pop()
    of_each = ("X", "Y", "Z") if included == "3D" else _BODY_COLUMNS
    if not cells or parse_number(cells[0]) is not None:
        leading = {0: [], 2: ["Frame", "Time"]}.get(len(cells) - len(of_each) * len(names))
        if leading is None:
            problem = f"the row has {len(cells)} cells, but {len(names)} names need {len(of_each) * len(names)}"
            fix = "export with column headers, and either with both frame and time or with neither"
            refuse(path, f"line {first + 1}", problem, fix)
        return [*leading, *(f"{name} {part}" for name in names for part in of_each)], first, leading
    leading = [cell for cell in cells[:2] if cell in ("Frame", "Time")]
    columns, current = list(leading), ""
    # A name can be the beginning of another one, so the longest match counts.
    by_length = sorted(names, key=len, reverse=True)
    for cell in cells[len(leading) :]:
        owner = next((name for name in by_length if cell.startswith(f"{name} ")), None)
        if owner is not None:
            current, cell = owner, cell[len(owner) + 1 :]
        columns.append(f"{current} {cell}")
    needed = [f"{name} {part}" for name in names for part in ("X", "Y", "Z")]
    missing = next((name for name in needed if name not in columns), None)
    if missing is not None:
        refuse(path, f"line {first + 1}", f"the column {shorten(missing)!r} is missing", "export again")
    return columns, first + 1, leading


def _rate(path: Path, line: int, text: str, mapping: RoomMapping | None) -> float:
    rate = mapping.rate if mapping is not None and mapping.rate is not None else parse_number(text)
    if rate is None or not 1 <= rate <= 1e5:
        problem = f"FREQUENCY {shorten(text)!r} is not a rate in Hz"
        refuse(path, f"line {line}", problem, "export with times, or write rate = ... in the mapping")
    return rate


def _marker(table: np.ndarray, index: Mapping[str, int], name: str, time: np.ndarray, unit: float) -> Stream:
    position = table[:, [index[f"{name} {axis}"] for axis in "XYZ"]] * unit
    position[(position == 0).all(axis=1)] = np.nan
    return Stream(time, position)


def _body(path: Path, table: np.ndarray, index: Mapping[str, int], name: str, time: np.ndarray, unit: float) -> Stream:
    stream = _marker(table, index, name, time, unit)
    present = [part for part in _ROTATION if f"{name} {part}" in index]
    if len(present) < len(_ROTATION):
        if present:
            fix = "export the whole matrix, Rot[0] to Rot[8]"
            refuse(path, "", f"{shorten(name)!r} has a rotation matrix with {len(present)} of 9 columns", fix)
        return stream
    matrices = table[:, [index[f"{name} {part}"] for part in _ROTATION]].reshape(-1, 3, 3).transpose(0, 2, 1)
    return Stream(time, stream.position, _quaternions(path, name, matrices, stream.position))


def _quaternions(
    path: Path, name: str, matrices: Float[np.ndarray, "T 3 3"], position: Float[np.ndarray, "T 3"]
) -> Float[np.ndarray, "T 4"]:
    seen = ~(np.isnan(matrices).any(axis=(1, 2)) | np.isnan(position).any(axis=1) | (matrices == 0).all(axis=(1, 2)))
    whole = matrices[seen]
    error = np.abs(whole @ whole.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    bad = (error > _TOLERANCE) | (np.linalg.det(whole) < 0)
    if bad.any():
        row = int(np.flatnonzero(seen)[int(bad.argmax())])
        problem = f"Rot[0] to Rot[8] of sample {row + 1} are not a rotation matrix"
        refuse(path, shorten(name), problem, "export again")
    quaternion = np.full((len(matrices), 4), np.nan)
    if seen.any():
        quaternion[seen] = Rotation.from_matrix(whole).as_quat(scalar_first=True)
    return quaternion
