# %% [markdown]
# # Tables of runs that differ only in their seed
#
# `python experiments/collect_runs.py runs/seed-0 runs/seed-1 runs/seed-2 --results results/main_job.json` reads the
# evaluations of residual runs, and writes tables of errors by group and horizon. `python docs/render.py` then renders
# them into README and docs. Make the runs first, each with another seed:
#
# `python -m ballu_mjx.train envmimic --seed 1 --output runs/seed-1`

# %%
from __future__ import annotations

import sys

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ballu_mjx.cli.compare import rows as rows_of_runs
from ballu_mjx.common import provenance
from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import Cell, Table, write_results
from ballu_mjx.evaluation.errors import SCORE_HORIZONS, Errors, Evaluation, error_ratio
from ballu_mjx.evaluation.errors_file import read_evaluation
from ballu_mjx.residuals.registry import RESIDUAL_TASKS
from ballu_mjx.runs.folder import read_config
from ballu_mjx.viz.style import label_of

_FORMS = {"position": (".3f", "m"), "orientation": (".1f", "deg")}


# %%
def seed_of(config: dict[str, Any]) -> int:
    """Return the training seed of a run, given its configuration.

    **Raises** `InputError` if the run has none.
    """
    for name in ("ppo", "fit"):
        if "seed" in config.get(name, {}):
            return int(config[name]["seed"])
    raise InputError(f"A run of {config['task']} has no seed; give runs of a method that trains a network.")


def read_runs(folders: Sequence[Path]) -> tuple[list[Evaluation], list[dict[str, Any]]]:
    """Return the evaluations and configurations of runs.

    **Raises** `InputError` if the runs differ in more than the seed, if two have the same seed, or if one was made with
    --quick.
    """
    if len(rows_of_runs(folders)) != 1:
        raise InputError("The runs differ in more than their seed; `ballu_mjx compare` shows the differences.")
    configs = [read_config(folder, *RESIDUAL_TASKS) for folder in folders]
    if len({seed_of(config) for config in configs}) < len(configs):
        raise InputError("Two of the runs have the same seed; give each seed once.")
    if any(config["data"]["quick"] for config in configs):
        raise InputError("A run was made with --quick, and its numbers mean little; repeat it without this option.")
    return [read_evaluation(folder / "evaluation.json") for folder in folders], configs


def provenance_of(config: dict[str, Any], commit: str | None) -> dict[str, Any]:
    """Return commit, machine and package versions of a run.

    Old runs do not record all of these. For them, `commit` and this machine are used.

    **Raises** `InputError` if the run does not record its commit, and `commit` is None.
    """
    start = config["starts"][0]
    commit = start.get("commit") or commit
    if commit is None:
        raise InputError("The runs do not record their commit; give it by --commit.")
    machine = start.get("machine") or provenance.describe_machine()
    return {"commit": commit, "machine": machine, "versions": start["versions"]}


def errors_table(runs: Sequence[Evaluation], horizons: Sequence[float] | None = None) -> Table:
    """Return the table of errors without and with the residual, and of their ratio, by group and horizon (s).

    `horizons` selects horizons; None selects all.
    """
    first = runs[0]
    name = label_of(first.name)
    columns = ["group", "horizon (s)"]
    for quantity, (_, unit) in _FORMS.items():
        called = first.angle if quantity == "orientation" else quantity
        columns += [f"{called}, {first.base} ({unit})", f"{name} ({unit})", "ratio"]
    rows = []
    for group in sorted(first.groups, reverse=True):
        reached = sorted({h for errors in first.vanilla if errors.group == group for h in errors.position})
        for horizon in [h for h in reached if horizons is None or h in horizons]:
            row: list[Cell | str] = [group, Cell((horizon,), "g")]
            for quantity, (form, _) in _FORMS.items():
                row += [
                    Cell((mean_over_recordings(first.vanilla, group, quantity, horizon),), form),
                    Cell(tuple(mean_over_recordings(run.residual, group, quantity, horizon) for run in runs), form),
                    Cell(tuple(run.ratio(group, quantity, horizon) for run in runs), spread=False),
                ]
            rows.append(tuple(row))
    return Table(tuple(columns), tuple(rows))


def mean_over_recordings(side: Sequence[Errors], group: str, quantity: str, horizon: float) -> float:
    """Return a simulator's mean error (m or deg) over a group's recordings. Infinite if all starts of one diverged.

    `errors.group_mean` leaves out such recordings. Its tables count the starts that diverged, and these tables do not.
    """
    return float(np.mean([getattr(errors, quantity)[horizon][0] for errors in side if errors.group == group]))


def remaining_errors(
    vanilla: Sequence[Errors],
    simulators: Mapping[str, Sequence[Sequence[Errors]]],
    columns: Sequence[tuple[str, str]],
    horizon: float,
) -> dict[str, list[Cell]]:
    """Return vanilla's errors over a horizon (s), and the ratio of each simulator's errors to these.

    `columns` are pairs of group and quantity. `simulators` holds the errors of all seeds, by label. Cells have one
    value for each seed.
    """
    rows = {
        "vanilla": [Cell((mean_over_recordings(vanilla, *column, horizon),), *_FORMS[column[1]]) for column in columns]
    }
    for label, runs in simulators.items():
        rows[label] = [Cell(tuple(error_ratio(run, vanilla, *column, horizon) for run in runs)) for column in columns]
    return rows


def recordings_table(runs: Sequence[Evaluation]) -> Table:
    """Return the table of errors over whole recordings, without and with the residual."""
    first, name = runs[0], label_of(runs[0].name)
    heads = (f"CoM error, {first.base} (m)", f"final {first.angle} error, {first.base} (deg)")
    columns = ("recording", heads[0], f"{name} (m)", heads[1], f"{name} (deg)")
    rows = []
    for index, without in enumerate(first.vanilla):
        ours = [run.residual[index] for run in runs]
        rows.append(
            (
                without.recording,
                Cell((without.mean_com_error,)),
                Cell(tuple(errors.mean_com_error for errors in ours)),
                Cell((without.final_orientation_error,), ".0f"),
                Cell(tuple(errors.final_orientation_error for errors in ours), ".0f"),
            )
        )
    return Table(columns, tuple(rows))


# %%
def main() -> None:
    parser = argparse.ArgumentParser(description="Make tables of residual runs that differ only in their seed.")
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    parser.add_argument("--results", type=Path, help="JSON file to write; without it, the tables are only printed")
    parser.add_argument("--commit", help="commit of the code that made the runs, if they do not record it")
    parser.add_argument("--data", default="Development data", help="name of the data, for the caption")
    options = parser.parse_args()
    runs, configs = read_runs(options.runs)
    tables = {
        "short": errors_table(runs, SCORE_HORIZONS),
        "all": errors_table(runs),
        "recordings": recordings_table(runs),
    }
    for table in tables.values():
        print(table.to_markdown(), end="\n\n")
    if options.results is not None:
        measured = provenance_of(configs[0], options.commit)
        seeds = {"training": sorted(map(seed_of, configs))}
        write_results(options.results, tables, options.data, seeds=seeds, measured=measured)
        print(f"Written to {options.results}.")


# %%
if __name__ == "__main__":
    _setup.run(main)
