"""Checkpoints of a run, with checksums."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import logging
import shutil
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import jax
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers as policies

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.runs.layout import (
    CHECKPOINTS_FOLDER,
    CHECKPOINTS_KEPT,
    PARAMS_FOLDER,
    RECORD_FILE,
    TRAINING_FOLDER,
    Which,
)

_LOG = logging.getLogger(__name__)
CHECKPOINT_OVERHEAD = 2**20
"""Upper bound of a checkpoint's size without its arrays (bytes)."""

SCORED_WITH = "scored_with"
"""Note of a checkpoint: hash of the options and recordings on which its score depends. Resumed runs may have others."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Checkpoint as `folder.Run.save` writes it."""

    step: int
    params: dict[str, Any]
    training: dict[str, np.ndarray] | None
    notes: dict[str, Any]


def restore_checkpoint(folder: Path, which: Which) -> tuple[int, dict[str, Any]]:
    """Return step and parameters of a run's checkpoint: the best, the last, or that of a given step.

    If the last checkpoint is damaged, the one before is read, and the terminal shows a warning. The best is chosen
    among the checkpoints whose scores have the same conditions (`SCORED_WITH`) as the last score.

    **Raises** `InputError` if there is no checkpoint, or if the requested one is damaged.
    """
    if which == "last":
        checkpoint = last_checkpoint(folder)
        return checkpoint.step, checkpoint.params
    steps = list_checkpoints(folder)
    try:
        step = _best_step(folder, steps) if which == "best" else which
        if step not in steps:
            raise _no_checkpoint(folder, "validated checkpoint" if which == "best" else "checkpoint")
        return step, _read(folder, step, training=False).params
    except _DamagedError as error:
        fix = "restore it from a copy, or delete its folder to use the next best"
        raise InputError(f"{error}; {fix}.") from error


def _best_step(folder: Path, steps: Sequence[int]) -> int | None:
    records = {step: _record(folder, step) for step in steps}
    scored = {
        step: checkpoint_metrics(record["score"], record["notes"])
        for step, record in records.items()
        if record["score"] is not None
    }
    return _best(scored) if scored else None


def _best(scored: Mapping[int, Mapping[str, Any]]) -> int:
    """Return the step with the smallest score among those with the conditions of the last one.

    `scored` holds the `checkpoint_metrics` of each step.
    """
    conditions = scored[max(scored)].get(SCORED_WITH)  # files of older versions lack it
    alike = [step for step, metrics in scored.items() if metrics.get(SCORED_WITH) == conditions]
    return min(alike, key=lambda step: (scored[step]["score"], -step))


def last_checkpoint(folder: Path, *, training: bool = False) -> Checkpoint:
    """Return a run's last intact checkpoint, with or without the training state. Damaged ones are logged.

    **Raises** `InputError` if there is none.
    """
    steps = list_checkpoints(folder)
    for step in reversed(steps):
        try:
            return _read(folder, step, training=training)
        except _DamagedError as error:
            _LOG.warning("%s; taking the one before.", error)
    if steps:
        raise InputError(
            f"{folder}: all checkpoints of the run are damaged; restore one from a copy, or start a new run."
        )
    raise _no_checkpoint(folder, "checkpoint")


def has_score(folder: Path, step: int) -> bool:
    """Return whether the checkpoint of a step has a score. One that an interruption saved has none."""
    return _record(folder, step)["score"] is not None


def list_checkpoints(folder: Path) -> list[int]:
    """Return the steps of the checkpoints in a run's folder, in order."""
    place = folder / CHECKPOINTS_FOLDER
    return sorted(ocp.utils.checkpoint_steps(place)) if place.is_dir() else []


class _DamagedError(Exception):
    """Error for a checkpoint whose content is not what was written."""


def _read(folder: Path, step: int, *, training: bool) -> Checkpoint:
    """Read a checkpoint.

    **Raises** `_DamagedError` if it is damaged.
    """
    place = (folder / CHECKPOINTS_FOLDER / str(step)).resolve()
    record = _record(folder, step)
    old = place / "default"  # format version 1
    try:
        params = _standard(old if old.is_dir() else place / PARAMS_FOLDER)
        more = _standard(place / TRAINING_FOLDER) if training and (place / TRAINING_FOLDER).is_dir() else None
    except Exception as error:  # damage causes many kinds of errors in orbax, tensorstore and decoders
        raise _DamagedError(f"{place}: the checkpoint cannot be read ({type(error).__name__})") from error
    return Checkpoint(step, params, more, record["notes"])


