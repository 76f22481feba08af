"""Measure with the seeds of the final tier: `python experiments/final_tier.py --seeds results/final.json`.

`experiments/draw_final.py` draws the seeds for a tagged commit (experiments/protocol.md). The robots are three of the
virtual robot's family and two of PyBullet's (extra `bench`). The measurement has units:

- `fidelity-ROBOT`: open-loop errors of simulators on fresh recordings of a robot, with all training seeds;
- `walk-ROBOT-TRAINING` and `turn-ROBOT-TRAINING`: the stages and trials of `train all` on a robot, with one training
  seed.

A unit takes about an hour on one core. Its numbers are written to `final/UNIT.json` beside the file of seeds. Units
that have a file are not repeated, so that an interrupted run resumes, also on another machine. Two processes must not
share a robot:

    git worktree add ../final "$(git rev-parse final-1^{commit})" && cd ../final
    taskset -c 0 python experiments/final_tier.py --seeds ../main/results/final.json --robots 0 2 4 &
    taskset -c 1 python experiments/final_tier.py --seeds ../main/results/final.json --robots 1 3 &
    python experiments/final_tier.py --seeds results/final.json --list      # which units are missing
    python experiments/final_tier.py --seeds results/final.json --tables    # tables of complete kinds
    python experiments/final_tier.py --quick                                # one robot, for minutes; no final seeds
"""

from __future__ import annotations

import sys

sys.path += ["experiments", "benchmarks"]

import _setup

_setup.prepare()

import argparse
import dataclasses
import datetime
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import collect_runs
import fidelity
import numpy as np
from draw_final import FORMAT, draw_seeds

from ballu_mjx.ballu.virtual import dataset
from ballu_mjx.ballu.virtual.hardware import Hardware, VirtualHardware
from ballu_mjx.cli import pipeline
from ballu_mjx.common import files, provenance
from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import Cell, Table, write_results
from ballu_mjx.evaluation.errors import SCORE_HORIZONS
from ballu_mjx.evaluation.seed_intervals import LEVEL, paired_difference, t_interval
from ballu_mjx.evaluation.transfer import Transfer
from ballu_mjx.identification.actuators import ACTUATORS_FILE
from ballu_mjx.policies.pipeline_layout import PAPER_PRESET, prediction_file
from ballu_mjx.policies.transfer_prediction import read_prediction
from ballu_mjx.viz.style import label_of

Kind = Literal["fidelity", "walk", "turn"]
KINDS: Sequence[Kind] = ("fidelity", "walk", "turn")
OWN, OUTSIDE = 3, 2
"""Numbers of robots of the virtual robot's family and of PyBullet's, in this order."""
ROBOTS = tuple(f"own {n + 1}" for n in range(OWN)) + tuple(f"PyBullet {n + 1}" for n in range(OUTSIDE))
"""Names of the robots in tables."""
TRAININGS = 3
"""Number of training seeds in use. More seeds are drawn than this, for later rankings."""
METHODS = ("paper", "regression", "analytic")
"""Methods of `fidelity.METHODS` besides EnvMimic and the white box."""
_UNIT_FORMAT = "ballu-final-unit/1"
_DECIMALS = 5
METHOD = fidelity.METHODS["identified"].label
"""Row with which the others are compared in pairs."""
PREDICTED = "smallest predicted error"
"""Row of the policies that `train all` names first, before any trial."""


class Unit(NamedTuple):
    """Part of the final measurement that is run at once."""

    kind: Kind
    robot: int
    """Index in `ROBOTS`."""
    training: int | None
    """Index of the training seed. None for all."""

    @property
    def name(self) -> str:
        """Name of the unit's file."""
        return f"{self.kind}-{self.robot}" + ("" if self.training is None else f"-{self.training}")


def all_units() -> list[Unit]:
    """Return the units in their order: fidelity, then transfer by training seed."""
    robots = range(len(ROBOTS))
    units = [Unit("fidelity", robot, None) for robot in robots]
    for training in range(TRAININGS):
        units += [Unit(kind, robot, training) for kind in KINDS[1:] for robot in robots]
    return units


# ---- measurement ----


def hardware_of(robot: int, seeds: Mapping[str, Sequence[int]]) -> Hardware:
    """Return a robot, given its index and the drawn seeds."""
    if robot < OWN:
        return VirtualHardware.draw(seeds["robots"][robot])
    from bullet_family import BulletHardware  # needs the extra `bench`  # pyright: ignore[reportMissingImports]

    return BulletHardware.draw(seeds["robots_outside"][robot - OWN])


