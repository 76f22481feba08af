"""Files of identified actuators, format `ballu-actuators/1`: what `train sysid` writes and `--actuators` reads.

JSON with the keys `format`; `robot`, the name that its recordings carry; `parameters`, each field of
`robot.ActuatorParameters` as [left, right] in SI units and radians; and optionally `standard_errors` alike, `delay`
(s, [left, right], null where unknown), `source` (the recordings) and whatever else the user wants to keep there.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ballu_mjx.errors import InputError, is_number
from ballu_mjx.robot import ActuatorParameters

FORMAT = "ballu-actuators/1"
NAME = "actuators.json"
"""The name under which a robot's file is found beside its recordings."""
_FIELDS = tuple(field.name for field in dataclasses.fields(ActuatorParameters))
_POSITIVE = ("knee_spring_stiffness", "motor_gain", "torque_limit")
_LARGEST_ANGLE = math.pi


def write(path: Path, robot: str, parameters: ActuatorParameters, more: Mapping[str, Any]) -> None:
    """Write `parameters` of the robot named `robot`, with `more` keys beside them."""
    content = {"format": FORMAT, "robot": robot, "parameters": as_json(parameters), **more}
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def read(path: Path) -> tuple[str, ActuatorParameters]:
    """The robot's name and its parameters.

    **Raises** `InputError` naming file, key and mend.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file; `python -m ballu_mjx.train sysid` writes one.") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({error}); restore it or identify again.") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f'{path}: "format" is not "{FORMAT}"; give a file that `train sysid` wrote.')
    if not isinstance(content.get("robot"), str) or not content["robot"]:
        raise InputError(f'{path}: "robot" must be the name that the robot\'s recordings carry.')
    if not isinstance(content.get("parameters"), dict):
        raise InputError(f'{path}: "parameters" is missing; give a file that `train sysid` wrote.')
    return content["robot"], from_json(content["parameters"], path)


def find(recordings: Iterable[Path], robot: str) -> Path | None:
    """The robot's file beside its recordings: in their folder or the one above."""
    folders = dict.fromkeys(folder for path in recordings for folder in (path.parent, path.parent.parent))
    for folder in folders:
        path = folder / NAME
        if path.is_file() and read(path)[0] == robot:
            return path
    return None


def as_json(parameters: ActuatorParameters) -> dict[str, list[float]]:
    """Pairs [left, right] by name."""
    return {name: [float(f"{x:.6g}") for x in np.asarray(getattr(parameters, name))] for name in _FIELDS}


def from_json(values: Mapping[str, Any], path: Path) -> ActuatorParameters:
    """The inverse of `as_json`.

    **Raises** `InputError` naming `path`, the parameter and the mend.
    """
    pairs = []
    for name in _FIELDS:
        pair = values.get(name)
        if not (isinstance(pair, list) and len(pair) == 2 and all(is_number(x) for x in pair)):
            raise InputError(f"{path}: {name} must be two numbers, [left, right]; it is {pair!r}.")
        if name in _POSITIVE and min(pair) <= 0:
            raise InputError(f"{path}: {name} is {pair}; it must be greater than 0.")
        if name not in _POSITIVE and max(map(abs, pair)) > _LARGEST_ANGLE:
            raise InputError(f"{path}: {name} is {pair}: give it in radians, not degrees.")
        pairs.append(jnp.array(pair, jnp.float32))
    unknown = set(values) - set(_FIELDS)
    if unknown:
        raise InputError(f"{path}: there is no parameter {sorted(unknown)[0]!r}; there are {', '.join(_FIELDS)}.")
    return ActuatorParameters(*pairs)
