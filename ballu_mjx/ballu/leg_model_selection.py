"""Are BALLU's further leg parameters worth having? An F-test and an effect size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import f as f_distribution

from ballu_mjx.ballu.leg_residuals import LegResiduals
from ballu_mjx.ballu.model import SIDES
from ballu_mjx.identification.undeclared import SMALL_EFFECT


class Selection(NamedTuple):
    """Whether the `FURTHER` parameters of both legs are worth having."""

    statistic: float
    """F, with as many samples as the residuals are worth."""
    threshold: float
    """F that chance exceeds in 5 of 100 sweeps."""
    effect: float
    """Cohen's f^2: what the further parameters explain of the squares, over what they leave."""

    @property
    def richer(self) -> bool:
        """Whether the richer model is kept: what it explains is neither chance nor negligible.

        With thousands of samples, an F-test sees errors of the simulator's time step: hundredths of a degree, which the
        further parameters would take up at the price of wrong springs and gains.
        """
        return self.statistic > self.threshold and self.effect > SMALL_EFFECT


def select_model(
    simpler: Float[np.ndarray, "legs size"],
    richer: Float[np.ndarray, "legs size"],
    more: int,
    spread: Float[np.ndarray, "legs residuals"],
    residuals: LegResiduals,
) -> Selection:
    """Compare two models that differ by `more` parameters a leg."""
    every = np.ones(richer.shape[1], bool)
    lost, left = (residuals(y, every)[0] for y in (simpler, richer))
    worth = float(np.sum(left**2 / spread**2))
    between, within = more * len(SIDES), max(worth - richer.size, 1.0)
    statistic = float(np.sum((lost**2 - left**2) / spread**2)) / between
    effect = float(np.sum(lost**2 - left**2) / max(np.sum(left**2), np.finfo(float).tiny))
    return Selection(statistic, float(f_distribution.ppf(1 - _LEVEL, between, within)), effect)


_LEVEL = 0.05
"""Of the F-test."""
