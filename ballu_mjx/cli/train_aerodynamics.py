"""Identifying the air: `python -m ballu_mjx.train residual --method aerodynamic`."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax

from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.residuals.aerodynamics import (
    AERODYNAMICS_FILE,
    AERODYNAMICS_FORMAT,
    AIR_PARAMETERS,
    Aerodynamics,
    air_parameters_to_json,
)
from ballu_mjx.residuals.aerodynamics_fit import AirConfig, AirFit, check_air_config, identify_air
from ballu_mjx.residuals.dataset import RecordingsData, ResidualDataset
from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.residuals.network import recorded_inputs
from ballu_mjx.residuals.run_config import describe_run
from ballu_mjx.residuals.trained import TrainedResidual, write_observed
from ballu_mjx.robots.model import same_parameters
from ballu_mjx.runs import loggers
from ballu_mjx.runs.folder import Run, new_folder
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.viz import artifacts

_BESIDE = 9
"""Most evaluations beside those of the first fit: one without air, and a fit at each whole delay beside the best."""
QUICK: Mapping[str, Any] = {"window_seconds": 0.5, "interval_seconds": 2.0, "evaluations": 3}
"""Defaults of `AirConfig` under `--quick`."""


@dataclasses.dataclass(frozen=True)
class AirData(RecordingsData):
    """Recordings and folders. A path is a recording (.csv or .csv.gz) or a folder of them."""

    known: Path | None = None
    """Folder of an earlier run whose parameters are kept but for those of --free: balloons lose lift over weeks, and
    `--known RUN --free lift` finds how much from one recording. Without this option nothing is known."""
    free: tuple[Literal[AIR_PARAMETERS], ...] = AIR_PARAMETERS  # pyright: ignore[reportInvalidTypeForm]
    """Parameters to identify; the others are as in --known, or 0. Leave the lift out where the model's was weighed:
    what the legs' model lacks can pass for it."""


def fit(data: AirData, config: AirConfig) -> int:
    """Read and check everything, identify, evaluate; returns the exit status."""
    started = time.perf_counter()
    check_air_config(config)
    loggers.check(data.wandb)
    if not data.free:
        raise InputError(f"--free names no parameter; there are {', '.join(AIR_PARAMETERS)}.")
    known = None if data.known is None else TrainedResidual.load(data.known)
    if known is not None and not isinstance(known.model, Aerodynamics):
        raise InputError(f"{data.known}: is no run of --method aerodynamic; give one.")
    prepared = ResidualDataset.read(data)
    if known is not None and not same_parameters(known.actuators, prepared.identified):
        raise InputError(f"{data.known}: belongs to other actuators than {prepared.where}; give --actuators the same.")
    folder = new_folder(data.output, "aerodynamic")
    prepared.announce(folder, data.quick)
    model = prepared.load_model()
    motions = prepared.reconstruct(model)
    sections = {"fit": config, "data": data}
    devices = [str(device) for device in jax.local_devices()]
    description = describe_run("aerodynamic", sections, prepared.files, devices, prepared.identified)
    with Run(folder, description, wandb=data.wandb) as run:
        print("Compiling: about a minute the first time ...", flush=True)
        stages, began = PhaseProgress(), time.perf_counter()

        done = 0

        def report(evaluation: int, cost: float) -> None:
            nonlocal done
            done = stages.update("air", evaluation, _BESIDE + config.evaluations, cost)
            run.log(done, {"cost": cost, "seconds": time.perf_counter() - began})

        values = None if known is None else known.params
        result = identify_air(model, motions["training"], config, report, known=values, free=data.free)
        stages.close()
        run.log(done, {"control_steps": result.control_steps})
        text = table(result)
        run.write("identification.txt", text + "\n")
        run.write(AERODYNAMICS_FILE, json.dumps(details(result), indent=2) + "\n")
        reference, _ = stack_motions(Simulator(model), motions["training"])
        write_observed(run, recorded_inputs(reference, EnvMimicConfig()))
    print(f"\n{text}\n\nOpen-loop replay of the test recordings:\n")
    evaluator = OpenLoopEvaluator(model, motions["test"], Aerodynamics(model), prepared.base)
    print(artifacts.write_evaluation(evaluator, result.parameters, folder).table())
    print(f"\nWritten to {folder}. {time.perf_counter() - started:.0f} s in all.")
    return 0


def details(result: AirFit) -> dict[str, Any]:
    """What `air.json` holds."""
    return {
        "format": AERODYNAMICS_FORMAT,
        "parameters": air_parameters_to_json(result.parameters),
        "standard_errors": air_parameters_to_json(result.standard_errors),
        "windows": result.windows,
        "cost": {"without": result.cost[0], "with": result.cost[1]},
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
}


def table(result: AirFit) -> str:
    """Parameters with their standard errors."""
    lines = [f"{'':18}{'':4}{'value':>12}{'std. error':>12}"]
    values, errors = (air_parameters_to_json(each) for each in (result.parameters, result.standard_errors))
    for name, unit in _UNITS.items():
        single = not isinstance(values[name], list)
        rows = [(values[name], errors[name])] if single else zip(values[name], errors[name], strict=True)
        for axis, (value, error) in zip("xyz", rows, strict=False):
            lines.append(f"{name:18}{'' if single else axis:4}{value:>12.5f}{error:>12.5f}  {unit}")
    lines.append(
        f"{result.windows} windows; robust cost {result.cost[0]:.1f} without, {result.cost[1]:.1f} with. Axes are the "
        "balloon's."
    )
    return "\n".join(lines)
