"""Reader of OptiTrack Motive's CSV exports, format versions 1.2x (https://docs.optitrack.com, "Data Export: CSV").

    Format Version,1.23,Take Name,...,Rotation Type,Quaternion,Length Units,Meters,Coordinate Space,Global
    (empty)
    ,Type,Rigid Body,Rigid Body,...             Rigid Body, Rigid Body Marker, Bone, Bone Marker, Marker
    ,Name,hull,hull,...
    ,ID,506381AA,...                            some versions have a row Parent here
    ,,Rotation,Rotation,Rotation,Rotation,Position,...,Mean Marker Error
    Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,...
    0,0.000000,...                              an empty cell: the sample was not seen

Motive's default axes have y up. Quaternions (x, y, z, w) are the orientation of the body's frame in the room's.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

from ballu_mjx.common.files import read_text
from ballu_mjx.recordings.importers.capture import Capture, Stream
from ballu_mjx.recordings.importers.mapping import RoomMapping
from ballu_mjx.recordings.importers.text import check_times, read_numbers, split_cells
from ballu_mjx.recordings.importers.trajectories import ANGLES, LENGTHS, refuse, shorten, to_quaternion

_PROGRAM = "an OptiTrack Motive CSV"
_UNITS = {"meters": "m", "metres": "m", "centimeters": "cm", "millimeters": "mm"}
_BODIES, _MARKERS = ("rigid body", "bone"), ("marker",)
_EXPECTED = ("rigid body marker", "bone marker")
"""Positions of markers according to the body's definition, not measurements."""
_AXES, _LETTERS = ("X", "Y", "Z"), ("X", "Y", "Z", "W")
_FIRST_ROWS = 20
"""Number of rows among which the row that begins with Frame is searched."""
_MEND = "export again, with header"


def recognise_motive(path: Path, start: str) -> bool:
    """Return whether a file that begins with `start` is a Motive CSV, possibly without its first lines."""
    del path
    if start.lstrip("\ufeff\n\r").startswith(("Format Version", '"Format Version"')):
        return True
    lines = start.splitlines()[:_FIRST_ROWS]
    return any(line.startswith("Frame") and "Position" in above for above, line in itertools.pairwise(lines))


