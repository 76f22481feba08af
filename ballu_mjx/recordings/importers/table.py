"""Tables: CSV with a row of names above the samples. Any program's, by a mapping; and command logs."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ballu_mjx.common.files import read_text
from ballu_mjx.recordings.importers.mapping import Commands, RoomMapping, Source
from ballu_mjx.recordings.importers.trajectories import (
    ANGLES,
    LENGTHS,
    TIMES,
    Body,
    Trajectories,
    refuse,
    shorten,
    suggest,
    to_quaternion,
)

_COMMAND_TOLERANCE = 0.005
"""Of a command's range: values that exceed it by at most this share are measurement noise and are clipped."""


class Table:
    """A CSV's columns by name, converted to numbers when asked for."""

    def __init__(self, path: Path, mapping: Path | None = None) -> None:
        """Read the CSV at `path`; `mapping` is what names its columns, for messages.

        Raises `InputError` for one without header or samples, or with rows cut off.
        """
        self.path = path
        self._mapping = "the mapping" if mapping is None else str(mapping)
        text = read_text(path)
        header_line = next((line for line in text.splitlines() if line.strip()), "")
        delimiter = max(",;\t", key=header_line.count)
        self.rows: list[list[str]] = []
        self.lines: list[int] = []
        header: list[str] | None = None
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
        try:
            for cells in reader:
                if not any(cell.strip() for cell in cells):
                    continue
                if header is None:
                    header = [cell.strip() for cell in cells]
                    continue
                if len(cells) != len(header):
                    few = len(cells) < len(header)
                    problem = f"the row has {len(cells)} cells, the header {len(header)}"
                    fix = "the file was cut off, copy it again" if few else "write points in numbers, not commas"
                    refuse(path, f"line {reader.line_num}", problem, fix)
                self.rows.append(cells)
                self.lines.append(reader.line_num)
        except csv.Error as error:
            refuse(path, f"line {reader.line_num}", f"not readable as a table ({error})", "save it as plain CSV")
        if header is None or not self.rows:
            refuse(path, "", "there is no sample below a header", "give a CSV with names in its first row")
        self.header = header

    def column(self, name: str) -> Float[np.ndarray, " T"]:
        """The numbers of a column, NaN where a cell is empty. Raises `InputError` naming line, column and fix."""
        if name not in self.header:
            hint = suggest(name, self.header).rstrip("?")
            refuse(self.path, "", f"there is no column {shorten(name)!r}", f"fix {self._mapping}, {hint}")
        if self.header.count(name) > 1:
            refuse(self.path, "", f"the column {shorten(name)!r} stands there twice", "rename one")
        place = self.header.index(name)
        values = np.empty(len(self.rows))
        for i, row in enumerate(self.rows):
            cell = row[place].strip()
            try:
                values[i] = float(cell) if cell and cell.lower() != "nan" else math.nan
                if math.isinf(values[i]) or "_" in cell:
                    raise ValueError
            except ValueError:
                fix = "write a number, or leave the cell empty if the sample is missing"
                where = f"line {self.lines[i]}, column {shorten(name)}"
                refuse(self.path, where, f"{shorten(cell)!r} is not a number", fix)
        return values

    def columns(self, names: Iterable[str]) -> Float[np.ndarray, "T n"]:
        """Several columns side by side."""
        return np.stack([self.column(name) for name in names], axis=1)

    def clock(self, name: str, unit: str) -> Float[np.ndarray, " T"]:
        """A column of times in s, strictly increasing."""
        time = self.column(name) * TIMES[unit]
        missing = np.isnan(time)
        if missing.any():
            line = self.lines[int(missing.argmax())]
            refuse(self.path, f"line {line}, column {shorten(name)}", "the time is missing", "delete the line")
        back = np.diff(time) <= 0
        if back.any():
            row = int(back.argmax()) + 1
            problem = f"time runs back or stands still, from {time[row - 1]:g} to {time[row]:g} s"
            fix = "sort the lines by time, and delete repeated ones"
            refuse(self.path, f"line {self.lines[row]}, column {shorten(name)}", problem, fix)
        return time


