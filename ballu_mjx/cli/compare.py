"""Comparison of runs: `python -m ballu_mjx compare RUN RUN...`.

Runs that differ only in their seed share a row: mean and 95 % confidence interval (Student's t).
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from ballu_mjx.cli._help import parse_options
from ballu_mjx.common import files, runtime
from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.seed_intervals import LEVEL, t_interval

_LAST = 0.1
"""Final fraction of a training over which the reward is averaged."""
_POINTS = 200
"""Number of points of a drawn learning curve."""
_UNTOLD = ("seed", "num_timesteps")
"""Options that do not distinguish rows. A run counts with the steps that it has done, not with the number of steps that
it was given."""
_PLACES = (
    *("recordings", "validation", "test", "robot", "actuators", "residual", "output", "resume", "wandb", "debug"),
    *("coordinator", "num_processes", "process_id"),
)
"""Options of the data section that do not distinguish rows. The content of files does."""


_MEAN_RATIO = "mean ratio"
"""Score on the test recordings. The same score on the validation recordings chooses the checkpoint."""
_NOT_SHARED = """\
Figures of all rows: {shared}. "-" is not measured: the method has no reward, or the recordings differ in group or
length. A ratio compares a run with its own simulator without residual. It does not say which row's errors are
smaller. `python -m ballu_mjx evaluate RUN --recordings ... --output RUN` measures runs of one robot on the same
recordings."""


@dataclasses.dataclass(frozen=True)
class Options(runtime.CommandOptions):
    """Compare runs of one task in a table and a plot. Runs that differ only in their seed share a row, with their mean
    and 95 % confidence interval."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders."""
    output: Path | None = None
    """Folder for compare.md and compare.png. Without this option, the table is only printed."""


@dataclasses.dataclass(frozen=True)
class Row:
    """Runs that differ only in their seed."""

    label: str
    """Options and values in which the runs differ from other rows."""
    folders: tuple[Path, ...]
    steps: str
    """Unit of the steps in the runs' metrics (`registry.steps_of`)."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status (`runtime.exit_status`)."""

    def run() -> None:
        runtime.prepare()
        _compare(parse_options(Options, arguments, "python -m ballu_mjx compare"))

    return runtime.exit_status(run, arguments)


def rows(folders: Sequence[Path]) -> list[Row]:
    """Return the runs grouped into rows, one for each set of options and number of steps.

    A run with the seed of an earlier run of its row has a row of its own.

    **Raises** `InputError` if a folder is no run, is given twice, or has another task.
    """
    from ballu_mjx.policies.tasks import TASKS
    from ballu_mjx.residuals.registry import RESIDUAL_TASKS, steps_of
    from ballu_mjx.runs.folder import read_config

    if len({folder.resolve() for folder in folders}) < len(folders):
        raise InputError("A run is given twice; give each once.")
    configs = [read_config(folder, *RESIDUAL_TASKS, *TASKS) for folder in folders]
    for folder, config in zip(folders, configs, strict=True):
        if _kind(config) != _kind(configs[0]):
            raise InputError(
                f"{folder}: is a run of {config['task']!r}, {folders[0]} one of {configs[0]['task']!r}; compare runs "
                "of one task."
            )
    options = [
        _options(config) | _robot(config, configs) | _steps(folder)
        for folder, config in zip(folders, configs, strict=True)
    ]
    differing = _differing(options)
    found: dict[str, list[Path]] = {}
    taken: set[tuple[str, Any]] = set()
    for folder, config, each in zip(folders, configs, options, strict=True):
        label = ", ".join(f"{name} {each[name]}" for name in differing if name in each) or config["task"]
        seed = next((config[section]["seed"] for section in ("ppo", "fit") if "seed" in config.get(section, {})), None)
        if (label, seed) in taken:
            label = f"{label} ({folder})"  # a repeated run is no other sample
        taken.add((label, seed))
        found.setdefault(label, []).append(folder)
    return [
        Row(label, tuple(members), steps_of(configs[folders.index(members[0])]["task"]))
        for label, members in found.items()
    ]


