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
import hashlib
import importlib
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import mujoco

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.robots.adapter import RobotAdapter
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
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
_LONGEST = 60
_LONGEST_STEP = 1.0
HORIZON_RANGE = (0.05, 100.0)
"""Seconds that errors may be taken over."""


@dataclasses.dataclass(frozen=True)
class Limits:
    """What no recording of a robot exceeds; None: no limit."""

    height: tuple[float, float] | None = None
    """m, along z."""
    distance: float | None = None
    """m, along x and y."""
    speed: float | None = None
    """m/s, between two samples along an axis."""
    angle: float | None = None
    """rad of a hinge, m of a slide."""


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
            _refuse(path, f"there is no key {_shown(key)}", f"there are {', '.join((*_MANDATORY, *_OPTIONAL))}")
    for key in _MANDATORY:
        if key not in content:
            _refuse(path, f'"{key}" is missing', "add it")
    if content["format"] != DESCRIPTION_FORMAT:
        _refuse(path, f'"format" is {_shown(content["format"])}', f'it must be "{DESCRIPTION_FORMAT}"')
    name, file = (_text(path, content, key) for key in ("name", "model"))
    tracked = _name(path, "tracked", content["tracked"])
    points, joints, held = (_names(path, key, content.get(key, [])) for key in ("points", "joints", "held"))
    commands = content["commands"]
    if not isinstance(commands, dict) or not commands:
        _refuse(path, f'"commands" is {_shown(commands)}', 'write {"name in recordings": "actuator", ...}')
    driven = {_name(path, "commands", key): _actuator(path, key, value) for key, value in commands.items()}
    step = content.get("control_timestep", DEFAULT_CONTROL_TIMESTEP)
    if not is_number(step) or not 0 < step <= _LONGEST_STEP:
        _refuse(path, f'"control_timestep" is {_shown(step)}', f"write seconds, above 0 and at most {_LONGEST_STEP:g}")
    place = path.parent / file
    model = _load(path, place)
    _check_joints(path, model, step)
    _check_sites(path, model, tracked, points)
    ranges = _check_actuators(path, model, driven)
    given = content.get("force_joints")
    forced = _names(path, "force_joints", _free_joints(model, held) if given is None else given)
    for key, names in (("joints", joints), ("held", held), ("force_joints", forced)):
        for joint in names:
            index = _find(path, model, mujoco.mjtObj.mjOBJ_JOINT, key, joint)
            if model.jnt_type[index] == mujoco.mjtJoint.mjJNT_FREE:
                _refuse(path, f'"{key}" names {_shown(joint)}, a free joint', "name hinges and slides only")
    for point in (oriented := _names(path, "oriented_points", content.get("oriented_points", []))):
        if point not in points:
            _refuse(path, f'"oriented_points" names {_shown(point)}, none of "points"', "name some of these")
    keyframe = content.get("keyframe")
    if keyframe is not None and mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, _text(path, content, "keyframe")) < 0:
        own = ", ".join(model.key(index).name for index in range(model.nkey)) or "none"
        _refuse(path, f'"keyframe" is {_shown(keyframe)}, no keyframe of the model', f"there are {own}")
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
        sha256=_checksum(path, place),
        command_ranges=ranges,
        control_timestep=float(step),
        oriented_points=oriented,
        keyframe=keyframe,
        limits=_limits(path, content.get("limits", {})),
        mirror=_mirror(path, content.get("mirror"), (*points, *driven, *joints)),
        adapter=_adapter(path, content.get("adapter")),
        identify=_entries(path, "identify", content.get("identify", [])),
        upright=_flag(path, "upright", content.get("upright", False)),
        horizons=_horizons(path, content.get("horizons", [])),
        force_joints={joint: _force_joint(model, joint) for joint in forced},
        directions=model.nv,
    )
    twice = [column for number, column in enumerate(found.columns) if column in found.columns[:number]]
    if twice:
        _refuse(path, f"recordings would have two columns {twice[0]}", "name sites, commands and joints apart")
    if (problem := found.adapter.check(found, model)) is not None:
        _refuse(path, f'"adapter" is {_shown(content["adapter"])}, but {problem}', "leave it out, or rename the parts")
    return found


