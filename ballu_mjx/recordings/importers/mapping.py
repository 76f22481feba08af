"""Mapping files: what in a laboratory's file is which part of the robot, in which units and axes. TOML or JSON."""

from __future__ import annotations

import dataclasses
import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn, cast

import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.model import SIDES
from ballu_mjx.common import files
from ballu_mjx.common.errors import is_number
from ballu_mjx.recordings.importers.trajectories import ANGLES, LENGTHS, TIMES, refuse, shorten, suggest
from ballu_mjx.recordings.recording import COLUMNS, Kind

ROLES = ("balloon", "base", *(f"foot_{side}" for side in SIDES))
JOINTS = (*COLUMNS["motor"], *COLUMNS["knee"])
MARKER_TOLERANCE = 0.01
"""m, see `trajectories.rigid_body`."""

EXAMPLE = """\
# What is what in the files of one capture room, for `python -m ballu_mjx record import`.
# Only robot, balloon, base and the feet must stand here; everything else shows its default unless it says otherwise.

robot = "ballu-room-3"   # the name that all recordings of this robot carry
kind = "free"            # "suspended": a sweep with the feet off the ground
notes = ""
# rate = 100.0           # Hz; only for tables without a time column, or where the file's own is wrong

[axes]                   # the capture's axes that point along the format's; all of "x", "-x" ... "-z"
forward = "x"
left = "y"
up = "z"

[origin]
start = true             # turn and shift so that the robot starts at the origin, looking along x; false: as captured
floor = 0.0              # m, height of the floor in the capture; "feet": where the lowest foot stands

[units]                  # only where the file does not say, or says something wrong
# length = "mm"          # m, cm, mm
# angle = "deg"          # rad, deg
# time = "s"             # s, ms, us, ns; tables only

[balloon]                # needs an orientation: a Vicon object or segment, three markers or more, or columns
body = "ballu:balloon"   # "subject:segment", an object, or the name behind the colon where only one subject has it
# section = "Segments"   # where the name stands in several sections of a Vicon file
# rotation = "helical"   # RX, RY, RZ are a rotation vector. Euler angles: "XYZ" about the body's own axes in turn
                         # (Vicon's "Euler XYZ"), "xyz" about the capture's. Default: helical in "Segments"; others must
                         # say it
# markers = ["B1", "B2", "B3", "B4"]                        # instead of body
# geometry = [[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, 0, 0.1]]  # where they sit, m; default: as at the start
# position = ["bx", "by", "bz"]                             # instead of body, in tables: names of columns
# orientation = ["qw", "qx", "qy", "qz"]                    # with rotation = "quaternion" (w, x, y, z), or three angles
offset = [0.0, 0.0, 0.0] # m: the model's site `balloon` in the tracked body's frame
turn = [0.0, 0.0, 0.0]   # deg, a rotation vector: the model's balloon frame in the tracked body's frame.
                         # "start": at the start the robot stands upright and looks along `forward`

[base]                   # the model's site `base`: the middle of the hip axle
body = "ballu:base"

[foot_left]              # the centre of the foot's sphere
body = "ballu:foot_left"

[foot_right]
body = "ballu:foot_right"

# [knee_left]            # tables only: motor_left, motor_right, knee_left, knee_right
# column = "kl"
# sign = 1               # -1 turns it round
# zero = 0.0             # in the column's unit: what it shows where the model's angle is 0

[commands]               # columns of the command log (--commands), or of the table itself
time = "time"
time_unit = "s"
left = "command_left"
right = "command_right"
range_left = [0.0, 1.0]  # what the columns show at command 0 and at command 1; servo angles: [0, 90]
range_right = [0.0, 1.0] # a servo mounted the other way round: [90, 0]
"""

_AXIS = re.compile(r"([+-]?)([xyz])")
_EULER = re.compile(r"[XYZ]{3}|[xyz]{3}")


@dataclasses.dataclass(frozen=True)
class Source:
    """Where one part of the robot comes from; see `EXAMPLE`."""

    role: str
    body: str | None = None
    section: str | None = None
    rotation: str | None = None
    markers: tuple[str, ...] = ()
    geometry: tuple[tuple[float, ...], ...] | None = None
    """m."""
    position: tuple[str, ...] = ()
    orientation: tuple[str, ...] = ()
    offset: tuple[float, ...] = (0.0, 0.0, 0.0)
    """m, tracked body's frame."""
    turn: tuple[float, ...] | Literal["start"] = (0.0, 0.0, 0.0)
    """rad, rotation vector."""


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint angle of a table: (column - zero) x sign."""

    column: str
    sign: float
    zero: float


@dataclasses.dataclass(frozen=True)
class Commands:
    """Columns of a command log."""

    time: str = "time"
    time_unit: str = "s"
    left: str = "command_left"
    right: str = "command_right"
    range_left: tuple[float, ...] = (0.0, 1.0)
    range_right: tuple[float, ...] = (0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class RoomMapping:
    """A mapping file, checked."""

    path: Path
    robot: str
    kind: Kind
    notes: str
    rate: float | None
    """Hz."""
    axes: Float[np.ndarray, "3 3"]
    """Turns the capture's coordinates into (forward, left, up)."""
    start: bool
    floor: float | Literal["feet"]
    """m."""
    length: str | None
    angle: str | None
    time: str
    time_column: str
    """Of tables; that of `commands`, for there is one clock in a table."""
    sources: Mapping[str, Source]
    joints: Mapping[str, Joint]
    commands: Commands


