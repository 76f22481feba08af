"""Reader of Vicon's CSV exports, from Nexus and Tracker.

A file holds one or more sections, separated by blank lines:

    Segments                                    title: Objects, Segments, Trajectories, Joints, Model Outputs, ...
    100                                         rate (Hz)
    ,,robot:base,,,,,,robot:body,,,,,           names, each above its first column; Tracker: "Global Angle robot"
    Frame,Sub Frame,RX,RY,RZ,TX,TY,TZ,RX,...    components; RX, RY, RZ, RW is a quaternion; markers have X, Y, Z
    ,,deg,deg,deg,mm,mm,mm,deg,...              units
    1,0,0.1,...                                 an empty cell: the sample was not seen

Commas, semicolons or tabs separate the cells. Frame numbers may begin anywhere. A body with 0 in every component was
not seen. The file does not state the convention of three rotation components. For Nexus's segments they are rotation
vectors (helical angles). For Tracker's objects they depend on the export settings.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ballu_mjx.common.files import read_text
from ballu_mjx.recordings.importers.contents import Contents, Item
from ballu_mjx.recordings.importers.mapping import MARKER_TOLERANCE, RoomMapping, Source
from ballu_mjx.recordings.importers.text import LARGEST, parse_number
from ballu_mjx.recordings.importers.trajectories import (
    ANGLES,
    LENGTHS,
    Body,
    Trajectories,
    find,
    refuse,
    rigid_body,
    shorten,
    suggest,
    to_quaternion,
)

_PREFIX = "Global Angle "
_TRANSLATIONS = (("TX", "TY", "TZ"), ("X", "Y", "Z"))
_ROTATION = ("RX", "RY", "RZ")
_HELICAL = ("Segments",)
"""Sections whose three rotation components are a rotation vector by default."""
_USED = ("Objects", "Segments", "Trajectories")
"""Sections that must be complete. Other sections are read if they have the same layout, else ignored (Events)."""
_TITLES = (*_USED, "Joints", "Model Outputs", "Devices", "Events")
_SEARCHED_ROWS = 12
_HEADER_ROWS = 5
_SPELLINGS: Mapping[str, str] = {"degrees": "deg", "degree": "deg", "°": "deg", "radians": "rad", "radian": "rad"}


@dataclasses.dataclass(frozen=True)
class _Group:
    """Columns of one name in one section."""

    section: _Section
    columns: Mapping[str, int]
    """Column by component."""
    units: Mapping[str, str]
    """Unit by component."""
    repeated: str | None
    """A component that appears twice, or None. It is an error only if the mapping selects the name."""


@dataclasses.dataclass(frozen=True)
class _Section:
    """Header of a section, and the lines of its samples. Lines count from 0."""

    title: str
    rate: float
    """Frame rate (Hz)."""
    first: int
    """First line of the samples."""
    last: int
    """Line after the last sample."""
    width: int
    """Number of columns."""
    names: Sequence[str]
    """Name above each column, without Tracker's prefix."""
    components: Sequence[str]
    units: Sequence[str]


_Values = Callable[[_Group, Sequence[str]], Float[np.ndarray, "T n"]]
"""Function that returns columns of a group, given their components, over all frames."""


def recognise_vicon(path: Path, start: str) -> bool:
    """Return whether a section begins in the first rows, with a title alone in its line or with a row of components."""
    del path
    rows = [_cells(line, ",") for line in start.replace(";", ",").replace("\t", ",").splitlines()]
    rows = [row for row in rows if any(row)]
    if any(_begins_components(row) for row in rows[:_SEARCHED_ROWS]):
        return True
    if not rows or any(rows[0][1:]) or parse_number(rows[0][0]) is not None:
        return False
    return rows[0][0] in _TITLES or any(row[0] == "Frame" for row in rows[:_SEARCHED_ROWS])


def _begins_components(cells: Sequence[str]) -> bool:
    return list(cells[:2]) in (["Frame", "Sub Frame"], ["Frame", "SubFrame"])


def list_vicon(path: Path) -> Contents:
    """Return the list of the bodies and markers in the Vicon CSV at `path`.

    **Raises** `InputError` naming file and line if a header is invalid.
    """
    lines = read_text(path).splitlines()
    items = []
    for name, groups in _groups(_sections(path, lines, _delimiter(path, lines))).items():
        for group in groups:
            turns = set(_ROTATION) <= set(group.columns)
            axes = next(axes for axes in _TRANSLATIONS if set(axes) <= set(group.columns))
            section = group.section
            open_rotation = turns and "RW" not in group.columns and section.title not in _HELICAL
            items.append(
                Item(
                    name,
                    "body" if turns else "marker",
                    section.last - section.first,
                    section.rate,
                    unit=group.units[axes[0]] or "unknown",
                    section=section.title if len(groups) > 1 else None,
                    rotation="helical" if open_rotation else None,
                )
            )
    notes = []
    if any(item.rotation for item in items):
        notes.append("RX, RY, RZ may be a rotation vector (helical) or Euler angles, depending on the export settings.")
    return Contents(path, "a Vicon CSV", items, notes=notes)


