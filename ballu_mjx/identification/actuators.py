"""Identification of any robot's actuators, by its adapter's method or from declared parameters, and the result files.

A robot whose adapter has a method uses the adapter's file format too. Any robot whose description declares `identify`
can use the format `ballu-identified/1` (`identification.write_back`).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.identification.parameters import IdentifiedParameters
from ballu_mjx.identification.write_back import IDENTIFIED_FORMAT, identified_from_json, identified_to_json
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.adapter import IdentificationProgress, IdentifiedActuators, RobotAdapter
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters

ACTUATORS_FILE = "actuators.json"
"""Name of the file of a robot's identified actuators beside its recordings."""

AUTO, NOMINAL = Path("auto"), Path("nominal")
"""Further values of options that take a file of identified actuators."""


def identify_actuators(
    recordings: Sequence[Recording] | Mapping[Path, Recording],
    robot: RobotDescription,
    config: Any = None,
    *,
    levels: int | None = None,
    progress: IdentificationProgress | None = None,
) -> IdentifiedActuators:
    """Identify the actuators of `robot`, by its adapter's method or from the parameters that its description declares.

    **Arguments**

    - `recordings`: recordings of one robot; suspended ones for an adapter's method. With a mapping from files, error
      messages name the files.
    - `config`: options of the method: `fit_robot.FitConfig` for declared parameters,
      `ballu.leg_parameters.IdentificationConfig` for BALLU. None: its defaults.
    - `levels`: smallest number of command levels of each actuator. None: the method's default.
    - `progress`: called at every iteration.

    **Raises** `InputError` if the recordings cannot be used, or if this robot's actuators cannot be identified.
    """
    by_file = recordings if isinstance(recordings, Mapping) else _by_name(recordings)
    if not by_file:
        raise InputError("There are no recordings to identify actuators from; give some.")
    if declares_parameters(robot):
        from ballu_mjx.identification.declared import identify_declared  # slow to import

        return identify_declared(by_file, robot, config, progress=progress)
    return robot.adapter.identify_actuators(robot, by_file, config, levels, progress)


def has_own_method(robot: RobotDescription) -> bool:
    """Return whether the robot's adapter has a method that identifies its actuators."""
    return type(robot.adapter).identify_actuators is not RobotAdapter.identify_actuators


def declares_parameters(robot: RobotDescription) -> bool:
    """Return whether identification fits the parameters that the robot's description declares."""
    return bool(robot.identify) and not has_own_method(robot)


def read_actuators(robot: RobotDescription, path: Path) -> tuple[str, ModelParameters]:
    """Read a file of identified actuators, and return the specimen's name and the parameters.

    **Raises** `InputError` if this robot's actuators cannot be identified, or if the file is damaged. The message names
    the file, the parameter and the fix.
    """
    if path.is_dir():
        raise InputError(f"{path}: this is a folder; give the file {ACTUATORS_FILE} of a run of `train sysid`.")
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; `python -m ballu_mjx.train sysid` writes one.")
    if robot.identify:
        content = files.read_json(path, "restore it or identify again")
        if content.get("format") == IDENTIFIED_FORMAT or not has_own_method(robot):
            return str(content.get("robot")), identified_from_json(content, path, robot)
    return robot.adapter.read_actuators(robot, path)


class Validation(NamedTuple):
    """Comparison of identified and nominal actuators on the validation recordings of the identification."""

    improves: bool
    """Whether the identified actuators replay them better."""
    ratio: float | None
    """Identified over nominal error. None if more replays diverge with the identified actuators."""


def read_validation(path: Path) -> Validation | None:
    """Return the comparison that a file of identified actuators contains. None if it contains none."""
    found = files.read_json(path, "restore it or identify again").get("validation")
    if not isinstance(found, dict) or not isinstance(found.get("improves"), bool):
        return None
    ratio = found.get("ratio")
    return Validation(found["improves"], float(ratio) if ratio is not None and is_number(ratio) else None)


def find_actuators(robot: RobotDescription, recordings: Iterable[Path], specimen: str) -> Path | None:
    """Return the file of a specimen's identified actuators, from the folder of its recordings or the folder above.

    None if there is no file, or if this robot's actuators cannot be identified.

    **Raises** `InputError` if a file there is damaged.
    """
    if not (robot.identify or has_own_method(robot)):
        return None
    for folder in dict.fromkeys(folder for path in recordings for folder in (path.parent, path.parent.parent)):
        path = folder / ACTUATORS_FILE
        if path.is_file() and read_actuators(robot, path)[0] == specimen:
            return path
    return None


def actuators_to_json(robot: RobotDescription, parameters: ModelParameters) -> dict[str, Any]:
    """Return identified parameters as JSON types, for `actuators_from_json`."""
    if isinstance(parameters, IdentifiedParameters):
        return json.loads(identified_to_json(robot, parameters))
    return robot.adapter.actuators_to_json(parameters)


def actuators_from_json(robot: RobotDescription, values: Mapping[str, Any], path: Path) -> ModelParameters:
    """Return the parameters from the `values` that `actuators_to_json` made; `path` is the file with the values.

    **Raises** `InputError` naming the file, the parameter and the fix.
    """
    if values.get("format") == IDENTIFIED_FORMAT:
        return identified_from_json(values, path, robot)
    return robot.adapter.actuators_from_json(robot, values, path)


def _by_name(recordings: Sequence[Recording]) -> dict[Path, Recording]:
    """Return recordings by name.

    **Raises** `InputError` if two have the same name.
    """
    found: dict[Path, Recording] = {}
    for each in recordings:
        if found.setdefault(Path(each.name), each) is not each:
            raise InputError(f"Two recordings have the name {each.name}; give a mapping from their files instead.")
    return found
