"""What a run's `config.json` says of robot, actuators, residual and recordings."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import hashlib
import reprlib
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ballu_mjx.common import provenance
from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.actuators import actuators_from_json, actuators_to_json
from ballu_mjx.recordings.csv_format import sidecar_path
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters, assets
from ballu_mjx.robots.registry import BUNDLED, describe_robot, find_robot, load_robot, portable_path
from ballu_mjx.runs.folder import config_section
from ballu_mjx.runs.layout import CONFIG_FILE, RUN_FORMAT

_LONGEST_PATH = 300


def run_actuators(config: Mapping[str, Any], folder: Path, robot: RobotDescription) -> ModelParameters | None:
    """The actuators of a run's simulator; None for the nominal ones.

    **Raises** `InputError` where they are damaged.
    """
    stored = config_section(config, "actuators", folder)
    return None if stored is None else actuators_from_json(robot, stored, folder / CONFIG_FILE)


def run_robot(config: Mapping[str, Any], folder: Path) -> RobotDescription:
    """The robot of a run; the default one where it names none.

    **Raises** `InputError` where its description is gone, has changed, or its model has.
    """
    stored = config.get("robot_description")
    return load_robot() if stored is None else find_robot(stored, folder / CONFIG_FILE)


def check_stands_in(robot: RobotDescription, own: RobotDescription, folder: Path) -> None:
    """Check that what was learned for the robot `own` of a run can act on another model.

    **Raises** `InputError` where the two differ in what residuals see or act on, naming it.
    """
    for name, words in _SHARED.items():
        one, other = getattr(robot, name), getattr(own, name)
        if one != other:
            shown = [reprlib.repr(dict(x) if isinstance(x, Mapping) else x) for x in (one, other)]
            raise InputError(
                f"{robot.file}: cannot stand in for {own.name}, the robot of {folder}: its {words} differ ({shown[0]}, "
                f"there {shown[1]}); give a model that differs in its numbers only."
            )


_SHARED = {
    "tracked": "tracked site",
    "points": "points",
    "commands": "commands",
    "command_ranges": "commands' ranges",
    "control_timestep": "control time step",
    "anchored": "root joint",
    "directions": "directions of motion",
    "force_joints": "joints that forces act along",
}
"""What residuals see and act on, by the description's field."""


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
    identified: ModelParameters | None = None,
    description: RobotDescription | None = None,
) -> dict[str, Any]:
    """What `config.json` holds: `sections` are configurations (dataclasses) by name, `recordings` files by use,
    `identified` the simulator's actuators where they are not the nominal ones, `description` the robot (None: the
    default one)."""
    description = description or load_robot()
    return {
        "format": RUN_FORMAT,
        "task": task,
        **{name: dataclasses.asdict(section) for name, section in sections.items()},
        "actuators": None if identified is None else actuators_to_json(description, identified),
        "recordings": {use: [describe_recording(path) for path in paths] for use, paths in recordings.items()},
        "robot_description": describe_robot(description),
        "starts": [
            {
                "time": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
                "command": list(sys.argv),
                "commit": provenance.source_commit(),
                "machine": provenance.describe_machine(),
                "versions": provenance.package_versions(),
                "devices": list(devices),
            }
        ],
    }


def describe_recording(path: Path) -> dict[str, str]:
    """Where a recording lies (bundled ones independently of the installation), and the SHA-256 of its content and of
    the JSON beside it."""
    place, sidecar = portable_path(path, assets() / "recordings"), sidecar_path(path)
    described = sidecar.read_bytes() if sidecar.is_file() else b""
    return {"path": place, "sha256": hashlib.sha256(path.read_bytes() + b"\0" + described).hexdigest()}


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
        if place.startswith(BUNDLED):
            path = assets() / "recordings" / place.removeprefix(BUNDLED)
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


def _cut(place: str) -> str:
    return place if len(place) < _LONGEST_PATH else place[:_LONGEST_PATH] + "..."
