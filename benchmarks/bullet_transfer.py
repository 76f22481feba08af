"""Measure if policies transfer to robots outside of the package's model class.

For each robot of `bullet_family`, `train all` runs as on the package's own virtual robot: sweep, identification,
vanilla policies, recordings of their actions, EnvMimic, identified air, and a policy for each simulator. Each policy
then runs as the exported controller in five trials with different draughts.

One training seed for each robot: the robots are the sample. A robot takes about 45 minutes on one core. Stages are
kept, so that an interrupted run resumes. Robots can be measured by several processes, one for each core:

    taskset -c 0 python benchmarks/bullet_transfer.py --robots 0 &
    taskset -c 1 python benchmarks/bullet_transfer.py --robots 1 &
    python benchmarks/bullet_transfer.py                  # all robots: reads the finished ones
    python benchmarks/bullet_transfer.py --quick          # one robot, for minutes; the numbers mean nothing
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ballu_mjx.common import runtime

runtime.prepare()

import numpy as np
from bullet_family import ROBOTS, BulletHardware

from ballu_mjx.cli import pipeline
from ballu_mjx.common.results import Cell, Table, write_results
from ballu_mjx.evaluation.transfer import Transfer
from ballu_mjx.policies import pipeline_layout

Trials = Mapping[int, Mapping[str, Sequence[Transfer]]]
"""Trials by robot and simulator."""


def measure(robot: int, output: Path, also: Sequence[Any], quick: bool) -> dict[str, list[Transfer]]:
    """Return the trials of the policies for walking on one robot, by simulator."""
    options = pipeline.Options(output=output / f"robot-{robot}", tasks=("walk",), also=tuple(also), quick=quick)
    found = pipeline.measure_transfer(options, BulletHardware.draw(robot))["walk"]
    return {setting: seeds[0] for setting, seeds in found.items()}


def robots_table(trials: Trials) -> Table:
    """Return one row for each robot and simulator. Brackets are the lowest and the highest of the trials."""
    heads = ("robot", "simulator", "mean CoM error (m)", "x-distance (m)", "y-distance (m)", "final yaw error (deg)")
    rows = [
        (
            str(robot),
            setting,
            Cell(tuple(trial.com_error for trial in found)),
            Cell(tuple(trial.x_distance for trial in found)),
            Cell(tuple(trial.y_distance for trial in found)),
            Cell(tuple(trial.yaw_error for trial in found), ".0f"),
            Cell((float(np.mean([trial.sim_x_distance for trial in found])),)),
        )
        for robot, by_setting in trials.items()
        for setting, found in by_setting.items()
    ]
    return Table((*heads, "x-distance in its simulator (m)"), tuple(rows))


def summary_table(trials: Trials) -> Table:
    """Return one row for each simulator. Cells have one value for each robot, and counts are of robots."""
    settings = list(next(iter(trials.values())))
    error = {s: [_mean(found[s], "com_error") for found in trials.values()] for s in settings}
    distance = {s: [_mean(found[s], "x_distance") for found in trials.values()] for s in settings}
    path = {s: [_mean(found[s], "total_distance") for found in trials.values()] for s in settings}
    rows = []
    for setting in settings:
        share = [e / p for e, p in zip(error[setting], path[setting], strict=True)]
        rows.append(
            (
                setting,
                Cell(tuple(error[setting])),
                _count(error, setting, min),
                Cell(tuple(share)),
                Cell(tuple(distance[setting])),
                _count(distance, setting, max),
            )
        )
    heads = ("simulator", "mean CoM error (m)", "smallest on", "error / distance walked", "x-distance (m)")
    return Table((*heads, "furthest on"), tuple(rows))


def _mean(trials: Sequence[Transfer], quantity: str) -> float:
    return float(np.mean([getattr(trial, quantity) for trial in trials]))


def _count(values: Mapping[str, Sequence[float]], setting: str, best: Callable[[Iterable[float]], float]) -> str:
    """Return on how many robots a simulator has the `best` value of all."""
    robots = range(len(values[setting]))
    won = sum(values[setting][robot] == best(each[robot] for each in values.values()) for robot in robots)
    return f"{won} of {len(robots)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", choices=list(ROBOTS), help="seeds (all)")
    parser.add_argument(
        "--also", nargs="+", default=[], choices=pipeline_layout.OPTIONAL_SIMULATORS, help="further simulators (none)"
    )
    parser.add_argument("--quick", action="store_true", help="one robot, for minutes; the numbers mean nothing")
    parser.add_argument("--output", type=Path, help="folder of all stages")
    parser.add_argument("--results", type=Path, help="JSON file to write the tables to")
    given = parser.parse_args()
    output = given.output or Path("runs") / ("bullet-transfer-quick" if given.quick else "bullet-transfer")
    robots = given.robots or (list(ROBOTS)[:1] if given.quick else list(ROBOTS))
    trials = {robot: measure(robot, output, given.also, given.quick) for robot in robots}
    tables = {"robots": robots_table(trials), "summary": summary_table(trials)}
    for table in tables.values():
        print(f"\n{table.to_markdown()}")
    if given.results is not None:
        write_results(given.results, tables, "Development data", seeds={"robot": robots, "training": [0]})


if __name__ == "__main__":
    main()
