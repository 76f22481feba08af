"""Rows of numbers in text files, with the line and the column in every message."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ballu_mjx.recordings.importers.trajectories import refuse, shorten

LARGEST = 1e6
"""No unit makes sense of a larger position or angle."""
_MISSING = ("", "nan", "null", "none")


def split_cells(line: str, delimiter: str | None) -> list[str]:
    """Return the cells of a line, without blanks and quotes around them; `delimiter` None: blanks part them."""
    return [cell.strip(' "\r') for cell in line.split(delimiter)]


def parse_number(text: str) -> float | None:
    """Return the finite number that `text` is, or None."""
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
    """Return the rows from line `first` (from 0) on, NaN for empty cells; blank lines at the end are no rows.

    **Arguments**

    - `names`: of the columns, for messages; as many numbers stand in each row.
    - `largest`: no number may be larger, but in the columns `unlimited`.

    **Raises** `InputError` naming line, column and fix.
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
                refuse(path, place, f"the row has more than {len(names)} numbers", "delete what is not meant")
            refuse(path, place, "the row has more cells than the header", "export with points in numbers, not commas")
        for column, cell in enumerate(cells[: len(names)]):
            value = math.nan if cell.lower() in _MISSING else parse_number(cell)
            if value is None or (abs(value) > largest and column not in unlimited):
                missing = "write nan" if delimiter is None else "leave the cell empty"
                mend = f"{missing} if the sample is missing, and write points in numbers"
                problem = f"{shorten(cell)!r} is not a number that can be meant"
                refuse(path, f"{place}, {shorten(names[column])}", problem, mend)
            table[number - first, column] = value
    return table


def check_times(path: Path, time: Float[np.ndarray, " T"], first: int, mend: str) -> None:
    """Refuse times that are missing, or do not increase; row 0 stands in line `first` (from 0)."""
    missing = np.isnan(time)
    if missing.any():
        refuse(path, f"line {first + int(missing.argmax()) + 1}", "the time is missing", "delete the line")
    back = np.diff(time) <= 0
    if back.any():
        row = int(back.argmax()) + 1
        problem = f"time runs back or stands still, from {time[row - 1]:.6f} to {time[row]:.6f} s"
        refuse(path, f"line {first + row + 1}", problem, mend)