def open_motive(path: Path, mapping: RoomMapping | None) -> Capture:
    """Return the bodies and markers of the Motive CSV at `path`.

    **Raises** `InputError` naming file and line if a part is missing or cut off, if a cell is not a number, if times do
    not increase, or if a unit is unknown.
    """
    lines = read_text(path).splitlines()
    delimiter = max(",;\t", key=next((line for line in lines if line.strip()), "").count)
    top = split_cells(next((line for line in lines if line.strip()), ""), delimiter)
    if top[0] != "Format Version":
        refuse(path, "line 1", "the line that begins with Format Version, and states the units, is missing", _MEND)
    header = next(
        (
            i
            for i, line in enumerate(lines[:_FIRST_ROWS])
            if (cells := split_cells(line, delimiter))[0] == "Frame" and cells[1:2] and cells[1].startswith("Time")
        ),
        None,
    )
    if header is None:
        refuse(path, "", "no line begins with Frame, Time (Seconds)", _MEND)
    axes = split_cells(lines[header], delimiter)
    types, names, components = _header_rows(path, lines, header, delimiter, len(axes))
    for row in (types, names, components):
        if len(row) > len(axes) and any(row[len(axes) :]):
            refuse(path, f"line {header + 1}", "the row ends before the names above it", _MEND)
    columns = [f"{names[i]} {components[i]} {axes[i]}".strip() if i > 1 else axes[i] for i in range(len(axes))]
    table = read_numbers(path, lines, header + 1, columns, delimiter)
    frame = table[:, 0]
    check_times(path, frame, header + 1, "export again, one take per file")
    rate = None if mapping is None else mapping.rate
    if rate is None:
        time = table[:, 1]
        check_times(path, time, header + 1, "export again, one take per file")
    else:
        time = frame / rate  # Frame 0 is the start of the take, also in a file that is cropped.
    unit = _length(path, _value(top, "Length Units"), mapping)
    rotation = _value(top, "Rotation Type")
    local = _value(top, "Coordinate Space").lower() == "local"

    groups: dict[tuple[str, str], dict[tuple[str, str], int]] = {}
    for i in range(2, len(axes)):
        if types[i] and names[i]:
            group = groups.setdefault((types[i].lower(), names[i]), {})
            if (components[i], axes[i]) in group:
                problem = f"{shorten(names[i])!r} has {components[i]} {axes[i]} twice"
                refuse(path, f"line {header + 1}", problem, "give assets different names and export again")
            group[components[i], axes[i]] = i
    bodies: dict[str, Stream] = {}
    notes = ["Motive's axes have y up unless the export settings say otherwise."]
    hidden = []
    # Bodies before markers, because in a skeleton's export a marker and a bone may have the same name.
    for (kind, name), group in sorted(groups.items(), key=lambda item: item[0][0] in _MARKERS):
        if kind not in (*_BODIES, *_MARKERS):
            continue
        lacking = [axis for axis in _AXES if ("Position", axis) not in group]
        if lacking:
            problem = f"{shorten(name)!r} has no column Position {', '.join(lacking)}"
            refuse(path, f"line {header + 1}", problem, _MEND)
        if kind == "bone" and local:
            notes.append(f"{shorten(name)!r} is in its parent's frame (Coordinate Space Local) and is not read.")
            continue
        if name in bodies and kind in _MARKERS:
            hidden.append(name)
            continue
        if name in bodies:
            problem = f"{shorten(name)!r} is the name of two bodies"
            refuse(path, f"line {header + 1}", problem, "rename one and export again")
        position = table[:, [group["Position", axis] for axis in _AXES]] * unit
        bodies[name] = Stream(time, position)
        turns = [group.get(("Rotation", letter)) for letter in _LETTERS]
        if kind not in _BODIES or all(turn is None for turn in turns[:3]):
            continue
        place = f"line {header + 1}, {shorten(name)}"
        if any(turn is None for turn in turns[:3]) or (rotation == "Quaternion") != (turns[3] is not None):
            problem = f"its rotation has the columns {', '.join(a for (c, a) in group if c == 'Rotation')}"
            refuse(path, place, f"{problem}, but Rotation Type is {shorten(rotation)!r}", "export quaternions again")
        values = table[:, [turn for turn in turns if turn is not None]]
        if turns[3] is not None:
            quaternion = to_quaternion(path, place, values[:, [3, 0, 1, 2]], "quaternion", 1.0)
            bodies[name] = Stream(time, position, quaternion)
        else:
            bodies[name] = Stream(time, position, angles=values * ANGLES["deg"])
    if hidden:
        notes.append(f"Markers that share their names with bodies are not read: {_first_of(hidden)}.")
    expected = [name for (kind, name), _ in groups.items() if kind in _EXPECTED and name not in bodies]
    if expected:
        notes.append(f"Expected positions of markers are not measurements and are not read: {_first_of(expected)}.")
    return Capture(path, _PROGRAM, bodies, notes=notes, first_frame=int(frame[0]) + 1 if len(frame) else 1)


def _first_of(names: Sequence[str]) -> str:
    return ", ".join(shorten(name) for name in names[:4]) + (", ..." if len(names) > 4 else "")


def _header_rows(
    path: Path, lines: Sequence[str], header: int, delimiter: str, width: int
) -> tuple[list[str], list[str], list[str]]:
    """Return type, name and component of each column.

    Their rows are found by the second cell (Type, Name), or else by their order.
    """
    rows = [split_cells(line, delimiter) for line in lines[1:header]]
    rows = [row for row in rows if any(row)]
    found = {row[1].lower(): row for row in rows if len(row) > 1 and row[1]}
    bare = [row for row in rows if len(row) > 1 and not row[1]]
    if "type" in found and "name" in found and bare:
        chosen = found["type"], found["name"], bare[-1]
    elif not found and len(bare) >= 3:
        chosen = bare[0], bare[1], bare[-1]
    else:
        problem = "the rows Type, Name and Rotation or Position above it are not complete"
        refuse(path, f"line {header + 1}", problem, _MEND)
    types, names, components = ([*row, *[""] * width] if len(row) < width else list(row) for row in chosen)
    return types, names, components


def _value(top: Sequence[str], key: str) -> str:
    """Return the cell after `key` in the first line. Empty if there is none."""
    place = next((i for i, cell in enumerate(top) if cell == key), len(top))
    return top[place + 1] if place + 1 < len(top) else ""


def _length(path: Path, stated: str, mapping: RoomMapping | None) -> float:
    unit = _UNITS.get(stated.lower())
    if mapping is not None and mapping.length is not None:
        unit = mapping.length
    if unit is None:
        fix = 'export in Meters, or write length = "..." under [units] in the mapping'
        refuse(path, "line 1, Length Units", f"{shorten(stated)!r} is not a known unit of length", fix)
    return LENGTHS[unit]
