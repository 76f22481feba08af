"""Robot descriptions (format `ballu-robot/1`): the parts of an MJCF model that are measured, and its commands.

A description is a JSON file with the keys

- `format`: `ballu-robot/1`;
- `name`: the robot's name;
- `model`: the MJCF file, relative to the description;
- `tracked`: the site whose position and orientation are tracked. Residual forces act on its body, at the centre of
  mass;
- `points`: further sites whose positions are measured and observed; may be empty;
- `commands`: all actuators of the model, in its order. Each key is the name that follows `command_` in recordings:
  `"left": "servo_left"`. An actuator without a `ctrlrange` is written
  `"left": {"actuator": "servo_left", "range": [-1, 1]}`. Commands are in the actuators' own units;
- `control_timestep` (optional): the control step (s), a multiple of the model's time step; default 0.05;
- `joints` (optional): hinges (rad) and slides (m) that recordings may contain, in columns with the joints' names;
- `oriented_points` (optional): points whose orientation recordings may contain too;
- `held` (optional): joints that get no noise in starting states;
- `force_joints` (optional): hinges and slides on which residual forces may act (the force set `joints`). By default,
  all that have valid names and are not held;
- `keyframe` (optional): the model's keyframe at which simulations and inverse kinematics start;
- `limits` (optional): bounds that no recording of this robot exceeds: `height` ([low, high], m), `distance` (m),
  `speed` (m/s), `angle` (rad or m);
- `mirror` (optional): for a robot that is symmetric about the xz plane, pairs of names (points, commands, joints) that
  the mirror image swaps, as `{"foot_left": "foot_right"}`; `{}` if it swaps none. A command that it does not swap has
  the same value in the mirror image;
- `adapter` (optional): `module:Class`, a `robots.adapter.RobotAdapter` with code that only this robot needs;
- `identify` (optional): list of the parameters that recordings may identify; see `identification.declarations`;
- `upright` (optional): `true` if the tracked body never tilts far. Orientation errors are then errors of yaw. With
  `false`, the default, they are the angle of the rotation between two orientations;
- `horizons` (optional): horizons of the errors (s), 0.05 to 100, in place of the default ones.

A model has at most one free joint, at the root. Its other joints are hinges and slides. A robot without a free joint is
anchored. Its observations and residual forces are in the world frame, because its position and heading matter.
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
"""Default control step (s), which is 20 Hz."""
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
    """A joint on which residual forces may act."""

    place: int
    """Index in generalized velocities."""
    unit: str
    """Unit of the load on it: `N m` for a hinge, `N` for a slide."""


@dataclasses.dataclass(frozen=True, eq=False)
class RobotDescription:
    """A robot description that agrees with its MJCF model. The module's docstring explains the keys of the format."""

    file: Path
    name: str
    model: Path
    """The MJCF file."""
    tracked: str
    points: tuple[str, ...]
    commands: tuple[str, ...]
    """Names of the commands in recordings, in the order of the model's actuators."""
    joints: tuple[str, ...]
    held: tuple[str, ...]
    anchored: bool
    """Whether the model has no free joint."""
    sha256: str
    """SHA-256 of the description, the MJCF file and all files that it names: included files, meshes, height fields,
    textures and skins."""
    command_ranges: tuple[tuple[float, float], ...]
    """Smallest and largest value of each command, in its actuator's units."""
    control_timestep: float = DEFAULT_CONTROL_TIMESTEP
    """Control step (s)."""
    oriented_points: tuple[str, ...] = ()
    """Points whose orientation recordings may contain."""
    keyframe: str | None = None
    """Keyframe of the model at which simulations and inverse kinematics start."""
    limits: Limits = Limits()
    """Bounds that no recording exceeds."""
    mirror: Mapping[str, str] | None = None
    """Names that the mirror image about the xz plane swaps, in both directions. None if the robot is not symmetric."""
    adapter: RobotAdapter = dataclasses.field(default_factory=RobotAdapter)
    """Code that only this robot needs."""
    identify: tuple[Mapping[str, Any], ...] = ()
    """Parameters that recordings may identify, as declared. `identification.declarations` reads them."""
    upright: bool = False
    """Whether the tracked body never tilts far. Orientation errors are then errors of yaw."""
    horizons: tuple[float, ...] = ()
    """Horizons of the errors (s), in increasing order. Empty for the default ones."""
    force_joints: Mapping[str, ForceJoint] = dataclasses.field(default_factory=dict)
    """Joints on which residual forces may act, by name."""
    directions: int = 0
    """Number of generalized velocities."""

    @property
    def features(self) -> int:
        """Return the size of `observe_features`: position, velocity and Euler angles of the tracked body, then position
        and velocity of each point."""
        return 9 + 6 * len(self.points)

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the columns that recordings of this robot may have."""
        sites = (self.tracked, *self.points)
        places = [f"{site}_{axis}" for site in sites for axis in "xyz"]
        turns = [f"{site}_q{axis}" for site in (self.tracked, *self.oriented_points) for axis in "wxyz"]
        return ("time", *(f"command_{name}" for name in self.commands), *places, *turns, *self.joints)

    def load_model(self, actuators: ModelParameters | None = None) -> mujoco.MjModel:
        """Load the model for C MuJoCo, nominal or with identified actuators."""
        return load_model(self.model, actuators)


def read_description(path: Path | str) -> RobotDescription:
    """Read a description file, and check it against its model.

    **Raises** `InputError` naming the file, the key and the fix.
    """
    path = Path(path)
    content = files.read_json(path, "write one as docs/own_robot.md shows")
    for key in content:
        if key not in (*_MANDATORY, *_OPTIONAL):
            refuse(path, f"there is no key {shown(key)}", f"the keys are {', '.join((*_MANDATORY, *_OPTIONAL))}")
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
        refuse(
            path,
            f'"control_timestep" is {shown(step)}',
            f"write a number of seconds above 0 and at most {_LONGEST_STEP:g}",
        )
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
            refuse(path, f'"oriented_points" names {shown(point)}, which is not among "points"', "name some of these")
    keyframe = content.get("keyframe")
    if keyframe is not None:
        check_keyframe(path, model, read_text(path, content, "keyframe"))
    mirror = read_mirror(path, content.get("mirror"), (*points, *driven, *joints))
    for command, span in zip(driven, ranges, strict=True):
        other = (mirror or {}).get(command, command)
        if other in driven and ranges[list(driven).index(other)] != span:
            refuse(path, f'"mirror" swaps {command} and {other}, whose ranges differ', "give them the same range")
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
        mirror=mirror,
        adapter=read_adapter(path, content.get("adapter")),
        identify=read_entries(path, "identify", content.get("identify", [])),
        upright=read_flag(path, "upright", content.get("upright", False)),
        horizons=read_horizons(path, content.get("horizons", []), float(step)),
        force_joints={joint: _force_joint(model, joint) for joint in forced},
        directions=model.nv,
    )
    twice = [column for number, column in enumerate(found.columns) if column in found.columns[:number]]
    if twice:
        refuse(path, f"recordings would have two columns {twice[0]}", "give sites, commands and joints different names")
    if (problem := found.adapter.check(found, model)) is not None:
        refuse(path, f'"adapter" is {shown(content["adapter"])}, but {problem}', "leave it out, or rename the parts")
    return found


def check_simulates(description: RobotDescription) -> None:
    """Check that MJX can simulate the model.

    **Raises** `InputError` with the reason if it cannot.
    """
    found = check_mjx(description.load_model())
    if found is not None:
        refuse(description.file, f"MJX cannot simulate {description.model.name}: {found[0]}", found[1])


def _force_joint(model: mujoco.MjModel, name: str) -> ForceJoint:
    joint = model.joint(name)
    return ForceJoint(int(joint.dofadr[0]), "N" if joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE else "N m")
