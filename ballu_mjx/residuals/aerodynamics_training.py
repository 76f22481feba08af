"""Fit of the aerodynamic residual: from a simulator and recorded motions to a residual."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.residuals.aerodynamics import (
    AERODYNAMICS_FILE,
    AERODYNAMICS_FORMAT,
    AIR_PARAMETERS,
    FREE_BY_DEFAULT,
    Aerodynamics,
    air_parameters_to_json,
)
from ballu_mjx.residuals.aerodynamics_fit import AirConfig, AirFit, check_air_config, identify_air, most_evaluations
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.residuals.white_box_training import FitReport, check_earlier, fitted_residual
from ballu_mjx.robots.model import colliding_geoms
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.runs.record import MemoryRecord, TrainingRecord
from ballu_mjx.sim.simulator import Simulator


def fit_aerodynamics(
    simulator: Simulator,
    motions: Sequence[Motion],
    config: AirConfig | None = None,
    *,
    fixed_from: TrainedResidual | None = None,
    free: Sequence[str] = FREE_BY_DEFAULT,
    run: TrainingRecord | None = None,
    progress: PhaseProgress | None = None,
) -> TrainedResidual:
    """Fit the parameters of the aerodynamic residual.

    The report of the result has the parameters with their standard errors.

    **Arguments**

    - `simulator`: the simulator to correct.
    - `motions`: training motions.
    - `config`: options of the fit. None for the defaults.
    - `fixed_from`: an earlier result. Its parameters are kept, except those in `free`. If None, they are 0.
    - `free`: names of the parameters to fit. If the simulator's drivetrain has a delay, the delay is known and is not
      fitted. Without geoms that collide, the friction has no effect and is not fitted.
    - `run`: record of metrics and files, for example a run's folder. None to keep them in memory.
    - `progress`: display that is updated after every evaluation.

    **Raises** `InputError` for options out of range, if `fixed_from` is of another kind or of another simulator, and if
    no motion is as long as a window.
    """
    config = config or AirConfig()
    check_air_config(config, simulator.control_timestep)
    known = {"delay"} if has_delay(simulator) else set()
    if not len(colliding_geoms(simulator.mj_model)) and not simulator.mj_model.npair:
        known.add("friction")
    free = [name for name in free if name not in known]
    if not free:
        unknown = [name for name in AIR_PARAMETERS if name not in known]
        raise InputError(f"--free names no parameter that is unknown; give one or more of {', '.join(unknown)}.")
    if fixed_from is not None:
        check_earlier(fixed_from, simulator, Aerodynamics, "aerodynamic")
    record = MemoryRecord({"fit": dataclasses.asdict(config)}) if run is None else run
    report, most = FitReport(record, progress, "cost"), most_evaluations(config, free)
    values = None if fixed_from is None else fixed_from.params
    found = identify_air(
        simulator,
        motions,
        config,
        lambda evaluation, cost: report("air", evaluation, most, cost),
        fixed_from=values,
        free=free,
    )
    report.close(found.control_steps)
    record.write(AERODYNAMICS_FILE, json.dumps(air_details(found), indent=2) + "\n")
    model = Aerodynamics(simulator.robot, simulator.mj_model)
    return fitted_residual(simulator, motions, model, found.parameters, record, air_table(found))


def has_delay(simulator: Simulator) -> bool:
    """Return whether the simulator's drivetrain delays commands."""
    return simulator.drivetrain is not None and bool(np.max(simulator.drivetrain.delay) > 0)


def air_details(found: AirFit) -> dict[str, Any]:
    """Return the content of the file `AERODYNAMICS_FILE`."""
    return {
        "format": AERODYNAMICS_FORMAT,
        "parameters": air_parameters_to_json(found.parameters),
        "standard_errors": air_parameters_to_json(found.standard_errors),
        "windows": found.windows,
        "cost": {"without": found.cost[0], "with": found.cost[1]},
    }


_UNITS = {
    "added_mass": "kg",
    "added_inertia": "kg m^2",
    "lift": "N",
    "centre": "m",
    "linear_drag": "N s/m",
    "quadratic_drag": "N s^2/m^2",
    "turning_drag": "N m s",
    "delay": "s",
    "friction": "1",
}


def air_table(found: AirFit) -> str:
    """Return a table of the parameters with their standard errors, as text."""
    lines = [f"{'':18}{'':4}{'value':>12}{'std. error':>12}"]
    values, errors = (air_parameters_to_json(each) for each in (found.parameters, found.standard_errors))
    for name, unit in _UNITS.items():
        single = not isinstance(values[name], list)
        rows = [(values[name], errors[name])] if single else zip(values[name], errors[name], strict=True)
        for axis, (value, error) in zip("xyz", rows, strict=False):
            lines.append(f"{name:18}{'' if single else axis:4}{value:>12.4g}{error:>12.2g}  {unit}")
    lines.append(
        f"{found.windows} windows; robust cost {found.cost[0]:.1f} before the fit, {found.cost[1]:.1f} after it. Axes "
        "are those of the buoyant body."
    )
    return "\n".join(lines)
