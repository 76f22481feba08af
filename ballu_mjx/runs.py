"""A run: its folder, and what it shows of itself on the terminal.

config.json         all it takes to repeat the run
metrics.jsonl       one JSON object a line: `step` (control steps) and what was measured there
tensorboard/        the same for TensorBoard
wandb/              the same for Weights & Biases, on demand
checkpoints/STEP/   the last three, and the best by validation (orbax): `params`, all it takes to use what was
                    learned; `training`, what else it takes to go on; `record.json`, checksums of all files
evaluation.txt, evaluation.json, learning_curve.png, tracking.png
replay.npz          what the robots did, for `ballu_mjx.report` and `ballu_mjx.view`
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import hashlib
import importlib.metadata
import io
import json
import logging
import math
import reprlib
import shutil
import sys
import threading
import time
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Literal, TextIO, TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers as policies
from tqdm import tqdm

try:
    import fcntl
except ImportError:  # Windows, where runs are not locked
    fcntl = None

from ballu_mjx import actuators as actuator_files
from ballu_mjx import files, loggers, robot, runtime
from ballu_mjx import robot_description as descriptions
from ballu_mjx.errors import InputError, is_number
from ballu_mjx.robot import ActuatorParameters
from ballu_mjx.robot_description import RobotDescription

FORMAT = "ballu-run/2"
"""Version 1 had checkpoints of parameters alone."""
KEPT = 3
"""Latest checkpoints that are kept."""

_READABLE = ("ballu-run/1", FORMAT)
_CONFIG, _METRICS, _LOCK, _CHECKPOINTS = "config.json", "metrics.jsonl", ".lock", "checkpoints"
_PARAMS, _TRAINING, _RECORD = "params", "training", "record.json"
_BUNDLED = "bundled:"
_NO_SCORE = 1e30
_MOST_STEPS = 2**63
_LONGEST_PATH = 300
_OVERHEAD = 2**20
"""Bytes of a checkpoint beside its arrays, at most."""
_PACKAGES = ("ballu-mjx", "jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "optimistix", "numpy")

Which = Literal["best", "last"] | int
Config = TypeVar("Config")


def new_folder(output: Path | None, task: str) -> Path:
    """The folder of a new run, empty or not there yet: `output`, or one under `runs/` named after task and time.

    **Raises** `InputError` where `output` holds something, or cannot be written to.
    """
    if output is None:
        stem = f"{task}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
        names = (stem if not number else f"{stem}-{number + 1}" for number in range(1000))
        output = next(folder for name in names if not (folder := Path("runs") / name).exists())
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file; give --output a folder that is new or empty.")
    if output.exists() and any(output.iterdir()):
        mend = "give --output a folder that is new or empty"
        if (output / _CHECKPOINTS).is_dir():
            mend = f"--resume {output} goes on with it, or give --output another folder"
        raise InputError(f"{output}: the folder is not empty; {mend}.")
    files.check_folder(output)
    return output


def read_config(folder: Path, *tasks: str) -> dict[str, Any]:
    """The content of a run's `config.json`.

    **Raises** `InputError` where `folder` is no run of one of `tasks`.
    """
    path = folder / _CONFIG
    if not path.is_file():
        raise InputError(f"{folder}: there is no run ({_CONFIG} is missing); check the path.")
    mend = "restore it or start a new run"
    content = files.read_json(path, mend)
    if content.get("format") not in _READABLE:
        raise InputError(f"{path}: is not of the format {FORMAT}; use the version of ballu_mjx that wrote it.")
    if content.get("task") not in tasks:
        needed = " or ".join(repr(task) for task in tasks)
        raise InputError(f"{path}: is of a run of {_shown(content.get('task'))}; one of {needed} is needed here.")
    for name, fits in _SHAPES.items():
        if name in content and not fits(content[name]):
            raise InputError(f'{path}: "{name}" is not what a run keeps there, {_shown(content[name])}; {mend}.')
    return content


def _is_description(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(value.get(name), str) for name in ("path", "sha256"))


def _is_start(value: Any) -> bool:
    return isinstance(value, dict) and isinstance(value.get("command", []), list)


def _is_list_of(value: Any, fits: Callable[[Any], bool]) -> bool:
    return isinstance(value, list) and all(map(fits, value))


_SHAPES: Mapping[str, Callable[[Any], bool]] = {
    **dict.fromkeys(("env", "ppo", "data", "fit"), lambda value: isinstance(value, dict)),
    "actuators": lambda value: value is None or isinstance(value, dict),
    "residual": lambda value: value is None or isinstance(value, str),
    "robot_description": lambda value: value is None or _is_description(value),
    "recordings": lambda value: (
        isinstance(value, dict) and all(_is_list_of(entries, _is_description) for entries in value.values())
    ),
    "starts": lambda value: _is_list_of(value, _is_start),
}
"""What stands under the keys of a `config.json`, as far as anybody looks into it."""


def typed(
    cls: type[Config],
    config: Mapping[str, Any],
    section: str,
    folder: Path,
    check: Callable[[Config], None] = lambda config: None,
) -> Config:
    """The configuration of class `cls`, a dataclass, in a section of the `config.json` of the run in `folder`; fields
    that are missing take their default.

    **Raises** `InputError` naming the file and the field for fields that `cls` does not have, for values of other
    types, and where `check` raises it.
    """
    path = folder / _CONFIG
    fields = {field.name: field for field in dataclasses.fields(cls)}  # pyright: ignore[reportArgumentType]
    hints = typing.get_type_hints(cls)
    values = _needed(config, section, folder)
    for name, value in values.items():
        if name not in fields:
            raise InputError(
                f"{path}: {cls.__name__} has no field {_shown(name)}; use the version of ballu_mjx that wrote it."
            )
        if not _is_of_type(hints[name], value):
            raise InputError(
                f"{path}: {name} of {section} is {_shown(value)}, which it cannot be; restore it or start a new run."
            )
    found = cls(**{name: _as_type(hints[name], value) for name, value in values.items()})
    try:
        check(found)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return found


def actuators(config: Mapping[str, Any], folder: Path) -> ActuatorParameters | None:
    """The actuators of a run's simulator; None for the nominal ones.

    **Raises** `InputError` where they are damaged.
    """
    stored = _needed(config, "actuators", folder)
    return None if stored is None else actuator_files.from_json(stored, folder / _CONFIG)


def robot_description(config: Mapping[str, Any], folder: Path) -> RobotDescription:
    """The robot of a run; BALLU where it names none.

    **Raises** `InputError` where its description is gone, has changed, or its model has.
    """
    stored = config.get("robot_description")
    if stored is None:
        return descriptions.ballu()
    mend = f"restore it: {folder / _CONFIG} names it"
    there, path = False, Path(stored["path"])
    with contextlib.suppress(OSError, ValueError):  # a name that no file can have
        there = path.is_file()
    if not there:
        raise InputError(f"{_cut(stored['path'])}: the robot description is gone; {mend}.")
    found = descriptions.read(path)
    if found.sha256 != stored["sha256"]:
        raise InputError(f"{path}: the robot description, or its model, has changed since the run began; {mend}.")
    return found


def residual(config: Mapping[str, Any], folder: Path) -> Path | None:
    """The run of the residual in a run's simulator; None where there is none.

    **Raises** `InputError` where the key is missing.
    """
    stored = _needed(config, "residual", folder)
    return None if stored is None else Path(stored)


def _needed(config: Mapping[str, Any], key: str, folder: Path) -> Any:
    """What stands under a key; None in runs of version 1, which had not all of them."""
    if key not in config and config.get("format") == FORMAT:
        raise InputError(f'{folder / _CONFIG}: "{key}" is missing; restore it or start a new run.')
    return config.get(key)


def describe(
    task: str,
    sections: Mapping[str, Any],
    recordings: Mapping[str, Sequence[Path]],
    devices: Sequence[str],
    identified: ActuatorParameters | None = None,
    description: RobotDescription | None = None,
) -> dict[str, Any]:
    """What `config.json` holds: `sections` are configurations (dataclasses) by name, `recordings` files by use,
    `identified` the simulator's actuators where they are not the nominal ones, `description` the robot where it is not
    BALLU."""
    other = description is not None and description.sha256 != descriptions.ballu().sha256
    return {
        "format": FORMAT,
        "task": task,
        **{name: dataclasses.asdict(section) for name, section in sections.items()},
        "actuators": None if identified is None else actuator_files.as_json(identified),
        "recordings": {use: [describe_recording(path) for path in paths] for use, paths in recordings.items()},
        **({"robot_description": _described(description)} if description is not None and other else {}),
        "starts": [
            {
                "time": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
                "command": list(sys.argv),
                "python": sys.version.split()[0],
                "versions": {name: _version(name) for name in _PACKAGES},
                "devices": list(devices),
            }
        ],
    }


def describe_recording(path: Path) -> dict[str, str]:
    """Where a recording lies (bundled ones independently of the installation), and the SHA-256 of its content."""
    bundled = (robot.assets() / "recordings").resolve()
    absolute = path.resolve()
    inside = absolute.is_relative_to(bundled)
    place = _BUNDLED + absolute.relative_to(bundled).as_posix() if inside else str(absolute)
    return {"path": place, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


def find_recordings(config: Mapping[str, Any], use: str, folder: Path) -> list[Path]:
    """The files that `describe_recording` described under `use`.

    **Raises** `InputError` where one is missing or has changed.
    """
    paths = []
    described = _needed(config, "recordings", folder).get(use)
    if not described:
        raise InputError(f"{folder / _CONFIG}: names no recordings for {use}; give some by options.")
    for entry in described:
        place = entry["path"]
        path, there = Path(place), False
        if place.startswith(_BUNDLED):
            path = robot.assets() / "recordings" / place.removeprefix(_BUNDLED)
        with contextlib.suppress(OSError):  # a name that no file can have
            there = path.is_file()
        if not there:
            raise InputError(
                f"{_cut(place)}: the recording, which {folder / _CONFIG} names, is gone; restore it or give "
                "--recordings."
            )
        if describe_recording(path)["sha256"] != entry["sha256"]:
            raise InputError(
                f"{path}: the recording has changed since {folder / _CONFIG} was written; restore it, or give it by "
                "--recordings to use it as it is."
            )
        paths.append(path)
    return paths


def _described(description: RobotDescription) -> dict[str, str]:
    return {"path": str(description.file.resolve()), "sha256": description.sha256}


def _cut(place: str) -> str:
    return place if len(place) < _LONGEST_PATH else place[:_LONGEST_PATH] + "..."


class Run:
    """An open run folder, for writing. A context manager: leaving it closes the files."""

    def __init__(
        self, folder: Path, config: Mapping[str, Any], *, resumed_at: int | None = None, wandb: str | None = None
    ) -> None:
        """Open `folder`, new unless `resumed_at` says at which control step an old run goes on; -1 is from its very
        beginning.

        `wandb`: a project of Weights & Biases to log to as well.

        **Raises** `InputError` where another process has it open, it cannot be written to, or Weights & Biases refuses.

        What an old run measured and saved after that step is dropped: it will be measured again.
        """
        self.folder = folder
        self._whole = None if resumed_at == -1 else resumed_at
        """Step of the last checkpoint that was written to the end."""
        self._loggers: list[loggers.Logger] = []
        self._manager: ocp.CheckpointManager | None = None
        files.check_folder(folder)
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = _locked(folder / _LOCK)
        try:
            self._open(config, resumed_at, wandb)
        except Exception as error:
            self.__exit__(type(error), error, None)
            raise

    def _open(self, config: Mapping[str, Any], resumed_at: int | None, wandb: str | None) -> None:
        folder = self.folder
        if resumed_at is not None:
            kept = read_metrics(folder, resumed_at)
            before = read_config(folder, config["task"]).get("starts", [])
            _drop_checkpoints(folder, resumed_at)
            files.write(folder / _METRICS, "".join(json.dumps(row) + "\n" for row in kept))
            config = {**config, "starts": [*before, *config["starts"]]}
        files.write(folder / _CONFIG, json.dumps(config, indent=2, default=str) + "\n")
        next_step = None if resumed_at is None else resumed_at + 1
        self._loggers.append(loggers.JsonLines(folder / _METRICS))
        self._loggers.append(loggers.TensorBoard(folder / "tensorboard", next_step))
        if wandb is not None:
            self._loggers.append(loggers.WeightsAndBiases(wandb, folder, config))

    def __enter__(self) -> Run:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        """Close the files.

        **Raises** `InputError` where the disk is full, instead of whatever came of that.
        """
        with contextlib.ExitStack() as closing:
            closing.callback(self._told_of_full_disk, error)
            if self._manager is not None:
                # Closed already where the disk is full; whatever it says now comes of that.
                closing.enter_context(contextlib.suppress(Exception) if error else contextlib.nullcontext())
                closing.callback(self._manager.close)
            closing.callback(self._lock.close)
            for logger in self._loggers:
                # What a logger could not write before, it cannot now.
                closing.enter_context(contextlib.suppress(OSError) if error is not None else contextlib.nullcontext())
                closing.callback(logger.close, failed=error is not None)

    def _told_of_full_disk(self, error: BaseException | None) -> None:
        """Raise an `InputError` instead of an exception that comes of a full disk."""
        if error is None or not files.is_full(error):
            return
        then = "start again"
        if self._whole is not None:
            then = f"go on with --resume {self.folder}: the checkpoint of step {self._whole:,} is whole"
        raise InputError(f"{self.folder}: its disk is full; make room there, then {then}.") from error

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Add a line of measurements at `step`."""
        for logger in self._loggers:
            logger.log(step, metrics)

    def save(
        self,
        step: int,
        params: Mapping[str, Any],
        score: float | None,
        *,
        training: Mapping[str, np.ndarray] | None = None,
        notes: Mapping[str, Any] | None = None,
    ) -> None:
        """Write a checkpoint, unless that of `step` stands there already.

        **Arguments**

        - `params`: nested dictionaries of arrays.
        - `score`: by validation, the smallest is the best; None where there is none.
        - `training`: what else it takes to go on.
        - `notes`: what whoever goes on wants to know beside it; goes into JSON and back.
        """
        if self._manager is None:
            self._manager = _manager(self.folder)
        if step in self._manager.all_steps():
            return
        trees = {_PARAMS: dict(params)} | ({} if training is None else {_TRAINING: dict(training)})
        items = {name: ocp.args.StandardSave(tree) for name, tree in trees.items()}
        finite = None if score is None else score if math.isfinite(score) else _NO_SCORE
        metrics = None if finite is None else {"score": finite}
        files.reserve(self.folder, _OVERHEAD + 2 * sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(trees)))
        with _quiet_when_full(self._manager):
            self._manager.save(step, args=ocp.args.Composite(**items), metrics=metrics)
            self._manager.wait_until_finished()
        # Last of all: what has no record was not written to the end.
        place = self.folder / _CHECKPOINTS / str(step)
        files.sync(self.folder / _METRICS)
        files.sync_all(place)
        record = {"step": step, "score": finite, "notes": dict(notes or {}), "files": _checksums(place)}
        files.write(place / _RECORD, json.dumps({**record, "sha256": _checksum(record)}, indent=2) + "\n")
        self._whole = step
        runtime.release_memory()

    def write(self, name: str, text: str) -> None:
        """Write a text file into the folder."""
        files.write(self.folder / name, text)


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """What `Run.save` wrote; see there."""

    step: int
    params: dict[str, Any]
    training: dict[str, np.ndarray] | None
    notes: dict[str, Any]