def record_all(hardware: Hardware, wanted: Sequence[dataset.Job], folder: Path) -> dict[str, list[Path]]:
    """Make recordings on a robot unless their files are there, and return the files by use."""
    found: dict[str, list[Path]] = {}
    for job in wanted:
        path = folder / job.split / f"{job.name}.csv.gz"
        found.setdefault(job.split, []).append(path)
        if not path.exists():
            dataset.record_job(job, hardware, folder)
            print(f"Recorded {path.relative_to(folder)}", flush=True)
    return found


def recorded_on(hardware: Hardware, recording: int, folder: Path, quick: bool) -> fidelity.Recorded:
    """Return recordings and identified actuators of a robot. They are made in `folder` unless they are there.

    Training and validation recordings have the commands of the bundled data set. `recording` is the seed of the test
    recordings.
    """
    place = folder / "recordings"
    free = record_all(hardware, [job for job in dataset.jobs() if job.split != "test"], place)
    fresh = record_all(hardware, dataset.fresh_jobs(recording, 1 if quick else 6), place)["fresh"]
    # The seed is that of trainings, and the identification has none.
    stages = pipeline.PipelineStages(pipeline.Options(output=folder, quick=quick), 0, hardware)
    return fidelity.Recorded(free["training"], free["validation"], fresh, stages.identified() / ACTUATORS_FILE)


Ratios = Mapping[str, Mapping[str, Mapping[str, Sequence[float | None]]]]
"""Errors by horizon (s), simulator, and group and quantity. Vanilla has its error (m or deg). Other simulators have
ratios to it, one for each training seed. None for simulations that diverged."""


def measure_fidelity(
    hardware: Hardware, training: Sequence[int], recording: int, folder: Path, quick: bool
) -> dict[str, dict[str, dict[str, list[float | None]]]]:
    """Return `Ratios` of all simulators on fresh recordings of a robot (`recorded_on`)."""
    recorded = recorded_on(hardware, recording, folder, quick)
    chosen = {*METHODS, "identified", fidelity.AIR}
    methods = [name for name in fidelity.METHODS if name in chosen]
    folders = fidelity.learn(methods, list(training), folder / "fidelity", recorded, quick=quick)
    found = {name: [fidelity.load(member) for member in members] for name, members in folders.items()}
    rows = fidelity.rows_of(fidelity.vanilla_errors(folders["identified"][0], recorded.test), found)
    columns = [(group, quantity) for group in fidelity.groups_of(rows) for quantity in ("position", "orientation")]
    others = {label: runs for label, runs in rows.items() if label != "vanilla"}
    return {
        f"{horizon:g}": {
            label: {" ".join(column): _stored(cell.values) for column, cell in zip(columns, cells, strict=True)}
            for label, cells in collect_runs.remaining_errors(rows["vanilla"][0], others, columns, horizon).items()
        }
        for horizon in SCORE_HORIZONS
    }


def _stored(values: Sequence[float]) -> list[float | None]:
    """Return rounded numbers, and None for those of simulations that diverged."""
    return [round(value, _DECIMALS) if math.isfinite(value) else None for value in values]


def measure_policies(
    hardware: Hardware, task: Literal["walk", "turn"], seed: int, folder: Path, quick: bool
) -> dict[str, Any]:
    """Return the trials of each simulator's policy on a robot, and the errors that were predicted before them."""
    options = pipeline.Options(output=folder, tasks=(task,), seeds=(seed,), also=(PAPER_PRESET,), quick=quick)
    trials = pipeline.measure_transfer(options, hardware)[task]
    predicted = read_prediction(prediction_file(folder, seed, task)).com_error
    return {
        setting: {
            "predicted": round(predicted[setting], _DECIMALS),
            "trials": [{name: round(x, _DECIMALS) for name, x in each.to_json().items()} for each in seeds[0]],
        }
        for setting, seeds in trials.items()
    }


def measure(unit: Unit, seeds: Mapping[str, Sequence[int]], folder: Path, quick: bool) -> dict[str, Any]:
    """Run a unit, and return its numbers. `folder` keeps its stages, so that it can be resumed."""
    hardware = hardware_of(unit.robot, seeds)
    training = list(seeds["trainings"][: 1 if quick else TRAININGS])
    if unit.kind == "fidelity":
        return measure_fidelity(hardware, training, seeds["recordings"][0], folder, quick)
    assert unit.training is not None
    return measure_policies(hardware, unit.kind, training[unit.training], folder, quick)


# ---- files of units ----


