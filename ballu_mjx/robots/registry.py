"""Robots, loaded by name or from a description file."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ballu_mjx.common.errors import InputError
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.robots.description_model import file_checksums
from ballu_mjx.robots.model import assets

DEFAULT_ROBOT = "ballu"
"""Robot of commands without `--robot`, and of runs whose configuration names no robot."""
BUNDLED = "bundled:"
"""Prefix of the path of a file that comes with the package."""
_ENDING = ".robot.json"
_LONGEST_PATH = 300
_MOST_NAMED = 3
"""Largest number of changed files that a message names."""


def load_robot(robot: str | Path = DEFAULT_ROBOT) -> RobotDescription:
    """Load a robot by its name, if it comes with the package, or from a description file.

    **Raises** `InputError` if the robot does not exist, or if its description is invalid.
    """
    name = str(robot)
    return _bundled(name) if name in bundled_robots() else read_description(_file(name))


def bundled_robots() -> tuple[str, ...]:
    """Return the names of the robots that come with the package."""
    return tuple(sorted(path.name.removesuffix(_ENDING) for path in assets().glob(f"*{_ENDING}")))


@functools.cache
def _bundled(name: str) -> RobotDescription:
    return read_description(assets() / f"{name}{_ENDING}")


def describe_robot(robot: RobotDescription) -> dict[str, Any]:
    """Return the entry that identifies a robot in files of results: the path of its description, one SHA-256 of all its
    files, and the SHA-256 of each file."""
    files = file_checksums(robot.file, robot.model)
    return {"path": portable_path(robot.file, assets()), "sha256": robot.sha256, "files": files}


def find_robot(described: Mapping[str, Any], named_in: Path) -> RobotDescription:
    """Return the robot that `describe_robot` described in the file `named_in`.

    **Raises** `InputError` if the entry is damaged, if the description is missing, or if the description or its model
    has changed.
    """
    fix = f"restore it, because {named_in} refers to it"
    if not isinstance(described, Mapping) or not all(isinstance(described.get(key), str) for key in ("path", "sha256")):
        raise InputError(f"{named_in}: the entry of its robot is missing or damaged; restore the file.")
    stored, there = described["path"], False
    path = assets() / stored.removeprefix(BUNDLED) if stored.startswith(BUNDLED) else Path(stored)
    with contextlib.suppress(OSError, ValueError):  # the name is not a valid path
        there = path.is_file()
    if not there:
        shown = stored if len(stored) < _LONGEST_PATH else stored[:_LONGEST_PATH] + "..."
        raise InputError(f"{shown}: the robot description is missing; {fix}.")
    found = read_description(path)
    if found.sha256 != described["sha256"]:
        problem = f"the robot description, or its model, has changed since {named_in} was written"
        raise InputError(f"{path}: {problem}{_name_changes(described.get('files'), found)}; restore it.")
    return found


def _name_changes(stored: Any, robot: RobotDescription) -> str:
    """Return the names of files whose stored hash differs, in words. Empty if no hashes of single files are stored."""
    if not isinstance(stored, Mapping):
        return ""
    now = file_checksums(robot.file, robot.model)
    names = sorted(str(name) for name in stored.keys() | now.keys() if stored.get(name) != now.get(name))
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    shown = ", ".join(names[:_MOST_NAMED])[:_LONGEST_PATH]
    return f" ({shown}{more})" if names else ""


def portable_path(path: Path, bundled: Path) -> str:
    """Return the absolute path of a file. Below the folder `bundled`, return `BUNDLED` and the relative path."""
    absolute, bundled = path.resolve(), bundled.resolve()
    return BUNDLED + absolute.relative_to(bundled).as_posix() if absolute.is_relative_to(bundled) else str(absolute)


def _file(name: str) -> Path:
    path = Path(name)
    if not path.suffix and not path.exists():
        known = ", ".join(bundled_robots())
        raise InputError(f"--robot {name}: no bundled robot has this name; give one of {known}, or a .robot.json file.")
    return path
