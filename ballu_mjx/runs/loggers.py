"""Loggers of a run's measurements: JSON lines and TensorBoard always, Weights & Biases on request."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import math
import time
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from ballu_mjx.common import files, runtime
from ballu_mjx.common.errors import InputError

_WANDB_ID = "wandb-id.txt"


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoggingOptions(runtime.CommandOptions):
    """Options of every training command."""

    wandb: str | None = None
    """Weights & Biases project to log to as well (needs the extra wandb). WANDB_MODE=offline keeps the log on this
    machine."""


class Logger(Protocol):
    """Interface of loggers."""

    def log(self, step: int, metrics: Mapping[str, float | int]) -> None:
        """Log measurements at `step`, by name. Steps must not decrease."""

    def close(self, *, failed: bool = False) -> None:
        """Write the rest and close. `failed`: an error ended the run."""


class JsonLines:
    """Logger that writes one JSON object per line: `step` and the measurements. Non-finite numbers are null."""

    def __init__(self, path: Path) -> None:
        """Append to `path`."""
        self._file = path.open("a", encoding="utf-8")

    def log(self, step: int, metrics: Mapping[str, float | int]) -> None:
        row = {"step": step, **{name: value if math.isfinite(value) else None for name, value in metrics.items()}}
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()

    def close(self, *, failed: bool = False) -> None:
        self._file.close()


class TensorBoard:
    """Logger that writes finite measurements to event files of TensorBoard.

    It writes at once, without tensorboardX's thread. A full disk ends that thread, and the next write would then wait
    forever.
    """

    def __init__(self, folder: Path, first_step: int | None = None) -> None:
        """Write into `folder`. `first_step`: first step of a resumed run; older events from this step on are hidden."""
        # This import loads PyTorch if it is installed, which takes most of a second. Commands without a log skip it.
        from tensorboardX import summary
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto import event_pb2

        folder.mkdir(parents=True, exist_ok=True)
        self._scalar, self._event = summary.scalar, event_pb2.Event  # pyright: ignore[reportAttributeAccessIssue]
        self._writer = EventsWriter(str(folder / "events"))
        if first_step is not None:
            status = event_pb2.SessionLog.START  # pyright: ignore[reportAttributeAccessIssue]
            self._write(first_step, session_log={"status": status})

    def log(self, step: int, metrics: Mapping[str, float | int]) -> None:
        for name, value in _finite(metrics).items():
            self._write(step, summary=self._scalar(name, value))
        self._writer.flush()

    def _write(self, step: int, **content: Any) -> None:
        self._writer.write_event(self._event(wall_time=time.time(), step=step, **content))

    def close(self, *, failed: bool = False) -> None:
        self._writer.close()


class WeightsAndBiases:
    """Logger to a run in a project of Weights & Biases.

    A resumed run continues its run there. Repeated measurements, at steps that are there already, are ignored.
    """

    def __init__(self, project: str, folder: Path, config: Mapping[str, Any]) -> None:
        """Start or continue the run, with local files in the run's `folder`.

        **Raises** `InputError` if Weights & Biases refuses, since nobody is logged in or there is no network.
        """
        import wandb  # an extra, and slow to import

        path = folder / _WANDB_ID
        if not path.exists():
            files.write(path, uuid.uuid4().hex)
        try:
            self._run = wandb.init(
                project=project,
                name=folder.name,
                id=files.read_text(path),
                resume="allow",
                dir=folder,
                config=dict(config),
            )
        except wandb.Error as error:
            said = " ".join(str(error).split()).rstrip(".")
            raise InputError(f"--wandb {project}: {said}; run `wandb login`, or set WANDB_MODE=offline.") from error

    def log(self, step: int, metrics: Mapping[str, float | int]) -> None:
        self._run.log(_finite(metrics), step=step)

    def close(self, *, failed: bool = False) -> None:
        self._run.finish(exit_code=int(failed))


def check(project: str | None) -> None:
    """Check that the package wandb is installed if a `project` of Weights & Biases is given.

    **Raises** `InputError` if it is missing.
    """
    if project is not None and importlib.util.find_spec("wandb") is None:
        raise InputError(
            f"--wandb {project}: the package wandb is not installed; run "
            '`pip install -c constraints.txt -e ".[wandb]"`, or leave this option out.'
        )


def _finite(metrics: Mapping[str, float | int]) -> dict[str, float]:
    return {name: float(value) for name, value in metrics.items() if math.isfinite(value)}
