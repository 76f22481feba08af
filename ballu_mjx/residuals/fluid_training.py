"""Fit of the fluid residual: from a simulator and recorded motions to a residual."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from ballu_mjx.recordings.motion import Motion
from ballu_mjx.residuals.fluid import FLUID_FILE, FluidEstimate, FluidResidual
from ballu_mjx.residuals.fluid_fit import FluidConfig, FluidFit, fit_fluid_forces
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.residuals.white_box_training import FitReport, check_earlier, fitted_residual
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.runs.record import MemoryRecord, TrainingRecord
from ballu_mjx.sim.simulator import Simulator


def fit_fluid(
    simulator: Simulator,
    motions: Sequence[Motion],
    validation: Sequence[Motion],
    config: FluidConfig | None = None,
    *,
    fixed_from: TrainedResidual | None = None,
    run: TrainingRecord | None = None,
    progress: PhaseProgress | None = None,
) -> TrainedResidual:
    """Fit the parameters of the fluid residual.

    The report of the result has the parameters with their standard errors.

    **Arguments**

    - `simulator`: the simulator to correct.
    - `motions`: training motions.
    - `validation`: other motions, which choose the set of terms.
    - `config`: options of the fit. None for the defaults.
    - `fixed_from`: earlier result. Its parameters are kept, and only a constant force and torque are fitted: the trim
      of the robot, which changes from day to day. If None, all parameters are fitted.
    - `run`: record of metrics and files, for example a run's folder. None to keep them in memory.
    - `progress`: display that is updated after every iteration.

    **Raises** `InputError` for options out of range, if `fixed_from` is of another kind or of another simulator, and if
    no motion is as long as a window.
    """
    config = config or FluidConfig()
    known = None if fixed_from is None else _known(fixed_from, simulator)
    record = MemoryRecord({"fit": dataclasses.asdict(config)}) if run is None else run
    report = FitReport(record, progress, "loss")
    found = fit_fluid_forces(simulator, motions, validation, config, report, known)
    report.close(found.control_steps)
    record.write(FLUID_FILE, found.estimate.to_json())
    model = found.estimate.residual(simulator.robot, simulator.mj_model)
    return fitted_residual(simulator, motions, model, found.estimate.params, record, fluid_table(found))


def _known(fixed_from: TrainedResidual, simulator: Simulator) -> FluidEstimate:
    """Return the parameters of an earlier result, without standard errors."""
    check_earlier(fixed_from, simulator, FluidResidual, "fluid")
    assert isinstance(fixed_from.model, FluidResidual)
    values = jax.tree.map(lambda x: np.asarray(x, np.float64), fixed_from.params)
    return FluidEstimate(fixed_from.model.term_set, values, jax.tree.map(np.zeros_like, values))


def fluid_table(found: FluidFit) -> str:
    """Return the parameters that were fitted, and the validation errors, as text."""
    scores = ", ".join(f"{name} {score:.3g}" for name, score in found.scores.items())
    symmetric = "symmetric about the xz plane" if found.symmetric else "without symmetry"
    return (
        f"{found.estimate.table()}\n{found.windows} training windows; {symmetric}. "
        f"Validation errors, in units of the expected error: {scores}."
    )