def restore(folder: Path, which: Which) -> tuple[int, dict[str, Any]]:
    """Step and parameters of a run's best or last checkpoint, or of that of a step.

    A damaged last checkpoint is told on the terminal, and the one before taken.

    **Raises** `InputError` where there is none, or that which was asked for is damaged.
    """
    if which == "last":
        checkpoint = last_checkpoint(folder)
        return checkpoint.step, checkpoint.params
    steps = checkpoints(folder)
    try:
        scores = {step: _record(folder, step)["score"] for step in steps} if which == "best" else {}
        scored = {step: score for step, score in scores.items() if score is not None}
        step = min(scored, key=lambda step: (scored[step], -step), default=None) if which == "best" else which
        if step not in steps:
            raise _no_checkpoint(folder, "validated checkpoint" if which == "best" else "checkpoint")
        return step, _read(folder, step, training=False).params
    except _DamagedError as error:
        mend = "restore it from a copy, or delete its folder: then the next best is taken"
        raise InputError(f"{error}; {mend}.") from error


def last_checkpoint(folder: Path, *, training: bool = False) -> Checkpoint:
    """A run's last checkpoint that is whole, with or without what it takes to go on; damaged ones are told on the
    terminal.

    **Raises** `InputError` where there is none.
    """
    steps = checkpoints(folder)
    for step in reversed(steps):
        try:
            return _read(folder, step, training=training)
        except _DamagedError as error:
            print(f"{error}; taking the one before.", file=sys.stderr)
    if steps:
        raise InputError(f"{folder}: all checkpoints of the run are damaged; restore one from a copy or start anew.")
    raise _no_checkpoint(folder, "checkpoint")


