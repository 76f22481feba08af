"""What identification finds of BALLU's legs."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.actuators import ActuatorParameters
from ballu_mjx.ballu.leg_model_selection import Selection
from ballu_mjx.ballu.leg_parameters import FURTHER, LEG_PARAMETERS, IdentificationConfig, LegDynamics
from ballu_mjx.identification.parameters import Direction


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """One leg, identified."""

    vector: Float[np.ndarray, " parameters"]
    standard_errors: Float[np.ndarray, " parameters"]
    """In the parameters' units, with all free parameters unknown, whether or not the simpler model was kept; 0 for
    those that the configuration holds. See `leg_uncertainty`."""
    correlations: Float[np.ndarray, "free free"]
    """Of the same errors."""
    directions: tuple[Direction, ...]
    """Of the parameters that were fitted, from the best to the least determined."""
    dynamics: LegDynamics | None
    """None: the motion had no part in the fit."""
    dynamics_errors: LegDynamics | None
    """Standard errors of `dynamics`."""
    residual: float
    """Root mean square (rad) of all residuals."""
    losses: Float[np.ndarray, " starts"]
    """Sums of squares (rad^2, settled angles) that the starts ended at, in ascending order."""

    @property
    def open_directions(self) -> tuple[Direction, ...]:
        """Those that the data leave open: held near the nominal values."""
        return tuple(d for d in self.directions if d.standard_error > 1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Identification:
    """Both legs (left, right)."""

    fits: tuple[Fit, Fit]
    settled: Float[np.ndarray, "holds 2 2"]
    """Angles (rad) at which the identified robot is in balance, without friction and play; (motor, knee), (left, right)
    last, as in `Sweep`."""
    simulated: Float[np.ndarray, "holds 2 2"] | None
    """What its simulated motion comes to; None where that was not fitted."""
    nominal_settled: Float[np.ndarray, "holds 2 2"]
    """The same as `settled`, of the nominal robot."""
    free: tuple[str, ...]
    """Parameters that the configuration leaves free: those of `Fit.correlations`."""
    fitted: tuple[str, ...]
    """Those that were fitted: without `FURTHER`, where the simpler model was kept."""
    selection: Selection | None
    """None: no further parameter was free."""
    config: IdentificationConfig

    @property
    def keeps_simpler(self) -> bool:
        """Whether the `FURTHER` parameters could be fitted, and were not worth it."""
        return self.selection is not None and not self.selection.richer

    @property
    def parameters(self) -> ActuatorParameters:
        """What simulators take; without `FURTHER`, the nominal robot's, where the simpler model was kept."""
        rows: dict[str, np.ndarray] = dict(
            zip(LEG_PARAMETERS, np.stack([fit.vector for fit in self.fits], axis=1), strict=True)
        )
        dynamics = [fit.dynamics for fit in self.fits if fit.dynamics is not None]
        for name in LegDynamics._fields if dynamics else ():
            rows[name] = np.maximum([getattr(each, name) for each in dynamics], 0.0)
        kept = {name: row for name, row in rows.items() if not (self.keeps_simpler and name in FURTHER)}
        return ActuatorParameters(**{name: jnp.asarray(row, jnp.float32) for name, row in kept.items()})
