"""Levenberg-Marquardt within bounds, for functions whose Jacobian comes with their values.

Every step minimizes the damped quadratic model within the bounds. A value may so arrive at a bound and leave it again,
where coordinates that are bent to stay inside have no slope left.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.optimize
from jaxtyping import Float

Evaluate = Callable[[Float[np.ndarray, " size"]], tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows size"]]]
"""Residuals and their Jacobian at a point."""


def bounded_least_squares(
    evaluate: Evaluate,
    start: Float[np.ndarray, " size"],
    steps: int,
    report: Callable[[int, int, float], None],
    patience: int,
) -> tuple[Float[np.ndarray, " size"], float]:
    """Minimize the sum of squares within 0 and 1 from `start`, in at most `steps` evaluations.

    The search ends after `patience` evaluations in a row that gained nothing worth it, and where the quadratic model
    promises nothing.

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
        idle = 0 if gained > _WORTH * loss else idle + 1
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
    """Return the change that minimizes the damped model while the point stays between the bounds."""
    held = np.sqrt(damping * np.mean(np.sum(slopes**2, axis=0)) + _TINY)
    rows = np.concatenate([slopes, held * np.eye(len(point))]), np.concatenate([-values, np.zeros(len(point))])
    return scipy.optimize.lsq_linear(*rows, bounds=(-point, 1 - point), method="bvls").x


_DAMPING = 1e-6
"""At first, in units of the mean square of the slopes: bold, and cautious only once a step has failed."""
_BOLDER, _CAUTIOUS = 0.01, 10.0
"""What multiplies the damping after a step that gained, and after one that did not (to the power of how many did not in
a row)."""
_LEAST = 1e-7
"""Damping that a failed step begins to grow from."""
_TINY = 1e-300
"""Where nothing depends on anything."""
_WORTH = 1e-4
"""Of the loss: what an evaluation gains at least."""
_PROMISED = 1e-8
"""Of the loss: a promise of less ends the search."""
