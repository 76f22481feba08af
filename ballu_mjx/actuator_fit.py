"""Identifying actuators from a sweep: `python -m ballu_mjx.train sysid`."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ballu_mjx import actuators, identification, loggers, plots, runs
from ballu_mjx.identification import IdentificationConfig
from ballu_mjx.recording import bundled, read_recording
from ballu_mjx.recording import recordings as expand
from ballu_mjx.sweep import read_sweep

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
    identification.check(config)
    loggers.check(data.wandb)
    paths = expand(data.recordings) if data.recordings else bundled("suspended")
    sweep = read_sweep({path: read_recording(path) for path in paths}, levels=data.levels)
    folder = runs.new_folder(data.output, "sysid")
    print(f"Run folder: {folder}")
    print(f"  sweep of {sweep.robot}: {len(sweep.command)} holds, {', '.join(path.name for path in paths)}")
    content = runs.describe("sysid", {"fit": config, "data": data}, {"suspended": paths}, [])
    with runs.Run(folder, content, wandb=data.wandb) as run:
        stages = runs.Stages()

        def report(stage: str, iteration: int, steps: int, loss: float) -> None:
            run.log(stages.update(stage, iteration, steps, loss), {stage: loss})

        result = identification.identify(sweep, config, report)
        stages.close()
        text = identification.table(sweep, result)
        run.write("identification.txt", text + "\n")
        source = [runs.describe_recording(path) for path in paths]
        actuators.write(folder / actuators.NAME, sweep.robot, result.parameters, identification.details(result, source))
        plots.actuator_curves(folder / "actuator_curves.png", sweep, result)
    print(f"\n{text}\n\nWritten to {folder}. {time.perf_counter() - started:.0f} s in all.")
    return 0