def check_simulates(description: RobotDescription) -> None:
    """**Raises** `InputError` where MJX cannot simulate the model, with the reason."""
    found = check_mjx(description.load_model())
    if found is not None:
        _refuse(description.file, f"MJX cannot simulate {description.model.name}: {found[0]}", found[1])


# ---- the model ----


def _load(path: Path, place: Path) -> mujoco.MjModel:
    mend = "give an MJCF file, relative to the description"
    try:
        there = place.is_file()
    except (OSError, ValueError):  # a name that no file can have
        there = False
    if not there:
        _refuse(path, f'"model" is {_shown(place.name)}, where there is no file', mend)
    try:
        return mujoco.MjModel.from_xml_path(str(place))
    except (ValueError, mujoco.FatalError) as error:
        _refuse(path, f'"model" is {_shown(place.name)}, which MuJoCo cannot read ({_said(error)})', mend)


def _checksum(path: Path, place: Path) -> str:
    """Return the SHA-256 of a description and of all files of its model."""
    parts = [path, place, *_named_files(place)]
    return hashlib.sha256(b"\0".join(part.read_bytes() for part in parts)).hexdigest()


def _named_files(place: Path) -> list[Path]:
    """Return the files that an MJCF file names, at any depth, but for itself.

    MuJoCo looks for an asset in its compiler's folders and beside the file that names it, whichever it finds first. All
    that it could find belong to the model.
    """
    found = [Path(name) for name in mujoco.mju_getXMLDependencies(str(place))]
    spec = mujoco.MjSpec.from_file(str(place))
    assets = [
        name
        for asset in (*spec.meshes, *spec.hfields, *spec.textures, *spec.skins)
        for name in (asset.file, *getattr(asset, "cubefiles", ()))
        if name
    ]
    texts = [file.parent for file in found if file.suffix == ".xml"]
    folders = {folder / sub for folder in (place.parent, *texts) for sub in ("", spec.meshdir, spec.texturedir)}
    found += [folder / name for folder in folders for name in assets]
    return sorted({file.resolve() for file in found if file.is_file()} - {place.resolve()})


def _check_joints(path: Path, model: mujoco.MjModel, control_timestep: float) -> None:
    kinds = mujoco.mjtJoint
    if not model.njnt:
        _refuse(path, '"model" has no joints', "give a robot that moves")
    for index, kind in enumerate(model.jnt_type):
        if kind == kinds.mjJNT_BALL or (kind == kinds.mjJNT_FREE and index > 0):
            if kind == kinds.mjJNT_BALL:
                called = "a ball joint"
            else:
                later = model.jnt_type[0] != kinds.mjJNT_FREE
                called = "a free joint that is not the first joint" if later else "a second free joint"
            mend = "make it of hinges and slides; one free joint may come first"
            _refuse(path, f'"model" has {called}, {_shown(model.joint(index).name)}', mend)
    count = control_timestep / model.opt.timestep
    if abs(count - round(count)) > 1e-6 or count < 1:
        problem = f'"model" has a time step of {model.opt.timestep:g} s'
        _refuse(path, problem, f"it must divide the control step of {control_timestep:g} s")


def _free_joints(model: mujoco.MjModel, held: tuple[str, ...]) -> list[str]:
    """Return the hinges and slides that have names fit for recordings and are not held."""
    names = (model.joint(index).name for index in range(model.njnt) if model.jnt_type[index] in _ONE_DIRECTION)
    return [name for name in names if _NAME.fullmatch(name) and len(name) <= _LONGEST and name not in held]


def _force_joint(model: mujoco.MjModel, name: str) -> ForceJoint:
    joint = model.joint(name)
    return ForceJoint(int(joint.dofadr[0]), "N" if joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE else "N m")


