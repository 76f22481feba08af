"""Content of a run's report, read from the run's folder.

JAX, MuJoCo and modules that need them are imported inside functions: `runtime.prepare` has to come first.
"""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.residuals.registry import CONTROL_STEPS
from ballu_mjx.runs.rollout_file import ROLLOUT_FILE, StoredRollout, read_rollouts

if TYPE_CHECKING:
    from ballu_mjx.evaluation.errors import Errors


IDENTIFICATION_FILE = "identification.json"
"""File that `train sysid` writes for declared parameters. Its content is `identification.fit_report.fit_details`."""
_INTERACTIVE = ("tracking.png", "learning_curve.png")
"""Figures of a run's folder that the page leaves out, because it has interactive versions of them."""
CURVES = {
    "reward": "reward per control step",
    "validation_error": "validation error (ratio to no residual)",
    "validation_reward": "reward per control step, without exploration (m/s)",
}
"""Titles of the curves of a training, by the name of the metric."""
_QUANTITIES = (
    ("position", "position RMSE (m)", 3),
    ("orientation", "{angle} RMSE (deg)", 1),
    ("points", "points RMSE (m)", 3),
    ("joints", "joints RMSE (deg)", 1),
)
_WHOLE = (("mean_com_error", "mean CoM error (m)", 3), ("final_orientation_error", "final {angle} error (deg)", 1))


@dataclasses.dataclass(frozen=True)
class Cell:
    """Cell of a table."""

    text: str
    """Text that is shown."""
    exact: str | None = None
    """Number in full precision, as it was stored. None if the cell has no number."""


@dataclasses.dataclass(frozen=True)
class Table:
    """Table with a title."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]


@dataclasses.dataclass(frozen=True)
class Curve:
    """Learning curves of one metric."""

    title: str
    values: Mapping[str, tuple[np.ndarray, np.ndarray]]
    """Steps and values of the metric, by the name of a run."""
    steps: str = CONTROL_STEPS
    """Unit of the steps (`registry.steps_of`)."""


@dataclasses.dataclass
class Content:
    """Content of a report."""

    title: str
    facts: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    """Names and values of the run's properties, such as its folder and its command."""
    tables: list[Table] = dataclasses.field(default_factory=list)
    markdown: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    """Titles and tables in Markdown."""
    texts: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    """Titles and plain texts."""
    curves: list[Curve] = dataclasses.field(default_factory=list)
    images: list[tuple[str, bytes]] = dataclasses.field(default_factory=list)
    """Titles and PNG images."""
    takes: list[StoredRollout] = dataclasses.field(default_factory=list)
    """Replays for the view in 3D."""
    options: list[tuple[str, list[tuple[str, str]]]] = dataclasses.field(default_factory=list)
    """Names and values of the options, by section."""


def collect(folder: Path) -> Content:
    """Return the report's content for a run, or for a folder of `train all`.

    **Raises** `InputError` if `folder` is neither, or if a file in it is damaged.
    """
    from ballu_mjx.policies import pipeline_layout

    tables = [(task, pipeline_layout.table_file(folder, task)) for task in pipeline_layout.TABLES]
    if not (folder / "config.json").is_file() and any(path.is_file() for _, path in tables):
        return _story(folder, {task: files.read_text(path) for task, path in tables if path.is_file()})
    return _run(folder)


def _run(folder: Path) -> Content:
    from ballu_mjx.policies.tasks import TASKS
    from ballu_mjx.residuals.registry import RESIDUAL_TASKS, steps_of
    from ballu_mjx.runs.folder import read_config

    config = read_config(folder, *RESIDUAL_TASKS, "sysid", *TASKS)
    content = Content(f"{config['task']}: {folder.resolve().name}")
    start = (config.get("starts") or [{}])[-1]
    content.facts = [("folder", str(folder.resolve())), ("begun", str(start.get("time", "")))]
    content.facts += [("command", shlex.join(map(str, start.get("command", []))))]
    for use, used in config.get("recordings", {}).items():
        content.facts.append((f"{use} recordings", ", ".join(str(file["path"]) for file in used)))
    _add_evaluation(content, folder)
    _add_identification(content, folder)
    if (folder / "identification.txt").is_file():
        content.texts.append(("Identification", files.read_text(folder / "identification.txt")))
    unit = steps_of(config["task"])
    content.curves = [dataclasses.replace(each, steps=unit) for each in _curves({config["task"]: folder})]
    figures = sorted(path for path in folder.glob("*.png") if path.name not in _INTERACTIVE)
    content.images = [(path.name, path.read_bytes()) for path in figures]
    if (folder / ROLLOUT_FILE).is_file():
        content.takes = read_rollouts(folder / ROLLOUT_FILE)
    robots = dict.fromkeys(take.robot for take in content.takes if take.robot)
    if robots:
        content.facts.append(("robot", ", ".join(robots)))
    content.options = _options(config)
    return content


