"""Reader of mapping files (TOML or JSON), which assign parts of a capture file to the robot, with units and axes."""

from __future__ import annotations

import dataclasses
import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn, cast

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common import files
from ballu_mjx.common.errors import is_number
from ballu_mjx.recordings.filters import turns_freely
from ballu_mjx.recordings.importers.trajectories import ANGLES, LENGTHS, TIMES, refuse, shorten, suggest
from ballu_mjx.recordings.recording import Kind
from ballu_mjx.recordings.recording_hooks import hooks_of
from ballu_mjx.robots.description import RobotDescription

MARKER_TOLERANCE = 0.01
"""Tolerance (m) of rigid bodies from markers, see `trajectories.rigid_body`."""
_TABLES = ("axes", "origin", "units", "clock", "commands")
_RESERVED = ("robot", "kind", "notes", "rate", *_TABLES)
"""Keys of a mapping file, which cannot be names of sites or joints."""
_RESERVED_COMMANDS = ("time", "time_unit")
"""Keys of the table `[commands]`, which cannot be names of commands."""

_AXIS = re.compile(r"([+-]?)([xyz])")
_EULER = re.compile(r"[XYZ]{3}|[xyz]{3}")


@dataclasses.dataclass(frozen=True)
class Source:
    """Source of one site of the robot. The fields are the keys of its table, see `example_mapping`."""

    role: str
    """Name of the site."""
    body: str | None = None
    section: str | None = None
    rotation: str | None = None
    markers: tuple[str, ...] = ()
    geometry: tuple[tuple[float, ...], ...] | None = None
    """Positions (m) of the markers in the body's frame. None to take them from the file."""
    position: tuple[str, ...] = ()
    orientation: tuple[str, ...] = ()
    offset: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Position (m) of the site in the tracked body's frame."""
    turn: tuple[float, ...] | Literal["start"] = (0.0, 0.0, 0.0)
    """Rotation vector (rad) of the model's body frame in the tracked body's frame."""


@dataclasses.dataclass(frozen=True)
class Joint:
    """Joint angle from a column: (column - zero) x sign."""

    column: str
    sign: float
    zero: float
    slides: bool = False
    """Whether the joint is a slide, so that the column is a length."""
    turns: bool = False
    """Whether the joint is a hinge without a range. The column may then restart each turn."""


@dataclasses.dataclass(frozen=True)
class Commands:
    """Columns of a command log, with their ranges."""

    columns: Mapping[str, str]
    """Column by name of the robot's command, in the robot's order."""
    limits: tuple[tuple[float, float], ...]
    """Smallest and largest value of each command, in its actuator's unit."""
    ranges: tuple[tuple[float, float], ...]
    """Values of the columns at these limits, in the columns' units."""
    time: str = "time"
    """Time column."""
    time_unit: str = "s"
    """Unit of the time column."""

    @staticmethod
    def of(robot: RobotDescription) -> Commands:
        """Return the columns of a log that needs no mapping: `command_NAME`, in the actuators' units."""
        columns = {name: f"command_{name}" for name in robot.commands}
        return Commands(columns, robot.command_ranges, robot.command_ranges)


@dataclasses.dataclass(frozen=True)
class Clock:
    """Source of a file's times."""

    time: str | None = None
    """Time column, or "header" or "received" for a bag. None for the default of the format."""
    time_unit: str = "s"
    """Unit of the time column, if the format does not specify it."""
    episode: int | None = None
    """Number of the episode in a LeRobot dataset. None if it has only one."""
    log: bool = False
    """Whether the file is a command log. `time` is then a key of the table [commands], not of [clock]."""

    @property
    def table(self) -> str:
        """Return the mapping's table with the key `time`, for messages."""
        return "[commands]" if self.log else "[clock]"


@dataclasses.dataclass(frozen=True)
class RoomMapping:
    """Content of a mapping file, checked."""

    path: Path
    robot: str
    """Name of the captured specimen."""
    kind: Kind
    notes: str
    rate: float | None
    """Sampling rate (Hz) that replaces the file's. None if not given."""
    axes: Float[np.ndarray, "3 3"]
    """Rotation matrix from coordinates of the capture to (forward, left, up)."""
    start: bool
    """Whether the robot's start becomes the origin, with the tracked body facing forward."""
    floor: float | str
    """Height (m) of the floor in the capture, or a name among the robot's `RecordingHooks.floors`."""
    length: str | None
    """Unit of lengths. None if not given."""
    angle: str | None
    """Unit of angles. None if not given."""
    clock: Clock
    sources: Mapping[str, Source]
    """Sources by site."""
    joints: Mapping[str, Joint]
    """Columns of joint angles by joint."""
    commands: Commands
    control_timestep: float
    """Control step (s) of the robot."""


