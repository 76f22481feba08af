"""Progress bars on a terminal, lines elsewhere."""

from __future__ import annotations

import datetime
import math
import sys
import time
from typing import TextIO

from tqdm import tqdm


class Progress:
    """Progress of a training run: a bar on a terminal, or a line every ten seconds elsewhere."""

    interval = 10.0
    """Time between two lines (s)."""

    def __init__(self, total: int, first: int = 0, stream: TextIO | None = None) -> None:
        """Show progress on `stream`. `total` and `first` are the control steps at the run's end and at its start."""
        self._total = total
        self._stream = stream or sys.stderr
        self._bar = None
        if self._stream.isatty():
            layout = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} steps{postfix}"
            self._bar = tqdm(
                total=total, initial=first, file=self._stream, bar_format=layout, unit_scale=True, dynamic_ncols=True
            )
        self._marks: list[tuple[float, int]] = []
        self._said = -math.inf

    def update(self, step: int, rate: float, metric: str) -> None:
        """Show the control step, the speed `rate` (control steps/s), and the text `metric` of the main metric."""
        now = time.perf_counter()
        # The time left follows from the speed of the last minute, including validation but not compilation.
        self._marks = [mark for mark in self._marks if now - mark[0] < 60.0] + [(now, step)]
        (then, before), left = self._marks[0], "?"
        if step > before:
            seconds = round((self._total - step) * (now - then) / (step - before))
            left = str(datetime.timedelta(seconds=max(seconds, 0)))
        text = f"{rate:,.0f} steps/s, {left} left, {metric}"
        if self._bar is not None:
            self._bar.update(min(step, self._total) - self._bar.n)
            self._bar.set_postfix_str(text)
        elif now - self._said >= self.interval or step >= self._total:
            self._said = now
            print(f"{step:,} of {self._total:,} steps, {text}", file=self._stream, flush=True)

    def tell(self, text: str) -> None:
        """Show a line that stays on the terminal."""
        if self._bar is not None:
            self._bar.write(text, file=self._stream)
        else:
            print(text, file=self._stream, flush=True)

    def close(self) -> None:
        """Close the bar, which stays on the terminal."""
        if self._bar is not None:
            self._bar.close()


class PhaseProgress:
    """Progress of a fit: a line when a stage begins, and a bar of its iterations on a terminal."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._stage, self._count = "", 0
        self._bar: tqdm | None = None

    def update(self, stage: str, iteration: int, steps: int, loss: float) -> int:
        """Show an iteration of a stage, and return the number of updates so far in all stages."""
        self._count += 1
        if stage != self._stage:
            self.close()
            self._stage = stage
            interval = 0.1 if self._stream.isatty() else Progress.interval
            self._bar = tqdm(
                total=steps, desc=f"{stage:15}", file=self._stream, dynamic_ncols=True, mininterval=interval
            )
        if self._bar is not None:
            self._bar.update(iteration - self._bar.n)
            if math.isfinite(loss):
                self._bar.set_postfix_str(f"loss {loss:.5g}")
        return self._count

    def close(self) -> None:
        """Close the last bar, which stays on the terminal."""
        if self._bar is not None:
            self._bar.close()
