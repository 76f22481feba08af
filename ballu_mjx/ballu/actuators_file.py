"""Files of identified actuators in the format `ballu-actuators/2`, which `train sysid` writes and `--actuators` reads.

A file is a JSON object with these keys:

- `format`: the name of the format.
- `robot`: the name of the robot in its recordings.
- `parameters`: fields of `actuators.ActuatorParameters` as [left, right], in SI units and radians. `cable_slack` and
  the fields that may be None may be missing. The nominal robot's values are then used.
- `standard_errors` (optional): standard errors in the same form.
- `source` (optional): the recordings.
- Further keys are ignored, so users may add their own.

Files of `ballu-actuators/1` have at most the first six fields.
"""

from __future__ import annotations

import dataclasses
import json
import math
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ballu_mjx.ballu.actuators import CABLE_SLACK, ActuatorParameters
from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number

ACTUATORS_FORMAT = "ballu-actuators/2"
_READ = ("ballu-actuators/1", ACTUATORS_FORMAT)
_FIELDS = tuple(field.name for field in dataclasses.fields(ActuatorParameters))
_OPTIONAL = tuple(f.name for f in dataclasses.fields(ActuatorParameters) if f.default is None)
_POSITIVE = ("knee_spring_stiffness", "motor_gain", "torque_limit", "motor_travel", "cable_stiffness")
_NOT_NEGATIVE = ("knee_damping", "knee_friction", "motor_friction", "delay", "lag", "backlash")
_ANGLES = ("default_motor_angle", "default_knee_angle", "knee_spring_reference", "backlash")
_LARGEST_ANGLE = math.pi
_LARGEST_SLACK = 0.05
"""Largest cable slack (m), more than a motor arm of 16 mm can take up."""
_SMALLEST, _LARGEST = 1e-9, 1e3
"""Bounds (SI units) of springs, gains and torques. No robot of 0.3 kg has values outside them."""
_LARGEST_STIFFNESS = 1e6
"""Largest cable stiffness (N/m)."""
_LONGEST_DELAY = 1.0
"""Longest delay or lag (s)."""


def write_actuators(path: Path, robot: str, parameters: ActuatorParameters, more: Mapping[str, Any]) -> None:
    """Write a file with the `parameters` of the robot named `robot`, and with the further keys of `more`."""
    content = {"format": ACTUATORS_FORMAT, "robot": robot, "parameters": actuators_to_json(parameters), **more}
    files.write(path, json.dumps(content, indent=2) + "\n")


def read_actuators(path: Path) -> tuple[str, ActuatorParameters]:
    """Return the robot's name and its parameters from a file.

    **Raises** `InputError` that names the file, the key and the fix.
    """
    if not path.exists():
        raise InputError(f"{path}: there is no such file; `python -m ballu_mjx.train sysid` writes one.")
    content = files.read_json(path, "restore it or identify again")
    if content.get("format") not in _READ:
        raise InputError(f'{path}: "format" is not "{ACTUATORS_FORMAT}"; give a file that `train sysid` wrote.')
    if not isinstance(content.get("robot"), str) or not content["robot"].strip():
        raise InputError(f'{path}: "robot" must be the name of the robot in its recordings.')
    if not isinstance(content.get("parameters"), dict):
        raise InputError(f'{path}: "parameters" is missing; give a file that `train sysid` wrote.')
    return content["robot"], actuators_from_json(content["parameters"], path)


def actuators_to_json(parameters: ActuatorParameters) -> dict[str, list[float]]:
    """Return pairs [left, right] by name, without the parameters that are None."""
    known = {name: getattr(parameters, name) for name in _FIELDS}
    return {name: [float(f"{x:.6g}") for x in np.asarray(v)] for name, v in known.items() if v is not None}


def actuators_from_json(values: Mapping[str, Any], path: Path) -> ActuatorParameters:
    """Return the inverse of `actuators_to_json`.

    **Raises** `InputError` that names `path`, the parameter and the fix.
    """
    pairs = {}
    for name in _FIELDS:
        if name in _OPTIONAL and name not in values:
            continue
        pair = values.get(name, [CABLE_SLACK] * 2 if name == "cable_slack" else None)
        if not (isinstance(pair, list) and len(pair) == 2 and all(is_number(x) for x in pair)):
            raise InputError(f"{path}: {name} must be two numbers, [left, right]; it is {reprlib.repr(pair)}.")
        most = _LARGEST_STIFFNESS if name == "cable_stiffness" else _LARGEST
        if name in _POSITIVE and not _SMALLEST <= min(pair) <= max(pair) <= most:
            raise InputError(f"{path}: {name} is {pair}; it must be greater than 0, and in SI units.")
        if name == "cable_slack" and not 0 <= min(pair) <= max(pair) <= _LARGEST_SLACK:
            raise InputError(f"{path}: {name} is {pair}; it must be 0 or more, in metres.")
        if name in _NOT_NEGATIVE and min(pair) < 0:
            raise InputError(f"{path}: {name} is {pair}; it must be 0 or more, in SI units.")
        if name in ("delay", "lag") and max(pair) > _LONGEST_DELAY:
            raise InputError(f"{path}: {name} is {pair}: give it in seconds.")
        if name in _ANGLES and max(map(abs, pair)) > _LARGEST_ANGLE:
            raise InputError(f"{path}: {name} is {pair}: give it in radians, not degrees.")
        if max(map(abs, pair)) > most:
            raise InputError(f"{path}: {name} is {pair}; it must be {most:g} or less, in SI units.")
        pairs[name] = jnp.array(pair, jnp.float32)
    unknown = set(values) - set(_FIELDS)
    if unknown:
        name = reprlib.repr(sorted(unknown)[0])
        raise InputError(f"{path}: there is no parameter {name}; the parameters are {', '.join(_FIELDS)}.")
    return ActuatorParameters(**pairs)
