"""Common parts of fits of physical models (aerodynamic and fluid residuals): reports, and the resulting residual."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_input import recorded_inputs
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.residuals.training_range import TrainingRange
from ballu_mjx.robots.model import same_parameters
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.runs.record import TrainingRecord
from ballu_mjx.sim.residual import Residual
from ballu_mjx.sim.simulator import Simulator


def check_earlier(earlier: TrainedResidual, simulator: Simulator, kind: type, name: str) -> None:
    """Check that parameters of an earlier result can be kept in a fit with `simulator`.

    **Raises** `InputError` if it was fitted with other actuators, or if its residual is not of `kind`, called `name`.
    """
    if not same_parameters(earlier.actuators, simulator.actuators):
        raise InputError(
            "The earlier residual was fitted with other actuators than the simulator's; give the same actuators."
        )
    if not isinstance(earlier.model, kind):
        article = "an" if name[0] in "aeiou" else "a"
        raise InputError(
            f"The earlier residual is of the kind {earlier.model.name}, not {name}; give {article} {name} one."
        )


class FitReport:
    """Report of a fit's iterations to a run's record and to a progress display."""

    def __init__(self, record: TrainingRecord, progress: PhaseProgress | None, metric: str) -> None:
        """Start the report. `metric` is the name in the record of the quantity that the fit minimizes."""
        self._record, self._progress, self._metric = record, progress, metric
        self._began, self._done = time.perf_counter(), 0

    def __call__(self, stage: str, iteration: int, steps: int, loss: float) -> None:
        """Report an iteration of a stage with at most `steps` iterations."""
        self._done += 1
        if self._progress is not None:
            self._progress.update(stage, iteration, steps, loss)
        self._record.log(self._done, {self._metric: loss, "seconds": time.perf_counter() - self._began})

    def close(self, control_steps: int) -> None:
        """End the report with the number of control steps that were simulated."""
        if self._progress is not None:
            self._progress.close()
        self._record.log(self._done, {"control_steps": control_steps})


def fitted_residual(
    simulator: Simulator, motions: Sequence[Motion], model: Residual, params: Any, record: TrainingRecord, text: str
) -> TrainedResidual:
    """Return the residual of a fit to `motions` with the report `text`, and write its training range to `record`."""
    reference, _ = stack_motions(simulator, motions)
    inputs = np.asarray(recorded_inputs(reference, ForceNetworkConfig(), simulator.robot))
    observed = TrainingRange.of(inputs)
    observed.write(record)
    return TrainedResidual(model, params, observed, 0, simulator.actuators, text)
