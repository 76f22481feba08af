"""Robots by name or file."""

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
"""The robot of commands without `--robot`, and of runs whose configuration names none."""
BUNDLED = "bundled:"
"""Begins the path of a file that comes with the package."""
_ENDING = ".robot.json"
_LONGEST_PATH = 300
_MOST_NAMED = 3
"""Files that have changed, in a message."""


def load_robot(robot: str | Path = DEFAULT_ROBOT) -> RobotDescription:
    """Return the robot of a name (one that comes with the package) or of a description file.

    **Raises** `InputError` where there is no such robot, or its description is at fault.
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
    """Return what files say of the robot that they are of: path of its description, and hashes of all and of each
    file."""
    files = file_checksums(robot.file, robot.model)
    return {"path": portable_path(robot.file, assets()), "sha256": robot.sha256, "files": files}


def find_robot(described: Mapping[str, Any], named_in: Path) -> RobotDescription:
    """Return the robot that `describe_robot` described in the file `named_in`.

    **Raises** `InputError` where its description is gone, has changed, or its model has.
    """
    fix = f"restore it: {named_in} names it"
    if not isinstance(described, Mapping) or not all(isinstance(described.get(key), str) for key in ("path", "sha256")):
        raise InputError(f"{named_in}: does not say of which robot it is; restore it.")
    stored, there = described["path"], False
    path = assets() / stored.removeprefix(BUNDLED) if stored.startswith(BUNDLED) else Path(stored)
    with contextlib.suppress(OSError, ValueError):  # a name that no file can have
        there = path.is_file()
    if not there:
        shown = stored if len(stored) < _LONGEST_PATH else stored[:_LONGEST_PATH] + "..."
        raise InputError(f"{shown}: the robot description is gone; {fix}.")
    found = read_description(path)
    if found.sha256 != described["sha256"]:
        problem = f"the robot description, or its model, has changed since {named_in} was written"
        raise InputError(f"{path}: {problem}{_name_changes(described.get('files'), found)}; restore it.")
    return found


def _name_changes(stored: Any, robot: RobotDescription) -> str:
    """Which files differ from what `describe_robot` stored of them; nothing where it stored none."""
    if not isinstance(stored, Mapping):
        return ""
    now = file_checksums(robot.file, robot.model)
    names = sorted(str(name) for name in stored.keys() | now.keys() if stored.get(name) != now.get(name))
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    shown = ", ".join(names[:_MOST_NAMED])[:_LONGEST_PATH]
    return f" ({shown}{more})" if names else ""


def portable_path(path: Path, bundled: Path) -> str:
    """Return where a file lies; of one below the folder `bundled`, independently of the installation."""
    absolute, bundled = path.resolve(), bundled.resolve()
    return BUNDLED + absolute.relative_to(bundled).as_posix() if absolute.is_relative_to(bundled) else str(absolute)


def _file(name: str) -> Path:
    path = Path(name)
    if not path.suffix and not path.exists():
        known = ", ".join(bundled_robots())
        raise InputError(f"--robot {name}: there is no robot of this name; there is {known}, or give a .robot.json.")
    return path
