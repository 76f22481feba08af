"""Uncertainty of declared parameters that are fitted to windows of recordings: standard errors and directions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ballu_mjx.identification.parameters import Direction, ParameterSet, principal_directions
from ballu_mjx.identification.window_objective import ReducedResiduals


class Analysis(NamedTuple):
    """Uncertainty of fitted parameters. Standard errors are in the parameters' units."""

    white: Float[np.ndarray, " parameters"]
    """Standard errors if the fit's residuals are white noise."""
    robust: Float[np.ndarray, " parameters"]
    """Standard errors if only the windows are independent."""
    correlations: Float[np.ndarray, "parameters parameters"]
    """Correlations of the parameters' errors, for independent windows."""
    directions: tuple[Direction, ...]
    """Combinations of parameters, from the best to the least determined."""


def analyse(reduced: ReducedResiduals, parameters: ParameterSet) -> Analysis:
    """Return standard errors at a minimum, for residuals that are white noise and for windows that err independently.

    The second kind leaves out one window at a time (jackknife, CR3). The usual products of scores are too small for few
    windows, because each window pulls the fit towards itself (Bell & McCaffrey, Survey Methodology 28, 2002). With one
    window it is not defined, and the first kind takes its place.
    """
    size, windows = len(parameters), len(reduced.values)
    # The residuals contain one prior row for each unknown of the starting states, so these rows cancel.
    variance = reduced.loss / max(reduced.values.size - reduced.start.size - size, 1)
    # `ParameterSet.unit` scales all parameters to a similar size.
    slopes = reduced.slopes * parameters.unit
    flat = slopes.reshape(-1, size)
    known = np.diag(np.where(np.isfinite(parameters.prior), 1.0, 0.0) + _SLIGHT)
    inverse = flat.T @ flat / variance + known
    bread = np.linalg.inv(inverse)
    jackknife = bread
    if windows > 1:
        scores = np.einsum("wr,wrp->wp", reduced.values, slopes) / variance
        own = np.einsum("wrp,wrq->wpq", slopes, slopes) / variance
        changes = np.linalg.solve(inverse - own, scores[..., None])[..., 0]
        jackknife = changes.T @ changes * (windows - 1) / windows + bread @ known @ bread
    deviations = [np.sqrt(np.diag(covariance)) for covariance in (bread, jackknife)]
    correlations = jackknife / np.outer(deviations[1], deviations[1])
    white, robust = (deviation * parameters.unit for deviation in deviations)
    return Analysis(white, robust, correlations, principal_directions(flat / np.sqrt(variance)))


_SLIGHT = 1e-9
"""Regularization that keeps the matrix invertible for parameters without prior that the data do not show."""
