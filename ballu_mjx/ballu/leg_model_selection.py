"""Choice between the simpler and the richer model of BALLU's legs, by an F-test and an effect size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import f as f_distribution

from ballu_mjx.ballu.leg_residuals import LegResiduals
from ballu_mjx.ballu.model import SIDES
from ballu_mjx.identification.undeclared import SMALL_EFFECT


class Selection(NamedTuple):
    """Result of the comparison of models without and with the `RICHER_PARAMETERS`, for both legs together."""

    statistic: float
    """F statistic, with the effective number of independent samples."""
    threshold: float
    """Value of F that chance exceeds in 5 of 100 sweeps."""
    effect: float
    """Cohen's f^2: the squares that the further parameters explain, divided by the squares that they leave."""

    @property
    def richer(self) -> bool:
        """Return whether the richer model is kept: its improvement is neither chance nor negligible.

        With thousands of samples, an F-test detects errors of hundredths of a degree from the simulator's time step.
        The further parameters would explain these errors, but springs and gains would then be wrong.
        """
        return self.statistic > self.threshold and self.effect > SMALL_EFFECT


def select_model(
    simpler: Float[np.ndarray, "legs size"],
    richer: Float[np.ndarray, "legs size"],
    more: int,
    spread: Float[np.ndarray, "legs residuals"],
    residuals: LegResiduals,
) -> Selection:
    """Compare the solutions of two models that differ by `more` parameters for each leg."""
    every = np.ones(richer.shape[1], bool)
    before, after = (residuals(y, every)[0] for y in (simpler, richer))
    chi_squared = float(np.sum(after**2 / spread**2))
    between, within = more * len(SIDES), max(chi_squared - richer.size, 1.0)
    statistic = float(np.sum((before**2 - after**2) / spread**2)) / between
    effect = float(np.sum(before**2 - after**2) / max(np.sum(after**2), np.finfo(float).tiny))
    return Selection(statistic, float(f_distribution.ppf(1 - _LEVEL, between, within)), effect)


_LEVEL = 0.05
"""Significance level of the F-test."""
