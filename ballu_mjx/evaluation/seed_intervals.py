"""Means over trainings, with confidence intervals that are valid for few seeds.

The seeds of a setting are the sample, because trials of one trained policy say nothing about another training. The mean
of each seed's trials is therefore one value, and Student's t gives the interval. A single seed has no interval and must
not be ranked.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

LEVEL = 0.95
"""Confidence level of the intervals in all tables."""


class Interval(NamedTuple):
    """Mean with its confidence interval."""

    mean: float
    half: float | None
    """Half the width of the interval. None for a single value."""

    @property
    def low(self) -> float | None:
        """Lower end of the interval. None for a single value."""
        return None if self.half is None else self.mean - self.half

    @property
    def high(self) -> float | None:
        """Upper end of the interval. None for a single value."""
        return None if self.half is None else self.mean + self.half

    @property
    def bounds(self) -> tuple[float, float] | None:
        """Lower and upper end of the interval. None for a single value."""
        return None if self.half is None else (self.mean - self.half, self.mean + self.half)

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval lies on one side of zero. False for a single value."""
        return self.half is not None and abs(self.mean) > self.half


def t_interval(values: Sequence[float], level: float = LEVEL) -> Interval:
    """Return mean and confidence interval (Student's t) of independent values, one for each seed.

    **Raises** `ValueError` if there is no value, or if a value is not finite.
    """
    sample = np.asarray(values, np.float64)
    if not sample.size or not np.isfinite(sample).all():
        raise ValueError(f"An interval needs finite values, one or more, not {list(values)}.")
    mean = float(sample.mean())
    if sample.size == 1:
        return Interval(mean, None)
    error = sample.std(ddof=1) / np.sqrt(sample.size)
    return Interval(mean, float(special.stdtrit(sample.size - 1, (1 + level) / 2) * error))


def seed_means(trials: Sequence[Sequence[float]]) -> list[float]:
    """Return the mean of each seed's trials, `trials[seed][trial]`. Numbers of trials may differ.

    **Raises** `ValueError` if there is no seed, or a seed without trials.
    """
    if not trials or not all(len(each) for each in trials):
        raise ValueError("A mean over trainings needs a seed or more, each with a trial or more.")
    return [float(np.mean(each)) for each in trials]


def paired_difference(one: Sequence[float], other: Sequence[float], level: float = LEVEL) -> Interval:
    """Return mean and confidence interval of the differences `one[i] - other[i]`.

    The values must be paired: the same seeds, or the same recordings and robots, in the same order. What both have in
    common, such as a hard recording, cancels. Two settings differ at this level if `excludes_zero` is true.

    **Raises** `ValueError` if the numbers of values differ, or as `t_interval`.
    """
    if len(one) != len(other):
        raise ValueError(f"Paired values come in equal numbers, not {len(one)} and {len(other)}.")
    return t_interval([a - b for a, b in zip(one, other, strict=True)], level)
