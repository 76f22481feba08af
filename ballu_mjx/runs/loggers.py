"""Where the measurements of a run go: JSON lines and TensorBoard always, Weights & Biases on demand."""

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
    """Options of every training."""

    wandb: str | None = None
    """Project of Weights & Biases to log to as well (extra wandb); WANDB_MODE=offline keeps it on this machine."""


class Logger(Protocol):
    """A place for measurements."""

    def log(self, step: int, metrics: Mapping[str, float | int]) -> None:
        """Add what was measured at `step`, by name; steps do not decrease."""

    def close(self, *, failed: bool = False) -> None:
        """Write the rest; `failed` where an error ended the run."""


class JsonLines:
    """One JSON object a line: `step`, and the measurements; null for what is no finite number."""

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
    """Event files, of what is finite. Written at once, and not by tensorboardX's thread: a full disk kills that, and
    whoever writes next waits for ever."""

    def __init__(self, folder: Path, first_step: int | None = None) -> None:
        """Write into `folder`; `first_step` of a run that goes on: what is there from that step on is hidden."""
        # Brings PyTorch along where that is installed: most of a second that commands without a log need not wait.
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
    """A run of a project of Weights & Biases.

    A run that is opened again goes on there too; what it measures again, at steps that are there already, is ignored.
    """

    def __init__(self, project: str, folder: Path, config: Mapping[str, Any]) -> None:
        """Begin, with the local files in the run's `folder`.

        **Raises** `InputError` where Weights & Biases refuses: nobody is logged in, or there is no network.
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
    """**Raises** `InputError` where there is a project of Weights & Biases, and the package to log to it is missing."""
    if project is not None and importlib.util.find_spec("wandb") is None:
        raise InputError(
            f'--wandb {project}: the package wandb is not installed; `pip install "ballu-mjx[wandb]"`, or leave it out.'
        )


def _finite(metrics: Mapping[str, float | int]) -> dict[str, float]:
    return {name: float(value) for name, value in metrics.items() if math.isfinite(value)}
