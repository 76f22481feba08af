"""Identifying the air: `python -m ballu_mjx.train aerodynamic`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from ballu_mjx.cli._command import TrainCommand, load_chosen_robot
from ballu_mjx.cli._residual import Prepared, show_report, train_residual
from ballu_mjx.common.errors import InputError
from ballu_mjx.residuals.aerodynamics import AIR_PARAMETERS, Aerodynamics
from ballu_mjx.residuals.aerodynamics_fit import AirConfig, check_air_config
from ballu_mjx.residuals.aerodynamics_training import fit_aerodynamics
from ballu_mjx.residuals.dataset import RecordingsData
from ballu_mjx.residuals.trained import TrainedResidual
from ballu_mjx.robots.registry import DEFAULT_ROBOT, load_robot
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.runs.record import TrainingRecord

QUICK: Mapping[str, Any] = {"window_seconds": 0.5, "interval_seconds": 2.0, "evaluations": 3}
"""Defaults of `AirConfig` under `--quick`."""


@dataclasses.dataclass(frozen=True)
class AirData(RecordingsData):
    """Recordings and folders. A path is a recording (.csv or .csv.gz) or a folder of them."""

    fixed_from: Path | None = None
    """Folder of an earlier run whose parameters are kept but for those of --free: balloons lose lift over weeks, and
    `--fixed-from RUN --free lift` finds how much from one recording. Without this option none are kept."""
    free: tuple[Literal[AIR_PARAMETERS], ...] = AIR_PARAMETERS  # pyright: ignore[reportInvalidTypeForm]
    """Parameters to identify; the others are as in --fixed-from, or 0. Leave the lift out where the model's was
    weighed: what the legs' model lacks can pass for it."""


def train(data: AirData, fit: AirConfig) -> int:
    """Read and check everything, identify, evaluate; returns the exit status."""
    check_air_config(fit, load_robot(data.robot or DEFAULT_ROBOT).control_timestep)
    if not data.free:
        raise InputError(f"--free names no parameter; there are {', '.join(AIR_PARAMETERS)}.")
    earlier = _earlier(data)

    def learn(prepared: Prepared, run: TrainingRecord) -> TrainedResidual:
        return fit_aerodynamics(
            prepared.simulator,
            prepared.motions["training"],
            fit,
            fixed_from=earlier,
            free=data.free,
            run=run,
            progress=PhaseProgress(),
        )

    return train_residual("aerodynamic", data, lambda prepared: {"fit": fit, "data": data}, learn, show_report)


def _earlier(data: AirData) -> TrainedResidual | None:
    """Return the earlier result."""
    if data.fixed_from is None:
        return None
    found = TrainedResidual.load(data.fixed_from, load_chosen_robot(data.robot))
    if not isinstance(found.model, Aerodynamics):
        raise InputError(f"{data.fixed_from}: is no run of `train aerodynamic`; give one.")
    return found


COMMAND = TrainCommand(
    "Identify the air around the robot (added mass, drag, lift, its centre) by least squares through the simulation: "
    "no forces are learned. Measure it on recordings that the fit never saw.",
    {"data": AirData(), "fit": AirConfig()},
    train,
    {"fit": QUICK},
)