def read_vicon(path: Path, mapping: RoomMapping) -> Trajectories:
    """Return the bodies and markers that `mapping` names from the Vicon CSV at `path`.

    **Raises** `InputError` naming file and line if a part is missing or cut off, or if a cell is not a number. It also
    does so if frame numbers do not increase, or if a unit or a rotation convention is unknown.
    """
    lines = read_text(path).splitlines()
    delimiter = _delimiter(path, lines)
    sections = _sections(path, lines, delimiter)
    groups = _groups(sections)
    wanted = {role: _wanted(path, mapping.path, source, groups, sections) for role, source in mapping.sources.items()}
    if not wanted:
        refuse(mapping.path, "", "it selects no body of a Vicon file", "name the bodies of its sites")
    used = list({id(g.section): g.section for gs in wanted.values() for g in gs}.values())
    rates = {section.rate for section in used}
    if len(rates) > 1:
        refuse(path, "", f"sections run at {' and '.join(f'{r:g}' for r in sorted(rates))} Hz", "export at one rate")
    tables = {id(section): _read(path, lines, delimiter, section, wanted) for section in used}
    frames = np.unique(np.concatenate([frame for frame, _ in tables.values()]))

    def values(group: _Group, names: Sequence[str]) -> Float[np.ndarray, "T n"]:
        frame, columns = tables[id(group.section)]
        spread = np.full((len(frames), len(names)), np.nan)
        spread[np.searchsorted(frames, frame)] = np.stack([columns[group.columns[name]] for name in names], axis=1)
        return spread

    numbers, bodies = frames.astype(int), {}
    for role, source in mapping.sources.items():
        markers = [_position(path, mapping, group, values) for group in wanted[role]]
        if source.markers:
            geometry = None if source.geometry is None else np.array(source.geometry)
            bodies[role] = rigid_body(path, role, np.stack(markers), geometry, MARKER_TOLERANCE, numbers)
        else:
            bodies[role] = _body(path, mapping, source, wanted[role][0], markers[0], values, numbers)
    rate = mapping.rate or rates.pop()
    start = max(int(frames[0]), 1)
    return Trajectories(path, (frames - frames[0] + start - 1) / rate, bodies, first_frame=start)


def _delimiter(path: Path, lines: Sequence[str]) -> str:
    for line in lines:
        for delimiter in ",;\t":
            cells = [cell.strip(' "') for cell in line.split(delimiter)]
            if cells[0] == "Frame" and len(cells) > 1:
                return delimiter
    refuse(path, "", "no line begins with Frame, Sub Frame", "export as CSV from Nexus or Tracker, with its header")


def _cells(line: str, delimiter: str) -> list[str]:
    return [cell.strip(' "') for cell in line.split(delimiter)]


def _sections(path: Path, lines: Sequence[str], delimiter: str) -> list[_Section]:
    blank = [not line.strip(f' "{delimiter}') for line in lines]
    sections = []
    line = 0
    while line < len(lines):
        if blank[line]:
            line += 1
            continue
        end = next((i for i in range(line, len(lines)) if blank[i]), len(lines))
        section = _section(path, lines, delimiter, line, end)
        if section is not None:
            sections.append(section)
        line = end
    return sections


