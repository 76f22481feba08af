"""Thread that warns if a training makes no progress."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path


class Watchdog:
    """Context manager around a training that warns if no training step finishes for a long time.

    It runs in a daemon thread, which ends with the process.
    """

    def __init__(self, folder: Path, tell: Callable[[str], None], limit: float = 300.0) -> None:
        """Prepare to warn by `tell` after `limit` (s) without progress. `folder` is the run's, for the message."""
        self._folder, self._tell, self._limit = folder, tell, limit
        self._step: int | None = None
        self._last = time.monotonic()
        self._told: float | None = None  # Start of the standstill for which the last warning was given.
        self._woken = threading.Condition()
        self._over = False

    def step_done(self, step: int | None) -> None:
        """Note that training has reached control step `step`. None: its first training step is about to start."""
        with self._woken:
            self._step, self._last = step, time.monotonic()

    def __enter__(self) -> Watchdog:
        self.step_done(None)
        threading.Thread(target=self._watch, name="watchdog", daemon=True).start()
        return self

    def __exit__(self, *exception: object) -> None:
        with self._woken:
            self._over = True
            self._woken.notify()

    def look(self, now: float) -> float:
        """Warn if the standstill has lasted for the limit at `now` (s, of `time.monotonic`), once for each standstill.

        **Returns** the seconds until the next check.
        """
        left = self._last + self._limit - now
        if left <= 0 and self._told != self._last:
            self._told = self._last
            self._tell(self._said())
        return max(left, self._limit / 10)

    def _watch(self) -> None:
        with self._woken:
            while not self._over:
                self._woken.wait(self.look(time.monotonic()))

    def _said(self) -> str:
        minutes = f"{self._limit / 60:.3g} minutes"
        if self._step is None:
            return (
                f"No training step has finished for {minutes}: a first compilation takes one or two, or longer on a "
                "busy machine. If it does not end, stop the process and try fewer --num-envs, "
                f"or delete the cache of compiled programs{_cache()}."
            )
        return (
            f"No training step has finished for {minutes}, since step {self._step:,}: check whether the machine "
            "sleeps, has run out of memory or is busy. If training does not continue, stop the process and resume with "
            f"--resume {self._folder}: saved checkpoints are kept."
        )


def _cache() -> str:
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR")  # Set by `runtime.prepare`.
    return f", {folder}" if folder else ""
