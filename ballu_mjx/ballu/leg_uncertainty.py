"""How well a sweep determines the parameters of BALLU's legs.

Residuals are divided by their scatter and by the root of their integrated autocorrelation time, both of the richer
model's residuals, by leg and channel: where a model lacks something, its errors go together in time, and many samples
are worth few.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ballu_mjx.ballu.leg_parameters import DYNAMICS_PRIOR, LEG_PARAMETERS, LegDynamics, leg_dynamics
from ballu_mjx.ballu.leg_residuals import LegResiduals
from ballu_mjx.identification.parameters import Direction, principal_directions


class LegAnalysis(NamedTuple):
    """Of one leg: what residuals scatter by, and how well they determine its parameters."""

    scatter: float
    standard_errors: Float[np.ndarray, " parameters"]
    dynamics_errors: LegDynamics | None
    correlations: Float[np.ndarray, "free free"]
    directions: tuple[Direction, ...]


def analyse_legs(
    residuals: LegResiduals,
    coordinates: Float[np.ndarray, "legs size"],
    kept: Bool[np.ndarray, " size"],
    spread: Float[np.ndarray, "legs residuals"],
) -> list[LegAnalysis]:
    """Directions of the parameters that are kept; standard errors with all unknown, beside what is known of robots
    beforehand."""
    space, size = residuals.space, residuals.size
    results = []
    rows = zip(coordinates, *residuals(coordinates, np.ones_like(kept)), spread, strict=True)
    for y, value, jacobian, worth in rows:
        scatter = float(np.sqrt(np.sum(value**2) / max(np.count_nonzero(value) - np.count_nonzero(kept), 1)))
        vector, slope = residuals.parameters(y[:size])
        units = space.units(vector)[space.free]
        priors = np.concatenate([units / np.diag(slope), DYNAMICS_PRIOR[: len(y) - size]])
        # In units of the prior, whatever the coordinates.
        shown = jacobian * priors / worth[:, None]
        covariance = np.linalg.inv(shown.T @ shown + np.eye(len(y)))
        deviation = np.sqrt(np.diag(covariance))
        standard_errors = np.zeros(len(LEG_PARAMETERS))
        standard_errors[space.free] = deviation[:size] * units
        # Of each direction, what the dynamics cannot take up.
        known, unknown = shown[:, :size][:, kept[:size]], shown[:, size:][:, kept[size:]]
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


def _dynamics_errors(coordinates: Float[np.ndarray, " 6"], deviation: Float[np.ndarray, " 6"]) -> LegDynamics:
    """Return standard errors in the dynamics' units from those in units of their priors."""
    slope = np.diag(np.asarray(jax.jacfwd(lambda y: jnp.stack(leg_dynamics(y)))(jnp.asarray(coordinates))))
    return LegDynamics(*map(float, slope * DYNAMICS_PRIOR * deviation))