def _section(path: Path, lines: Sequence[str], delimiter: str, start: int, end: int) -> _Section | None:
    """Return the section in lines `start` to `end`. None if it has another layout and is not needed."""
    title = _cells(lines[start], delimiter)
    components = _cells(lines[start + 3], delimiter) if end - start >= _HEADER_ROWS else []
    laid_out = _begins_components(components)
    if not laid_out and not any(title[1:]) and parse_number(title[0]) is None and title[0] not in _USED:
        return None
    place = f"line {start + 1}"
    if any(title[1:]) or parse_number(title[0]) is not None:
        fix = "export again; a section begins with a blank line, then a title such as Segments alone in its line"
        refuse(path, place, "the section's title is missing", fix)
    if end - start < _HEADER_ROWS:
        problem = f"the section {shorten(title[0])!r} ends within its header"
        refuse(path, place, problem, "export again; title, rate, names, components and units must precede the samples")
    rate_row, names, units = (_cells(lines[start + i], delimiter) for i in (1, 2, 4))
    rate = parse_number(rate_row[0])
    if rate is None or not 1 <= rate <= 1e5 or any(rate_row[1:]):
        problem = f"{shorten(delimiter.join(rate_row))!r} is not a rate in Hz"
        refuse(path, f"line {start + 2}", problem, "export again; the rate must be alone in the line below the title")
    if not laid_out:
        problem = f"the row of components begins with {shorten(delimiter.join(components[:2]))!r}"
        fix = "export again; it must begin with Frame, Sub Frame, below title, rate and names"
        refuse(path, f"line {start + 4}", problem, fix)
    if parse_number(units[0]) is not None:
        fix = "export again; the units must be between components and samples"
        refuse(path, f"line {start + 5}", "it holds numbers instead of units", fix)
    while components and not components[-1]:
        components.pop()
    width = len(components)
    spread, current = [], ""
    for cell in [*names, *[""] * width][:width]:
        current = cell.removeprefix(_PREFIX).strip() or current
        spread.append(current)
    if any(names[width:]):
        refuse(path, f"line {start + 3}", "there are names without components below", "export again")
    units = [*units, *[""] * width][:width]
    return _Section(title[0], rate, start + _HEADER_ROWS, end, width, spread, components, units)


def _groups(sections: Sequence[_Section]) -> dict[str, list[_Group]]:
    """Return all columns with a position, by name."""
    groups: dict[str, list[_Group]] = {}
    for section in sections:
        for name in dict.fromkeys(section.names[2:]):
            places = [i for i in range(2, section.width) if section.names[i] == name]
            components = [section.components[i] for i in places]
            if not any(set(axes) <= set(components) for axes in _TRANSLATIONS):
                continue
            repeated = next((c for c in components if c and components.count(c) > 1), None)
            columns = dict(zip(components, places, strict=True))
            units = {component: section.units[i] for component, i in columns.items()}
            groups.setdefault(name, []).append(_Group(section, columns, units, repeated))
    return groups


def _wanted(
    path: Path, mapping: Path, source: Source, groups: Mapping[str, list[_Group]], sections: Sequence[_Section]
) -> list[_Group]:
    if source.position:
        fix = 'a Vicon file has bodies and markers by name; write body = "..." there'
        refuse(path, "", f"{mapping} gives [{source.role}] by columns", fix)
    found = []
    for name in source.markers or (source.body or "",):
        _check_position(path, name, groups, sections)
        full = find(path, name, groups, "body or marker", mapping)
        candidates = [g for g in groups[full] if source.section in (None, g.section.title)]
        if not candidates:
            titles = [g.section.title for g in groups[full]]
            problem = f"{shorten(full)!r} is not in a section {shorten(str(source.section))!r}"
            refuse(path, "", problem, f"fix {mapping}, {suggest(str(source.section), titles).rstrip('?')}")
        if len(candidates) > 1:
            titles = ", ".join(dict.fromkeys(g.section.title for g in candidates))
            fix = f'add section = "..." to [{source.role}] in {mapping}'
            refuse(path, "", f"{shorten(full)!r} is in several sections ({titles})", fix)
        chosen = candidates[0]
        if chosen.repeated is not None:
            problem = f"{shorten(full)!r} has {chosen.repeated} twice"
            refuse(path, f"line {chosen.section.first - 1}", problem, "give bodies different names and export again")
        found.append(chosen)
    return found


def _check_position(path: Path, name: str, groups: Mapping[str, list[_Group]], sections: Sequence[_Section]) -> None:
    """Refuse a name whose columns lack components of a position: it exists, but is neither a body nor a marker."""
    for section in sections:
        if section.title not in _USED or name in {part for full in groups for part in (full, full.rpartition(":")[2])}:
            continue
        here = [
            component
            for full, component in zip(section.names[2:], section.components[2:], strict=True)
            if name in (full, full.rpartition(":")[2])
        ]
        if here:
            problem = f"{shorten(name)!r} has the components {', '.join(shorten(c) for c in here[:8])}"
            refuse(path, f"line {section.first - 1}", f"{problem}, but no complete position", "export TX, TY, TZ too")


