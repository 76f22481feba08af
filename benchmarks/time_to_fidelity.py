"""Measure the wall time of `python -m ballu_mjx.train envmimic` until the validation error is half of vanilla's.

The command runs as a user runs it: first with an empty cache of compiled programs (cold), then with the cache of the
first run (warm). Vanilla is the nominal robot without residual forces. The time is divided into stages:

- import: Python and packages, measured by a process that only imports them.
- prepare: reading of recordings and reconstruction of their states.
- compile: additional time of the first training step and the first validation, and the time before them.
- train, evaluate: training steps and validations, once compiled.
- rest: checkpoints and logs.

A run's validation error is a ratio to its base, which has identified actuators. The base's ratio to vanilla is measured
once, at the run's best checkpoint, and all errors of the run are multiplied by it.

`python benchmarks/time_to_fidelity.py`. With `--quick` it runs within minutes as a check, and its results mean little.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import common
import numpy as np
import tyro
from matplotlib.figure import Figure

from ballu_mjx.common import runtime

STAGES = ("import", "prepare", "compile", "train", "evaluate", "rest")
COLOURS = ("#999999", "#56b4e9", "#d55e00", "#009e73", "#e69f00", "#dddddd")
IMPORTS = "from ballu_mjx.common import runtime; runtime.prepare(); import ballu_mjx.cli.train_envmimic"


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the measurement."""

    target: float = 0.5
    """Target of the validation error, as a share of vanilla's."""
    validate_every: int = 200_000
    """Control steps between two validations."""
    arguments: tuple[str, ...] = ()
    """Further options of `train envmimic`, after --, for example --arguments -- --num-timesteps 1000000."""
    output: Path = Path("runs/bench-time-to-fidelity")
    """Folder for time_to_fidelity.json and .png, and for the runs."""
    quick: bool = False
    """Use trainings of seconds, which do not reach the target."""


def run(folder: Path, arguments: tuple[str, ...], cache: str) -> dict[str, float]:
    """Train in `folder`. Return the times (s after the start) of the first lines of some stages, and of the end."""
    command = [sys.executable, "-u", "-m", "ballu_mjx.train", "envmimic", "--output", str(folder), *arguments]
    marks: dict[str, float] = {}
    environment = common.unprepared() | {"JAX_COMPILATION_CACHE_DIR": cache}
    began = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            for mark in ("Run folder", "Compiling"):
                if line.startswith(mark):
                    marks[mark] = time.perf_counter() - began
    if process.returncode:
        raise SystemExit(f"{' '.join(command)}: failed with status {process.returncode}.")
    return marks | {"end": time.perf_counter() - began}


def import_seconds() -> float:
    """Return the wall time (s) of a process that only imports the packages of the command."""
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", IMPORTS], check=True, env=common.unprepared())
    return time.perf_counter() - began


def timeline(rows: list[dict[str, Any]], marks: dict[str, float], imported: float) -> list[dict[str, Any]]:
    """Return step, error, time (s after the start) and durations of all stages (s) until each validation of a run."""
    trained = [row for row in rows if "steps_per_second" in row]
    validated = [row for row in rows if "validation_error" in row]
    steps = np.diff([0, *(row["step"] for row in trained)])
    took = steps / np.array([row["steps_per_second"] for row in trained])
    usual = np.median(took[1:]) if len(took) > 1 else took[0]
    validating = np.array([row["validation_seconds"] for row in validated])
    usual_validation = np.median(validating[1:]) if len(validating) > 1 else validating[0]

    found = []
    for count, row in enumerate(validated, start=1):
        before = [other for other in trained if other["step"] <= row["step"]]
        if not before:
            continue  # It was done before any training.
        when = marks["Compiling"] + before[-1]["seconds"] + row["validation_seconds"]
        training, evaluating = took[: len(before)].sum(), validating[:count].sum()
        beforehand = trained[0]["seconds"] - took[0] - validating[0]  # Mostly compiling of the initial state.
        compiling = beforehand + took[0] - usual + validating[0] - usual_validation
        stages = {
            "import": imported,
            "prepare": marks["Compiling"] - imported,
            "compile": compiling,
            "train": training - (took[0] - usual),
            "evaluate": evaluating - (validating[0] - usual_validation),
        }
        stages["rest"] = when - sum(stages.values())
        entry = {"step": row["step"], "error": row["validation_error"], "seconds": when}
        found.append(entry | {"stages": {name: float(value) for name, value in stages.items()}})
    return found


