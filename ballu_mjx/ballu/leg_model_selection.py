"""Choice between the simpler and the richer model of BALLU's legs, by an F-test and an effect size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special

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
    simpler: Float[np.ndarray, "legs residuals"],
    richer: Float[np.ndarray, "legs residuals"],
    spread: Float[np.ndarray, "legs residuals"],
    size: int,
    more: int,
) -> Selection:
    """Compare the residuals of two models' solutions, which have standard deviations `spread` by chance.

    The richer model has `size` parameters for both legs together, `more` of them further ones of each leg. It may hold
    the springs, which the simpler one fits. The models are then not nested, and the distribution of F is an
    approximation. If the numbers of parameters are equal, one further parameter is assumed.
    """
    chi_squared = float(np.sum(richer**2 / spread**2))
    between, within = max(more, 1) * len(SIDES), max(chi_squared - size, 1.0)
    statistic = float(np.sum((simpler**2 - richer**2) / spread**2)) / between
    effect = float(np.sum(simpler**2 - richer**2) / max(np.sum(richer**2), np.finfo(float).tiny))
    return Selection(statistic, float(special.fdtri(between, within, 1 - _LEVEL)), effect)


_LEVEL = 0.05
"""Significance level of the F-test."""
