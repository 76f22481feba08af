"""What is in a laboratory's file, for people: names, rates, lengths and units."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from ballu_mjx.recordings.importers.trajectories import shorten


@dataclasses.dataclass(frozen=True)
class Item:
    """One body, marker or column."""

    name: str
    kind: Literal["body", "marker", "column"]
    """A body has an orientation, a marker a place alone."""
    samples: int
    rate: float | None
    """Hz; None where the file does not say."""
    share: float = 1.0
    """Of the samples that are seen."""
    unit: str | None = None
    """None: the file does not say."""
    section: str | None = None
    """Of a Vicon CSV, where the name stands in several."""
    rotation: str | None = None
    """A guess of what its three angles are, where the file does not say."""
    clock: str | None = None
    label: str | None = None
    """What the file calls the column beside its name."""
    low: float | None = None
    high: float | None = None
    step: float | None = None
    """Median step of a column that increases throughout, as a clock does; in the column's unit."""

    @property
    def called(self) -> str:
        return self.label or self.name


@dataclasses.dataclass(frozen=True)
class Contents:
    """What one file holds."""

    path: Path
    program: str
    items: Sequence[Item]
    rows: bool = False
    """Whether columns hold a sample a row, and the times are a column."""
    notes: Sequence[str] = ()
    episodes: Sequence[int] = ()
    """Where a mapping has to name one; what is told here is of the first."""


def printable(text: str) -> str:
    """Return `text` without what would break a line."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def describe_contents(contents: Contents, *, most: int = 60) -> list[str]:
    """Return lines for people: a line an item, at most `most`, and the notes."""
    lines = [f"{contents.path} is {contents.program}."]
    for item in contents.items[:most]:
        told = [item.kind, shorten(item.name) + (f" ({aside})" if (aside := item.section or item.label) else "")]
        told.append(f"{item.samples} samples" + ("" if item.rate is None else f" at {item.rate:.4g} Hz"))
        if item.share < 1:
            told.append(f"{100 * item.share:.1f} % seen")
        if item.low is not None and item.high is not None:
            told.append(f"from {item.low:.4g} to {item.high:.4g}")
        told.append("unit not stated" if item.unit is None else item.unit)
        if item.clock is not None:
            told.append(f"clock {item.clock}")
        lines.append("  " + ", ".join(told))
    if len(contents.items) > most:
        lines.append(f"  and {len(contents.items) - most} more")
    return [printable(line) for line in (*lines, *(f"  {note}" for note in contents.notes))]
