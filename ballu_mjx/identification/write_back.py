"""Files of identified values: JSON that this package reads, and the user's MJCF with the values."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.parameters import IdentifiedParameters
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.mjcf import WRITTEN_FIELDS, differing_fields, write_fields
from ballu_mjx.robots.model import raise_iterations, set_fields

IDENTIFIED_FORMAT = "ballu-identified/1"


def identified_to_json(
    robot: RobotDescription,
    identified: IdentifiedParameters,
    standard_errors: Float[np.ndarray, " parameters"] | None = None,
    *,
    specimen: str | None = None,
    more: Mapping[str, Any] | None = None,
) -> str:
    """Return identified values as JSON text for `read_identified`, by the names of the declared parameters.

    - `specimen`: the robot's name in its recordings. None: the name in its description.
    - `more`: further keys.
    """
    declared = identified.declared
    # Values in single precision may lie slightly outside the bounds.
    values = np.clip(np.asarray(identified.values, float), declared.lower, declared.upper)
    errors = np.full(len(values), np.nan) if standard_errors is None else standard_errors
    rows = {}
    for parameter, value, error in zip(declared.parameters, values, errors, strict=True):
        rows[parameter.name] = {"value": float(value), "unit": parameter.unit}
        if np.isfinite(error):
            rows[parameter.name]["standard_error"] = float(error)
    head = {"format": IDENTIFIED_FORMAT, "robot": specimen or robot.name, "parameters": rows}
    return json.dumps({**head, **(more or {})}, indent=2) + "\n"


def read_identified(path: Path | str, robot: RobotDescription) -> IdentifiedParameters:
    """Read a file of `identified_to_json`. Parameters that are missing in it have their nominal values.

    **Raises** `InputError` naming the file, the parameter and the fix.
    """
    path = Path(path)
    return identified_from_json(files.read_json(path, "restore it or identify again"), path, robot)


def identified_from_json(content: Mapping[str, Any], path: Path, robot: RobotDescription) -> IdentifiedParameters:
    """Return the values in the JSON of `identified_to_json`, which the file `path` contains; see `read_identified`.

    **Raises** `InputError` naming the file, the parameter and the fix.
    """
    rows = content.get("parameters")
    if content.get("format") != IDENTIFIED_FORMAT or not isinstance(rows, dict):
        raise InputError(f'{path}: is not of the format "{IDENTIFIED_FORMAT}"; give a file that identification wrote.')
    parameters = declared_parameters(robot, robot.load_model())
    values = parameters.nominal.copy()
    for name, row in rows.items():
        if name not in parameters.names:
            known = ", ".join(parameters.names)
            raise InputError(f"{path}: {robot.file.name} identifies no {name}; it identifies {known}.")
        value = row.get("value") if isinstance(row, dict) else None
        place = parameters.names.index(name)
        low, high = parameters.parameters[place].bounds
        if value is None or not is_number(value) or not low <= value <= high:
            raise InputError(f"{path}: {name} is {value!r}; write a number from {low:g} to {high:g}.")
        values[place] = value
    return IdentifiedParameters(jnp.asarray(values), parameters)


def identified_xml(robot: RobotDescription, identified: IdentifiedParameters) -> str:
    """Return the robot's MJCF with the identified values, for plain MuJoCo.

    MJCF cannot express the drivetrain, which is written in a comment at the top. Paths of meshes and textures stay
    relative to the robot's MJCF file. Numbers have six digits, as MuJoCo writes them.

    **Raises** `InputError` for a field that cannot be set in MuJoCo's model specification (`mujoco.MjSpec`), or that
    its compiler changes.
    """
    model = robot.load_model()
    with jax.enable_x64(True):
        fields = {k: np.asarray(v) for k, v in identified.declared.fields(model, identified.values).items()}
    set_fields(model, fields)
    raise_iterations(model)
    spec = mujoco.MjSpec.from_file(str(robot.model))
    write_fields(spec, model)
    lost = differing_fields(spec.compile(), model, [*WRITTEN_FIELDS, *fields])
    if lost:
        raise InputError(f"{robot.file}: {lost[0]} cannot be written as MJCF; keep it in the JSON file.")
    head, _, rest = spec.to_xml().partition("\n")
    return f"{head}\n  <!-- {_drivetrain_words(robot, identified)} -->\n{rest}"


def _drivetrain_words(robot: RobotDescription, identified: IdentifiedParameters) -> str:
    """Return the drivetrain quantities that differ from the identity, as text for a comment."""
    found = identified.drivetrain()
    nominal = {"scale": 1.0, "rate_limit": np.inf}
    words = []
    for number, command in enumerate(robot.commands):
        own = {name: float(value[number]) for name, value in zip(found._fields, found, strict=True)}
        changed = [f"{name} {value:.6g}" for name, value in own.items() if value != nominal.get(name, 0.0)]
        if changed:
            words.append(f"{command}: {', '.join(changed)}")
    return f"Drivetrain, which MJCF cannot express: {'; '.join(words) or 'none'}"
