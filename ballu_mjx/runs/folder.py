"""A run: its folder, and what it shows of itself on the terminal.

config.json         all it takes to repeat the run
metrics.jsonl       one JSON object a line: `step` (control steps) and what was measured there
tensorboard/        the same for TensorBoard
wandb/              the same for Weights & Biases, on demand
checkpoints/STEP/   the last three, and the best by validation (orbax): `params`, all it takes to use what was
                    learned; `training`, what else it takes to go on; `record.json`, checksums of all files
evaluation.txt, evaluation.json, learning_curve.png, tracking.png
replay.npz          what the robots did, for `ballu_mjx report` and `ballu_mjx view`
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
    drop_checkpoints,
    file_checksums,
    quiet_when_full,
    record_checksum,
    restore_checkpoint,
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
        if any((output / CHECKPOINTS_FOLDER).glob(f"*/{TRAINING_FOLDER}")):  # others cannot go on
            mend = f"--resume {output} goes on with it, or give --output another folder"
        raise InputError(f"{output}: the folder is not empty; {mend}.")
    files.check_folder(output)
    return output


def read_config(folder: Path, *tasks: str) -> dict[str, Any]:
    """The content of a run's `config.json`.

    **Raises** `InputError` where `folder` is no run of one of `tasks`.
    """
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise InputError(f"{folder}: there is no run ({CONFIG_FILE} is missing); check the path.")
    mend = "restore it or start a new run"
    content = files.read_json(path, mend)
    if content.get("format") not in READABLE_FORMATS:
        raise InputError(f"{path}: is not of the format {RUN_FORMAT}; use the version of ballu_mjx that wrote it.")
    if content.get("task") not in tasks:
        needed = " or ".join(repr(task) for task in tasks)
        raise InputError(
            f"{path}: is of a run of {shorten_value(content.get('task'))}; one of {needed} is needed here."
        )
    for name, fits in _SHAPES.items():
        if name in content and not fits(content[name]):
            raise InputError(f'{path}: "{name}" is not what a run keeps there, {shorten_value(content[name])}; {mend}.')
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


def typed_config(
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
    path = folder / CONFIG_FILE
    fields = {field.name: field for field in dataclasses.fields(cls)}  # pyright: ignore[reportArgumentType]
    hints = typing.get_type_hints(cls)
    values = config_section(config, section, folder)
    for name, value in values.items():
        if name not in fields:
            raise InputError(
                f"{path}: {cls.__name__} has no field {shorten_value(name)}; use the version of ballu_mjx that wrote "
                "it."
            )
        if not _is_of_type(hints[name], value):
            raise InputError(
                f"{path}: {name} of {section} is {shorten_value(value)}, which it cannot be; restore it or start a new "
                "run."
            )
    found = cls(**{name: _as_type(hints[name], value) for name, value in values.items()})
    try:
        check(found)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return found


def config_section(config: Mapping[str, Any], key: str, folder: Path) -> Any:
    """What stands under a key; None in runs of version 1, which had not all of them."""
    if key not in config and config.get("format") == RUN_FORMAT:
        raise InputError(f'{folder / CONFIG_FILE}: "{key}" is missing; restore it or start a new run.')
    return config.get(key)


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
        self.folder, self.config = folder, config
        self._whole = None if resumed_at == -1 else resumed_at
        """Step of the last checkpoint that was written to the end."""
        self._loggers: list[loggers.Logger] = []
        self._manager: ocp.CheckpointManager | None = None
        files.check_folder(folder)
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = _locked(folder / LOCK_FILE)
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
            drop_checkpoints(folder, resumed_at)
            files.write(folder / METRICS_FILE, "".join(json.dumps(row) + "\n" for row in kept))
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

    def log(self, step: int, metrics: Mapping[str, float | int]) -> None:
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
            self._manager = checkpoint_manager(self.folder)
        if step in self._manager.all_steps():
            return
        trees = {PARAMS_FOLDER: dict(params)} | ({} if training is None else {TRAINING_FOLDER: dict(training)})
        items = {name: ocp.args.StandardSave(tree) for name, tree in trees.items()}
        finite = None if score is None else score if math.isfinite(score) else NO_SCORE
        metrics = None if finite is None else {"score": finite}
        files.reserve(
            self.folder, CHECKPOINT_OVERHEAD + 2 * sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(trees))
        )
        with quiet_when_full(self._manager):
            self._manager.save(step, args=ocp.args.Composite(**items), metrics=metrics)
            self._manager.wait_until_finished()
        # Last of all: what has no record was not written to the end.
        place = self.folder / CHECKPOINTS_FOLDER / str(step)
        files.sync(self.folder / METRICS_FILE)
        files.sync_all(place)
        record = {"step": step, "score": finite, "notes": dict(notes or {}), "files": file_checksums(place)}
        files.write(place / RECORD_FILE, json.dumps({**record, "sha256": record_checksum(record)}, indent=2) + "\n")
        self._whole = step
        runtime.release_memory()

    def write(self, name: str, text: str) -> None:
        """Write a text file into the folder."""
        files.write(self.folder / name, text)

    def best(self) -> tuple[int, dict[str, Any]]:
        """Return step and parameters of the best checkpoint.

        **Raises** `InputError` where there is none, or it is damaged.
        """
        return restore_checkpoint(self.folder, "best")


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


def _is_of_type(hint: Any, value: Any) -> bool:
    """Whether a value from JSON can be one of a field's type."""
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
    """JSON has no tuples."""
    return tuple(value) if typing.get_origin(hint) is tuple and isinstance(value, list) else value
