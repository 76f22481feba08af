"""Uncertainty of the parameters of BALLU's legs, identified from a sweep.

Residuals are divided by their scatter and by the square root of their integrated autocorrelation time. Both are
computed for each leg and channel, from the residuals of the richer model. The errors of an incomplete model are
correlated in time, so that many samples have the information of few.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ballu_mjx.ballu.leg_parameters import DYNAMICS_PRIOR, LEG_PARAMETERS, LegDynamics, leg_dynamics
from ballu_mjx.ballu.leg_residuals import LegResiduals
from ballu_mjx.ballu.model import SIDES
from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.parameters import Direction, principal_directions


class LegAnalysis(NamedTuple):
    """Uncertainty of one leg's parameters; see `leg_results.Fit`."""

    scatter: float
    """Root mean square of the residuals (rad)."""
    standard_errors: Float[np.ndarray, " parameters"]
    """Standard errors in the parameters' units."""
    dynamics_errors: LegDynamics | None
    """Standard errors of the dynamics. None if the motion was not fitted."""
    correlations: Float[np.ndarray, "free free"]
    """Correlations of the standard errors of the free parameters."""
    directions: tuple[Direction, ...]
    """Directions of the fitted parameters, from the best to the least determined."""


def analyse_legs(
    residuals: LegResiduals,
    coordinates: Float[np.ndarray, "legs size"],
    kept: Bool[np.ndarray, " size"],
    spread: Float[np.ndarray, "legs residuals"],
) -> list[LegAnalysis]:
    """Return the uncertainty of each leg's parameters.

    The directions are those of the parameters in `kept`, determined by the data alone. The standard errors take all
    parameters as unknown, and include the priors.

    **Raises** `InputError` if a leg moves unstably in simulation (`LegResiduals.__call__`).
    """
    space, size = residuals.space, residuals.size
    values, jacobians = residuals(coordinates, np.ones_like(kept))
    unstable = ~jacobians.any(axis=(1, 2))
    if unstable.any():
        legs = " and ".join(np.array(SIDES)[unstable])
        raise InputError(
            f"No stable motion of the {legs} leg was found that follows the sweep; identify its settled angles alone, "
            "with --no-motion."
        )
    results = []
    for y, value, jacobian, divisor in zip(coordinates, values, jacobians, spread, strict=True):
        scatter = float(np.sqrt(np.sum(value**2) / max(np.count_nonzero(value) - np.count_nonzero(kept), 1)))
        vector, derivatives = residuals.parameters(y[:size])
        units = space.units(vector)[space.free]
        # At a bound, a coordinate no longer moves its parameter. The data then leave it to its prior.
        moved = np.maximum(np.diag(derivatives), _LEAST_MOVE * units)
        priors = np.concatenate([units / moved, DYNAMICS_PRIOR[: len(y) - size]])
        # The Jacobian with respect to parameters in units of their priors.
        scaled = jacobian * priors / divisor[:, None]
        covariance = np.linalg.inv(scaled.T @ scaled + np.eye(len(y)))
        deviation = np.sqrt(np.diag(covariance))
        standard_errors = np.zeros(len(LEG_PARAMETERS))
        standard_errors[space.free] = deviation[:size] * units
        # Remove from each direction the part that the dynamics can explain.
        known, unknown = scaled[:, :size][:, kept[:size]], scaled[:, size:][:, kept[size:]]
        unknown, singular, _ = np.linalg.svd(unknown, full_matrices=False)
        unknown = unknown[:, singular > 1e-9 * singular.max(initial=0.0)]
        results.append(
            LegAnalysis(
                scatter=scatter,
                standard_errors=standard_errors,
                dynamics_errors=_dynamics_errors(y[size:], deviation[size:]) if residuals.moves else None,
                correlations=(covariance / np.outer(deviation, deviation))[:size, :size],
                directions=principal_directions(known - unknown @ (unknown.T @ known)),
            )
        )
    return results


_LEAST_MOVE = 1e-6
"""Smallest change of a parameter by a coordinate, in units of the prior."""


def _dynamics_errors(coordinates: Float[np.ndarray, " 6"], deviation: Float[np.ndarray, " 6"]) -> LegDynamics:
    """Return standard errors in the units of the dynamics, given those in units of the priors."""
    derivatives = np.diag(np.asarray(jax.jacfwd(lambda y: jnp.stack(leg_dynamics(y)))(jnp.asarray(coordinates))))
    return LegDynamics(*map(float, derivatives * DYNAMICS_PRIOR * deviation))