def vanilla_ratio(folder: str) -> float:
    """Return a run's base relative to vanilla: its best error relative to vanilla over that relative to its base."""
    runtime.prepare()
    from ballu_mjx.evaluation.errors import Evaluation
    from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator
    from ballu_mjx.recordings.csv_format import read_recording
    from ballu_mjx.recordings.reconstruct import reconstruct_for_simulator
    from ballu_mjx.residuals.run_config import find_recordings
    from ballu_mjx.residuals.trained_residual import TrainedResidual
    from ballu_mjx.robots.registry import load_robot
    from ballu_mjx.runs.folder import read_config
    from ballu_mjx.sim.simulator import Simulator

    path = Path(folder)
    robot = load_robot()
    trained = TrainedResidual.load(path, robot)
    paths = find_recordings(read_config(path, "envmimic"), "validation", path, "--validation")
    recordings = [read_recording(each, robot) for each in paths]

    def evaluate(simulator: Simulator) -> Evaluation:
        motions = [reconstruct_for_simulator(each, simulator) for each in recordings]
        return OpenLoopEvaluator(simulator, motions, trained.model)(trained.params)

    best = evaluate(Simulator(robot, trained.actuators))
    vanilla = best.vanilla if trained.actuators is None else evaluate(Simulator(robot)).vanilla
    return dataclasses.replace(best, vanilla=vanilla).score / best.score


def plot(path: Path, entries: list[dict[str, Any]], target: float, machine: str) -> None:
    """Plot the validation error over wall time (above), and the durations of the stages (below)."""
    figure = Figure(figsize=(8.0, 7.0), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(2, 1))
    for entry, style in zip(entries, ("--", "-"), strict=True):
        seconds = [point["seconds"] for point in entry["timeline"]]
        error = [point["of_vanilla"] for point in entry["timeline"]]
        above.plot(seconds, error, style, color="#009e73", marker="o", markersize=3, label=entry["cache"])
    above.axhline(target, color="black", linewidth=0.8)
    above.set(xlabel="wall time from the command (s)", ylabel="validation error (share of vanilla's)")
    above.legend(title="cache")
    left = np.zeros(len(entries))
    for stage, colour in zip(STAGES, COLOURS, strict=True):
        values = np.array([entry["at"]["stages"][stage] for entry in entries])
        below.barh([entry["cache"] for entry in entries], values, left=left, color=colour, label=stage)
        left += values
    reached = all(entry["seconds_to_target"] is not None for entry in entries)
    below.set_xlabel(f"time (s) to {'the target' if reached else 'the last validation (target not reached by all)'}")
    figure.legend(*below.get_legend_handles_labels(), ncols=len(STAGES), fontsize=8, loc="outside lower center")
    above.set_title(machine, fontsize=9)
    common.save(figure, path)


def main(options: Options) -> None:
    runtime.prepare()
    from ballu_mjx.runs.metrics import read_metrics

    arguments = ("--validate-every", str(options.validate_every), *options.arguments)
    if options.quick:
        arguments = ("--quick", "--validate-every", "40000", *options.arguments)
    stamp = time.strftime("%Y%m%d-%H%M%S")
    entries: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as cache:
        for state in ("cold", "warm"):
            folder = options.output / f"{stamp}-{state}"
            imported = import_seconds()
            marks = run(folder, arguments, cache)
            line = timeline(read_metrics(folder), marks, imported)
            entries.append({"cache": state, "whole_command_seconds": marks["end"], "timeline": line})
    # The two runs differ only in their cache, so one ratio applies to both.
    factor = common.child(__file__, {"folder": str(options.output / f"{stamp}-warm")})
    for entry in entries:
        for point in entry["timeline"]:
            point["of_vanilla"] = point["error"] * factor
        reached = [point for point in entry["timeline"] if point["of_vanilla"] <= options.target]
        entry["at"] = reached[0] if reached else entry["timeline"][-1]
        entry["seconds_to_target"] = reached[0]["seconds"] if reached else None
        best = min(point["of_vanilla"] for point in entry["timeline"])
        told = f"after {entry['seconds_to_target']:.0f} s" if reached else f"never; the best is {best:.2f}"
        stages = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in entry["at"]["stages"].items())
        print(f"{entry['cache']}: {options.target:g} of vanilla's validation error {told} ({stages})")
    result = {"quick": options.quick, "target": options.target, "base_of_vanilla": factor, "runs": entries}
    common.write(options.output, "time_to_fidelity", result)
    machine = common.described(common.machine())
    plot(options.output / "time_to_fidelity.png", entries, options.target, machine)


if __name__ == "__main__" and not common.answer(vanilla_ratio):
    main(tyro.cli(Options, description=__doc__))