def read_mapping(path: Path) -> RoomMapping:
    """Read and check the mapping at `path`: JSON where it ends in .json, TOML else.

    **Raises** `InputError` naming file, key and mend.
    """
    mend = "mend it there; `python -m ballu_mjx record example-mapping` prints one that works"
    if path.suffix == ".json":
        content = files.read_json(path, mend)
    else:
        try:
            content = tomllib.loads(files.read_text(path))
        except (ValueError, RecursionError) as error:
            refuse(path, "", f"not TOML ({shorten(str(error))})", mend)
    top = _Keys(path, "", content)
    robot = top.text("robot")
    kind = cast(Kind, top.choice("kind", ("free", "suspended"), "free"))
    notes, rate = top.text("notes", "", empty=True), top.number("rate", None, positive=True)
    axes = _axes(top.keys("axes"))
    origin = top.keys("origin")
    start = origin.flag("start", True)
    floor = "feet" if origin.values.get("floor") == "feet" else origin.number("floor", 0.0)
    origin.taken.add("floor")
    origin.finish()
    units = top.keys("units")
    length = units.choice("length", LENGTHS, None)
    angle = units.choice("angle", ANGLES, None)
    time = units.choice("time", TIMES, "s")
    units.finish()
    sources = {role: _source(top.keys(role), role) for role in ROLES if role in content}
    for role in ROLES:
        if role not in sources and kind == "free":
            refuse(path, f"[{role}]", "the table is missing", f'say what the {role} is, such as body = "ballu:{role}"')
    if kind == "free" and not (sources["balloon"].body or sources["balloon"].markers or sources["balloon"].orientation):
        mend = 'give it by body = "...", by markers = [...] or by orientation = [...]'
        refuse(path, "[balloon]", "its orientation is missing", mend)
    joints = {name: _joint(top.keys(name)) for name in JOINTS if name in content}
    commands = _commands(top.keys("commands"))
    top.taken |= {*ROLES, *JOINTS}
    top.finish()
    assert time is not None
    return RoomMapping(
        path, robot, kind, notes, rate, axes, start, cast(Any, floor), length, angle, time, commands.time, sources,
        joints, commands,
    )  # fmt: skip


class _Keys:
    """A table of the file: each key is asked for once, with its type; what nobody asked for is refused."""

    def __init__(self, path: Path, name: str, values: Mapping[str, Any]) -> None:
        self.path, self.name, self.values = path, name, values
        self.taken: set[str] = set()

    def bad(self, key: str, mend: str) -> NoReturn:
        value = shorten(_json(self.values[key])) if key in self.values else "missing"
        place = f"[{self.name}] {key}" if self.name else f"key {key}"
        refuse(self.path, place, "it is missing" if value == "missing" else f"it is {value}", mend)

    def get(self, key: str) -> Any:
        self.taken.add(key)
        return self.values.get(key)

    def keys(self, key: str) -> _Keys:
        value = self.get(key)
        if value is not None and not isinstance(value, dict):
            self.bad(key, f"write a table there, under the heading [{key}]")
        return _Keys(self.path, key, value or {})

    def text(self, key: str, default: str | None = None, *, empty: bool = False) -> str:
        value = self.get(key)
        if value is None and default is not None:
            return default
        if not isinstance(value, str) or not (empty or value.strip()):
            self.bad(key, "write text there")
        return value

    def optional_text(self, key: str) -> str | None:
        return self.text(key) if key in self.values else self.get(key)

    def flag(self, key: str, default: bool) -> bool:
        value = self.get(key)
        if value is not None and not isinstance(value, bool):
            self.bad(key, "write true or false")
        return default if value is None else value

    def choice(self, key: str, known: Sequence[str] | Mapping[str, Any], default: str | None) -> str | None:
        value = self.get(key)
        if value is not None and value not in list(known):
            self.bad(key, f"write one of {', '.join(known)}")
        return default if value is None else value

    def number(self, key: str, default: float | None, *, positive: bool = False) -> float | None:
        value = self.get(key)
        if value is None:
            return default
        if not is_number(value) or (positive and value <= 0):
            self.bad(key, "write a positive number" if positive else "write a number")
        return float(value)

    def numbers(self, key: str, count: int, default: tuple[float, ...]) -> tuple[float, ...]:
        value = self.get(key)
        if value is None:
            return default
        if not isinstance(value, list) or len(value) != count or not all(map(is_number, value)):
            self.bad(key, f"write {count} numbers, [{', '.join(['0.0'] * count)}]")
        return tuple(map(float, value))

    def names(self, key: str, counts: Sequence[int] | None, mend: str) -> tuple[str, ...]:
        value = self.get(key)
        if value is None:
            return ()
        fits = isinstance(value, list) and all(isinstance(name, str) and name for name in value)
        if not fits or (counts is not None and len(value) not in counts) or len(set(value)) < len(value):
            self.bad(key, mend)
        return tuple(value)

    def finish(self) -> None:
        for key in self.values:
            if key not in self.taken:
                where = f"[{self.name}] {shorten(key)}" if self.name else f"key {shorten(key)}"
                refuse(
                    self.path, where, "there is no such key", f"leave it out, {suggest(key, self.taken).rstrip('?')}"
                )