def checkpoints(folder: Path) -> list[int]:
    """Steps of the checkpoints that a run has kept, in order."""
    place = folder / _CHECKPOINTS
    return sorted(ocp.utils.checkpoint_steps(place)) if place.is_dir() else []


def read_metrics(folder: Path, last: int | None = None) -> list[dict[str, Any]]:
    """The rows of a run's `metrics.jsonl`, up to the step `last` where it is given; a last line cut off is left out.

    **Raises** `InputError` naming the line where it is damaged.
    """
    path = folder / _METRICS
    lines = files.read_text(path).split("\n")[:-1] if path.exists() else []
    rows: list[dict[str, Any]] = []
    mend = "restore the file, or delete the line"
    for number, line in enumerate(lines, start=1):
        row = files.parse_object(line, f"{path}, line {number}", mend)
        step, before = row.get("step"), rows[-1]["step"] if rows else 0
        if type(step) is not int or not before <= step < _MOST_STEPS:
            raise InputError(f'{path}, line {number}: "step" is no step after the one before; {mend}.')
        for name, value in row.items():
            if value is not None and not is_number(value):
                raise InputError(f"{path}, line {number}: {_shown(name)} is {_shown(value)}, no number; {mend}.")
        if last is not None and step > last:
            break
        rows.append(row)
    return rows


