"""Readers of single fields of a robot description in JSON. They check the type and the value of each field.

The readers take the description's path and the field's key for their messages. All of them raise `InputError` naming
the file, the field and the fix.
"""

from __future__ import annotations

import dataclasses
import importlib
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.robots.adapter import RobotAdapter

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
_LONGEST = 60
HORIZON_RANGE = (0.05, 100.0)
"""Shortest and longest horizon of errors (s)."""


@dataclasses.dataclass(frozen=True)
class Limits:
    """Bounds that no recording of a robot exceeds. None if there is no bound."""

    height: tuple[float, float] | None = None
    """Lowest and highest z (m)."""
    distance: float | None = None
    """Largest distance from the origin along x and along y (m)."""
    speed: float | None = None
    """Largest speed between two samples along an axis (m/s)."""
    angle: float | None = None
    """Largest absolute joint coordinate (rad for a hinge, m for a slide)."""


def read_actuator(path: Path, key: str, value: Any) -> tuple[str, tuple[float, float] | None]:
    """Return the actuator of a command, and its range. The range is None if the description gives none."""
    if isinstance(value, str):
        return value, None
    if isinstance(value, dict) and set(value) == {"actuator", "range"} and isinstance(value["actuator"], str):
        return value["actuator"], read_pair(path, f"range of {key}", value["range"])
    refuse(
        path,
        f'"commands" has {shown(value)} for {key}',
        'write the actuator\'s name, or {"actuator": ..., "range": [...]}',
    )


def read_pair(path: Path, key: str, value: Any) -> tuple[float, float]:
    """Return two numbers, the smaller first."""
    if isinstance(value, list) and len(value) == 2 and all(map(is_number, value)) and value[0] < value[1]:
        return float(value[0]), float(value[1])
    refuse(path, f'"{key}" is {shown(value)}', "write two numbers, the smaller first")


def read_limits(path: Path, value: Any) -> Limits:
    """Return the bounds that no recording exceeds."""
    names = [field.name for field in dataclasses.fields(Limits)]
    if not isinstance(value, dict) or not set(value) <= set(names):
        refuse(path, f'"limits" is {shown(value)}', f"write an object with some of {', '.join(names)}")
    found: dict[str, Any] = {}
    for key, limit in value.items():
        if key == "height":
            found[key] = read_pair(path, "limits: height", limit)
        elif not is_number(limit) or limit <= 0:
            refuse(path, f'"limits: {key}" is {shown(limit)}', "write a number above 0")
        else:
            found[key] = float(limit)
    return Limits(**found)


def read_mirror(path: Path, value: Any, known: tuple[str, ...]) -> Mapping[str, str] | None:
    """Return the `known` names that the mirror image swaps, in both directions. None if the key is missing."""
    if value is None:
        return None
    if not isinstance(value, dict) or not all(isinstance(each, str) for each in value.values()):
        refuse(path, f'"mirror" is {shown(value)}', 'write pairs such as {"foot_left": "foot_right"}')
    pairs = value | {other: name for name, other in value.items()}
    unknown = [name for name in pairs if name not in known]
    if unknown:
        refuse(path, f'"mirror" names {shown(unknown[0])}', "name points, commands and joints of the description")
    if len(pairs) != 2 * len(value):
        refuse(path, '"mirror" has a name twice', "write each name once")
    return pairs


def read_adapter(path: Path, value: Any) -> RobotAdapter:
    """Return an instance of the adapter that `module:Class` names, or of `RobotAdapter` if the key is missing."""
    if value is None:
        return RobotAdapter()
    module, _, name = value.partition(":") if isinstance(value, str) else ("", "", "")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        refuse(path, f'"adapter" is {shown(value)}, which cannot be imported ({said(error)})', "write module:Class")
    if not (isinstance(found, type) and issubclass(found, RobotAdapter)):
        refuse(path, f'"adapter" is {shown(value)}, which is no RobotAdapter', "derive it from RobotAdapter")
    return found()


def read_text(path: Path, content: dict[str, Any], key: str) -> str:
    """Return a printable text that is not empty."""
    value = content[key]
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        refuse(path, f'"{key}" is {shown(value)}', "write printable text")
    return value


def is_name(text: str) -> bool:
    """Return whether a text is a valid name in recordings: up to 60 letters, digits and underscores, a letter first."""
    return _NAME.fullmatch(text) is not None and len(text) <= _LONGEST


def read_name(path: Path, key: str, value: Any) -> str:
    """Return a valid name in recordings (see `is_name`)."""
    if not isinstance(value, str) or not is_name(value):
        refuse(path, f'"{key}" has {shown(value)}', "give names of letters, digits and underscores, a letter first")
    return value


def read_entries(path: Path, key: str, value: Any) -> tuple[Mapping[str, Any], ...]:
    """Return a list of objects, whose content is not checked."""
    if not isinstance(value, list) or not all(isinstance(each, dict) for each in value):
        refuse(path, f'"{key}" is {shown(value)}', "write a list of objects")
    return tuple(value)


def read_flag(path: Path, key: str, value: Any) -> bool:
    """Return true or false."""
    if not isinstance(value, bool):
        refuse(path, f'"{key}" is {shown(value)}', "write true or false")
    return value


def read_horizons(path: Path, value: Any, control_timestep: float) -> tuple[float, ...]:
    """Return horizons (s) in increasing order and without duplicates.

    They lie within `HORIZON_RANGE`, and are not shorter than a control step (s).
    """
    low, high = max(HORIZON_RANGE[0], control_timestep), HORIZON_RANGE[1]
    if not isinstance(value, list) or not all(is_number(each) and low <= each <= high for each in value):
        refuse(path, f'"horizons" is {shown(value)}', f"write a list of seconds from {low:g} to {high:g}")
    return tuple(sorted({float(each) for each in value}))


def read_names(path: Path, key: str, value: Any) -> tuple[str, ...]:
    """Return valid names in recordings (see `is_name`), all different."""
    if not isinstance(value, list):
        refuse(path, f'"{key}" is {shown(value)}', "write a list of names")
    names = tuple(read_name(path, key, each) for each in value)
    if len(set(names)) < len(names):
        refuse(path, f'"{key}" has a name twice', "write each name once")
    return names


def shown(value: Any) -> str:
    """Return a value as text for a message, shortened if it is long."""
    text = repr(value)
    return text if len(text) <= _LONGEST else text[:_LONGEST] + "..."


def said(error: Exception) -> str:
    """Return the message of an error in one line, shortened if it is long."""
    return textwrap.shorten(re.sub(r"[^\x20-\x7e]+", " ", str(error)), 200) or type(error).__name__


def refuse(path: Path, problem: str, fix: str) -> NoReturn:
    """Raise `InputError` with the file, the problem and the fix."""
    raise InputError(f"{path}: {problem}; {fix}.")
