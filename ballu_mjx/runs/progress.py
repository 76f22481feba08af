"""Progress bars on a terminal, lines elsewhere."""

from __future__ import annotations

import datetime
import math
import sys
import time
from typing import TextIO

from tqdm import tqdm

try:
    import fcntl
except ImportError:  # Windows, where runs are not locked
    fcntl = None


class Progress:
    """What a training run says while it runs: a bar on a terminal, a line every ten seconds elsewhere."""

    interval = 10.0

    def __init__(self, total: int, first: int = 0, stream: TextIO | None = None) -> None:
        """`total` and `first`: control steps at the run's end and at its start."""
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
        """Show where training is: control step, steps/s, and the metric that matters, in words."""
        now = time.perf_counter()
        # The time left is judged by the last minute's pace, validation included, compiling not.
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
        """Show a line that stays."""
        if self._bar is not None:
            self._bar.write(text, file=self._stream)
        else:
            print(text, file=self._stream, flush=True)

    def close(self) -> None:
        """Leave the bar as it stands."""
        if self._bar is not None:
            self._bar.close()


class PhaseProgress:
    """What a fit says while it runs: a line when a stage begins, and a bar for its iterations on a terminal."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._stage, self._count = "", 0
        self._bar: tqdm | None = None

    def update(self, stage: str, iteration: int, steps: int, loss: float) -> int:
        """Show an iteration of a stage; returns how many there were in all."""
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
        """Leave the last bar as it stands."""
        if self._bar is not None:
            self._bar.close()