_ONE_DIRECTION = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def _check_sites(path: Path, model: mujoco.MjModel, tracked: str, points: tuple[str, ...]) -> None:
    linked, roots = _linked_roots(model), []
    for key, site in (("tracked", tracked), *(("points", point) for point in points)):
        body = model.site_bodyid[_find(path, model, mujoco.mjtObj.mjOBJ_SITE, key, site)]
        roots.append(linked[int(model.body_rootid[body])])
        if model.body_weldid[body] == 0:
            _refuse(path, f'"{key}" names {_shown(site)}, a site that does not move', "name sites of the robot only")
        if roots[-1] != roots[0]:
            problem = f'"{key}" names {_shown(site)}, which is of another robot than {tracked}'
            fix = "give sites below one body of the world, or close the loop between them by an equality"
            _refuse(path, problem, fix)


def _linked_roots(model: mujoco.MjModel) -> dict[int, int]:
    """By body of the world: one that stands for it and all that equalities (closed loops) link it with."""
    linked = {int(root): int(root) for root in model.body_rootid}
    for number in range(model.neq):
        ends = [int(model.eq_obj1id[number]), int(model.eq_obj2id[number])]
        if int(model.eq_type[number]) not in (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)):
            continue
        if model.eq_objtype[number] == mujoco.mjtObj.mjOBJ_SITE:
            ends = [int(model.site_bodyid[site]) for site in ends]
        one, other = (linked[int(model.body_rootid[body])] for body in ends)
        if 0 not in (one, other):
            linked = {root: one if stand_in == other else stand_in for root, stand_in in linked.items()}
    return linked


def _check_actuators(
    path: Path, model: mujoco.MjModel, driven: Mapping[str, tuple[str, tuple[float, float] | None]]
) -> tuple[tuple[float, float], ...]:
    """Return the range of each command."""
    own = [model.actuator(index).name for index in range(model.nu)]
    named = [name for name, _ in driven.values()]
    if named != own:
        problem = f'"commands" has the actuators {_shown(named)}'
        _refuse(path, problem, f"name the model's, all in its order: {textwrap.shorten(', '.join(own), 200) or 'none'}")
    if model.na:
        _refuse(path, '"model" has actuators with states of their own', "give actuators without activation")
    ranges = []
    for index, (name, given) in enumerate(driven.values()):
        if given is None and not model.actuator_ctrllimited[index]:
            fix = f'give it one, or write {{"actuator": "{name}", "range": [low, high]}} in "commands"'
            _refuse(path, f"the model's actuator {_shown(name)} has no ctrlrange", fix)
        low, high = given or map(float, model.actuator_ctrlrange[index])
        if not low < high:
            _refuse(path, f"the range of {_shown(name)} is {low:g} to {high:g}", "give the smaller number first")
        ranges.append((low, high))
    return tuple(ranges)


# ---- values ----


def _actuator(path: Path, key: str, value: Any) -> tuple[str, tuple[float, float] | None]:
    """Return the actuator of a command, and its range where the description gives one."""
    if isinstance(value, str):
        return value, None
    if isinstance(value, dict) and set(value) == {"actuator", "range"} and isinstance(value["actuator"], str):
        return value["actuator"], _pair(path, f"range of {key}", value["range"])
    _refuse(path, f'"commands" has {_shown(value)} for {key}', 'write the actuator\'s name, or {"actuator", "range"}')


def _pair(path: Path, key: str, value: Any) -> tuple[float, float]:
    if isinstance(value, list) and len(value) == 2 and all(map(is_number, value)) and value[0] < value[1]:
        return float(value[0]), float(value[1])
    _refuse(path, f'"{key}" is {_shown(value)}', "write two numbers, the smaller first")


def _limits(path: Path, value: Any) -> Limits:
    names = [field.name for field in dataclasses.fields(Limits)]
    if not isinstance(value, dict) or not set(value) <= set(names):
        _refuse(path, f'"limits" is {_shown(value)}', f"write an object with some of {', '.join(names)}")
    found: dict[str, Any] = {}
    for key, limit in value.items():
        if key == "height":
            found[key] = _pair(path, "limits: height", limit)
        elif not is_number(limit) or limit <= 0:
            _refuse(path, f'"limits: {key}" is {_shown(limit)}', "write a number above 0")
        else:
            found[key] = float(limit)
    return Limits(**found)


