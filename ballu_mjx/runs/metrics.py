"""Reading a run's `metrics.jsonl`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

try:
    import fcntl
except ImportError:  # Windows, where runs are not locked
    fcntl = None


from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.runs.layout import METRICS_FILE, MOST_STEPS, shorten_value


def read_metrics(folder: Path, last: int | None = None) -> list[dict[str, Any]]:
    """The rows of a run's `metrics.jsonl`, up to the step `last` where it is given; a last line cut off is left out.

    **Raises** `InputError` naming the line where it is damaged.
    """
    path = folder / METRICS_FILE
    lines = files.read_text(path).split("\n")[:-1] if path.exists() else []
    rows: list[dict[str, Any]] = []
    mend = "restore the file, or delete the line"
    for number, line in enumerate(lines, start=1):
        row = files.parse_object(line, f"{path}, line {number}", mend)
        step, before = row.get("step"), rows[-1]["step"] if rows else 0
        if type(step) is not int or not before <= step < MOST_STEPS:
            raise InputError(f'{path}, line {number}: "step" is no step after the one before; {mend}.')
        for name, value in row.items():
            if value is not None and not is_number(value):
                raise InputError(
                    f"{path}, line {number}: {shorten_value(name)} is {shorten_value(value)}, no number; {mend}."
                )
        if last is not None and step > last:
            break
        rows.append(row)
    return rows


def read_column(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Control steps, and what was measured there under `name`."""
    pairs = [(row["step"], row[name]) for row in read_metrics(folder) if row.get(name) is not None]
    steps, values = np.array(pairs, float).reshape(-1, 2).T
    return steps, values