def _story(folder: Path, tables: Mapping[str, str]) -> Content:
    """Return the content for a folder of `train all`: its tables, and for each seed and task the policies overlaid."""
    from ballu_mjx.policies import pipeline_layout
    from ballu_mjx.viz.style import label_of

    content = Content(f"train all: {folder.resolve().name}", facts=[("folder", str(folder.resolve()))])
    content.markdown = [(f"Transfer, {task}", text) for task, text in tables.items()]
    for seed in sorted(path for path in folder.glob("seed-*") if path.is_dir()):
        for task in tables:
            where = f"{task}, {seed.name}"
            settings = ("vanilla", *pipeline_layout.PAPER_SIMULATORS, *pipeline_layout.settings_beyond(seed, task))
            policies = {setting: seed / f"{task}-{setting}" for setting in settings}
            policies = {setting: path for setting, path in policies.items() if (path / "config.json").is_file()}
            content.curves += [dataclasses.replace(c, title=f"{c.title} ({where})") for c in _curves(policies)]
            own = {s: read_rollouts(p / ROLLOUT_FILE)[0] for s, p in policies.items() if (p / ROLLOUT_FILE).is_file()}
            if own:
                content.takes.append(_over_each_other(f"policies: {where}", own))
            for setting in policies:
                image = seed / f"trials-{task}-{setting}" / "trials.png"
                if image.is_file():
                    content.images.append((f"Trials on the robot: {where}, {setting}", image.read_bytes()))
            residuals: dict[Path, str] = {}  # two settings may share a residual
            for setting in filter(pipeline_layout.has_residual, settings[1:]):
                residuals.setdefault(pipeline_layout.residual_folder(seed, task, setting), setting)
            for learned, setting in residuals.items():
                name = f"{label_of(setting)}: {where}"
                if (learned / "config.json").is_file():
                    _add_evaluation(content, learned, f"{name}: ")
                    if (learned / ROLLOUT_FILE).is_file():
                        content.takes += [
                            dataclasses.replace(take, name=f"{name}: {take.name}")
                            for take in read_rollouts(learned / ROLLOUT_FILE)
                        ]
    return content


def _over_each_other(name: str, own: Mapping[str, StoredRollout]) -> StoredRollout:
    """Return the episodes of several policies, each in its own simulator, as one replay of the shortest length."""
    states = min(len(take.time) for take in own.values())
    first = next(iter(own.values()))
    qpos = {setting: next(iter(take.qpos.values()))[:states] for setting, take in own.items()}
    return StoredRollout(name=name, description=first.description, time=first.time[:states], qpos=qpos)


def _add_evaluation(content: Content, folder: Path, prefix: str = "") -> None:
    """Add the tables of `evaluation.json`, and the text of `evaluation.txt`, if the folder has them."""
    path = folder / "evaluation.json"
    if not path.is_file():
        return
    from ballu_mjx.evaluation.errors_file import read_evaluation
    from ballu_mjx.viz.style import label_of

    found = read_evaluation(path)
    base, name = found.base, label_of(found.name)
    pairs = list(zip(found.vanilla, found.residual, strict=True))
    content.facts.append((f"{prefix}score", f"{found.score:.3f} (mean ratio to {base})"))
    content.tables += [
        _horizons(f"{prefix}{without.recording}", (base, name), without, mimic, found.angle) for without, mimic in pairs
    ]
    header = ["", *(f"{title.format(angle=found.angle)}, {each}" for _, title, _ in _WHOLE for each in (base, name))]
    header.append("mean force (N)")
    rows = []
    for without, mimic in pairs:
        cells = [_cell(getattr(errors, key), digits) for key, _, digits in _WHOLE for errors in (without, mimic)]
        rows.append([Cell(without.recording), *cells, _cell(mimic.mean_force, 4)])
    content.tables.append(Table(f"{prefix}whole recordings", header, rows))
    if (folder / "evaluation.txt").is_file():
        content.texts.append((f"{prefix}by group", files.read_text(folder / "evaluation.txt")))


