"""Tables of results: files `results/NAME.json`, written by the command that measured, and rendered as Markdown.

A table has rows of cells. A cell is text, or numbers with one for each seed or repetition. Rendering shows the mean of
several numbers, with the lowest and the highest, or with an interval.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import math
import re
import shlex
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ballu_mjx.common import files, provenance
from ballu_mjx.common.errors import InputError, is_number

RESULTS_FORMAT = "ballu-results/1"
_ROOT = Path(__file__).parents[2]
_FIX = "write it again with the command that it names"


@dataclasses.dataclass(frozen=True)
class Cell:
    """Numbers of one cell, one for each seed or repetition."""

    values: tuple[float, ...]
    """The numbers. An infinite one marks a simulation that diverged."""
    form: str = ".2f"
    """Python's format of a number."""
    unit: str = ""
    """Unit shown behind the mean."""
    spread: bool = True
    """Whether to show the lowest and the highest number beside the mean."""
    bounds: tuple[float, float] | None = None
    """Ends of a confidence interval, shown instead of the lowest and the highest. None if there is no interval."""
    standard_error: float | None = None
    """Standard error of one estimated value, shown in parentheses in the same format. None if there is none."""

    def to_text(self) -> str:
        """Return the mean, with the lowest and the highest (or `bounds`) in brackets if there are several values."""
        if not self.values:
            return ""
        if not all(map(math.isfinite, self.values)):
            broken = sum(not math.isfinite(value) for value in self.values)
            return "diverged" if len(self.values) == 1 else f"diverged in {broken} of {len(self.values)}"
        ends = (min(self.values), max(self.values)) if self.bounds is None else self.bounds
        mean, low, high = (_format(value, self.form) for value in (statistics.fmean(self.values), *ends))
        unit = f" {self.unit}" if self.unit else ""
        error = "" if self.standard_error is None else f" ({_format(self.standard_error, self.form)})"
        return f"{mean}{error}{unit}" + (f" [{low}, {high}]" if self.spread and len(self.values) > 1 else "")


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of cells, and the names of the columns."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Cell | str, ...], ...]

    def __post_init__(self) -> None:
        if any(len(row) != len(self.columns) for row in self.rows):
            raise ValueError(f"every row must have {len(self.columns)} cells, one for each column")

    def to_markdown(self) -> str:
        """Return the table as Markdown. Columns with numbers are aligned to the right."""
        numbers = [any(isinstance(row[i], Cell) for row in self.rows) for i in range(len(self.columns))]
        lines = [self.columns, tuple("---:" if right else "---" for right in numbers)]
        lines += [tuple(cell.to_text() if isinstance(cell, Cell) else cell for cell in row) for row in self.rows]
        return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


@dataclasses.dataclass(frozen=True)
class Results:
    """Tables of one command, with the provenance of their numbers.

    **Fields**

    - `command`: the command that measured, as typed in the repository's root. Behind `--results` is the file's present
      name.
    - `commit`: the commit of the code that measured. None if it did not run from a checkout.
    - `time`: the time of the measurement, in ISO 8601 format.
    - `machine`, `versions`: see `common.provenance`.
    - `seeds`: the seeds, by their use, such as "training" or "robot".
    - `data`: the kind of data for the caption, such as "Development data".
    """

    tables: Mapping[str, Table]
    command: str
    commit: str | None
    time: str
    machine: Mapping[str, Any]
    versions: Mapping[str, str | None]
    seeds: Mapping[str, Sequence[int]]
    data: str

    def caption(self) -> str:
        """Return a caption with the data, command, commit, machine and seeds of the numbers."""
        commit = ""
        if self.commit is not None:
            commit = f" at commit {self.commit[:7]}" + (" with changes" if provenance.CHANGED in self.commit else "")
        seeds = "".join(
            f" {use[:1].upper()}{use[1:]} {_counted('seed', len(s))}: {', '.join(map(str, s))}."
            for use, s in self.seeds.items()
            if s
        )
        seeds += " One seed on one robot supports no ranking." if len(self.seeds.get("training", (0, 1))) == 1 else ""
        cores = int(self.machine["cores"])
        machine = f"{cores} {_counted('core', cores)} of {self.machine['cpu']}"
        return f"{self.data}. `{self.command}`{commit}, {machine}.{seeds}"


