"""Identification of the air around the robot: `python -m ballu_mjx.train aerodynamic`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from ballu_mjx.cli._command import TrainCommand, load_chosen_robot
from ballu_mjx.cli._residual import Prepared, load_earlier, show_report, train_residual
from ballu_mjx.common.errors import InputError
from ballu_mjx.residuals.aerodynamics import AIR_PARAMETERS, FREE_BY_DEFAULT, Aerodynamics
from ballu_mjx.residuals.aerodynamics_fit import AirConfig, check_air_config
from ballu_mjx.residuals.aerodynamics_training import fit_aerodynamics
from ballu_mjx.residuals.dataset import RecordingsData
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.runs.record import TrainingRecord

QUICK: Mapping[str, Any] = {"window_seconds": 0.5, "interval_seconds": 2.0, "evaluations": 3, "frictions": 1}
"""Defaults of `AirConfig` under `--quick`."""


@dataclasses.dataclass(frozen=True)
class AirData(RecordingsData):
    """Recordings and folders. A path is a recording (.csv or .csv.gz) or a folder of them."""

    fixed_from: Path | None = None
    """Folder of an earlier run. Parameters that are not in --free keep their values of that run. For example, balloons
    lose lift over weeks, and `--fixed-from RUN --free lift` identifies the present lift from one recording. The
    actuators are those of that run, unless --actuators names others. Without this option: they are 0."""
    free: tuple[Literal[AIR_PARAMETERS], ...] = FREE_BY_DEFAULT  # pyright: ignore[reportInvalidTypeForm]
    """Parameters to identify. The others keep their values of --fixed-from, or are 0. Leave out the lift if the model
    has a weighed value: the fit can attribute errors of the legs' model to the lift."""
    contact_friction: bool = False
    """Also identify the sliding friction of contacts, as if --free named it. The simulator then predicts recordings
    better, but policies can transfer worse (docs/white_box.md)."""

    def identified(self) -> tuple[str, ...]:
        """Return the names of the parameters to identify."""
        return tuple(dict.fromkeys((*self.free, *(["friction"] if self.contact_friction else []))))


def train(data: AirData, fit: AirConfig) -> int:
    """Read and check all inputs, identify the air, evaluate the result, and return the exit status."""
    robot = load_chosen_robot(data.robot, residual=data.fixed_from)
    check_air_config(fit, robot.control_timestep)
    if not data.identified():
        raise InputError(f"--free names no parameter; choose from {', '.join(AIR_PARAMETERS)}.")
    earlier = load_earlier(data.fixed_from, robot, Aerodynamics, "aerodynamic")

    def learn(prepared: Prepared, run: TrainingRecord) -> TrainedResidual:
        return fit_aerodynamics(
            prepared.simulator,
            prepared.motions["training"],
            fit,
            fixed_from=None if earlier is None else earlier.residual,
            free=data.identified(),
            run=run,
            progress=PhaseProgress(),
        )

    def sections(prepared: Prepared) -> Mapping[str, Any]:
        return {"fit": fit, "data": data}

    return train_residual("aerodynamic", data, sections, learn, show_report, earlier=earlier)


COMMAND = TrainCommand(
    "Identify parameters of the air around the robot (added mass, drag, lift and its centre) by least squares through "
    "the simulation. Evaluate them on test recordings. No network is trained.",
    {"data": AirData(), "fit": AirConfig()},
    train,
    {"fit": QUICK},
)
