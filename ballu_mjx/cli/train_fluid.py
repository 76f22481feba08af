"""Fitting fluid forces: `python -m ballu_mjx.train fluid`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ballu_mjx.cli._command import TrainCommand, load_chosen_robot, open_run, written_to
from ballu_mjx.cli._residual import prepare
from ballu_mjx.residuals.dataset import RecordingsData
from ballu_mjx.residuals.fluid_fit import FluidConfig, check_fluid_config
from ballu_mjx.residuals.fluid_training import fit_fluid
from ballu_mjx.runs import loggers
from ballu_mjx.runs.progress import PhaseProgress

QUICK: Mapping[str, Any] = {"terms": "linear", "window_seconds": (0.5,), "windows": 20, "steps": 2}
"""Defaults of `FluidConfig` under `--quick`."""


def train(data: RecordingsData, fit: FluidConfig) -> int:
    """Read and check everything, fit, evaluate; returns the exit status."""
    check_fluid_config(fit, load_chosen_robot(data.robot).control_timestep)
    loggers.check(data.wandb)
    with written_to() as written:
        prepared = prepare("fluid", data)
        folder = written.folder = prepared.folder
        motions = prepared.motions
        with open_run(folder, prepared.describe({"fit": fit, "data": data}), None, data.wandb) as run:
            residual = fit_fluid(
                prepared.simulator,
                motions["training"],
                motions["validation"],
                fit,
                run=run,
                progress=PhaseProgress(),
            )
            run.write("identification.txt", residual.report + "\n")
        print(f"\n{residual.report}\n")
        prepared.show_evaluation(residual, quick=data.quick)
    return 0


COMMAND = TrainCommand(
    "Fit force and torque on the tracked body as polynomials of its velocity: lift, drag, side force, moments and "
    "rotary damping, for any body in air or water.",
    {"data": RecordingsData(), "fit": FluidConfig()},
    train,
    {"fit": QUICK},
)
