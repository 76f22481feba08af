"""Measure if the transfer of policies can be predicted before they meet the robot.

The policies and their trials are those of `bullet_transfer.py`. Each policy is tried in three simulators of its robot:
with identified actuators, with EnvMimic, and with the identified air. The prediction of a policy's CoM error is

    sqrt(d^2 + e^2),

with the distance d between the policy's motions in its own simulator and in the reference simulator, and the error e of
the reference in open-loop replays of the validation recordings. The reference has the smallest e of the three. Rank
correlations of this number, and of simpler ones, with the measured CoM errors are printed. The form of the prediction
was set before any policy was tried.

    python benchmarks/transfer_prediction.py runs/bullet-transfer

`--own` takes the policies of the package's own virtual robots instead. `--beside` adds the policies of an earlier
results file to the rank correlation:

    python benchmarks/transfer_prediction.py runs/bullet-transfer --own 0 1 --beside results/transfer_prediction.json
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ballu_mjx.common import runtime

runtime.prepare()

import numpy as np
from bullet_family import ROBOTS
from scipy.stats import spearmanr

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import Cell, Table, read_results, write_results
from ballu_mjx.evaluation.transfer import read_transfer
from ballu_mjx.policies.load_simulator import load_simulator
from ballu_mjx.policies.pipeline_layout import PAPER_SIMULATORS
from ballu_mjx.policies.policy import Policy
from ballu_mjx.policies.transfer_prediction import TransferPredictor, expected_error, own_simulator, replay_errors

PREDICTIONS = (
    "distance to the reference, with its error",
    "distance to the reference",
    "mean distance to the others",
    "share outside of the training range",
)
"""Numbers that are compared, by which policies are ordered."""


class Row(NamedTuple):
    """One policy."""

    robot: str
    setting: str
    measured: float
    """Mean CoM error on the robot (m)."""
    predicted: tuple[float, ...]
    """The numbers of `PREDICTIONS`."""


def predict(robot: str, folder: Path) -> list[Row]:
    """Return the rows of one robot's policies for walking. `folder` has the stages of this robot.

    **Raises** `InputError` if there are none.
    """
    seed = folder / "seed-0"
    residuals = {name: seed / f"{name}-walk" for name in ("envmimic", "aerodynamic")}
    runs = {"vanilla+sysid": seed.parent / "sysid", **residuals}
    if missing := [str(run) for run in runs.values() if not run.is_dir()]:
        raise InputError(f"{missing[0]}: is missing; run benchmarks/bullet_transfer.py for this robot first.")
    error = replay_errors(residuals)
    reference = min(error, key=lambda name: error[name])
    predictor = TransferPredictor({name: load_simulator(run) for name, run in runs.items()})
    rows = []
    for setting in PAPER_SIMULATORS:
        policy = Policy.load(seed / f"walk-{setting}")
        found = predictor.predict(policy, own_simulator(setting, runs))
        trials = read_transfer(seed / f"trials-walk-{setting}" / "transfer.json")
        distance = found[reference].com_error
        others = [each.com_error for name, each in found.items() if name != setting]
        numbers = (
            expected_error(distance, error[reference]),
            distance,
            float(np.mean(others)),
            found[reference].outside,
        )
        rows.append(Row(robot, setting, float(np.mean([trial.com_error for trial in trials])), numbers))
        print(robot, setting, *(f"{number:.2f}" for number in (rows[-1].measured, *numbers)), flush=True)
    return rows


def policies_table(rows: Sequence[Row]) -> Table:
    """Return one row for each policy, with its measured and its predicted error."""
    heads = ("robot", "simulator", "measured CoM error (m)", "predicted (m)")
    cells = [(row.robot, row.setting, Cell((row.measured,)), Cell((row.predicted[0],))) for row in rows]
    return Table(heads, tuple(cells))


def choices_table(policies: Table) -> Table:
    """Return which policy of each robot has the smallest prediction, from a table of policies (`policies_table`).

    The place is 1 if its measured error is the smallest of the robot's policies.
    """
    by_robot: dict[str, list[tuple[str, float, float]]] = {}
    for robot, setting, measured, predicted in policies.rows:
        assert isinstance(measured, Cell) and isinstance(predicted, Cell)
        by_robot.setdefault(str(robot), []).append((str(setting), measured.values[0], predicted.values[0]))
    rows = []
    for robot, found in by_robot.items():
        setting, error, _ = min(found, key=lambda policy: policy[2])
        place = 1 + sum(other < error for _, other, _ in found)
        rows.append((robot, setting, Cell((error,)), f"{place} of {len(found)}"))
    return Table(
        ("robot", "smallest prediction", "its measured CoM error (m)", "its place by measured error"), tuple(rows)
    )


def rank_correlation(measured: Sequence[float], predicted: Sequence[float]) -> float:
    """Return Spearman's rank correlation."""
    return float(np.asarray(spearmanr(measured, predicted))[0])


def correlations_table(rows: Sequence[Row], earlier: Table | None) -> Table:
    """Return the rank correlation of each prediction with the measured errors.

    `earlier`: a table of other policies (`policies_table`). A further row has the first prediction for all of them.
    """
    found = [
        (name, len(rows), rank_correlation([row.measured for row in rows], [row.predicted[place] for row in rows]))
        for place, name in enumerate(PREDICTIONS)
    ]
    if earlier is not None:
        pairs = [(row.measured, row.predicted[0]) for row in rows]
        pairs += [(cells[2].values[0], cells[3].values[0]) for cells in earlier.rows]  # pyright: ignore[reportAttributeAccessIssue]
        found.append((PREDICTIONS[0], len(pairs), rank_correlation(*zip(*pairs, strict=True))))
    heads = ("prediction", "policies", "rank correlation with the measured CoM error")
    return Table(heads, tuple((name, str(count), Cell((value,))) for name, count, value in found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="output folder of bullet_transfer.py")
    parser.add_argument("--robots", type=int, nargs="+", choices=list(ROBOTS), default=list(ROBOTS), help="seeds (all)")
    parser.add_argument("--own", type=int, nargs="+", help="seeds of the package's virtual robots, instead (none)")
    parser.add_argument("--beside", type=Path, help="earlier results whose policies the correlation has too")
    parser.add_argument("--results", type=Path, help="JSON file to write the tables to")
    given = parser.parse_args()
    earlier = None if given.beside is None else read_results(given.beside).tables["policies"]
    robots = given.own or given.robots
    names = [f"own-{robot}" if given.own else str(robot) for robot in robots]
    rows = [row for name in names for row in predict(name, given.folder / f"robot-{name}")]
    policies = policies_table(rows)
    everything = policies if earlier is None else Table(policies.columns, (*earlier.rows, *policies.rows))
    tables = {
        "policies": policies,
        "correlations": correlations_table(rows, earlier),
        "choices": choices_table(everything),
    }
    for each in tables.values():
        print(f"\n{each.to_markdown()}")
    if given.results is not None:
        write_results(given.results, tables, "Development data", seeds={"robot": robots, "training": [0]})


if __name__ == "__main__":
    main()
