"""Means over trainings, with intervals that hold what they promise with few seeds.

A setting's seeds are the sample: trials of one trained policy say nothing about the next training. So the mean of each
seed's trials is one value, and Student's t gives the interval. One seed has neither interval nor rank.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

LEVEL = 0.95
"""Of the confidence intervals in all tables."""


class Interval(NamedTuple):
    """A mean with its confidence interval."""

    mean: float
    half: float | None
    """Half the interval's width; None of a single value."""

    @property
    def low(self) -> float | None:
        """Lower end."""
        return None if self.half is None else self.mean - self.half

    @property
    def high(self) -> float | None:
        """Upper end."""
        return None if self.half is None else self.mean + self.half

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval lies on one side of zero; never of a single value."""
        return self.half is not None and abs(self.mean) > self.half


def t_interval(values: Sequence[float], level: float = LEVEL) -> Interval:
    """Return mean and confidence interval of independent values, one a seed, by Student's t.

    **Raises** `ValueError` where there is no value, or one that is not finite.
    """
    sample = np.asarray(values, np.float64)
    if not sample.size or not np.isfinite(sample).all():
        raise ValueError(f"An interval needs finite values, one or more, not {list(values)}.")
    mean = float(sample.mean())
    if sample.size == 1:
        return Interval(mean, None)
    error = sample.std(ddof=1) / np.sqrt(sample.size)
    return Interval(mean, float(stats.t.ppf((1 + level) / 2, sample.size - 1) * error))


def seed_means(trials: Sequence[Sequence[float]]) -> list[float]:
    """Return the mean of each seed's trials, `trials[seed][trial]`; numbers of trials may differ.

    **Raises** `ValueError` where there is no seed, or one without trials.
    """
    if not trials or not all(len(each) for each in trials):
        raise ValueError("A mean over trainings needs a seed or more, each with a trial or more.")
    return [float(np.mean(each)) for each in trials]


def paired_difference(one: Sequence[float], other: Sequence[float], level: float = LEVEL) -> Interval:
    """Return the mean of `one` less `other`, value by value, and its interval.

    The values must be paired: the same seeds, or the same recordings and robots, in the same order. What both have in
    common, such as a hard recording, cancels. Two settings are told apart where `excludes_zero` is true.

    **Raises** `ValueError` where they differ in number, and as `t_interval`.
    """
    if len(one) != len(other):
        raise ValueError(f"Paired values come in equal numbers, not {len(one)} and {len(other)}.")
    return t_interval([a - b for a, b in zip(one, other, strict=True)], level)
