"""Reader of tables: CSV with column names above the samples, from any program. Command logs are tables too."""

from __future__ import annotations

import csv
import functools
import io
import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ballu_mjx.common.files import read_text
from ballu_mjx.recordings.importers.capture import Capture, Lazy, Series
from ballu_mjx.recordings.importers.text import parse_number
from ballu_mjx.recordings.importers.trajectories import TIMES, refuse, shorten, suggest

_COMMENT = "#"


class Table:
    """Columns of a CSV by name, converted to numbers at first use."""

    def __init__(self, path: Path) -> None:
        """Read the CSV at `path`. Lines that begin with # are comments, but the last of them may be the header.

        **Raises** `InputError` if the header or the samples are missing, or if a row is cut off.
        """
        self.path = path
        lines = read_text(path).splitlines(keepends=True)
        first = _header_line(lines)
        text = "".join(lines[first:])
        header_line = lines[first] if first < len(lines) else ""
        delimiter = max(",;\t", key=header_line.count)
        self.rows: list[list[str]] = []
        self.lines: list[int] = []
        header: list[str] | None = None
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
        try:
            for cells in reader:
                line = first + reader.line_num
                if not any(cell.strip() for cell in cells):
                    continue
                if header is None:
                    header = _check_header(path, line, [cell.strip() for cell in cells])
                    continue
                while len(cells) > len(header) and not cells[-1].strip():
                    cells.pop()
                if len(cells) != len(header):
                    few = len(cells) < len(header)
                    problem = f"the row has {len(cells)} cells, the header {len(header)}"
                    fix = "the file was cut off, copy it again" if few else "use decimal points, not commas"
                    refuse(path, f"line {line}", problem, fix)
                self.rows.append(cells)
                self.lines.append(line)
        except csv.Error as error:
            problem = f"not readable as a table ({error})"
            refuse(path, f"line {first + reader.line_num}", problem, "save it as plain CSV")
        if header is None or not self.rows:
            refuse(path, "", "there is no sample below a header", "give a CSV with names in its first row")
        self.header = header

    def column(self, name: str) -> Float[np.ndarray, " T"]:
        """Return the numbers of a column, NaN for empty cells.

        **Raises** `InputError` naming line and column if a cell is not a number, or if there is no such column.
        """
        if name not in self.header:
            hint = suggest(name, self.header).rstrip("?")
            refuse(self.path, "", f"there is no column {shorten(name)!r}", f"add it, {hint}")
        if self.header.count(name) > 1:
            refuse(self.path, "", f"the column {shorten(name)!r} appears twice", "rename one")
        place = self.header.index(name)
        values = np.empty(len(self.rows))
        for i, row in enumerate(self.rows):
            cell = row[place].strip()
            value = parse_number(cell) if cell and cell.lower() != "nan" else math.nan
            if value is None:
                fix = "write a number with a decimal point, or leave the cell empty if the sample is missing"
                where = f"line {self.lines[i]}, column {shorten(name)}"
                refuse(self.path, where, f"{shorten(cell)!r} is not a number", fix)
            values[i] = value
        return values

    def clock(self, name: str, unit: str) -> Float[np.ndarray, " T"]:
        """Return the times (s) of a time column with the unit `unit`.

        **Raises** `InputError` naming line and column if a time is missing, or if times do not increase.
        """
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


def open_table(path: Path) -> Capture:
    """Return the table at `path`. Its columns are converted at first use.

    **Raises** `InputError` if the header or the samples are missing, or if a row is cut off.
    """
    table = Table(path)

    def series(name: str) -> Series:
        return Series(table.column(name))

    columns = Lazy({name: functools.partial(series, name) for name in table.header})
    return Capture(path, "a table", columns=columns, clock=table.clock, rows=len(table.rows))


def _header_line(lines: list[str]) -> int:
    """Return the line (from 0) with the column names.

    It is the first line after the comments, or the last comment if that has as many cells as the numbers below it.
    """
    first = next((i for i, line in enumerate(lines) if line.strip() and not line.startswith(_COMMENT)), len(lines))
    if first == len(lines) or first == 0:
        return first
    delimiter = max(",;\t", key=lines[first].count)
    cells = lines[first].split(delimiter)
    above = lines[first - 1]
    as_many = above.startswith(_COMMENT) and above.count(delimiter) == len(cells) - 1
    if as_many and parse_number(cells[0].strip()) is not None:
        return first - 1
    return first


def _check_header(path: Path, line: int, header: list[str]) -> list[str]:
    """Return the column names without comment character and empty cells at the end. Refuse a row of numbers."""
    while header and not header[-1]:
        header.pop()
    header[:1] = [name.removeprefix(_COMMENT).strip() for name in header[:1]]
    numbers = sum(parse_number(name) is not None for name in header)
    if 2 * numbers > len(header):
        fix = "write the columns' names above the numbers, or export with a header"
        refuse(path, f"line {line}", "it holds numbers instead of column names", fix)
    return header
