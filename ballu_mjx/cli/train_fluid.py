"""Fit of fluid forces: `python -m ballu_mjx.train fluid`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ballu_mjx.cli._command import TrainCommand, load_chosen_robot
from ballu_mjx.cli._residual import Prepared, show_report, train_residual
from ballu_mjx.residuals.dataset import RecordingsData
from ballu_mjx.residuals.fluid_fit import FluidConfig, check_fluid_config
from ballu_mjx.residuals.fluid_training import fit_fluid
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.runs.record import TrainingRecord

QUICK: Mapping[str, Any] = {"terms": "linear", "window_seconds": (0.5,), "windows": 20, "steps": 2}
"""Defaults of `FluidConfig` under `--quick`."""


def train(data: RecordingsData, fit: FluidConfig) -> int:
    """Read and check all inputs, fit, evaluate the result, and return the exit status."""
    check_fluid_config(fit, load_chosen_robot(data.robot).control_timestep)

    def learn(prepared: Prepared, run: TrainingRecord) -> TrainedResidual:
        motions = prepared.motions
        return fit_fluid(
            prepared.simulator, motions["training"], motions["validation"], fit, run=run, progress=PhaseProgress()
        )

    return train_residual("fluid", data, lambda prepared: {"fit": fit, "data": data}, learn, show_report)


COMMAND = TrainCommand(
    "Fit the force and torque on the tracked body as polynomials of its velocity: lift, drag, side force, moments and "
    "rotary damping. For any body in air or water.",
    {"data": RecordingsData(), "fit": FluidConfig()},
    train,
    {"fit": QUICK},
)
