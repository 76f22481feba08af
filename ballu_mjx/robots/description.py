"""Robot descriptions, format `ballu-robot/1`: which parts of an MJCF model motion capture sees, and which are driven.

JSON with the keys

- `format`; `name`, what the robot is called;
- `model`: the MJCF file, relative to the description;
- `tracked`: the site whose place and orientation are followed; forces act on its body, at the centre of mass;
- `points`: further sites whose places are measured and observed; may be empty;
- `commands`: the model's actuators, all of them in its order, each under the name that follows `command_` in
  recordings: `"left": "servo_left"`, or, for an actuator without a `ctrlrange`,
  `"left": {"actuator": "servo_left", "range": [-1, 1]}`. Commands are in the actuators' own units;
- `control_timestep` (optional): seconds between two commands, a multiple of the model's time step; 0.05 without it;
- `joints` (optional): hinges (rad) and slides (m) that recordings may hold, as columns of their names;
- `oriented_points` (optional): points whose orientation recordings may hold too;
- `held` (optional): joints that no noise on starting states moves;
- `force_joints` (optional): hinges and slides that residual forces may act along (the force set `joints`); without it,
  all that have names and are not held;
- `keyframe` (optional): the model's keyframe that simulations and inverse kinematics start from;
- `limits` (optional): what no recording of this robot exceeds: `height` ([low, high], m), `distance` (m),
  `speed` (m/s), `angle` (rad or m);
- `mirror` (optional): for a robot that is its own mirror image about the xz plane, pairs of names (points, commands,
  joints) that change places, as `{"foot_left": "foot_right"}`; {} where nothing does;
- `adapter` (optional): `module:Class`, a `robots.adapter.RobotAdapter` with what only this robot has;
- `identify` (optional): parameters that recordings may identify, a list; see `identification.parameters`;
- `upright` (optional): true for a robot whose tracked body never tilts far, so that its yaw says how it is turned;
  false, the default: errors of orientation are the angle of the rotation between two orientations;
- `horizons` (optional): seconds over which errors are taken, 0.05 to 100, for a robot that the default ones do not fit.

Joints are one free joint at the root or none, then hinges and slides. A robot without a free joint is anchored: what it
sees and how it is pushed are told in the world's frame, for where it stands and how it is turned then matter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import mujoco

from ballu_mjx.common import files
from ballu_mjx.common.errors import is_number
from ballu_mjx.robots.adapter import RobotAdapter
from ballu_mjx.robots.description_fields import (
    Limits,
    read_actuator,
    read_adapter,
    read_entries,
    read_flag,
    read_horizons,
    read_limits,
    read_mirror,
    read_name,
    read_names,
    read_text,
    refuse,
    shown,
)
from ballu_mjx.robots.description_model import (
    check_actuators,
    check_joints,
    check_keyframe,
    check_sites,
    checksum,
    find_part,
    free_joints,
    read_model,
)
from ballu_mjx.robots.mjx_support import check_mjx
from ballu_mjx.robots.model import ModelParameters, load_model

DESCRIPTION_FORMAT = "ballu-robot/1"
DEFAULT_CONTROL_TIMESTEP = 0.05
"""Seconds between two commands (20 Hz) where a description does not say."""
_MANDATORY = ("format", "name", "model", "tracked", "points", "commands")
_OPTIONAL = (
    "control_timestep",
    "joints",
    "oriented_points",
    "held",
    "force_joints",
    "keyframe",
    "limits",
    "mirror",
    "adapter",
    "identify",
    "upright",
    "horizons",
)
_LONGEST_STEP = 1.0


class ForceJoint(NamedTuple):
    """A joint that residual forces may act along."""

    place: int
    """In generalized velocities."""
    unit: str
    """Of what acts along it: `N m` of a hinge, `N` of a slide."""


@dataclasses.dataclass(frozen=True, eq=False)
class RobotDescription:
    """What `read` found; keys of the format are explained at the module's head."""

    file: Path
    name: str
    model: Path
    """The MJCF file."""
    tracked: str
    points: tuple[str, ...]
    commands: tuple[str, ...]
    """Their names in recordings, in the order of the model's actuators."""
    joints: tuple[str, ...]
    held: tuple[str, ...]
    anchored: bool
    """Whether the model has no free joint."""
    sha256: str
    """Of description, MJCF file, and all files that it names: included ones, meshes, height fields, textures."""
    command_ranges: tuple[tuple[float, float], ...]
    """Smallest and largest value of each command, in its actuator's units."""
    control_timestep: float = DEFAULT_CONTROL_TIMESTEP
    """Seconds between two commands."""
    oriented_points: tuple[str, ...] = ()
    """Points whose orientation recordings may hold."""
    keyframe: str | None = None
    """The model's keyframe to start from."""
    limits: Limits = Limits()
    """What no recording exceeds."""
    mirror: Mapping[str, str] | None = None
    """Names that change places in the mirror image about the xz plane, both ways; None: the robot is not symmetric."""
    adapter: RobotAdapter = dataclasses.field(default_factory=RobotAdapter)
    """What only this robot has."""
    identify: tuple[Mapping[str, Any], ...] = ()
    """Parameters that recordings may identify, as declared; `identification.parameters` reads them."""
    upright: bool = False
    """Whether yaw says how the tracked body is turned; errors of orientation are then those of yaw."""
    horizons: tuple[float, ...] = ()
    """Seconds over which errors are taken, increasing; empty: the default ones."""
    force_joints: Mapping[str, ForceJoint] = dataclasses.field(default_factory=dict)
    """Joints that residual forces may act along."""
    directions: int = 0
    """Size of generalized velocities."""

    @property
    def features(self) -> int:
        """Return the size of `observe_features`: place, velocity and Euler angles of the tracked body, place
        and velocity of each point."""
        return 9 + 6 * len(self.points)

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns that its recordings may have."""
        sites = (self.tracked, *self.points)
        places = [f"{site}_{axis}" for site in sites for axis in "xyz"]
        turns = [f"{site}_q{axis}" for site in (self.tracked, *self.oriented_points) for axis in "wxyz"]
        return ("time", *(f"command_{name}" for name in self.commands), *places, *turns, *self.joints)

    def load_model(self, actuators: ModelParameters | None = None) -> mujoco.MjModel:
        """Return the robot for C MuJoCo: the nominal one, or with identified actuators."""
        return load_model(self.model, actuators)


def read_description(path: Path | str) -> RobotDescription:
    """The description in a file, found to agree with its model.

    **Raises** `InputError` naming file, key and mend.
    """
    path = Path(path)
    content = files.read_json(path, "write one as docs/own_robot.md shows")
    for key in content:
        if key not in (*_MANDATORY, *_OPTIONAL):
            refuse(path, f"there is no key {shown(key)}", f"there are {', '.join((*_MANDATORY, *_OPTIONAL))}")
    for key in _MANDATORY:
        if key not in content:
            refuse(path, f'"{key}" is missing', "add it")
    if content["format"] != DESCRIPTION_FORMAT:
        refuse(path, f'"format" is {shown(content["format"])}', f'it must be "{DESCRIPTION_FORMAT}"')
    name, file = (read_text(path, content, key) for key in ("name", "model"))
    tracked = read_name(path, "tracked", content["tracked"])
    points, joints, held = (read_names(path, key, content.get(key, [])) for key in ("points", "joints", "held"))
    commands = content["commands"]
    if not isinstance(commands, dict) or not commands:
        refuse(path, f'"commands" is {shown(commands)}', 'write {"name in recordings": "actuator", ...}')
    driven = {read_name(path, "commands", key): read_actuator(path, key, value) for key, value in commands.items()}
    step = content.get("control_timestep", DEFAULT_CONTROL_TIMESTEP)
    if not is_number(step) or not 0 < step <= _LONGEST_STEP:
        refuse(path, f'"control_timestep" is {shown(step)}', f"write seconds, above 0 and at most {_LONGEST_STEP:g}")
    place = path.parent / file
    model = read_model(path, place)
    check_joints(path, model, step)
    check_sites(path, model, tracked, points)
    ranges = check_actuators(path, model, driven)
    given = content.get("force_joints")
    forced = read_names(path, "force_joints", free_joints(model, held) if given is None else given)
    for key, names in (("joints", joints), ("held", held), ("force_joints", forced)):
        for joint in names:
            index = find_part(path, model, mujoco.mjtObj.mjOBJ_JOINT, key, joint)
            if model.jnt_type[index] == mujoco.mjtJoint.mjJNT_FREE:
                refuse(path, f'"{key}" names {shown(joint)}, a free joint', "name hinges and slides only")
    for point in (oriented := read_names(path, "oriented_points", content.get("oriented_points", []))):
        if point not in points:
            refuse(path, f'"oriented_points" names {shown(point)}, none of "points"', "name some of these")
    keyframe = content.get("keyframe")
    if keyframe is not None:
        check_keyframe(path, model, read_text(path, content, "keyframe"))
    found = RobotDescription(
        file=path,
        name=name,
        model=place,
        tracked=tracked,
        points=points,
        commands=tuple(driven),
        joints=joints,
        held=held,
        anchored=bool(model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE),
        sha256=checksum(path, place),
        command_ranges=ranges,
        control_timestep=float(step),
        oriented_points=oriented,
        keyframe=keyframe,
        limits=read_limits(path, content.get("limits", {})),
        mirror=read_mirror(path, content.get("mirror"), (*points, *driven, *joints)),
        adapter=read_adapter(path, content.get("adapter")),
        identify=read_entries(path, "identify", content.get("identify", [])),
        upright=read_flag(path, "upright", content.get("upright", False)),
        horizons=read_horizons(path, content.get("horizons", [])),
        force_joints={joint: _force_joint(model, joint) for joint in forced},
        directions=model.nv,
    )
    twice = [column for number, column in enumerate(found.columns) if column in found.columns[:number]]
    if twice:
        refuse(path, f"recordings would have two columns {twice[0]}", "name sites, commands and joints apart")
    if (problem := found.adapter.check(found, model)) is not None:
        refuse(path, f'"adapter" is {shown(content["adapter"])}, but {problem}', "leave it out, or rename the parts")
    return found


def check_simulates(description: RobotDescription) -> None:
    """**Raises** `InputError` where MJX cannot simulate the model, with the reason."""
    found = check_mjx(description.load_model())
    if found is not None:
        refuse(description.file, f"MJX cannot simulate {description.model.name}: {found[0]}", found[1])


def _force_joint(model: mujoco.MjModel, name: str) -> ForceJoint:
    joint = model.joint(name)
    return ForceJoint(int(joint.dofadr[0]), "N" if joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE else "N m")
