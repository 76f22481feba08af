"""Robots by name or file."""

from __future__ import annotations

import functools
from pathlib import Path

from ballu_mjx.common.errors import InputError
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.robots.model import assets

DEFAULT_ROBOT = "ballu"
"""The robot of commands without `--robot`, and of runs whose configuration names none."""
_ENDING = ".robot.json"


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


def _file(name: str) -> Path:
    path = Path(name)
    if not path.suffix and not path.exists():
        known = ", ".join(bundled_robots())
        raise InputError(f"--robot {name}: there is no robot of this name; there is {known}, or give a .robot.json.")
    return path