def read_mapping(path: Path, robot: RobotDescription) -> RoomMapping:
    """Read and check the mapping file at `path` for captures of `robot`: JSON if its name ends in .json, else TOML.

    **Raises** `InputError` naming file and key if the file is invalid.
    """
    fix = "correct it there; `python -m ballu_mjx record example-mapping` prints one that works"
    if path.suffix == ".json":
        content = files.read_json(path, fix)
    else:
        try:
            content = tomllib.loads(files.read_text(path))
        except (ValueError, RecursionError) as error:
            refuse(path, "", f"not TOML ({error})", fix)
    roles = (robot.tracked, *robot.points)
    _check_names(path, roles, robot)
    top = _Keys(path, "", content)
    specimen = top.text("robot")
    kind = cast(Kind, top.choice("kind", ("free", "suspended"), "free"))
    notes, rate = top.text("notes", "", empty=True), top.number("rate", None, positive=True)
    axes = _axes(top.keys("axes"))
    origin = top.keys("origin")
    start = origin.flag("start", not robot.anchored)
    floors = hooks_of(robot).floors
    floor = origin.get("floor")
    if not (isinstance(floor, str) and floor in floors):
        floor = origin.number("floor", 0.0)
    origin.finish()
    units = top.keys("units")
    length = units.choice("length", LENGTHS, None)
    angle = units.choice("angle", ANGLES, None)
    time = units.choice("time", TIMES, None)  # Earlier mappings, without `[clock]`, have the unit here.
    units.finish()
    clock = _clock(top.keys("clock"), time)
    sources = {role: _source(top.keys(role), role) for role in roles if role in content}
    for role in roles:
        if role not in sources and kind == "free":
            refuse(path, f"[{role}]", "the table is missing", f'give its source, such as body = "name:{role}"')
    tracked = sources.get(robot.tracked)
    if kind == "free" and tracked is not None and not (tracked.body or tracked.markers or tracked.orientation):
        fix = 'give it by body = "...", by markers = [...] or by orientation = [...]'
        refuse(path, f"[{robot.tracked}]", "its orientation is missing", fix)
    given = [name for name in robot.joints if name in content]
    for name in robot.joints:
        if kind == "suspended" and name not in given:
            refuse(path, f"[{name}]", "the table is missing", f'give its column, such as column = "{name}"')
    model = robot.load_model()
    joints = {name: _joint(top.keys(name), model, name) for name in given}
    commands = _commands(top.keys("commands"), robot)
    top.taken |= {*roles, *robot.joints}
    top.finish()
    assert floor is not None
    return RoomMapping(
        path, specimen, kind, notes, rate, axes, start, floor, length, angle, clock, sources, joints, commands,
        robot.control_timestep,
    )  # fmt: skip


def _check_names(path: Path, roles: Sequence[str], robot: RobotDescription) -> None:
    """Check that no site, joint or command has the name of a key of mapping files."""
    for name, reserved in [
        *((name, _RESERVED) for name in (*roles, *robot.joints)),
        *((name, _RESERVED_COMMANDS) for name in robot.commands),
    ]:
        if name in reserved:
            refuse(robot.file, shorten(name), f"this name is reserved in mapping files such as {path}", "rename it")


class _Keys:
    """Table of the file. Each method reads a key of one type. `finish` refuses keys that were not read."""

    def __init__(self, path: Path, name: str, values: Mapping[str, Any]) -> None:
        self.path, self.name, self.values = path, name, values
        self.taken: set[str] = set()

    def bad(self, key: str, fix: str) -> NoReturn:
        value = shorten(_json(self.values[key])) if key in self.values else "missing"
        place = f"[{self.name}] {key}" if self.name else f"key {key}"
        refuse(self.path, place, "it is missing" if value == "missing" else f"it is {value}", fix)

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

    def names(self, key: str, counts: Sequence[int] | None, fix: str) -> tuple[str, ...]:
        value = self.get(key)
        if value is None:
            return ()
        fits = isinstance(value, list) and all(isinstance(name, str) and name for name in value)
        if not fits or (counts is not None and len(value) not in counts) or len(set(value)) < len(value):
            self.bad(key, fix)
        return tuple(value)

    def finish(self) -> None:
        for key in self.values:
            if key not in self.taken:
                where = f"[{self.name}] {shorten(key)}" if self.name else f"key {shorten(key)}"
                refuse(
                    self.path,
                    where,
                    "there is no such key",
                    f"leave it out, {suggest(key, sorted(self.taken)).rstrip('?')}",
                )