def _counted(noun: str, count: int) -> str:
    """Return a noun in the singular or plural."""
    return noun if count == 1 else f"{noun}s"


def _format(value: float, form: str) -> str:
    """Return a number in a format, without a minus sign if it rounds to zero."""
    text = format(value, form)
    return text.removeprefix("-") if not text.strip("-0.") else text


def command_line(arguments: Sequence[str] | None = None) -> str:
    """Return a command line as typed in a shell, in the repository's root.

    Absolute paths outside it are cut to the file name. Arguments with spaces are quoted.

    `arguments`: the script and its arguments. None for those of this process.
    """
    script, *rest = sys.argv if arguments is None else arguments
    parts = []
    for part in (script, *rest):
        path = Path(part)
        if path.is_absolute() or (part == script and path.exists()):
            path = path.resolve()
            part = str(path.relative_to(_ROOT)) if path.is_relative_to(_ROOT) else path.name
        parts.append(part)
    return shlex.join(["python", *parts])


def write_results(
    path: Path,
    tables: Mapping[str, Table],
    data: str,
    *,
    seeds: Mapping[str, Sequence[int]] | None = None,
    measured: Mapping[str, Any] | None = None,
    packages: Sequence[str] = provenance.PACKAGES,
) -> None:
    """Write tables with the command, commit, machine, versions and seeds of the measurement.

    **Arguments**

    - `data`: the kind of data for the caption.
    - `seeds`: the seeds, by their use.
    - `measured`: `commit`, `machine` and `versions` of the process that measured. None if this process measured.
    - `packages`: the packages whose versions are written.
    """
    here: Mapping[str, Any] = measured or {
        "commit": provenance.source_commit(),
        "machine": provenance.describe_machine(),
        "versions": provenance.package_versions(packages),
    }
    content = {
        "format": RESULTS_FORMAT,
        "data": data,
        "command": command_line(),
        "commit": here["commit"],
        "time": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        "machine": here["machine"],
        "versions": here["versions"],
        "seeds": {use: list(values) for use, values in (seeds or {}).items()},
        "tables": {name: _table_to_json(table) for name, table in tables.items()},
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write(path, json.dumps(content, indent=1) + "\n")


def read_results(path: Path) -> Results:
    """Return the content of a file that `write_results` wrote.

    **Raises** `InputError` if the file does not have this format.
    """
    content = files.read_json(path, _FIX)
    if content.get("format") != RESULTS_FORMAT:
        raise InputError(f'{path}: is not of the format "{RESULTS_FORMAT}"; {_FIX}.')
    try:
        tables = {name: _table_from_json(table) for name, table in content["tables"].items()}
        others = {f.name: content[f.name] for f in dataclasses.fields(Results) if f.name != "tables"}
        # The file may have been renamed since, when other options became the default.
        others["command"] = re.sub(r"(--results results/)\S+", rf"\g<1>{path.name}", others["command"])
        return Results(tables, **others)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: lacks a part or has an invalid one ({error}); {_FIX}.") from None


def _table_to_json(table: Table) -> dict[str, Any]:
    def cell(value: Cell | str) -> Any:
        if isinstance(value, str):
            return value
        stored = dataclasses.asdict(value)
        return stored | {"values": [x if math.isfinite(x) else None for x in value.values]}

    return {"columns": list(table.columns), "rows": [[cell(value) for value in row] for row in table.rows]}


def _table_from_json(content: Mapping[str, Any]) -> Table:
    def cell(value: Any) -> Cell | str:
        if isinstance(value, str):
            return value
        if not all(x is None or is_number(x) for x in value["values"]):
            raise ValueError("a cell has a value that is not a number")
        values = tuple(math.inf if x is None else float(x) for x in value["values"])
        bounds = None if value["bounds"] is None else (float(value["bounds"][0]), float(value["bounds"][1]))
        error = value.get("standard_error")  # older files lack it
        return Cell(
            **value | {"values": values, "bounds": bounds, "standard_error": None if error is None else float(error)}
        )

    return Table(tuple(content["columns"]), tuple(tuple(cell(value) for value in row) for row in content["rows"]))