def _read(
    path: Path, lines: Sequence[str], delimiter: str, section: _Section, wanted: Mapping[str, Sequence[_Group]]
) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """Return the frame numbers, and the wanted columns by their index."""
    columns = sorted(
        {i for groups in wanted.values() for g in groups if g.section is section for i in g.columns.values()}
    )
    if section.first == section.last:
        refuse(path, f"line {section.last}", "there is no sample below the header", "export again with samples")
    frames, table = [], []
    for number in range(section.first, section.last):
        cells = lines[number].split(delimiter)
        place = f"line {number + 1}"
        frame, sub = (parse_number(cells[i].strip(' "')) if i < len(cells) else None for i in (0, 1))
        if frame is None or sub is None or frame != round(frame) or not 0 <= frame < 2**40:
            problem = f"{shorten(delimiter.join(cells[:2]))!r} is not a frame and a sub-frame"
            refuse(path, place, problem, "export again, or delete the line if it is not a sample")
        if sub != 0:
            fix = "export at the cameras' rate"
            refuse(path, place, f"section {section.title} has sub-frames, samples between the cameras' frames", fix)
        if frames and frame <= frames[-1]:
            problem = f"frame numbers run back, from {frames[-1]:g} to {frame:g}"
            refuse(path, place, problem, "export again, one trial per file")
        frames.append(frame)
        if any(cell.strip(' "') for cell in cells[section.width :]):
            refuse(path, place, "the row has more cells than the header", "export with decimal points, not commas")
        if len(cells) < section.width and any(cell.strip(' "') for cell in cells[2:]):
            name = shorten(section.names[len(cells)] or section.components[len(cells)])
            refuse(path, place, f"the row ends before {name!r}", "the file was cut off; copy or export it again")
        row = []
        for i in columns:
            cell = cells[i].strip(' "') if i < len(cells) else ""
            value = parse_number(cell) if cell and cell.lower() != "nan" else math.nan
            if value is None or abs(value) > LARGEST:
                name = f"{shorten(section.names[i])} {section.components[i]}"
                fix = "leave the cell empty if the sample is missing, and use decimal points"
                refuse(path, f"{place}, {name}", f"{shorten(cell)!r} is not a number, or is too large", fix)
            row.append(value)
        table.append(row)
    values = np.array(table, float).reshape(len(table), len(columns))
    return np.array(frames), {place: values[:, i] for i, place in enumerate(columns)}


def _unit(
    path: Path, group: _Group, components: Sequence[str], known: Mapping[str, float], override: str | None, kind: str
) -> float:
    if override is not None:
        return known[override]
    units = {group.units[c].lower() for c in components}
    unit = _SPELLINGS.get(next(iter(units)), next(iter(units))) if len(units) == 1 else ""
    if unit not in known:
        shown = ", ".join(sorted(repr(shorten(u)) for u in units))
        names = f"{shorten(group.section.names[group.columns[components[0]]])} {components[0]} to {components[-1]}"
        fix = f'export in {", ".join(known)}, or write {kind} = "..." under [units] in the mapping'
        refuse(path, f"line {group.section.first}, {names}", f"the unit {shown} is not a known unit of {kind}", fix)
    return known[unit]


def _position(path: Path, mapping: RoomMapping, group: _Group, values: _Values) -> Float[np.ndarray, "T 3"]:
    axes = next(axes for axes in _TRANSLATIONS if set(axes) <= set(group.columns))
    position = values(group, axes) * _unit(path, group, axes, LENGTHS, mapping.length, "length")
    everything = values(group, list(group.columns))
    position[(everything == 0).all(axis=1)] = np.nan
    return position


def _body(
    path: Path,
    mapping: RoomMapping,
    source: Source,
    group: _Group,
    position: Float[np.ndarray, "T 3"],
    values: _Values,
    frames: Int[np.ndarray, " T"],
) -> Body:
    turns = [component for component in _ROTATION if component in group.columns]
    if not turns:
        return Body(position)
    name = shorten(group.section.names[next(iter(group.columns.values()))])
    place = f"section {group.section.title}, {name}"
    if len(turns) < len(_ROTATION):
        refuse(path, place, f"it has only {' and '.join(turns)} of RX, RY, RZ", "export again")
    rotation, unit = source.rotation, 1.0
    if "RW" in group.columns:
        if rotation not in (None, "quaternion"):
            refuse(path, place, f"it has RW, so its rotation is not {rotation}", 'write rotation = "quaternion"')
        rotation = "quaternion"
        columns = values(group, ("RW", *_ROTATION))
    else:
        if rotation is None and group.section.title in _HELICAL:
            rotation = "helical"
        if rotation in (None, "quaternion"):
            fix = f'write rotation = "helical" or "XYZ" in [{source.role}] of the mapping, as it was exported'
            refuse(path, place, "RX, RY, RZ may be a rotation vector or Euler angles", fix)
        columns = values(group, _ROTATION)
        unit = _unit(path, group, _ROTATION, ANGLES, mapping.angle, "angle")
    columns[np.isnan(position).any(axis=1)] = np.nan
    return Body(position, to_quaternion(path, place, columns, rotation, unit, frames))