def _json(value: Any) -> str:
    try:
        return json.dumps(value, default=str)
    except ValueError:  # TOML's hexadecimal numbers may have more digits than Python prints
        return "a number of very many digits"


def _axes(keys: _Keys) -> Float[np.ndarray, "3 3"]:
    rows = []
    for key, default in (("forward", "x"), ("left", "y"), ("up", "z")):
        match = _AXIS.fullmatch(keys.text(key, default))
        if match is None:
            keys.bad(key, 'write an axis of the capture, such as "x" or "-y"')
        row = np.zeros(3)
        row["xyz".index(match[2])] = -1.0 if match[1] == "-" else 1.0
        rows.append(row)
    keys.finish()
    axes = np.array(rows)
    determinant = round(float(np.linalg.det(axes)))
    if determinant != 1:
        problem = "two of them point the same way" if determinant == 0 else "they are left-handed"
        refuse(keys.path, "[axes]", problem, 'write three different ones so that forward x left = up, such as "x y z"')
    return axes


def _source(keys: _Keys, role: str) -> Source:
    body, section = keys.optional_text("body"), keys.optional_text("section")
    markers = keys.names("markers", None, "write the names of three different markers or more")
    position = keys.names("position", (3,), 'write the names of three columns, ["x", "y", "z"]')
    ways = [name for name, given in (("body", body), ("markers", markers), ("position", position)) if given]
    if len(ways) != 1:
        problem = "nothing says where it comes from" if not ways else f"{' and '.join(ways)} both stand there"
        refuse(keys.path, f"[{role}]", problem, 'write one of body = "...", markers = [...] and position = [...]')
    if markers and len(markers) < 3:
        keys.bad("markers", 'write three or more, or body = "..." for a single one')
    orientation = keys.names("orientation", (3, 4), "write the names of three or four columns")
    if orientation and not position:
        keys.bad("orientation", "it belongs beside position = [...], leave it out")
    rotation = keys.optional_text("rotation")
    if rotation is not None and rotation not in ("helical", "quaternion"):
        if not _EULER.fullmatch(rotation) or any(a == b for a, b in zip(rotation, rotation[1:], strict=False)):
            keys.bad("rotation", 'write "helical", "quaternion", or a sequence of Euler angles such as "XYZ"')
    if orientation and rotation is None:
        keys.bad("rotation", 'say what the columns are, such as rotation = "quaternion" for w, x, y, z')
    if orientation and (rotation == "quaternion") != (len(orientation) == 4):
        keys.bad("orientation", "write four columns for a quaternion (w, x, y, z), three for all else")
    geometry = keys.get("geometry")
    if geometry is not None:
        if not isinstance(geometry, list) or len(geometry) != len(markers):
            keys.bad("geometry", "write one position [x, y, z] for each of the markers")
        for place in geometry:
            if not isinstance(place, list) or len(place) != 3 or not all(map(is_number, place)):
                keys.bad("geometry", "write positions as [x, y, z], in metres")
        geometry = tuple(tuple(map(float, place)) for place in geometry)
    offset = keys.numbers("offset", 3, (0.0, 0.0, 0.0))
    if max(map(abs, offset)) > 2.0:
        keys.bad("offset", "write metres")
    turn: tuple[float, ...] | Literal["start"] = "start"
    if keys.get("turn") != "start":
        turn = tuple(np.deg2rad(keys.numbers("turn", 3, (0.0, 0.0, 0.0))).tolist())
    keys.finish()
    return Source(role, body, section, rotation, markers, geometry, position, orientation, offset, turn)


def _joint(keys: _Keys) -> Joint:
    column = keys.text("column")
    sign = keys.number("sign", 1.0)
    if sign not in (1.0, -1.0):
        keys.bad("sign", "write 1 or -1")
    zero = keys.number("zero", 0.0)
    keys.finish()
    assert sign is not None and zero is not None
    return Joint(column, sign, zero)


def _commands(keys: _Keys) -> Commands:
    default = Commands()
    texts = {name: keys.text(name, getattr(default, name)) for name in ("time", "left", "right")}
    unit = keys.choice("time_unit", TIMES, default.time_unit)
    ranges = {name: keys.numbers(name, 2, (0.0, 1.0)) for name in ("range_left", "range_right")}
    for name, (low, high) in ranges.items():
        if low == high:
            keys.bad(name, "write what the column shows at command 0 and at command 1")
    keys.finish()
    return dataclasses.replace(default, time_unit=unit or "s", **texts, **ranges)
