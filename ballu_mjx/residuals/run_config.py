"""What a run's `config.json` says of robot, actuators, residual and recordings."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import hashlib
import importlib.metadata
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # Windows, where runs are not locked
    fcntl = None


from ballu_mjx.ballu.actuators_file import actuators_from_json, actuators_to_json
from ballu_mjx.ballu.model import ActuatorParameters
from ballu_mjx.common.errors import InputError
from ballu_mjx.robots.description import RobotDescription, ballu, read_description
from ballu_mjx.robots.model import assets
from ballu_mjx.runs.folder import config_section
from ballu_mjx.runs.layout import CONFIG_FILE, RUN_FORMAT

_BUNDLED = "bundled:"
_LONGEST_PATH = 300
_PACKAGES = ("ballu-mjx", "jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "optimistix", "numpy")


def run_actuators(config: Mapping[str, Any], folder: Path) -> ActuatorParameters | None:
    """The actuators of a run's simulator; None for the nominal ones.

    **Raises** `InputError` where they are damaged.
    """
    stored = config_section(config, "actuators", folder)
    return None if stored is None else actuators_from_json(stored, folder / CONFIG_FILE)


def run_robot(config: Mapping[str, Any], folder: Path) -> RobotDescription:
    """The robot of a run; BALLU where it names none.

    **Raises** `InputError` where its description is gone, has changed, or its model has.
    """
    stored = config.get("robot_description")
    if stored is None:
        return ballu()
    mend = f"restore it: {folder / CONFIG_FILE} names it"
    there, path = False, Path(stored["path"])
    with contextlib.suppress(OSError, ValueError):  # a name that no file can have
        there = path.is_file()
    if not there:
        raise InputError(f"{_cut(stored['path'])}: the robot description is gone; {mend}.")
    found = read_description(path)
    if found.sha256 != stored["sha256"]:
        raise InputError(f"{path}: the robot description, or its model, has changed since the run began; {mend}.")
    return found


def run_residual(config: Mapping[str, Any], folder: Path) -> Path | None:
    """The run of the residual in a run's simulator; None where there is none.

    **Raises** `InputError` where the key is missing.
    """
    stored = config_section(config, "residual", folder)
    return None if stored is None else Path(stored)


def describe_run(
    task: str,
    sections: Mapping[str, Any],
    recordings: Mapping[str, Sequence[Path]],
    devices: Sequence[str],
    identified: ActuatorParameters | None = None,
    description: RobotDescription | None = None,
) -> dict[str, Any]:
    """What `config.json` holds: `sections` are configurations (dataclasses) by name, `recordings` files by use,
    `identified` the simulator's actuators where they are not the nominal ones, `description` the robot where it is not
    BALLU."""
    other = description is not None and description.sha256 != ballu().sha256
    return {
        "format": RUN_FORMAT,
        "task": task,
        **{name: dataclasses.asdict(section) for name, section in sections.items()},
        "actuators": None if identified is None else actuators_to_json(identified),
        "recordings": {use: [describe_recording(path) for path in paths] for use, paths in recordings.items()},
        **({"robot_description": _described(description)} if description is not None and other else {}),
        "starts": [
            {
                "time": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
                "command": list(sys.argv),
                "python": sys.version.split()[0],
                "versions": {name: _version(name) for name in _PACKAGES},
                "devices": list(devices),
            }
        ],
    }


def describe_recording(path: Path) -> dict[str, str]:
    """Where a recording lies (bundled ones independently of the installation), and the SHA-256 of its content."""
    bundled = (assets() / "recordings").resolve()
    absolute = path.resolve()
    inside = absolute.is_relative_to(bundled)
    place = _BUNDLED + absolute.relative_to(bundled).as_posix() if inside else str(absolute)
    return {"path": place, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


def find_recordings(config: Mapping[str, Any], use: str, folder: Path) -> list[Path]:
    """The files that `describe_recording` described under `use`.

    **Raises** `InputError` where one is missing or has changed.
    """
    paths = []
    described = config_section(config, "recordings", folder).get(use)
    if not described:
        raise InputError(f"{folder / CONFIG_FILE}: names no recordings for {use}; give some by options.")
    for entry in described:
        place = entry["path"]
        path, there = Path(place), False
        if place.startswith(_BUNDLED):
            path = assets() / "recordings" / place.removeprefix(_BUNDLED)
        with contextlib.suppress(OSError):  # a name that no file can have
            there = path.is_file()
        if not there:
            raise InputError(
                f"{_cut(place)}: the recording, which {folder / CONFIG_FILE} names, is gone; restore it or give "
                "--recordings."
            )
        if describe_recording(path)["sha256"] != entry["sha256"]:
            raise InputError(
                f"{path}: the recording has changed since {folder / CONFIG_FILE} was written; restore it, or give it "
                "by --recordings to use it as it is."
            )
        paths.append(path)
    return paths


def _described(description: RobotDescription) -> dict[str, str]:
    return {"path": str(description.file.resolve()), "sha256": description.sha256}


def _cut(place: str) -> str:
    return place if len(place) < _LONGEST_PATH else place[:_LONGEST_PATH] + "..."


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
