"""Robot, actuators, residual and recordings in a run's `config.json`."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import hashlib
import reprlib
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
    """Return the identified actuators of a run's simulator. None if they are nominal.

    **Raises** `InputError` if the entry in `config.json` is damaged.
    """
    stored = config_section(config, "actuators", folder)
    return None if stored is None else actuators_from_json(robot, stored, folder / CONFIG_FILE)


def run_robot(config: Mapping[str, Any], folder: Path) -> RobotDescription:
    """Return the robot of a run, or the default robot if `config.json` names none.

    **Raises** `InputError` if the robot's description is missing, or if its description or its model has changed.
    """
    stored = config.get("robot_description")
    return load_robot() if stored is None else find_robot(stored, folder / CONFIG_FILE)


def check_compatible_robot(
    robot: RobotDescription, own: RobotDescription, config: Mapping[str, Any], folder: Path
) -> None:
    """Check that a residual that was learned for the robot `own` of a run can act on `robot`.

    `config` is the content of the run's `config.json`.

    **Raises** `InputError` if the robots differ in a quantity of a residual's input or loads. The message names it.
    """
    mirrored = config.get("env", {}).get("mirror", False)  # only networks have the section
    for name, words in (_SHARED | (_MIRRORED if mirrored else {})).items():
        one, other = getattr(robot, name), getattr(own, name)
        if one != other:
            shown = [reprlib.repr(dict(x) if isinstance(x, Mapping) else x) for x in (one, other)]
            raise InputError(
                f"{robot.file}: cannot stand in for {own.name}, the robot of {folder}: its {words} differ ({shown[0]} "
                f"instead of {shown[1]}); give a robot whose model differs in numbers only."
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
"""Fields of the description that determine inputs and loads of residuals, with their names in messages."""
_MIRRORED = {"mirror": "mirror images"}
"""The same for symmetric networks alone."""


class ResidualReference(NamedTuple):
    """Run whose residual is in the simulator of another run."""

    folder: Path
    step: int | None = None
    """Step of its checkpoint. None for the best one."""
    sha256: str | None = None
    """Checksum of its parameters (`TrainedResidual.sha256`). None to accept any."""
    user: Path | None = None
    """The other run, for messages."""

    @staticmethod
    def chosen(folder: Path | None) -> ResidualReference | None:
        """Return the best residual of the run that the user chose. None if there is none."""
        return None if folder is None else ResidualReference(folder)


def run_residual(config: Mapping[str, Any], folder: Path) -> ResidualReference | None:
    """Return the residual in a run's simulator. None if the simulator has no residual.

    **Raises** `InputError` if `config.json` lacks the key.
    """
    stored = config_section(config, "residual", folder)
    if stored is None:
        return None
    step, sha256 = (config.get(f"residual_{name}") for name in ("step", "sha256"))  # older versions lack them
    return ResidualReference(Path(stored), step, sha256, folder)


def describe_run(
    task: str,
    sections: Mapping[str, Any],
    recordings: Mapping[str, Sequence[Path]],
    devices: Sequence[str],
    identified: ModelParameters | None = None,
    description: RobotDescription | None = None,
) -> dict[str, Any]:
    """Return the content of a run's `config.json`.

    **Arguments**

    - `task`: name of the task.
    - `sections`: configurations (dataclasses) by name.
    - `recordings`: files of recordings by use.
    - `devices`: names of the devices of the run.
    - `identified`: identified actuators of the simulator. None if they are nominal.
    - `description`: the robot. None for the default robot.
    """
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
    """Return the path of a recording, and the SHA-256 of its content and of the JSON beside it.

    The path of a bundled recording does not depend on the place of the installation.
    """
    place, sidecar = portable_path(path, assets() / "recordings"), sidecar_path(path)
    described = sidecar.read_bytes() if sidecar.is_file() else b""
    return {"path": place, "sha256": hashlib.sha256(path.read_bytes() + b"\0" + described).hexdigest()}


def find_recordings(config: Mapping[str, Any], use: str, folder: Path, option: str) -> list[Path]:
    """Return the recordings that a run's `config.json` names under `use`. `option` is the option for other recordings.

    **Raises** `InputError` if a recording is missing or has changed.
    """
    paths = []
    described = config_section(config, "recordings", folder).get(use)
    if not described:
        raise InputError(f"{folder / CONFIG_FILE}: names no recordings for {use}; give some by {option}.")
    for entry in described:
        place = entry["path"]
        path, there = Path(place), False
        if place.startswith(BUNDLED):
            path = assets() / "recordings" / place.removeprefix(BUNDLED)
        with contextlib.suppress(OSError):  # The file system may not allow this name.
            there = path.is_file()
        if not there:
            raise InputError(
                f"{_cut(place)}: the recording is missing, but {folder / CONFIG_FILE} names it; restore it or give "
                f"{option}."
            )
        if describe_recording(path)["sha256"] != entry["sha256"]:
            raise InputError(
                f"{path}: the recording has changed since {folder / CONFIG_FILE} was written; restore it, or give it "
                f"by {option} to use it as it is."
            )
        paths.append(path)
    return paths


def _cut(place: str) -> str:
    return place if len(place) < _LONGEST_PATH else place[:_LONGEST_PATH] + "..."
