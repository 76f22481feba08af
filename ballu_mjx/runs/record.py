"""Where a training leaves what it measures and learns: a run's folder, or memory."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ballu_mjx.runs.layout import NO_SCORE


@runtime_checkable
class TrainingRecord(Protocol):
    """Measurements and checkpoints of a training: `folder.Run` writes them to disk, `MemoryRecord` keeps them."""

    @property
    def folder(self) -> Path | None:
        """The run's folder; None: there is none."""
        ...

    @property
    def config(self) -> Mapping[str, Any]:
        """What a run's `config.json` holds; see `residuals.run_config.describe_run`."""
        ...

    def log(self, step: int, metrics: Mapping[str, float | int]) -> None:
        """Add measurements at `step`; steps do not decrease."""
        ...

    def save(
        self,
        step: int,
        params: Mapping[str, Any],
        score: float | None,
        *,
        training: Mapping[str, np.ndarray] | None = None,
        notes: Mapping[str, Any] | None = None,
    ) -> None:
        """Keep what was learned until `step`; see `folder.Run.save`."""
        ...

    def write(self, name: str, text: str) -> None:
        """Keep a text under a file's name."""
        ...

    def best(self) -> tuple[int, dict[str, Any]]:
        """Return step and parameters of what was saved with the smallest score; of equal ones the last."""
        ...


class MemoryRecord:
    """A record without a folder: all measurements, and the parameters with the best score."""

    folder: Path | None = None

    def __init__(self, config: Mapping[str, Any]) -> None:
        self.config = config
        self.metrics: list[dict[str, Any]] = []
        self.texts: dict[str, str] = {}
        self._best: tuple[float, int, dict[str, Any]] | None = None

    def log(self, step: int, metrics: Mapping[str, float | int]) -> None:
        self.metrics.append({"step": step, **metrics})

    def save(
        self,
        step: int,
        params: Mapping[str, Any],
        score: float | None,
        *,
        training: Mapping[str, np.ndarray] | None = None,
        notes: Mapping[str, Any] | None = None,
    ) -> None:
        del training, notes
        if score is None:
            return
        score = score if math.isfinite(score) else NO_SCORE
        if self._best is None or score <= self._best[0]:
            self._best = score, step, dict(params)

    def write(self, name: str, text: str) -> None:
        self.texts[name] = text

    def best(self) -> tuple[int, dict[str, Any]]:
        """**Raises** `ValueError` where nothing was saved with a score."""
        if self._best is None:
            raise ValueError("Nothing was saved with a score.")
        return self._best[1:]