def column(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Control steps, and what was measured there under `name`."""
    pairs = [(row["step"], row[name]) for row in read_metrics(folder) if row.get(name) is not None]
    steps, values = np.array(pairs, float).reshape(-1, 2).T
    return steps, values


class Progress:
    """What a training run says while it runs: a bar on a terminal, a line every ten seconds elsewhere."""

    interval = 10.0

    def __init__(self, total: int, first: int = 0, stream: TextIO | None = None) -> None:
        """`total` and `first`: control steps at the run's end and at its start."""
        self._total = total
        self._stream = stream or sys.stderr
        self._bar = None
        if self._stream.isatty():
            layout = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} steps{postfix}"
            self._bar = tqdm(
                total=total, initial=first, file=self._stream, bar_format=layout, unit_scale=True, dynamic_ncols=True
            )
        self._marks: list[tuple[float, int]] = []
        self._said = -math.inf

    def update(self, step: int, rate: float, metric: str) -> None:
        """Show where training is: control step, steps/s, and the metric that matters, in words."""
        now = time.perf_counter()
        # The time left is judged by the last minute's pace, validation included, compiling not.
        self._marks = [mark for mark in self._marks if now - mark[0] < 60.0] + [(now, step)]
        (then, before), left = self._marks[0], "?"
        if step > before:
            seconds = round((self._total - step) * (now - then) / (step - before))
            left = str(datetime.timedelta(seconds=max(seconds, 0)))
        text = f"{rate:,.0f} steps/s, {left} left, {metric}"
        if self._bar is not None:
            self._bar.update(min(step, self._total) - self._bar.n)
            self._bar.set_postfix_str(text)
        elif now - self._said >= self.interval or step >= self._total:
            self._said = now
            print(f"{step:,} of {self._total:,} steps, {text}", file=self._stream, flush=True)

    def close(self) -> None:
        """Leave the bar as it stands."""
        if self._bar is not None:
            self._bar.close()


