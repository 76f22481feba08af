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
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TextIO

import jax
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers as policies

try:
    import fcntl
except ImportError:  # Windows, where runs are not locked
    fcntl = None


from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.runs.layout import CHECKPOINTS_FOLDER, KEPT, PARAMS_FOLDER, RECORD_FILE, TRAINING_FOLDER

_LOG = logging.getLogger(__name__)
CHECKPOINT_OVERHEAD = 2**20
"""Bytes of a checkpoint beside its arrays, at most."""

Which = Literal["best", "last"] | int


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """What `Run.save` wrote; see there."""

    step: int
    params: dict[str, Any]
    training: dict[str, np.ndarray] | None
    notes: dict[str, Any]


def restore_checkpoint(folder: Path, which: Which) -> tuple[int, dict[str, Any]]:
    """Step and parameters of a run's best or last checkpoint, or of that of a step.

    A damaged last checkpoint is told on the terminal, and the one before taken.

    **Raises** `InputError` where there is none, or that which was asked for is damaged.
    """
    if which == "last":
        checkpoint = last_checkpoint(folder)
        return checkpoint.step, checkpoint.params
    steps = list_checkpoints(folder)
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
    """A run's last checkpoint that is whole, with or without what it takes to go on; damaged ones are logged.

    **Raises** `InputError` where there is none.
    """
    steps = list_checkpoints(folder)
    for step in reversed(steps):
        try:
            return _read(folder, step, training=training)
        except _DamagedError as error:
            _LOG.warning("%s; taking the one before.", error)
    if steps:
        raise InputError(f"{folder}: all checkpoints of the run are damaged; restore one from a copy or start anew.")
    raise _no_checkpoint(folder, "checkpoint")


def list_checkpoints(folder: Path) -> list[int]:
    """Steps of the checkpoints that a run has kept, in order."""
    place = folder / CHECKPOINTS_FOLDER
    return sorted(ocp.utils.checkpoint_steps(place)) if place.is_dir() else []


class _DamagedError(Exception):
    """A checkpoint that does not hold what was written."""


def _read(folder: Path, step: int, *, training: bool) -> Checkpoint:
    """**Raises** `_DamagedError`."""
    place = (folder / CHECKPOINTS_FOLDER / str(step)).resolve()
    record = _record(folder, step)
    old = place / "default"  # of version 1
    try:
        params = _standard(old if old.is_dir() else place / PARAMS_FOLDER)
        more = _standard(place / TRAINING_FOLDER) if training and (place / TRAINING_FOLDER).is_dir() else None
    except Exception as error:  # orbax, tensorstore and the decoders raise whatever damage brings them to
        raise _DamagedError(f"{place}: the checkpoint cannot be read ({type(error).__name__})") from error
    return Checkpoint(step, params, more, record["notes"])


def _record(folder: Path, step: int) -> dict[str, Any]:
    """What is written beside a checkpoint of it. Before orbax sees the checkpoint: it does not take damage quietly.

    **Raises** `_DamagedError` where the checkpoint is not as it was written.
    """
    place = folder / CHECKPOINTS_FOLDER / str(step)
    path = place / RECORD_FILE
    try:
        if (place / "default").is_dir():  # of version 1, which has no checksums
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
    if record.get("step", step) != step:  # older ones do not say
        raise _DamagedError(f"{place}: the checkpoint is that of step {record['step']}")
    now = file_checksums(place)
    for name, checksum in record["files"].items():
        if now.get(name) != checksum:
            raise _DamagedError(f"{place / name}: the checkpoint is damaged")
    return record


def file_checksums(place: Path) -> dict[str, str]:
    """SHA-256 of every file of a checkpoint but its record."""
    files = sorted(path for path in place.rglob("*") if path.is_file() and not path.name.startswith(RECORD_FILE))
    return {path.relative_to(place).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def record_checksum(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def _standard(place: Path) -> dict[str, Any]:
    with ocp.StandardCheckpointer(multiprocessing_options=_alone()) as checkpointer:
        return jax.tree.map(np.asarray, checkpointer.restore(place))


def drop_checkpoints(folder: Path, after: int) -> None:
    """Remove checkpoints after a step, and all that are damaged or half-written, over which orbax would stumble."""

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


def checkpoint_manager(folder: Path) -> ocp.CheckpointManager:
    best = policies.BestN(get_metric_fn=_score, reverse=True, n=1, keep_checkpoints_without_metrics=False)
    options = ocp.CheckpointManagerOptions(
        best_fn=_score,
        best_mode="min",
        preservation_policy=policies.AnyPreservationPolicy([policies.LatestN(KEPT), best]),
        enable_async_checkpointing=False,
        create=False,
        multiprocessing_options=_alone(),
    )
    place = (folder / CHECKPOINTS_FOLDER).resolve()
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
def quiet_when_full(manager: ocp.CheckpointManager) -> Iterator[None]:
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
