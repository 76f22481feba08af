"""Listing of a motion capture file's content for the user: names, rates, lengths and units."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from ballu_mjx.recordings.importers.trajectories import shorten


@dataclasses.dataclass(frozen=True)
class Item:
    """Body, marker or column of a file."""

    name: str
    kind: Literal["body", "marker", "column"]
    """A body has position and orientation, a marker only a position."""
    samples: int
    rate: float | None
    """Sampling rate (Hz). None if the file does not state it."""
    share: float = 1.0
    """Share of samples that were seen, from 0 to 1."""
    unit: str | None = None
    """Unit. None if the file does not state it."""
    section: str | None = None
    """Section of a Vicon CSV, if the name occurs in several sections."""
    rotation: str | None = None
    """Guessed convention of the three rotation angles, if the file does not state it."""
    clock: str | None = None
    """Clock of its times, if the file has several."""
    label: str | None = None
    """Label of the column in the file, in addition to its name."""
    low: float | None = None
    """Smallest value, in `unit`."""
    high: float | None = None
    """Largest value, in `unit`."""
    step: float | None = None
    """Median step of a column that always increases, as times do, in the column's unit. None for other columns."""

    @property
    def called(self) -> str:
        """Label of the column if there is one, else the name."""
        return self.label or self.name


@dataclasses.dataclass(frozen=True)
class Contents:
    """Content of one file."""

    path: Path
    program: str
    items: Sequence[Item]
    rows: bool = False
    """Whether the columns have one sample per row, with the times in one column."""
    notes: Sequence[str] = ()
    """Sentences about parts of the file that are not read, and about uncertain properties."""
    episodes: Sequence[int] = ()
    """Numbers of the episodes, if a mapping must select one. The items are of the first."""


def printable(text: str) -> str:
    """Return `text` with a question mark for each character that cannot be printed in a line."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def describe_contents(contents: Contents, *, most: int = 60) -> list[str]:
    """Return lines for the user: one for each of the first `most` items, and one for each note."""
    lines = [f"{contents.path} is {contents.program}."]
    for item in contents.items[:most]:
        described = [item.kind, shorten(item.name) + (f" ({aside})" if (aside := item.section or item.label) else "")]
        described.append(f"{item.samples} samples" + ("" if item.rate is None else f" at {item.rate:.4g} Hz"))
        if item.share < 1:
            described.append(f"{100 * item.share:.1f} % seen")
        if item.low is not None and item.high is not None:
            described.append(f"from {item.low:.4g} to {item.high:.4g}")
        described.append("unit not stated" if item.unit is None else item.unit)
        if item.clock is not None:
            described.append(f"clock {item.clock}")
        lines.append("  " + ", ".join(described))
    if len(contents.items) > most:
        lines.append(f"  and {len(contents.items) - most} more")
    return [printable(line) for line in (*lines, *(f"  {note}" for note in contents.notes))]
