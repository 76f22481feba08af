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

`--own` measures the package's own virtual robots instead. `--beside` adds the robots of an earlier results file to the
summary:

    python benchmarks/bullet_transfer.py --own 0 1 --beside results/bullet_transfer.json
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ballu_mjx.common import runtime

runtime.prepare()

import numpy as np
from bullet_family import ROBOTS, BulletHardware

from ballu_mjx.ballu.virtual.hardware import Hardware, VirtualHardware
from ballu_mjx.cli import pipeline
from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import Cell, Table, read_results, write_results
from ballu_mjx.evaluation.transfer import Transfer
from ballu_mjx.policies import pipeline_layout

Trials = Mapping[str, Mapping[str, Sequence[Transfer]]]
"""Trials by robot and simulator."""

_ROBOT_COLUMNS = (
    "robot",
    "simulator",
    "mean CoM error (m)",
    "x-distance (m)",
    "y-distance (m)",
    "final yaw error (deg)",
)
_SUMMARY_COLUMNS = ("simulator", "mean CoM error (m)", "smallest on", "error / distance walked", "x-distance (m)")


class Measured(NamedTuple):
    """Trials of one policy, as the summary needs them."""

    error: tuple[float, ...]
    """Mean CoM error (m) of each trial."""
    share: float
    """Mean CoM error, divided by the distance walked; means over trials."""
    x_distance: tuple[float, ...]
    """Distance (m) along x of each trial."""


def measure(hardware: Hardware, folder: Path, also: Sequence[Any], quick: bool) -> dict[str, list[Transfer]]:
    """Return the trials of the policies for walking on one robot, by simulator."""
    options = pipeline.Options(output=folder, tasks=("walk",), also=tuple(also), quick=quick)
    found = pipeline.measure_transfer(options, hardware)["walk"]
    return {setting: seeds[0] for setting, seeds in found.items()}


def robots_table(trials: Trials) -> Table:
    """Return one row for each robot and simulator. Brackets are the lowest and the highest of the trials."""
    rows = [
        (
            robot,
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
    return Table((*_ROBOT_COLUMNS, "x-distance in its simulator (m)"), tuple(rows))


def measured(trials: Trials) -> dict[str, dict[str, Measured]]:
    """Return what the summary needs, `[robot][simulator]`."""

    def of(found: Sequence[Transfer]) -> Measured:
        error, distance = (tuple(getattr(each, name) for each in found) for name in ("com_error", "x_distance"))
        return Measured(error, float(np.mean(error) / np.mean([each.total_distance for each in found])), distance)

    return {robot: {setting: of(found) for setting, found in each.items()} for robot, each in trials.items()}


def read_measured(path: Path) -> dict[str, dict[str, Measured]]:
    """Return what the summary needs, `[robot][simulator]`, from a results file of this benchmark.

    **Raises** `InputError` if the file has other tables.
    """
    tables = read_results(path).tables
    if not {"robots", "summary"} <= set(tables) or tables["robots"].columns[:6] != _ROBOT_COLUMNS:
        raise InputError(f"{path}: has no tables of this benchmark; give a file that it wrote with --results.")
    shares = {row[0]: row[3] for row in tables["summary"].rows}
    robots = list(dict.fromkeys(str(row[0]) for row in tables["robots"].rows))
    found: dict[str, dict[str, Measured]] = {robot: {} for robot in robots}
    for robot, setting, error, distance, *_ in tables["robots"].rows:
        share = shares[setting]
        assert isinstance(error, Cell) and isinstance(distance, Cell) and isinstance(share, Cell)
        found[str(robot)][str(setting)] = Measured(
            error.values, share.values[robots.index(str(robot))], distance.values
        )
    return found


def summary_table(found: Mapping[str, Mapping[str, Measured]]) -> Table:
    """Return one row for each simulator. Cells have one value for each robot, and counts are of robots.

    A policy is level with the furthest one if the ranges of their trials overlap.
    """
    robots = list(found.values())
    error = {s: tuple(float(np.mean(robot[s].error)) for robot in robots) for s in robots[0]}
    distance = {s: tuple(float(np.mean(robot[s].x_distance)) for robot in robots) for s in robots[0]}
    furthest = [max(robot, key=lambda s, robot=robot: float(np.mean(robot[s].x_distance))) for robot in robots]
    rows = [
        (
            setting,
            Cell(error[setting]),
            _count(error, setting, min),
            Cell(tuple(robot[setting].share for robot in robots)),
            Cell(distance[setting]),
            _count(distance, setting, max),
            f"{sum(_overlap(r[setting].x_distance, r[f].x_distance) for r, f in zip(robots, furthest, strict=True))}"
            f" of {len(robots)}",
        )
        for setting in robots[0]
    ]
    return Table((*_SUMMARY_COLUMNS, "furthest on", "level with the furthest on"), tuple(rows))


def _overlap(one: Sequence[float], other: Sequence[float]) -> bool:
    """Return whether the ranges of two sets of trials overlap."""
    return max(one) >= min(other) and max(other) >= min(one)


def _count(values: Mapping[str, Sequence[float]], setting: str, best: Callable[[Iterable[float]], float]) -> str:
    """Return on how many robots a simulator has the `best` value of all."""
    robots = range(len(values[setting]))
    won = sum(values[setting][robot] == best(each[robot] for each in values.values()) for robot in robots)
    return f"{won} of {len(robots)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", choices=list(ROBOTS), help="seeds of PyBullet's robots (all)")
    parser.add_argument("--own", type=int, nargs="+", help="seeds of the package's virtual robots, instead (none)")
    parser.add_argument(
        "--also", nargs="+", default=[], choices=pipeline_layout.OPTIONAL_SIMULATORS, help="further simulators (none)"
    )
    parser.add_argument("--quick", action="store_true", help="one robot, for minutes; the numbers mean nothing")
    parser.add_argument("--output", type=Path, help="folder of all stages")
    parser.add_argument("--results", type=Path, help="JSON file to write the tables to")
    parser.add_argument("--beside", type=Path, help="earlier results whose robots the table `all` has too")
    given = parser.parse_args()
    if given.own and given.robots:
        parser.error("give either --robots or --own")
    earlier = {} if given.beside is None else read_measured(given.beside)
    output = given.output or Path("runs") / ("bullet-transfer-quick" if given.quick else "bullet-transfer")
    robots = given.own or given.robots or (list(ROBOTS)[:1] if given.quick else list(ROBOTS))
    trials = {}
    for robot in robots:
        name = f"own-{robot}" if given.own else str(robot)
        hardware = VirtualHardware.draw(robot) if given.own else BulletHardware.draw(robot)
        trials[name] = measure(hardware, output / f"robot-{name}", given.also, given.quick)
    found = measured(trials)
    tables = {"robots": robots_table(trials), "summary": summary_table(found)}
    if earlier:
        tables["all"] = summary_table(earlier | found)
    for table in tables.values():
        print(f"\n{table.to_markdown()}")
    if given.results is not None:
        write_results(given.results, tables, "Development data", seeds={"robot": robots, "training": [0]})


if __name__ == "__main__":
    main()