def _add_identification(content: Content, folder: Path) -> None:
    """Add the tables of `identification.json`, if any: parameters with intervals, and errors on held-out windows."""
    path = folder / IDENTIFICATION_FILE
    if not path.is_file():
        return
    found = files.read_json(path, "run the identification again")
    try:
        rows = []
        for each in found["parameters"]:
            low, high = each["interval"]
            notes = ["not shown"] * (not each["seen"]) + ["at a bound"] * bool(each["at_bound"])
            numbers = [each[key] for key in ("value", "standard_error", "white_noise_error")]
            cells = [_number(each["nominal"], 4, "none")]
            cells += [Cell(f"{x:.4g}", repr(x)) for x in (*numbers, low, high)]
            rows.append([Cell(str(each["name"])), *cells, Cell(str(each["unit"])), Cell(", ".join(notes))])
        header = ["", "nominal", "identified", "standard error", "of white noise", "95 % from", "to", "unit", ""]
        content.tables.append(Table("parameters", header, rows))
        pair = [found["held_out"][name] for name in ("nominal", "identified")]
        rows = [[Cell("all, in units of noise"), *(_number(each["score"], 3, "diverged") for each in pair)]]
        for name in pair[0]["final_median"]:
            values = [each["final_median"][name] for each in pair]
            cells = [_number(x, 4, "diverged") for x in values]
            rows.append([Cell(f"{name}, median at the end (rad or m)"), *cells])
        title = f"errors on {pair[0]['windows']} held-out windows"
        content.tables.append(Table(title, ["", "nominal", "identified"], rows))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: is damaged ({error!r}); run the identification again.") from None


def _number(value: float | None, digits: int, otherwise: str) -> Cell:
    """Return a cell with a number to some significant digits, or with the text `otherwise` if it is None."""
    return Cell(otherwise) if value is None else Cell(f"{value:.{digits}g}", repr(value))


def _horizons(title: str, names: tuple[str, str], without: Errors, mimic: Errors, angle: str) -> Table:
    """Return the table of a recording's errors by horizon: means over starts without and with residual, and ratios."""
    from ballu_mjx.evaluation.errors import error_ratio

    header = ["horizon (s)"]
    shown = [each for each in _QUANTITIES if getattr(without, each[0])]
    for key, quantity, _ in shown:
        header += [*(f"{quantity.format(angle=angle)}, {name}" for name in names)]
        header.append(f"{angle if key == 'orientation' else key}, ratio")
    rows = []
    for horizon in without.position:
        row = [Cell(f"{horizon:g}")]
        for key, _, digits in shown:
            if horizon not in getattr(without, key):
                row += [Cell("")] * 3
                continue
            one, other = getattr(without, key)[horizon][0], getattr(mimic, key)[horizon][0]
            ratio = error_ratio((mimic,), (without,), without.group, key, horizon)
            row += [_cell(one, digits), _cell(other, digits), _cell(ratio, 2)]
        rows.append(row)
    return Table(title, header, rows)


def _cell(value: float, digits: int) -> Cell:
    return Cell(f"{value:.{digits}f}", repr(float(value))) if np.isfinite(value) else Cell("diverged")


def _curves(folders: Mapping[str, Path]) -> list[Curve]:
    from ballu_mjx.runs.metrics import read_column

    found = []
    for name, title in CURVES.items():
        values = {run: read_column(folder, name) for run, folder in folders.items()}
        values = {run: pair for run, pair in values.items() if len(pair[0])}
        if values:
            found.append(Curve(title, values))
    return found


def _options(config: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the sections of a `config.json`, each with names and values."""
    sections, loose = [], []
    for name, value in config.items():
        if isinstance(value, dict):
            sections.append((name, [(key, json.dumps(entry)) for key, entry in value.items()]))
        elif isinstance(value, list):
            sections.append((name, [(str(index), json.dumps(entry)) for index, entry in enumerate(value)]))
        else:
            loose.append((name, json.dumps(value)))
    return [("run", loose), *sections]
