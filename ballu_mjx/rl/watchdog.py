"""A thread that notices when a training stands still."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path


class Watchdog:
    """Tell the user when no training step has finished for long: a context manager around the training.

    It watches from a thread, which holds nothing up and ends with the process.
    """

    def __init__(self, folder: Path, tell: Callable[[str], None], limit: float = 300.0) -> None:
        """`tell` takes sentences for the user; `limit` is in s."""
        self._folder, self._tell, self._limit = folder, tell, limit
        self._step: int | None = None
        self._last = time.monotonic()
        self._told: float | None = None  # when the standstill began that has been told of
        self._woken = threading.Condition()
        self._over = False

    def step_done(self, step: int | None) -> None:
        """Training has got to control step `step`; None: it is about to take its first step."""
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
        """Tell of a standstill that has lasted for the limit at `now` (s, of `time.monotonic`), unless it has been told
        of; return in how many seconds to look again."""
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
                f"No training step has finished for {minutes}: a first compilation takes one or two, more where other "
                "work keeps the machine busy. If nothing comes of it, end the process and try fewer --num-envs, "
                f"or delete the cache of compiled programs{_cache()}."
            )
        return (
            f"No training step has finished for {minutes}, since step {self._step:,}: look whether the machine sleeps, "
            "has run out of memory or does other work. If it does not go on, end the process, and go on with "
            f"--resume {self._folder}: what is saved stays."
        )


def _cache() -> str:
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR")  # `runtime.prepare` sets it
    return f", {folder}" if folder else ""