def _record(folder: Path, step: int) -> dict[str, Any]:
    """Return a checkpoint's record (score, notes, checksums) after a check that the checkpoint is as it was written.

    The check comes before orbax reads the checkpoint, since orbax does not handle damage quietly.

    **Raises** `_DamagedError` if the checkpoint has changed or is incomplete.
    """
    place = folder / CHECKPOINTS_FOLDER / str(step)
    path = place / RECORD_FILE
    try:
        if (place / "default").is_dir():  # format version 1, without checksums
            score = place / "metrics" / "metrics"
            return {"score": json.loads(score.read_bytes())["score"] if score.exists() else None, "notes": {}}
        record = json.loads(path.read_bytes())
        intact = record.pop("sha256") == record_checksum(record)
    except FileNotFoundError as error:
        raise _DamagedError(f"{place}: the checkpoint is half-written") from error
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise _DamagedError(f"{path}: the checkpoint is damaged") from error
    if not intact:
        raise _DamagedError(f"{path}: the checkpoint is damaged")
    if record.get("step", step) != step:  # older records have no step
        raise _DamagedError(f"{place}: the checkpoint is that of step {record['step']}")
    now = file_checksums(place)
    for name, checksum in record["files"].items():
        if now.get(name) != checksum:
            raise _DamagedError(f"{place / name}: the checkpoint is damaged")
    return record


def file_checksums(place: Path) -> dict[str, str]:
    """Return the SHA-256 of every file of a checkpoint except its record."""
    files = sorted(path for path in place.rglob("*") if path.is_file() and not path.name.startswith(RECORD_FILE))
    return {path.relative_to(place).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def record_checksum(record: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a checkpoint's record without its own checksum."""
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def _standard(place: Path) -> dict[str, Any]:
    with ocp.StandardCheckpointer(multiprocessing_options=_alone()) as checkpointer:
        return jax.tree.map(np.asarray, checkpointer.restore(place))


def drop_checkpoints(folder: Path, after: int) -> None:
    """Remove checkpoints after a step, and all that are damaged or incomplete, with which orbax would fail."""

    def keep(step: int) -> bool:
        try:
            return step <= after and bool(_record(folder, step))
        except _DamagedError:
            return False

    place = folder / CHECKPOINTS_FOLDER
    kept = {str(step) for step in list_checkpoints(folder) if keep(step)}
    for path in place.iterdir() if place.is_dir() else ():
        if path.is_dir() and path.name not in kept:
            shutil.rmtree(path)


def _no_checkpoint(folder: Path, kind: str) -> InputError:
    return InputError(f"{folder}: the run has no {kind}; train for longer.")


class _Kept(policies.PreservationPolicy):
    """Keeps the last `CHECKPOINTS_KEPT` checkpoints with a score, the best of them, and the last one of all.

    The last one has no score if an interruption saved it. It is not counted, so that a resumed run keeps the same
    checkpoints as an uninterrupted one.
    """

    def should_preserve(self, checkpoints: Sequence[Any], *, context: Any) -> Sequence[bool]:
        del context
        scored = {each.step: each.metrics for each in checkpoints if each.metrics is not None}
        best = {_best(scored)} if scored else set()
        kept = {*sorted(scored)[-CHECKPOINTS_KEPT:], *best, checkpoints[-1].step}
        return [each.step in kept for each in checkpoints]


def checkpoint_metrics(score: float, notes: Mapping[str, Any]) -> dict[str, Any]:
    """Return what orbax stores with a checkpoint, from which it is decided which checkpoints are kept."""
    return {"score": score, SCORED_WITH: notes.get(SCORED_WITH)}


def checkpoint_manager(folder: Path) -> ocp.CheckpointManager:
    """Return the orbax manager of a run's checkpoints. `_Kept` says which it keeps."""
    options = ocp.CheckpointManagerOptions(
        best_fn=_score,
        best_mode="min",
        preservation_policy=_Kept(),
        enable_async_checkpointing=False,
        create=False,
        multiprocessing_options=_alone(),
    )
    place = (folder / CHECKPOINTS_FOLDER).resolve()
    place.mkdir(parents=True, exist_ok=True)  # The manager creates it only if all processes have one.
    return ocp.CheckpointManager(place, options=options)


def _alone() -> ocp.options.MultiprocessingOptions:
    """Return options by which this process reads and writes alone, even if several processes train together."""
    if jax.process_count() == 1:
        return ocp.options.MultiprocessingOptions()
    number = jax.process_index()
    return ocp.options.MultiprocessingOptions(
        primary_host=number, active_processes={number}, barrier_sync_key_prefix=f"process-{number}"
    )


@contextlib.contextmanager
def suppress_full_disk_output(manager: ocp.CheckpointManager) -> Iterator[None]:
    """Suppress orbax's output about a full disk: each of its threads fills pages. The exception still propagates."""
    stderr, before = sys.stderr, logging.root.manager.disable
    sys.stderr = said = io.StringIO()
    logging.disable(logging.CRITICAL)
    full = False
    try:
        yield
    except Exception as error:
        full = files.is_full(error)
        if full:
            with contextlib.suppress(Exception):  # the disk is still full
                manager.close()  # ends its threads
        raise
    finally:
        if full:  # tensorstore's threads print errors until the process ends
            sys.stderr = _OfThisThread(stderr)
        else:
            sys.stderr = stderr
            logging.disable(before)
            stderr.write(said.getvalue())


class _OfThisThread(io.TextIOBase):
    """Text stream that passes on output of the thread that created it, and drops output of other threads."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._thread = stream, threading.get_ident()

    def write(self, text: str, /) -> int:
        return self._stream.write(text) if threading.get_ident() == self._thread else len(text)

    def flush(self) -> None:
        self._stream.flush()


def _score(metrics: Any) -> float:
    return metrics["score"]
