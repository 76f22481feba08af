"""Storage of a training's measurements and checkpoints, in a run's folder or in memory."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ballu_mjx.runs.layout import NO_SCORE


@runtime_checkable
class TrainingRecord(Protocol):
    """Interface for measurements and checkpoints of a training.

    `folder.Run` writes them to disk, and `MemoryRecord` keeps them in memory.
    """

    @property
    def folder(self) -> Path | None:
        """Return the run's folder, or None if there is none."""
        ...

    @property
    def config(self) -> Mapping[str, Any]:
        """Return the content of the run's `config.json`; see `residuals.run_config.describe_run`."""
        ...

    def log(self, step: int, metrics: Mapping[str, float | int]) -> None:
        """Log measurements at `step`. Steps must not decrease."""
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
        """Save the parameters that were learned until `step`; see `folder.Run.save`."""
        ...

    def write(self, name: str, text: str) -> None:
        """Save a text under a file name."""
        ...

    def best(self) -> tuple[int, dict[str, Any]]:
        """Return step and parameters with the smallest score. Of equal scores, the last one counts."""
        ...


class MemoryRecord:
    """Record without a folder. It keeps all measurements and texts, and the parameters with the best score."""

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
        """Return step and parameters with the smallest score.

        **Raises** `ValueError` if nothing was saved with a score.
        """
        if self._best is None:
            raise ValueError("Nothing was saved with a score.")
        return self._best[1:]
