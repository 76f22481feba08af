"""Results of the identification of BALLU's legs."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.actuators import ActuatorParameters
from ballu_mjx.ballu.leg_model_selection import Selection
from ballu_mjx.ballu.leg_parameters import LEG_PARAMETERS, RICHER_PARAMETERS, IdentificationConfig, LegDynamics
from ballu_mjx.identification.parameters import Direction


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """Identified parameters of one leg."""

    vector: Float[np.ndarray, " parameters"]
    """Parameters in their units, in the order of `LEG_PARAMETERS`."""
    standard_errors: Float[np.ndarray, " parameters"]
    """Standard errors in the parameters' units. All free parameters are taken as unknown, even if the simpler model was
    kept. 0 for parameters that the configuration holds. See `leg_uncertainty`."""
    correlations: Float[np.ndarray, "free free"]
    """Correlations of these errors, for the parameters in `Identification.free`."""
    directions: tuple[Direction, ...]
    """Directions of the fitted parameters, from the best to the least determined."""
    dynamics: LegDynamics | None
    """Identified dynamics. None if the motion was not fitted."""
    dynamics_errors: LegDynamics | None
    """Standard errors of `dynamics`. None if the motion was not fitted."""
    residual: float
    """Root mean square (rad) of all residuals. Residuals of settled angles are weighted; see `LegData.weights`."""
    losses: Float[np.ndarray, " starts"]
    """Sums of squares (rad^2) of weighted settled-angle residuals at the ends of the searches, in ascending order."""

    @property
    def open_directions(self) -> tuple[Direction, ...]:
        """Return the directions that the data leave open. Priors hold them near the nominal values."""
        return tuple(d for d in self.directions if d.standard_error > 1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Identification:
    """Result of the identification of both legs (left, right)."""

    fits: tuple[Fit, Fit]
    """Fits of the left and the right leg."""
    settled: Float[np.ndarray, "holds 2 2"]
    """Settled angles (rad) of the identified robot, in equilibrium without friction and backlash. The last two axes are
    (motor, knee) and (left, right), as in `Sweep`."""
    simulated: Float[np.ndarray, "holds 2 2"] | None
    """Mean angles (rad) of its simulated motion at the end of each hold. None if the motion was not fitted."""
    nominal_settled: Float[np.ndarray, "holds 2 2"]
    """Settled angles (rad) of the nominal robot, in the form of `settled`."""
    free: tuple[str, ...]
    """Names of the parameters that the configuration leaves free, in the order of `Fit.correlations`."""
    fitted: tuple[str, ...]
    """Names of the fitted parameters. `RICHER_PARAMETERS` are not among them if the simpler model was kept."""
    selection: Selection | None
    """Comparison of the simpler and the richer model. None if none of the `RICHER_PARAMETERS` was free."""
    config: IdentificationConfig
    """Options of the identification."""

    @property
    def keeps_simpler(self) -> bool:
        """Return whether the `RICHER_PARAMETERS` were free, but the simpler model was kept."""
        return self.selection is not None and not self.selection.richer

    @property
    def parameters(self) -> ActuatorParameters:
        """Return the parameters for simulators.

        If the simpler model was kept, the `RICHER_PARAMETERS` have their nominal values.
        """
        rows: dict[str, np.ndarray] = dict(
            zip(LEG_PARAMETERS, np.stack([fit.vector for fit in self.fits], axis=1), strict=True)
        )
        dynamics = [fit.dynamics for fit in self.fits if fit.dynamics is not None]
        for name in LegDynamics._fields if dynamics else ():
            rows[name] = np.maximum([getattr(each, name) for each in dynamics], 0.0)
        kept = {name: row for name, row in rows.items() if not (self.keeps_simpler and name in RICHER_PARAMETERS)}
        return ActuatorParameters(**{name: jnp.asarray(row, jnp.float32) for name, row in kept.items()})