def _differing(options: Sequence[Mapping[str, str]]) -> list[str]:
    """Return the properties that distinguish some of the runs.

    A property distinguishes runs if all have it, or if it differs among those of one task, where it may be missing.
    """
    of_a_task = [[each for each in options if each["task"] == task] for task in {each["task"] for each in options}]
    found = []
    for name in dict.fromkeys(name for each in options for name in each):
        among = [options] if all(name in each for each in options) else of_a_task
        if any(len({each.get(name) for each in runs}) > 1 for runs in among):
            found.append(name)
    return found


def figures(folder: Path) -> dict[str, float]:
    """Return a run's figures by name: its final reward, and the error ratios of its evaluation if it has one.

    A ratio divides the error with the residual by the error without it.

    **Raises** `InputError` if the run has not trained yet, or if its evaluation is missing or damaged.
    """
    from ballu_mjx.evaluation.errors_file import read_evaluation
    from ballu_mjx.policies.tasks import TASKS
    from ballu_mjx.residuals.registry import RESIDUAL_TASKS
    from ballu_mjx.runs.folder import read_config
    from ballu_mjx.runs.metrics import read_column

    steps, reward = read_column(folder, "reward")
    path = folder / "evaluation.json"
    rewarded = read_config(folder, *RESIDUAL_TASKS, *TASKS)["task"] in ("envmimic", *TASKS)
    if rewarded and not len(steps):
        raise InputError(f"{folder}: has not trained yet (metrics.jsonl holds no reward); leave it out.")
    if not rewarded and not path.exists():
        raise InputError(
            f"{folder}: has no evaluation; `python -m ballu_mjx evaluate {folder} --output {folder}` writes it."
        )
    found = {}
    if len(steps):
        at_end = (steps > (1 - _LAST) * steps[-1]) | (steps == steps[-1])  # the latter is for a last step of 0
        found["reward at the end"] = float(reward[at_end].mean())
    if path.exists():
        evaluation = read_evaluation(path)
        found[_MEAN_RATIO] = evaluation.score
        for group in evaluation.groups:
            for quantity in ("position", "orientation"):
                for horizon in evaluation.score_horizons(group):
                    if any(horizon in errors.position for errors in evaluation.vanilla if errors.group == group):
                        called = evaluation.angle if quantity == "orientation" else quantity
                        name = f"{group} {called}, {horizon:g} s (ratio)"
                        found[name] = evaluation.ratio(group, quantity, horizon)
    return found


def table(found: Mapping[str, Sequence[Mapping[str, float]]]) -> str:
    """Return a Markdown table of the figures of each row's runs, `found[label][run][figure]`.

    It has a row for each label and a column for each figure. Figures that all runs have come first.
    """
    everything = [figures for members in found.values() for figures in members]
    names = list(dict.fromkeys(name for figures in everything for name in figures))
    shared = [name for name in names if all(name in figures for figures in everything)]
    names = shared + [name for name in names if name not in shared]
    lines = ["| | runs | " + " | ".join(names) + " |", "| --- | ---: |" + " ---: |" * len(names)]
    for label, members in found.items():
        cells = []
        for name in names:
            values = [figures[name] for figures in members if name in figures]
            if len(values) < len(members):
                cells.append("-")
                continue
            broken = sum(map(np.isinf, values))
            if broken:
                cells.append(f"diverged in {broken} of {len(values)}")
                continue
            mean, half = t_interval(values)
            cells.append(f"{mean:.3f}" + ("" if half is None else f" ± {half:.3f}"))
        lines.append(f"| {label} | {len(members)} | " + " | ".join(cells) + " |")
    if max(map(len, found.values())) > 1:
        lines += ["", f"± is half the {LEVEL:.0%} confidence interval of the mean over runs (Student's t)."]
    if names != shared:
        lines += ["", _NOT_SHARED.format(shared=", ".join(shared) or "none")]
    return "\n".join(lines)


