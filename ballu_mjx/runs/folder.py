"""The folder of a run, which holds these files:

config.json         everything needed to repeat the run
metrics.jsonl       one JSON object per line: `step` (control steps) and the measurements at that step
tensorboard/        the same measurements for TensorBoard
wandb/              the same measurements for Weights & Biases, on request
checkpoints/STEP/   the last three that were validated, the best of all, and the last (orbax): `params`, everything
                    needed to use the result; `training`, the further state needed to resume; `record.json`, checksums
                    of all files
evaluation.txt, evaluation.json, learning_curve.png, tracking.png
replay.npz          motions of the robots, for `ballu_mjx report` and `ballu_mjx view`
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
import math
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any, TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp

try:
    import fcntl
except ImportError:  # Windows, where runs are not locked
    fcntl = None


from ballu_mjx.common import files, runtime
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.runs import loggers
from ballu_mjx.runs.checkpoints import (
    CHECKPOINT_OVERHEAD,
    checkpoint_manager,
    checkpoint_metrics,
    drop_checkpoints,
    file_checksums,
    has_score,
    record_checksum,
    restore_checkpoint,
    suppress_full_disk_output,
)
from ballu_mjx.runs.layout import (
    CHECKPOINTS_FOLDER,
    CONFIG_FILE,
    LOCK_FILE,
    METRICS_FILE,
    NO_SCORE,
    PARAMS_FOLDER,
    READABLE_FORMATS,
    RECORD_FILE,
    RUN_FORMAT,
    TRAINING_FOLDER,
    shorten_value,
)
from ballu_mjx.runs.metrics import read_metrics
from ballu_mjx.runs.rollout_file import ROLLOUT_FILE

Config = TypeVar("Config")


def new_folder(output: Path | None, task: str) -> Path:
    """Return the folder of a new run: `output`, or a folder in `runs/` that is named after task and time.

    The folder is empty or does not exist yet.

    **Raises** `InputError` if `output` is not empty, or if it cannot be written to.
    """
    if output is None:
        stem = f"{task}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
        names = (stem if not number else f"{stem}-{number + 1}" for number in range(1000))
        output = next(folder for name in names if not (folder := Path("runs") / name).exists())
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: this is a file; give --output a folder that is new or empty.")
    if output.exists() and any(output.iterdir()):
        fix = "give --output a folder that is new or empty"
        if any((output / CHECKPOINTS_FOLDER).glob(f"*/{TRAINING_FOLDER}")):  # others cannot be resumed
            fix = f"resume the run with --resume {output}, or give --output another folder"
        raise InputError(f"{output}: the folder is not empty; {fix}.")
    files.check_folder(output)
    return output


def read_config(folder: Path, *tasks: str) -> dict[str, Any]:
    """Return the content of a run's `config.json`.

    **Raises** `InputError` if `folder` is not a run of one of `tasks`, or if the file is damaged.
    """
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise InputError(f"{folder}: there is no run ({CONFIG_FILE} is missing); check the path.")
    fix = "restore it or start a new run"
    content = files.read_json(path, fix)
    if content.get("format") not in READABLE_FORMATS:
        raise InputError(f"{path}: the format is not {RUN_FORMAT}; use the version of ballu_mjx that wrote it.")
    if content.get("task") not in tasks:
        needed = " or ".join(repr(task) for task in tasks)
        raise InputError(
            f"{path}: the task of this run is {shorten_value(content.get('task'))}; give a run of {needed}."
        )
    for name, fits in _SHAPES.items():
        if name in content and not fits(content[name]):
            raise InputError(f'{path}: "{name}" has an invalid value, {shorten_value(content[name])}; {fix}.')
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
    **dict.fromkeys(("residual", "residual_sha256"), lambda value: value is None or isinstance(value, str)),
    "residual_step": lambda value: value is None or type(value) is int,
    "robot_description": lambda value: value is None or _is_description(value),
    "recordings": lambda value: (
        isinstance(value, dict) and all(_is_list_of(entries, _is_description) for entries in value.values())
    ),
    "starts": lambda value: _is_list_of(value, _is_start),
}
"""Checks of the values in a `config.json`, by key."""


def typed_config(
    cls: type[Config],
    config: Mapping[str, Any],
    section: str,
    folder: Path,
    check: Callable[[Config], None] = lambda config: None,
) -> Config:
    """Return a section of the `config.json` of the run in `folder` as the dataclass `cls`.

    Missing fields take their default.

    **Raises** `InputError` that names the file and the field, if `cls` does not have a field, if a value has another
    type, or if `check` raises it.
    """
    path = folder / CONFIG_FILE
    found = cls(**typed_values(cls, config_section(config, section, folder), section, path))
    try:
        check(found)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return found


def typed_values(cls: type, values: Mapping[str, Any], section: str, path: Path) -> dict[str, Any]:
    """Return some values of a section of the `config.json` at `path`, in the types of the fields of dataclass `cls`.

    **Raises** `InputError` that names the file and the field, if `cls` does not have a field, or if a value has another
    type.
    """
    fields = {field.name for field in dataclasses.fields(cls)}
    hints = typing.get_type_hints(cls)
    for name, value in values.items():
        if name not in fields:
            raise InputError(
                f"{path}: {cls.__name__} has no field {shorten_value(name)}; use the version of ballu_mjx that wrote "
                "it."
            )
        if not _is_of_type(hints[name], value):
            raise InputError(
                f"{path}: {name} of {section} has an invalid value, {shorten_value(value)}; restore it or start a new "
                "run."
            )
    return {name: _as_type(hints[name], value) for name, value in values.items()}


def config_section(config: Mapping[str, Any], key: str, folder: Path) -> Any:
    """Return the value of a key, or None if a run of format version 1 lacks it.

    **Raises** `InputError` if a run of the present format lacks it.
    """
    if key not in config and config.get("format") == RUN_FORMAT:
        raise InputError(f'{folder / CONFIG_FILE}: "{key}" is missing; restore it or start a new run.')
    return config.get(key)


_RESULTS = (ROLLOUT_FILE, "evaluation.json", "evaluation.txt")
"""Files that are written after training. A resumed training writes them anew."""
_MARKS = ("quick", "preset")
"""Options of the data section that a run keeps when it is resumed."""


class Run:
    """Run folder that is open for writing. It is a context manager, which closes the files at its end."""

    def __init__(
        self, folder: Path, config: Mapping[str, Any], *, resumed_at: int | None = None, wandb: str | None = None
    ) -> None:
        """Open `folder` for a new run, or to resume a run.

        - `resumed_at`: control step from which the run resumes, or -1 for its beginning. Measurements and checkpoints
          after this step are deleted, since they will be made again. None for a new run.
        - `wandb`: project of Weights & Biases to log to as well.

        **Raises** `InputError` if another process has the folder open, if the folder cannot be written to, or if
        Weights & Biases refuses.
        """
        self.folder, self.config = folder, config
        self._last_complete = None if resumed_at == -1 else resumed_at
        """Step of the last checkpoint that was written completely."""
        self._loggers: list[loggers.Logger] = []
        self._manager: ocp.CheckpointManager | None = None
        files.check_folder(folder)
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = _open_locked(folder / LOCK_FILE)
        try:
            self._open(config, resumed_at, wandb)
        except Exception as error:
            self.__exit__(type(error), error, None)
            raise

    def _open(self, config: Mapping[str, Any], resumed_at: int | None, wandb: str | None) -> None:
        folder = self.folder
        if resumed_at is not None:
            kept = read_metrics(folder, resumed_at)
            earlier = read_config(folder, config["task"])
            before = earlier.get("starts", [])
            if "data" in earlier:
                marks = {name: earlier["data"][name] for name in _MARKS if name in earlier["data"]}
                config = {**config, "data": {**config.get("data", {}), **marks}}
            drop_checkpoints(folder, resumed_at)
            files.write(folder / METRICS_FILE, "".join(json.dumps(row) + "\n" for row in kept))
            for name in _RESULTS:  # of the training so far
                (folder / name).unlink(missing_ok=True)
            config = {**config, "starts": [*before, *config["starts"]]}
        files.write(folder / CONFIG_FILE, json.dumps(config, indent=2, default=str) + "\n")
        next_step = None if resumed_at is None else resumed_at + 1
        self._loggers.append(loggers.JsonLines(folder / METRICS_FILE))
        self._loggers.append(loggers.TensorBoard(folder / "tensorboard", next_step))
        if wandb is not None:
            self._loggers.append(loggers.WeightsAndBiases(wandb, folder, config))

    def __enter__(self) -> Run:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        """Close the files.

        **Raises** `InputError` if the disk is full, instead of the error that this caused.
        """
        with contextlib.ExitStack() as closing:
            closing.callback(self._raise_if_disk_is_full, error)
            if self._manager is not None:
                # If the disk is full, it is closed already, and further errors have the same cause.
                closing.enter_context(contextlib.suppress(Exception) if error else contextlib.nullcontext())
                closing.callback(self._manager.close)
            closing.callback(self._lock.close)
            for logger in self._loggers:
                # A logger that could not write before fails again.
                closing.enter_context(contextlib.suppress(OSError) if error is not None else contextlib.nullcontext())
                closing.callback(logger.close, failed=error is not None)

    def _raise_if_disk_is_full(self, error: BaseException | None) -> None:
        """Raise an `InputError` if the cause of `error` is a full disk."""
        if error is None or not files.is_full(error):
            return
        then = "start again"
        if self._last_complete is not None:
            then = f"resume with --resume {self.folder}: the checkpoint of step {self._last_complete:,} is intact"
        raise InputError(f"{self.folder}: its disk is full; make room there, then {then}.") from error

    def log(self, step: int, metrics: Mapping[str, float | int]) -> None:
        """Log measurements at `step`."""
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
        """Write a checkpoint, unless the one of `step` exists already and has a score or `score` is None.

        **Arguments**

        - `params`: learned parameters, as nested dictionaries of arrays.
        - `score`: validation score, of which the smallest is the best. None if there is none.
        - `training`: further state that is needed to resume.
        - `notes`: further values for the resumed run, stored as JSON.
        """
        if self._manager is None:
            self._manager = checkpoint_manager(self.folder)
        if step in self._manager.all_steps():
            if score is None or has_score(self.folder, step):
                return
            self._manager.delete(step)
        trees = {PARAMS_FOLDER: dict(params)} | ({} if training is None else {TRAINING_FOLDER: dict(training)})
        items = {name: ocp.args.StandardSave(tree) for name, tree in trees.items()}
        finite = None if score is None else score if math.isfinite(score) else NO_SCORE
        metrics = None if finite is None else checkpoint_metrics(finite, notes or {})
        files.reserve(
            self.folder, CHECKPOINT_OVERHEAD + 2 * sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(trees))
        )
        with suppress_full_disk_output(self._manager):
            self._manager.save(step, args=ocp.args.Composite(**items), metrics=metrics)
            self._manager.wait_until_finished()
        # The record comes last: a checkpoint without a record is incomplete.
        place = self.folder / CHECKPOINTS_FOLDER / str(step)
        files.sync(self.folder / METRICS_FILE)
        files.sync_all(place)
        record = {"step": step, "score": finite, "notes": dict(notes or {}), "files": file_checksums(place)}
        files.write(place / RECORD_FILE, json.dumps({**record, "sha256": record_checksum(record)}, indent=2) + "\n")
        self._last_complete = step
        runtime.release_memory()

    def write(self, name: str, text: str) -> None:
        """Write a text file into the folder."""
        files.write(self.folder / name, text)

    def best(self) -> tuple[int, dict[str, Any]]:
        """Return step and parameters of the best checkpoint.

        **Raises** `InputError` if there is none, or if it is damaged.
        """
        return restore_checkpoint(self.folder, "best")


def _open_locked(path: Path) -> IO[str]:
    """Open and lock the file at `path`. The system releases the lock when the process ends, even by a crash."""
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


def _is_of_type(hint: Any, value: Any) -> bool:
    """Return whether a value from JSON is valid for a field's type."""
    kind, inner = typing.get_origin(hint), typing.get_args(hint)
    if kind is types.UnionType:
        return any(_is_of_type(each, value) for each in inner)
    if kind is typing.Literal:
        return any(type(value) is type(each) and value == each for each in inner)
    if kind is tuple:
        hints = [inner[0]] * len(value) if inner[-1] is ... and isinstance(value, list) else list(inner)
        fits = isinstance(value, list) and len(value) == len(hints)
        return fits and all(map(_is_of_type, hints, value))
    return is_number(value) if hint is float else type(value) is hint


def _as_type(hint: Any, value: Any) -> Any:
    """Return a value from JSON in a field's type. JSON has no tuples, so lists become tuples."""
    return tuple(value) if typing.get_origin(hint) is tuple and isinstance(value, list) else value
