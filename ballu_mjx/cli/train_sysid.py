"""Identifying actuators from a sweep: `python -m ballu_mjx.train sysid`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ballu_mjx.ballu import plots as ballu_plots
from ballu_mjx.ballu.actuators_file import ACTUATORS_FILE
from ballu_mjx.ballu.leg_identification import IdentifiedLegs
from ballu_mjx.ballu.leg_parameters import IdentificationConfig, check_identification_config
from ballu_mjx.cli._command import TrainCommand, load_chosen_robot, written_to
from ballu_mjx.identification.actuators import identify_actuators
from ballu_mjx.recordings.csv_format import list_recordings, read_recording
from ballu_mjx.recordings.load import bundled_recordings
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
    robot: str | None = None
    """Whose recordings these are: the name of a robot that comes with the package, or the file of a description
    (docs/own_robot.md). Without this option: ballu."""
    levels: int = 20
    """Fewest command levels for each leg (paper: 20)."""
    output: Path | None = None
    """Folder of the run, new or empty. Without this option: one under runs/, named after the time."""
    quick: bool = False
    """Settled angles alone, from fewer starts: within two minutes, compiling included."""


def train(data: SweepData, fit: IdentificationConfig) -> int:
    """Read and check the sweep, identify, write; returns the exit status."""
    check_identification_config(fit)
    loggers.check(data.wandb)
    robot = load_chosen_robot(data.robot)
    paths = list_recordings(data.recordings) if data.recordings else bundled_recordings("suspended", robot)
    recordings = {path: read_recording(path, robot) for path in paths}
    robot.adapter.check_sweep(robot, recordings, data.levels)
    folder = new_folder(data.output, "sysid")
    content = describe_run("sysid", {"fit": fit, "data": data}, {"suspended": paths}, [], description=robot)
    stages = PhaseProgress()

    def report(stage: str, iteration: int, steps: int, loss: float) -> None:
        run.log(stages.update(stage, iteration, steps, loss), {stage: loss})

    with written_to() as written, Run(folder, content, wandb=data.wandb) as run:
        written.folder = folder
        print(f"Run folder: {folder}")
        print(f"  sweeps: {', '.join(path.name for path in paths)}")
        found = identify_actuators(recordings, robot, fit, levels=data.levels, progress=report)
        stages.close()
        run.write("identification.txt", found.report + "\n")
        source = [describe_recording(path) for path in paths]
        robot.adapter.write_actuators(folder / ACTUATORS_FILE, found, {"source": source})
        if isinstance(found, IdentifiedLegs):
            ballu_plots.actuator_curves(folder / "actuator_curves.png", found.sweep, found.identification)
        print(f"\n{found.report}")
    return 0


COMMAND = TrainCommand(
    "Identify the actuators from a suspended sweep: what `--actuators` of the other commands takes.",
    {"data": SweepData(), "fit": IdentificationConfig()},
    train,
    {"fit": QUICK},
)
