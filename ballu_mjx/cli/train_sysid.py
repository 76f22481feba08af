"""Identifying actuators from a sweep: `python -m ballu_mjx.train sysid`."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ballu_mjx.ballu import plots as ballu_plots
from ballu_mjx.ballu.actuators_file import ACTUATORS_FILE, write_actuators
from ballu_mjx.ballu.identification import identify_legs
from ballu_mjx.ballu.leg_parameters import IdentificationConfig, check_identification_config
from ballu_mjx.ballu.sweep import read_sweep
from ballu_mjx.ballu.sysid_report import identification_details, identification_table
from ballu_mjx.recordings.csv_format import list_bundled, list_recordings, read_recording
from ballu_mjx.residuals.run_config import describe_recording, describe_run
from ballu_mjx.runs import loggers
from ballu_mjx.runs.folder import Run, new_folder
from ballu_mjx.runs.progress import PhaseProgress

QUICK: Mapping[str, Any] = {"motion": False, "starts": 4}
"""Defaults of `IdentificationConfig` under `--quick`."""


@dataclasses.dataclass(frozen=True)
class SweepData(loggers.LoggingOptions):
    """Sweeps and folders. A path is a recording (.csv or .csv.gz) or a folder of them."""

    recordings: tuple[Path, ...] = ()
    """Suspended recordings of one robot, its legs swept together or one after the other. Without this option: the
    bundled sweep."""
    levels: int = 20
    """Fewest command levels for each leg (paper: 20)."""
    output: Path | None = None
    """Folder of the run, new or empty. Without this option: one under runs/, named after the time."""
    quick: bool = False
    """Settled angles alone, from fewer starts: within two minutes, compiling included."""


def fit(data: SweepData, config: IdentificationConfig) -> int:
    """Read and check the sweep, identify, write; returns the exit status."""
    started = time.perf_counter()
    check_identification_config(config)
    loggers.check(data.wandb)
    paths = list_recordings(data.recordings) if data.recordings else list_bundled("suspended")
    sweep = read_sweep({path: read_recording(path) for path in paths}, levels=data.levels)
    folder = new_folder(data.output, "sysid")
    print(f"Run folder: {folder}")
    print(f"  sweep of {sweep.robot}: {len(sweep.command)} holds, {', '.join(path.name for path in paths)}")
    content = describe_run("sysid", {"fit": config, "data": data}, {"suspended": paths}, [])
    with Run(folder, content, wandb=data.wandb) as run:
        stages = PhaseProgress()

        def report(stage: str, iteration: int, steps: int, loss: float) -> None:
            run.log(stages.update(stage, iteration, steps, loss), {stage: loss})

        result = identify_legs(sweep, config, report)
        stages.close()
        text = identification_table(sweep, result)
        run.write("identification.txt", text + "\n")
        source = [describe_recording(path) for path in paths]
        write_actuators(folder / ACTUATORS_FILE, sweep.robot, result.parameters, identification_details(result, source))
        ballu_plots.actuator_curves(folder / "actuator_curves.png", sweep, result)
    print(f"\n{text}\n\nWritten to {folder}. {time.perf_counter() - started:.0f} s in all.")
    return 0
