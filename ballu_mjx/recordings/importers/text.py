"""Reader of rows of numbers in text files. Every error message names line and column."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ballu_mjx.recordings.importers.trajectories import refuse, shorten

LARGEST = 1e6
"""Largest plausible position or angle, in any unit."""
_MISSING = ("", "nan", "null", "none")


def split_cells(line: str, delimiter: str | None) -> list[str]:
    """Return the cells of a line without surrounding blanks and quotes. A `delimiter` of None means blanks."""
    return [cell.strip(' "\r') for cell in line.split(delimiter)]


def parse_number(text: str) -> float | None:
    """Return `text` as a finite number. None if it is not one."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and "_" not in text else None


def read_numbers(
    path: Path,
    lines: Sequence[str],
    first: int,
    names: Sequence[str],
    delimiter: str | None,
    *,
    largest: float = LARGEST,
    unlimited: Sequence[int] = (0, 1),
) -> Float[np.ndarray, "T n"]:
    """Return the rows of numbers from line `first` (from 0) on, NaN for empty cells. Ignore blank lines at the end.

    **Arguments**

    - `path`: the file, for messages.
    - `lines`: all lines of the file.
    - `names`: names of the columns, for messages. Each row has as many numbers.
    - `delimiter`: the separator of cells. None for blanks.
    - `largest`: largest magnitude of a number outside of the columns `unlimited`.
    - `unlimited`: indices of columns without limit.

    **Raises** `InputError` naming line and column if a row has too few or too many cells, or if a cell is not a number
    or is too large.
    """
    last = len(lines)
    while last > first and not lines[last - 1].strip(f' "\r{delimiter or ""}'):
        last -= 1
    if last == first:
        refuse(path, f"line {last}", "there is no sample below the header", "export again with samples")
    table = np.empty((last - first, len(names)))
    for number in range(first, last):
        cells = split_cells(lines[number], delimiter)
        place = f"line {number + 1}"
        if len(cells) < len(names):
            problem = f"the row ends before {shorten(names[len(cells)])!r}"
            refuse(path, place, problem, "the file was cut off; copy or export it again")
        if any(cells[len(names) :]):
            if delimiter is None:
                refuse(path, place, f"the row has more than {len(names)} numbers", "delete the others")
            refuse(path, place, "the row has more cells than the header", "export with decimal points, not commas")
        for column, cell in enumerate(cells[: len(names)]):
            value = math.nan if cell.lower() in _MISSING else parse_number(cell)
            if value is None or (abs(value) > largest and column not in unlimited):
                missing = "write nan" if delimiter is None else "leave the cell empty"
                fix = f"{missing} if the sample is missing, and use decimal points"
                problem = f"{shorten(cell)!r} is not a number, or is too large"
                refuse(path, f"{place}, {shorten(names[column])}", problem, fix)
            table[number - first, column] = value
    return table


def check_times(path: Path, time: Float[np.ndarray, " T"], first: int, fix: str) -> None:
    """Check that times are given and increase. Row 0 is in line `first` (from 0), and `fix` is the fix in messages.

    **Raises** `InputError` naming the line.
    """
    missing = np.isnan(time)
    if missing.any():
        refuse(path, f"line {first + int(missing.argmax()) + 1}", "the time is missing", "delete the line")
    back = np.diff(time) <= 0
    if back.any():
        row = int(back.argmax()) + 1
        problem = f"time runs back or stands still, from {time[row - 1]:.6f} to {time[row]:.6f} s"
        refuse(path, f"line {first + row + 1}", problem, fix)
