"""Reading a run's `metrics.jsonl`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.runs.layout import MAX_STEPS, METRICS_FILE, shorten_value


def read_metrics(folder: Path, last: int | None = None) -> list[dict[str, Any]]:
    """Return the rows of a run's `metrics.jsonl`, up to the step `last` if it is given.

    An incomplete last line is left out.

    **Raises** `InputError` that names a damaged line.
    """
    path = folder / METRICS_FILE
    lines = files.read_text(path).split("\n")[:-1] if path.exists() else []
    rows: list[dict[str, Any]] = []
    fix = "restore the file, or delete the line"
    for number, line in enumerate(lines, start=1):
        row = files.parse_object(line, f"{path}, line {number}", fix)
        step, before = row.get("step"), rows[-1]["step"] if rows else 0
        if type(step) is not int or not before <= step < MAX_STEPS:
            raise InputError(f'{path}, line {number}: "step" must be an integer, and not below the one before; {fix}.')
        for name, value in row.items():
            if value is not None and not is_number(value):
                raise InputError(
                    f"{path}, line {number}: {shorten_value(name)} is {shorten_value(value)}, not a number; {fix}."
                )
        if last is not None and step > last:
            break
        rows.append(row)
    return rows


def read_column(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the control steps at which `name` was measured, and its values there."""
    pairs = [(row["step"], row[name]) for row in read_metrics(folder) if row.get(name) is not None]
    steps, values = np.array(pairs, float).reshape(-1, 2).T
    return steps, values
