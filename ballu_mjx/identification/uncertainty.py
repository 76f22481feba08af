"""How well windows of recordings determine declared parameters: standard errors and directions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ballu_mjx.identification.parameters import Direction, ParameterSet, principal_directions
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
    slopes = reduced.slopes * parameters.unit
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
    white, robust = (deviation * parameters.unit for deviation in deviations)
    return Analysis(white, robust, correlations, principal_directions(flat / np.sqrt(variance)))


_SLIGHT = 1e-9
