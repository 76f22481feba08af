"""Levenberg-Marquardt within bounds, for functions that return their values together with their Jacobian.

Every step minimizes the damped quadratic model within the bounds. A coordinate can therefore reach a bound and leave it
again. A transformation that keeps coordinates inside would have a derivative of 0 at the bound.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.optimize
from jaxtyping import Float

Evaluate = Callable[[Float[np.ndarray, " size"]], tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows size"]]]
"""Function from a point to residuals and their Jacobian."""


def bounded_least_squares(
    evaluate: Evaluate,
    start: Float[np.ndarray, " size"],
    steps: int,
    report: Callable[[int, int, float], None],
    patience: int,
) -> tuple[Float[np.ndarray, " size"], float]:
    """Minimize a sum of squares from `start`, with all coordinates between 0 and 1.

    The search ends after `steps` evaluations, after `patience` evaluations in a row without a sufficient decrease, or
    if the quadratic model predicts no decrease. `report` is called with (evaluation, `steps`, loss) after each.

    **Returns** the best point, and its sum of squares.
    """
    point, damping, failed, idle = start, _DAMPING, 0, 0
    values, slopes = evaluate(point)
    loss = float(values @ values)
    report(1, steps, loss)
    for step in range(1, steps):
        change = _step(values, slopes, damping, point)
        promised = loss - float(np.sum((values + slopes @ change) ** 2))
        if promised <= _PROMISED * loss:
            break
        tried = np.clip(point + change, 0.0, 1.0)
        new, new_slopes = evaluate(tried)
        gained = loss - float(new @ new)
        idle = 0 if gained > _LEAST_GAIN * loss else idle + 1
        if gained > 0:
            point, values, slopes, loss = tried, new, new_slopes, loss - gained
            damping, failed = damping * _BOLDER, 0
        else:
            failed += 1
            damping = max(damping, _LEAST) * _CAUTIOUS**failed
        report(step + 1, steps, loss)
        if idle == patience:
            break
    return point, loss


def _step(
    values: Float[np.ndarray, " rows"],
    slopes: Float[np.ndarray, "rows size"],
    damping: float,
    point: Float[np.ndarray, " size"],
) -> Float[np.ndarray, " size"]:
    """Return the change of the point that minimizes the damped model within the bounds."""
    held = np.sqrt(damping * np.mean(np.sum(slopes**2, axis=0)) + _TINY)
    rows = np.concatenate([slopes, held * np.eye(len(point))]), np.concatenate([-values, np.zeros(len(point))])
    return scipy.optimize.lsq_linear(*rows, bounds=(-point, 1 - point), method="bvls").x


_DAMPING = 1e-6
"""Initial damping, in units of the mean squared norm of the Jacobian's columns. It grows only after a failed step."""
_BOLDER, _CAUTIOUS = 0.01, 10.0
"""Factors of the damping after a step that decreased the loss, and after one that did not. The second is raised to the
power of the number of failures in a row."""
_LEAST = 1e-7
"""Smallest damping to which the factor of a failed step is applied."""
_TINY = 1e-300
"""Damping that remains if the Jacobian is 0."""
_LEAST_GAIN = 1e-4
"""Relative decrease of the loss below which an evaluation counts as idle."""
_PROMISED = 1e-8
"""Predicted relative decrease of the loss below which the search ends."""