def read_table(table: Table, mapping: RoomMapping) -> Trajectories:
    """The columns that `mapping` names.

    **Raises** `InputError` naming file, line, column and fix.
    """
    path = table.path
    if mapping.time_column in table.header:
        time = table.clock(mapping.time_column, mapping.time)
    elif mapping.rate is not None:
        time = np.arange(len(table.rows)) / mapping.rate
    else:
        problem = f"there is no column {shorten(mapping.time_column)!r} of times"
        fix = f'write time = "..." under [commands], {suggest(mapping.time_column, table.header)}'.rstrip("?")
        refuse(path, "", problem, f"{fix}; or rate = ... (Hz)")
    positions = [name for source in mapping.sources.values() for name in source.position]
    length = _unit(mapping, mapping.length, LENGTHS, "length") if positions else 1.0
    bodies = {}
    for role, source in mapping.sources.items():
        if not source.position:
            fix = 'a table has columns, write position = ["x", "y", "z"] there'
            refuse(mapping.path, f"[{role}]", f"it is given by name, and {path.name} is a table", fix)
        bodies[role] = _body(table, mapping, source, length)
    joints = {}
    for name, joint in mapping.joints.items():
        if joint.slides:
            unit = _unit(mapping, mapping.length, LENGTHS, "length")
        else:
            unit = _unit(mapping, mapping.angle, ANGLES, "angle")
        joints[name] = (table.column(joint.column) - joint.zero) * joint.sign * unit
    return Trajectories(path, time, bodies, joints)


def _unit(mapping: RoomMapping, unit: str | None, known: Mapping[str, float], name: str) -> float:
    if unit is None:
        fix = f'write {name} = "{next(iter(known))}" or another there'
        refuse(mapping.path, "[units]", f"the {name} of a table's columns is not said", fix)
    return known[unit]


def _body(table: Table, mapping: RoomMapping, source: Source, length: float) -> Body:
    position = table.columns(source.position) * length
    if not source.orientation:
        return Body(position)
    unit = 1.0 if source.rotation == "quaternion" else _unit(mapping, mapping.angle, ANGLES, "angle")
    place = f"columns {source.orientation[0]} to {source.orientation[-1]}"
    assert source.rotation is not None
    columns = table.columns(source.orientation)
    return Body(position, to_quaternion(table.path, place, columns, source.rotation, unit))


def read_commands(table: Table, columns: Commands) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N commands"]]:
    """Times (s, the log's own clock) and commands of a log, in the actuators' units.

    **Raises** `InputError` naming file, line, column and fix.
    """
    time = table.clock(columns.time, columns.time_unit)
    return time, commands_in(table, columns)


def commands_in(table: Table, columns: Commands) -> Float[np.ndarray, "N commands"]:
    """Commands in the actuators' units; an empty cell goes on with the command before.

    **Raises** `InputError` naming file, line, column and fix.
    """
    each = zip(columns.columns.items(), columns.ranges, columns.limits, strict=True)
    return np.stack([_command(table, *names, shown, limits) for names, shown, limits in each], axis=1)


def _command(
    table: Table, command: str, name: str, shown: tuple[float, float], limits: tuple[float, float]
) -> Float[np.ndarray, " N"]:
    raw = table.column(name)
    held = np.maximum.accumulate(np.where(np.isnan(raw), -1, np.arange(len(raw))))
    if held[0] < 0:
        fix = "write what was being sent, or delete the lines before the first command"
        refuse(table.path, f"line {table.lines[0]}, column {shorten(name)}", "the first command is missing", fix)
    with np.errstate(over="ignore"):
        share = (raw[held] - shown[0]) / (shown[1] - shown[0])
    outside = (share < -_COMMAND_TOLERANCE) | (share > 1 + _COMMAND_TOLERANCE)
    if outside.any():
        row = int(outside.argmax())
        problem = f"{raw[held][row]:g} is outside of {shown[0]:g} to {shown[1]:g}"
        fix = (
            "write under [commands] in the mapping what the column shows at the smallest and the largest command, as "
            f"range_{command}"
        )
        refuse(table.path, f"line {table.lines[row]}, column {shorten(name)}", problem, fix)
    return limits[0] + np.clip(share, 0.0, 1.0) * (limits[1] - limits[0])
