"""How well windows of recordings determine declared parameters: standard errors and directions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ballu_mjx.identification.parameters import Direction, ParameterSet
from ballu_mjx.identification.window_objective import ReducedResiduals


class Analysis(NamedTuple):
    """How well residuals determine parameters: standard errors in the parameters' units."""

    white: Float[np.ndarray, " parameters"]
    robust: Float[np.ndarray, " parameters"]
    correlations: Float[np.ndarray, "parameters parameters"]
    directions: tuple[Direction, ...]


def analyse(reduced: ReducedResiduals, parameters: ParameterSet) -> Analysis:
    """Return standard errors at a minimum, if what is left were white noise and if windows err independently.

    The latter are what leaving out one window at a time changes (jackknife, CR3). Products of scores come out too small
    with few windows, because each window has pulled the fit towards itself (Bell & McCaffrey, Survey Methodology 28,
    2002).
    """
    size, windows = len(parameters), len(reduced.values)
    # As many rows say where starting states begin as there are starting states.
    variance = reduced.loss / max(reduced.values.size - reduced.start.size - size, 1)
    # In units of what bounds or priors leave open, so that all are of a size.
    unit = np.where(np.isfinite(parameters.prior), parameters.prior, (parameters.upper - parameters.lower) / 2)
    slopes = reduced.slopes * unit
    flat = slopes.reshape(-1, size)
    known = np.diag(np.where(np.isfinite(parameters.prior), 1.0, 0.0) + _SLIGHT)
    inverse = flat.T @ flat / variance + known
    bread = np.linalg.inv(inverse)
    scores = np.einsum("wr,wrp->wp", reduced.values, slopes) / variance
    own = np.einsum("wrp,wrq->wpq", slopes, slopes) / variance
    changes = np.linalg.solve(inverse - own, scores[..., None])[..., 0]
    jackknife = changes.T @ changes * (windows - 1) / windows + bread @ known @ bread
    deviations = [np.sqrt(np.diag(covariance)) for covariance in (bread, jackknife)]
    correlations = jackknife / np.outer(deviations[1], deviations[1])
    _, singular, right = np.linalg.svd(flat / np.sqrt(variance), full_matrices=False)
    signed = [row * np.sign(row[np.argmax(np.abs(row))]) for row in right]
    directions = [Direction(row, float(1 / max(s, 1e-12))) for row, s in zip(signed, singular, strict=True)]
    return Analysis(deviations[0] * unit, deviations[1] * unit, correlations, tuple(directions))


_SLIGHT = 1e-9