def curve(folders: Sequence[Path], name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return a learning curve of the metric `name`: steps, mean over runs, and half-width of the interval.

    It covers the steps that all runs have reached. None if a run has fewer than two values, or if the runs have no
    steps in common. The half-width is NaN for a single run.
    """
    from ballu_mjx.runs.metrics import read_column

    columns = [read_column(folder, name) for folder in folders]
    if min(len(steps) for steps, _ in columns) < 2:
        return None
    low, high = max(steps[0] for steps, _ in columns), min(steps[-1] for steps, _ in columns)
    if low >= high:
        return None
    at = np.linspace(low, high, _POINTS)
    values = np.array([np.interp(at, steps, measured) for steps, measured in columns])
    intervals = [t_interval(column) for column in values.T.tolist()]
    mean, half = np.array([(each.mean, np.nan if each.half is None else each.half) for each in intervals]).T
    return at, mean, half


def _compare(options: Options) -> None:
    from ballu_mjx.viz import plots
    from ballu_mjx.viz.report_content import CURVES

    if not options.runs:
        raise InputError("No run is given; name one or more run folders.")
    if options.output is not None:
        files.check_folder(options.output)
    found = rows(options.runs)
    text = table({row.label: [figures(folder) for folder in row.folders] for row in found})
    print(text)
    if options.output is None:
        return
    options.output.mkdir(parents=True, exist_ok=True)
    (options.output / "compare.md").write_text(text + "\n", encoding="utf-8")
    panels: dict[tuple[str, str], dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]] = {}
    for name, title in CURVES.items():
        for row in found:
            line = curve(row.folders, name)
            if line is not None:
                panels.setdefault((title, row.steps), {})[row.label] = line
    if panels:
        plots.compared(options.output / "compare.png", panels)
    print(f"\nWritten to {options.output}." + ("" if panels else " These runs have no learning curves to draw."))


def _options(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the properties that distinguish runs, without those of `_robot` and `_steps`."""
    found = {"task": config["task"]} | {
        name: json.dumps(value)
        for section, untold in (("env", _UNTOLD), ("ppo", _UNTOLD), ("fit", _UNTOLD), ("data", _PLACES))
        for name, value in config.get(section, {}).items()
        if name not in untold
    }
    found["actuators"] = "nominal" if config.get("actuators") is None else _digest(config["actuators"])
    for use, recordings in config.get("recordings", {}).items():
        found[f"{use} recordings"] = _digest([each["sha256"] for each in recordings])
    found["residual"] = config.get("residual") or "none"
    return found


def _robot(config: Mapping[str, Any], configs: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the name of a run's robot. It has a digest of its files if those of this name differ among `configs`."""
    from ballu_mjx.robots.registry import DEFAULT_ROBOT

    def identity(config: Mapping[str, Any]) -> tuple[str, str]:
        robot = config.get("robot_description")
        if robot is None:
            return DEFAULT_ROBOT, ""
        return Path(robot["path"]).name.removesuffix(".robot.json"), robot["sha256"][:6]

    name, version = identity(config)
    versions = {other for called, other in map(identity, configs) if called == name}
    return {"robot": name if len(versions) == 1 else f"{name} {version}".strip()}


def _steps(folder: Path) -> dict[str, str]:
    """Return the number of control steps that a run has trained for, if it has trained."""
    from ballu_mjx.runs.metrics import read_column

    steps, _ = read_column(folder, "reward")
    return {"steps": f"{int(steps[-1]):,}"} if len(steps) else {}


def _kind(config: Mapping[str, Any]) -> str:
    """Return a run's kind. Only runs of one kind can be compared: all residuals, or all policies of one task."""
    from ballu_mjx.residuals.registry import RESIDUAL_TASKS

    return "residual" if config["task"] in RESIDUAL_TASKS else config["task"]


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:6]