def read_seeds(path: Path) -> dict[str, Any]:
    """Return the content of the file that `draw_final.py` wrote.

    **Raises** `InputError` if the file is of another format, or if its seeds are not those of its commit.
    """
    content = files.read_json(path, "draw it again with experiments/draw_final.py")
    if content.get("format") != FORMAT or content.get("seeds") != draw_seeds(str(content.get("commit"))):
        raise InputError(f"{path}: has no seeds of a commit; draw it again with experiments/draw_final.py.")
    return content


def check_code(drawn: Mapping[str, Any]) -> None:
    """Refuse code that is not the tagged commit.

    **Raises** `InputError`.
    """
    here = provenance.source_commit()
    if here != drawn["commit"]:
        raise InputError(
            f"This code is {here}, but the seeds were drawn for {drawn['commit']} ({drawn['tag']}); "
            "run the script in a checkout of that commit, without changes."
        )


def write_unit(path: Path, unit: Unit, drawn: Mapping[str, Any], seconds: float, result: Any) -> None:
    """Write the numbers of a unit, with one line for each part of the file."""
    content = {
        "format": _UNIT_FORMAT,
        "unit": unit.name,
        "tag": drawn["tag"],
        "commit": drawn["commit"],
        "time": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        "seconds": round(seconds),
        "machine": provenance.describe_machine(),
        "versions": provenance.package_versions(),
    }
    lines = [f" {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items()]
    parts = ",\n".join(f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in result.items())
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write(path, "{\n" + ",\n".join(lines) + ',\n "result": {\n' + parts + "\n }\n}\n")


def read_unit(path: Path, drawn: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a unit's file.

    **Raises** `InputError` if it is not a unit of this tag.
    """
    fix = "delete it, and measure it again"
    content = files.read_json(path, fix)
    expected = {"format": _UNIT_FORMAT, "unit": path.name.removesuffix(".json"), "commit": drawn["commit"]}
    for name, value in expected.items():
        if content.get(name) != value:
            raise InputError(f'{path}: "{name}" is not {value!r}; {fix}.')
    return content


# ---- tables ----


def fidelity_tables(results: Sequence[Ratios]) -> dict[str, Table]:
    """Return the tables of errors over each horizon, given those of each robot.

    Cells are means over robots with Student's t interval. Each robot's value is the mean over training seeds. Tables
    `pairs-HORIZON` have the paired differences of EnvMimic and each other simulator. The table `robots` has the values
    of each robot over the longest horizon.
    """
    tables = {}
    for horizon, first in results[0].items():
        columns = list(first["vanilla"])
        means = {
            label: [[float(np.mean(_finite(robot[horizon][label][c]))) for robot in results] for c in columns]
            for label in first
        }
        rows = [(label, *map(_fidelity_cell, means[label], [label] * len(columns), columns)) for label in first]
        tables[horizon] = Table((f"{horizon} s", *map(_title, columns)), tuple(rows))
        ours = means[METHOD]
        pairs = [
            (label, *map(_difference, ours, means[label], [".2f"] * len(columns)))
            for label in first
            if label not in ("vanilla", METHOD)
        ]
        tables[f"pairs-{horizon}"] = Table((f"{METHOD} minus this, {horizon} s", *map(_title, columns)), tuple(pairs))
    last = list(results[0])[-1]
    columns = list(results[0][last]["vanilla"])
    made = [
        (name, label, *(Cell(_finite(robot[last][label][c]), *_form(label, c)) for c in columns))
        for name, robot in zip(ROBOTS, results, strict=True)
        for label in robot[last]
    ]
    return tables | {"robots": Table(("robot", f"{last} s", *map(_title, columns)), tuple(made))}


def _title(column: str) -> str:
    """Return the title of a column of errors, given its group and quantity."""
    return column.replace("orientation", "yaw").replace(" ", ": ")


def _form(label: str, column: str) -> tuple[str, str]:
    """Return format and unit of an error: that of vanilla itself, or a ratio to it."""
    if label != "vanilla":
        return ".2f", ""
    return (".3f", "m") if column.endswith("position") else (".1f", "deg")


def _fidelity_cell(means: Sequence[float], label: str, column: str) -> Cell:
    """Return the cell of one simulator, given its mean for each robot."""
    form, unit = _form(label, column)
    return dataclasses.replace(_over_robots(means, form), unit=unit)


def _finite(values: Sequence[float | None]) -> tuple[float, ...]:
    """Return the numbers, with infinity for None."""
    return tuple(math.inf if value is None else value for value in values)


def _over_robots(values: Sequence[float], form: str = ".2f") -> Cell:
    """Return the cell of one value for each robot, with Student's t interval if all are finite."""
    return Cell(tuple(values), form, bounds=t_interval(values).bounds if all(map(math.isfinite, values)) else None)


class Figure(NamedTuple):
    """Quantity of a trial."""

    title: str
    of: Callable[[Transfer], float]
    form: str = ".2f"


FIGURES: Mapping[str, Sequence[Figure]] = {
    "walk": (
        Figure("mean CoM error (m)", lambda t: t.com_error),
        Figure("x-distance (m)", lambda t: t.x_distance),
        Figure("x-distance in simulation (m)", lambda t: t.sim_x_distance),
        Figure("total distance (m)", lambda t: t.total_distance),
    ),
    "turn": (
        Figure("abs. final yaw error (deg)", lambda t: abs(t.yaw_error), ".0f"),
        Figure("y-distance (m)", lambda t: t.y_distance),
        Figure("y-distance in simulation (m)", lambda t: t.sim_y_distance),
        Figure("change of yaw (deg)", lambda t: t.yaw_change, ".0f"),
        Figure("mean CoM error (m)", lambda t: t.com_error),
    ),
}
"""Columns of the tables, by task. The first is the one by which the paper ranks transfer, and the second is the one
that a policy should make large."""


def transfer_tables(task: str, results: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, Table]:
    """Return the tables of a task, `results[robot][training][setting]`.

    Cells of `summary` are means over robots with Student's t interval. Each robot's value is the mean over training
    seeds and trials. `short` has its first and last columns. `robots` has the values of each robot and training seed.
    """
    figures = FIGURES[task]
    by_robot = [_by_setting(trainings, figures) for trainings in results]
    settings = list(by_robot[0])
    means = {s: [[float(np.mean(robot[s][i])) for robot in by_robot] for i in range(len(figures))] for s in settings}
    ranked = [s for s in settings if s != PREDICTED]
    rows = []
    for setting in settings:
        cells: list[Cell | str] = [_called(setting)]
        for index, figure in enumerate(figures):
            cells.append(_over_robots(means[setting][index], figure.form))
        cells += [_won(means, setting, ranked, 0, min), _won(means, setting, ranked, 1, max)]
        for index in range(2):
            cells.append(_difference(means["envmimic"][index], means[setting][index], figures[index].form))
        rows.append(tuple(cells))
    titles = [figure.title for figure in figures]
    beside = [f"EnvMimic minus this: {titles[index]}" for index in range(2)]
    counts = ["smallest error on", "furthest on"]
    made = [
        (name, _called(setting), *(Cell(tuple(robot[setting][i]), f.form) for i, f in enumerate(figures)))
        for name, robot in zip(ROBOTS, by_robot, strict=True)
        for setting in settings
    ]
    short = (0, 1, 2, -2, -1)
    columns = ("setting", *titles, *counts, *beside)
    return {
        "short": Table(tuple(columns[i] for i in short), tuple(tuple(row[i] for i in short) for row in rows)),
        "summary": Table(columns, tuple(rows)),
        "robots": Table(("robot", "setting", *titles), tuple(made)),
    }


def _called(setting: str) -> str:
    return setting if setting == PREDICTED else label_of(setting)


def _by_setting(trainings: Sequence[Mapping[str, Any]], figures: Sequence[Figure]) -> dict[str, list[list[float]]]:
    """Return the mean over trials, `[setting][figure][training]`, also of the policy with the smallest prediction."""
    found: dict[str, list[list[float]]] = {}
    for training in trainings:
        named = {setting: each["trials"] for setting, each in training.items()}
        named[PREDICTED] = named[min(training, key=lambda setting: training[setting]["predicted"])]
        for setting, trials in named.items():
            lists = found.setdefault(setting, [[] for _ in figures])
            for values, figure in zip(lists, figures, strict=True):
                values.append(float(np.mean([figure.of(Transfer.from_json(trial)) for trial in trials])))
    return found


def _won(
    means: Mapping[str, Sequence[Sequence[float]]],
    setting: str,
    ranked: Sequence[str],
    index: int,
    best: Callable[[list[float]], float],
) -> str:
    """Return on how many robots a setting has the `best` value of the `ranked` settings."""
    robots = range(len(means[setting][index]))
    won = sum(means[setting][index][r] == best([means[each][index][r] for each in ranked]) for r in robots)
    return f"{won} of {len(robots)}"


def _difference(one: Sequence[float], other: Sequence[float], form: str) -> Cell | str:
    """Return the cell of the paired differences over robots, with Student's t interval. It is empty if all are 0."""
    if not all(map(math.isfinite, (*one, *other))):
        return "diverged"
    if list(one) == list(other):
        return ""
    bounds = paired_difference(one, other).bounds
    return Cell(tuple(a - b for a, b in zip(one, other, strict=True)), form, bounds=bounds)


def write_tables(drawn: Mapping[str, Any], units: Path, output: Path) -> list[Path]:
    """Write the tables of each kind that was measured on all robots, and return the files.

    The tables of policies are over the first training seeds, as many as were measured on all robots. Their caption
    names them.
    """
    written = []
    for kind in KINDS:
        mine = [unit for unit in all_units() if unit.kind == kind]
        paths = {unit: units / f"{unit.name}.json" for unit in mine}
        missing = [unit for unit in mine if not paths[unit].exists()]
        first = min((unit.training or 0 for unit in missing), default=TRAININGS)
        if missing:
            print(f"{kind}: {len(missing)} of {len(mine)} units are missing.")
        if first == 0:
            continue
        mine = [unit for unit in mine if (unit.training or 0) < first]
        read = [read_unit(paths[unit], drawn) for unit in mine]
        if kind == "fidelity":
            tables = fidelity_tables([each["result"] for each in read])
        else:
            groups: list[list[Any]] = [[] for _ in ROBOTS]
            for unit, each in zip(mine, read, strict=True):
                groups[unit.robot].append(each["result"])
            tables = transfer_tables(kind, groups)
        machine = read[0]["machine"] | {"cpu": " and ".join(sorted({each["machine"]["cpu"] for each in read}))}
        measured = {"commit": drawn["commit"], "machine": machine, "versions": read[0]["versions"]}
        data = f"Final tier, tag {drawn['tag']}: brackets are {LEVEL:.0%} intervals over {len(ROBOTS)} robots"
        if missing:
            data += f", the first {first} of {TRAININGS} training seeds"
        seeds = {"training": drawn["seeds"]["trainings"][:first]}
        seeds |= {"own robot": drawn["seeds"]["robots"], "PyBullet robot": drawn["seeds"]["robots_outside"]}
        written.append(output / f"final_{kind}.json")
        write_results(written[-1], tables, data, seeds=seeds, measured=measured)
        for name, table in tables.items():
            print(f"\n### {kind}: {name}\n\n{table.to_markdown()}")
    return written


# ---- command line ----


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=Path, help="file of draw_final.py")
    numbers = range(len(ROBOTS))
    parser.add_argument("--robots", type=int, nargs="+", choices=numbers, default=list(numbers), help="robots (all)")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), help="kinds of units (all)")
    parser.add_argument("--list", action="store_true", help="list the units, and run nothing")
    parser.add_argument("--tables", action="store_true", help="write the tables of complete kinds, and run nothing")
    parser.add_argument("--quick", action="store_true", help="one robot, for minutes; the numbers mean nothing")
    given = _setup.parse(parser, Path("runs/final"))
    if given.quick == (given.seeds is not None):
        parser.error("give either --seeds or --quick")
    output = given.output
    if given.quick:
        drawn = {"tag": "none", "commit": "none", "seeds": draw_seeds("none")}
        units, todo = output / "final", [Unit("fidelity", 0, None), Unit("walk", 0, 0)]
    else:
        drawn = read_seeds(given.seeds)
        units, todo = given.seeds.parent / "final", all_units()
    chosen = [unit for unit in todo if unit.kind in given.kinds and unit.robot in given.robots]
    if given.list:
        for unit in chosen:
            print(f"{unit.name:12}  {'measured' if (units / f'{unit.name}.json').exists() else 'missing'}")
        return
    if given.tables:
        for path in write_tables(drawn, units, units.parent):
            print(f"\nWritten to {path}.")
        return
    if not given.quick:
        check_code(drawn)
    _setup.reserve(output, commit=drawn["commit"], seeds=drawn["seeds"], quick=given.quick)
    for unit in chosen:
        path = units / f"{unit.name}.json"
        if path.exists():
            continue
        print(f"\n==== {unit.name}: {ROBOTS[unit.robot]}", flush=True)
        began = time.perf_counter()
        result = measure(unit, drawn["seeds"], output / f"robot-{unit.robot}", given.quick)
        write_unit(path, unit, drawn, time.perf_counter() - began, result)
        print(f"Written to {path}.", flush=True)


if __name__ == "__main__":
    _setup.run(main)
