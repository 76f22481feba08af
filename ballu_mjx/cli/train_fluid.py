"""Fit of fluid forces: `python -m ballu_mjx.train fluid`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ballu_mjx.cli._command import TrainCommand, load_chosen_robot
from ballu_mjx.cli._residual import Prepared, load_earlier, show_report, train_residual
from ballu_mjx.residuals.dataset import RecordingsData
from ballu_mjx.residuals.fluid import FluidResidual
from ballu_mjx.residuals.fluid_fit import FluidConfig, check_fluid_config
from ballu_mjx.residuals.fluid_training import fit_fluid
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.runs.record import TrainingRecord

QUICK: Mapping[str, Any] = {"terms": "linear", "window_seconds": (0.5,), "windows": 20, "steps": 2}
"""Defaults of `FluidConfig` under `--quick`."""


@dataclasses.dataclass(frozen=True)
class FluidData(RecordingsData):
    """Recordings and folders. A path is a recording (.csv or .csv.gz) or a folder of them."""

    fixed_from: Path | None = None
    """Folder of an earlier run of `train fluid`. Its forces are kept, and only a constant force and torque in the body
    frame are fitted: the trim, which changes from day to day. Minutes of recordings determine it. The actuators are
    those of that run, unless --actuators names others. Without this option: all forces are fitted."""


def train(data: FluidData, fit: FluidConfig) -> int:
    """Read and check all inputs, fit, evaluate the result, and return the exit status."""
    robot = load_chosen_robot(data.robot, residual=data.fixed_from)
    check_fluid_config(fit, robot.control_timestep)
    earlier = load_earlier(data.fixed_from, robot, FluidResidual, "fluid")

    def learn(prepared: Prepared, run: TrainingRecord) -> TrainedResidual:
        motions = prepared.motions
        return fit_fluid(
            prepared.simulator,
            motions["training"],
            motions["validation"],
            fit,
            fixed_from=None if earlier is None else earlier.residual,
            run=run,
            progress=PhaseProgress(),
        )

    def sections(prepared: Prepared) -> Mapping[str, Any]:
        return {"fit": fit, "data": data}

    return train_residual("fluid", data, sections, learn, show_report, earlier=earlier)


def _defaults(data: FluidData) -> Mapping[str, Mapping[str, Any]]:
    """Return the defaults that --quick implies. The terms of --fixed-from stay."""
    if not data.quick:
        return {}
    kept = () if data.fixed_from is None else ("terms",)
    return {"fit": {name: value for name, value in QUICK.items() if name not in kept}}


COMMAND = TrainCommand(
    "Fit the force and torque on the tracked body as polynomials of its velocity: lift, drag, side force, moments and "
    "rotary damping. For any body in air or water.",
    {"data": FluidData(), "fit": FluidConfig()},
    train,
    {"fit": QUICK},
    _defaults,
)