class Stages:
    """What a fit says while it runs: a line when a stage begins, and a bar for its iterations on a terminal."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._stage, self._count = "", 0
        self._bar: tqdm | None = None

    def update(self, stage: str, iteration: int, steps: int, loss: float) -> int:
        """Show an iteration of a stage; returns how many there were in all."""
        self._count += 1
        if stage != self._stage:
            self.close()
            self._stage = stage
            interval = 0.1 if self._stream.isatty() else Progress.interval
            self._bar = tqdm(
                total=steps, desc=f"{stage:15}", file=self._stream, dynamic_ncols=True, mininterval=interval
            )
        if self._bar is not None:
            self._bar.update(iteration - self._bar.n)
            if math.isfinite(loss):
                self._bar.set_postfix_str(f"loss {loss:.5g}")
        return self._count

    def close(self) -> None:
        """Leave the last bar as it stands."""
        if self._bar is not None:
            self._bar.close()


def _locked(path: Path) -> IO[str]:
    """The file at `path`, open and locked; the system gives the lock up with its owner, however that ends."""
    file = path.open("a", encoding="utf-8")
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.close()
            raise InputError(
                f"{path.parent}: another process is writing to this run; wait for it, or give --output another folder."
            ) from error
    return file


class _DamagedError(Exception):
    """A checkpoint that does not hold what was written."""


def _read(folder: Path, step: int, *, training: bool) -> Checkpoint:
    """**Raises** `_DamagedError`."""
    place = (folder / _CHECKPOINTS / str(step)).resolve()
    record = _record(folder, step)
    old = place / "default"  # of version 1
    try:
        params = _standard(old if old.is_dir() else place / _PARAMS)
        more = _standard(place / _TRAINING) if training and (place / _TRAINING).is_dir() else None
    except Exception as error:  # orbax, tensorstore and the decoders raise whatever damage brings them to
        raise _DamagedError(f"{place}: the checkpoint cannot be read ({type(error).__name__})") from error
    return Checkpoint(step, params, more, record["notes"])


def _record(folder: Path, step: int) -> dict[str, Any]:
    """What is written beside a checkpoint of it. Before orbax sees the checkpoint: it does not take damage quietly.

    **Raises** `_DamagedError` where the checkpoint is not as it was written.
    """
    place = folder / _CHECKPOINTS / str(step)
    path = place / _RECORD
    try:
        if (place / "default").is_dir():  # of version 1, which has no checksums
            score = place / "metrics" / "metrics"
            return {"score": json.loads(score.read_bytes())["score"] if score.exists() else None, "notes": {}}
        record = json.loads(path.read_bytes())
        intact = record.pop("sha256") == _checksum(record)
    except FileNotFoundError as error:
        raise _DamagedError(f"{place}: the checkpoint is half-written") from error
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise _DamagedError(f"{path}: the checkpoint is damaged") from error
    if not intact:
        raise _DamagedError(f"{path}: the checkpoint is damaged")
    if record.get("step", step) != step:  # older ones do not say
        raise _DamagedError(f"{place}: the checkpoint is that of step {record['step']}")
    now = _checksums(place)
    for name, checksum in record["files"].items():
        if now.get(name) != checksum:
            raise _DamagedError(f"{place / name}: the checkpoint is damaged")
    return record


def _checksums(place: Path) -> dict[str, str]:
    """SHA-256 of every file of a checkpoint but its record."""
    files = sorted(path for path in place.rglob("*") if path.is_file() and not path.name.startswith(_RECORD))
    return {path.relative_to(place).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _checksum(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def _standard(place: Path) -> dict[str, Any]:
    with ocp.StandardCheckpointer(multiprocessing_options=_alone()) as checkpointer:
        return jax.tree.map(np.asarray, checkpointer.restore(place))


def _drop_checkpoints(folder: Path, after: int) -> None:
    """Remove checkpoints after a step, and all that are damaged or half-written, over which orbax would stumble."""

    def keep(step: int) -> bool:
        try:
            return step <= after and bool(_record(folder, step))
        except _DamagedError:
            return False

    place = folder / _CHECKPOINTS
    kept = {str(step) for step in checkpoints(folder) if keep(step)}
    for path in place.iterdir() if place.is_dir() else ():
        if path.is_dir() and path.name not in kept:
            shutil.rmtree(path)


def _no_checkpoint(folder: Path, kind: str) -> InputError:
    return InputError(f"{folder}: the run has no {kind}; train for longer.")


def _manager(folder: Path) -> ocp.CheckpointManager:
    best = policies.BestN(get_metric_fn=_score, reverse=True, n=1, keep_checkpoints_without_metrics=False)
    options = ocp.CheckpointManagerOptions(
        best_fn=_score,
        best_mode="min",
        preservation_policy=policies.AnyPreservationPolicy([policies.LatestN(KEPT), best]),
        enable_async_checkpointing=False,
        create=False,
        multiprocessing_options=_alone(),
    )
    place = (folder / _CHECKPOINTS).resolve()
    place.mkdir(parents=True, exist_ok=True)  # which the manager would do only if all processes had one
    return ocp.CheckpointManager(place, options=options)


def _alone() -> ocp.options.MultiprocessingOptions:
    """This process reads and writes by itself, whatever others train with it."""
    if jax.process_count() == 1:
        return ocp.options.MultiprocessingOptions()
    number = jax.process_index()
    return ocp.options.MultiprocessingOptions(
        primary_host=number, active_processes={number}, barrier_sync_key_prefix=f"process-{number}"
    )


@contextlib.contextmanager
def _quiet_when_full(manager: ocp.CheckpointManager) -> Iterator[None]:
    """Keep what orbax says of a full disk off the terminal: each of its threads fills pages. The exception stays."""
    stderr, before = sys.stderr, logging.root.manager.disable
    sys.stderr = said = io.StringIO()
    logging.disable(logging.CRITICAL)
    full = False
    try:
        yield
    except Exception as error:
        full = files.is_full(error)
        if full:
            with contextlib.suppress(Exception):  # the same once more
                manager.close()  # and with it, its threads
        raise
    finally:
        if full:  # tensorstore's threads go on complaining until the process ends
            sys.stderr = _OfThisThread(stderr)
        else:
            sys.stderr = stderr
            logging.disable(before)
            stderr.write(said.getvalue())


class _OfThisThread(io.TextIOBase):
    """A stream that takes what the thread which made it says, and drops what others do."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._thread = stream, threading.get_ident()

    def write(self, text: str, /) -> int:
        return self._stream.write(text) if threading.get_ident() == self._thread else len(text)

    def flush(self) -> None:
        self._stream.flush()


def _score(metrics: Any) -> float:
    return metrics["score"]


def _is_of_type(hint: Any, value: Any) -> bool:
    """Whether a value from JSON can be one of a field's type."""
    kind, inner = typing.get_origin(hint), typing.get_args(hint)
    if kind is typing.Literal:
        return any(type(value) is type(each) and value == each for each in inner)
    if kind is tuple:
        hints = [inner[0]] * len(value) if inner[-1] is ... and isinstance(value, list) else list(inner)
        fits = isinstance(value, list) and len(value) == len(hints)
        return fits and all(map(_is_of_type, hints, value))
    return is_number(value) if hint is float else type(value) is hint


def _as_type(hint: Any, value: Any) -> Any:
    """JSON has no tuples."""
    return tuple(value) if typing.get_origin(hint) is tuple and isinstance(value, list) else value


def _shown(value: Any) -> str:
    """A value from JSON in a sentence."""
    return reprlib.repr(value)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
