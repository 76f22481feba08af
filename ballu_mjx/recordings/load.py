"""Loading of recordings by the name of a bundled set, or by file and folder."""

from __future__ import annotations

import typing
from collections.abc import Iterable
from pathlib import Path

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.csv_format import list_bundled, list_recordings, read_recording
from ballu_mjx.recordings.recording import Recording, Split
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.registry import load_robot

BUNDLED_SETS: tuple[str, ...] = typing.get_args(Split)
"""Names of the sets of recordings in the package."""


def load_recordings(source: str | Path | Iterable[str | Path], robot: RobotDescription) -> list[Recording]:
    """Return the recordings of `robot` in a bundled set, or in files and folders.

    `source`: one of `BUNDLED_SETS` (training, validation, test, suspended), a path, or several paths. A path is a
    recording (`.csv` or `.csv.gz`) or a folder of recordings, which are sorted by name.

    **Raises** `InputError` that names file and fix, if there is no recording or one cannot be used.
    """
    if isinstance(source, str) and source in BUNDLED_SETS:
        paths = bundled_recordings(typing.cast(Split, source), robot)
    else:
        paths = list_recordings([source] if isinstance(source, str | Path) else source)
    if not paths:
        raise InputError("No recording is given; name files or folders.")
    return [read_recording(path, robot) for path in paths]


def bundled_recordings(split: Split, robot: RobotDescription) -> list[Path]:
    """Return the files of a bundled set.

    **Raises** `InputError` if the bundled recordings are not of `robot`.
    """
    own = load_robot()
    if robot.sha256 != own.sha256:
        raise InputError(
            f"{robot.file}: the bundled recordings are of {own.name}; give recordings of {robot.name} by --recordings."
        )
    return list_bundled(split)