def _mirror(path: Path, value: Any, known: tuple[str, ...]) -> Mapping[str, str] | None:
    if value is None:
        return None
    if not isinstance(value, dict) or not all(isinstance(each, str) for each in value.values()):
        _refuse(path, f'"mirror" is {_shown(value)}', 'write pairs such as {"foot_left": "foot_right"}')
    pairs = value | {other: name for name, other in value.items()}
    unknown = [name for name in pairs if name not in known]
    if unknown:
        _refuse(path, f'"mirror" names {_shown(unknown[0])}', "name points, commands and joints of the description")
    if len(pairs) != 2 * len(value):
        _refuse(path, '"mirror" names one twice', "name each once")
    return pairs


def _adapter(path: Path, value: Any) -> RobotAdapter:
    if value is None:
        return RobotAdapter()
    module, _, name = value.partition(":") if isinstance(value, str) else ("", "", "")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        _refuse(path, f'"adapter" is {_shown(value)}, which cannot be imported ({_said(error)})', "write module:Class")
    if not (isinstance(found, type) and issubclass(found, RobotAdapter)):
        _refuse(path, f'"adapter" is {_shown(value)}, no RobotAdapter', "derive it from ballu_mjx.robots.adapter")
    return found()


def _find(path: Path, model: mujoco.MjModel, kind: mujoco.mjtObj, key: str, name: str) -> int:
    index = mujoco.mj_name2id(model, kind, name)
    if index < 0:
        what = "site" if kind == mujoco.mjtObj.mjOBJ_SITE else "joint"
        count, named = (model.nsite, model.site) if what == "site" else (model.njnt, model.joint)
        own = ", ".join(named(number).name for number in range(count)) or "none"
        _refuse(
            path, f'"{key}" names {_shown(name)}, no {what} of the model', f"there are {textwrap.shorten(own, 200)}"
        )
    return int(index)


def _text(path: Path, content: dict[str, Any], key: str) -> str:
    value = content[key]
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        _refuse(path, f'"{key}" is {_shown(value)}', "write a text there")
    return value


def _name(path: Path, key: str, value: Any) -> str:
    if not isinstance(value, str) or not _NAME.fullmatch(value) or len(value) > _LONGEST:
        _refuse(path, f'"{key}" has {_shown(value)}', "give names of letters, digits and underscores, a letter first")
    return value


def _entries(path: Path, key: str, value: Any) -> tuple[Mapping[str, Any], ...]:
    if not isinstance(value, list) or not all(isinstance(each, dict) for each in value):
        _refuse(path, f'"{key}" is {_shown(value)}', "write a list of objects")
    return tuple(value)


def _flag(path: Path, key: str, value: Any) -> bool:
    if not isinstance(value, bool):
        _refuse(path, f'"{key}" is {_shown(value)}', "write true or false")
    return value


def _horizons(path: Path, value: Any) -> tuple[float, ...]:
    low, high = HORIZON_RANGE
    if not isinstance(value, list) or not all(is_number(each) and low <= each <= high for each in value):
        _refuse(path, f'"horizons" is {_shown(value)}', f"write a list of seconds from {low:g} to {high:g}")
    return tuple(sorted({float(each) for each in value}))


def _names(path: Path, key: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list):
        _refuse(path, f'"{key}" is {_shown(value)}', "write a list of names")
    names = tuple(_name(path, key, each) for each in value)
    if len(set(names)) < len(names):
        _refuse(path, f'"{key}" names one twice', "name each once")
    return names


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST else text[:_LONGEST] + "..."


def _said(error: Exception) -> str:
    return textwrap.shorten(re.sub(r"[^\x20-\x7e]+", " ", str(error)), 200) or type(error).__name__


def _refuse(path: Path, problem: str, mend: str) -> NoReturn:
    raise InputError(f"{path}: {problem}; {mend}.")