def _json(value: Any) -> str:
    try:
        return json.dumps(value, default=str)
    except ValueError:  # Hexadecimal numbers in TOML may have more digits than Python prints.
        return "a number with too many digits"


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
    markers = keys.names("markers", None, "write the names of three or more different markers")
    position = keys.names("position", (3,), 'write the names of three columns, ["x", "y", "z"]')
    ways = [name for name, given in (("body", body), ("markers", markers), ("position", position)) if given]
    if len(ways) != 1:
        problem = "its source is missing" if not ways else f"{' and '.join(ways)} are both given"
        refuse(keys.path, f"[{role}]", problem, 'write one of body = "...", markers = [...] and position = [...]')
    if markers and len(markers) < 3:
        keys.bad("markers", 'write three or more, or body = "..." for a single one')
    orientation = keys.names("orientation", (3, 4), "write the names of three or four columns")
    if orientation and not position:
        keys.bad("orientation", "it needs position = [...]; add that, or leave orientation out")
    rotation = keys.optional_text("rotation")
    if rotation is not None and rotation not in ("helical", "quaternion"):
        if not _EULER.fullmatch(rotation) or any(a == b for a, b in zip(rotation, rotation[1:], strict=False)):
            keys.bad("rotation", 'write "helical", "quaternion", or a sequence of Euler angles such as "XYZ"')
    if orientation and rotation is None:
        keys.bad("rotation", 'state the meaning of the columns, such as rotation = "quaternion" for w, x, y, z')
    if orientation and (rotation == "quaternion") != (len(orientation) == 4):
        keys.bad("orientation", "write four columns for a quaternion (w, x, y, z), or three for angles")
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
        keys.bad("offset", "write it in metres, at most 2")
    turn: tuple[float, ...] | Literal["start"] = "start"
    if keys.get("turn") != "start":
        turn = tuple(np.deg2rad(keys.numbers("turn", 3, (0.0, 0.0, 0.0))).tolist())
    keys.finish()
    return Source(role, body, section, rotation, markers, geometry, position, orientation, offset, turn)


def _joint(keys: _Keys, model: mujoco.MjModel, name: str) -> Joint:
    column = keys.text("column")
    sign = keys.number("sign", 1.0)
    if sign not in (1.0, -1.0):
        keys.bad("sign", "write 1 or -1")
    zero = keys.number("zero", 0.0)
    keys.finish()
    assert sign is not None and zero is not None
    slides = bool(model.joint(name).type[0] == mujoco.mjtJoint.mjJNT_SLIDE)
    return Joint(column, sign, zero, slides, turns_freely(model, name))


def _clock(keys: _Keys, unit: str | None) -> Clock:
    """Return the table `[clock]`. `unit` is the unit of times in `[units]`, None if there is none."""
    if unit is not None and "time_unit" in keys.values:
        keys.bad("time_unit", "time under [units] has the same meaning; leave that one out")
    episode = keys.get("episode")
    if episode is not None and (isinstance(episode, bool) or not isinstance(episode, int) or not 0 <= episode < 2**31):
        keys.bad("episode", "write its number, such as 0")
    clock = Clock(keys.optional_text("time"), keys.choice("time_unit", TIMES, unit or "s") or "s", episode)
    keys.finish()
    return clock


def _commands(keys: _Keys, robot: RobotDescription) -> Commands:
    default = Commands.of(robot)
    time = keys.text("time", default.time)
    unit = keys.choice("time_unit", TIMES, default.time_unit)
    columns = {command: keys.text(command, column) for command, column in default.columns.items()}
    ranges = []
    for command, limits in zip(robot.commands, default.limits, strict=True):
        key = f"range_{command}"
        low, high = keys.numbers(key, 2, limits)
        if low == high:
            keys.bad(key, f"write the column's values at command {limits[0]:g} and at command {limits[1]:g}")
        ranges.append((low, high))
    keys.finish()
    return Commands(columns, default.limits, tuple(ranges), time, unit or "s")
