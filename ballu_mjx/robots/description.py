"""Robot descriptions, format `ballu-robot/1`: which parts of an MJCF model motion capture sees, and which are driven.

JSON with the keys

- `format`; `name`, what the robot is called;
- `model`: the MJCF file, relative to the description;
- `tracked`: the site whose place and orientation are followed; forces act on its body, at the centre of mass;
- `points`: further sites whose places are measured and observed; may be empty;
- `commands`: the model's actuators, all of them in its order, each under the name that follows `command_` in
  recordings; `ctrlrange` is 0 to 1;
- `joints` (optional): hinges (rad) and slides (m) that recordings may hold, as columns of their names;
- `held` (optional): joints that no noise on starting states moves;
- `built_like` (optional): "BALLU", for a model with BALLU's legs and their names. What is tied to these (actuators and
  their identification, the base's pitch, servos in the reconstruction) works with such models only.

Joints are one free joint at the root or none, then hinges and slides. A robot without a free joint is anchored: what it
sees and how it is pushed are told in the world's frame, for where it stands and how it is turned then matter.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import re
import textwrap
from pathlib import Path
from typing import Any, NoReturn

import mujoco
from mujoco import mjx

from ballu_mjx.ballu.model import JOINTS, SIDES, ActuatorParameters
from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.robots.model import CONTROL_TIMESTEP, assets, load_model

DESCRIPTION_FORMAT = "ballu-robot/1"
BALLU = "BALLU"
"""The value of `built_like`."""
_MANDATORY = ("format", "name", "model", "tracked", "points", "commands")
_OPTIONAL = ("joints", "held", "built_like")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
_LONGEST = 60


@dataclasses.dataclass(frozen=True)
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
    is_ballu: bool
    """Whether it has BALLU's legs."""
    anchored: bool
    """Whether the model has no free joint."""
    sha256: str
    """Of description and MJCF file."""

    @property
    def features(self) -> int:
        """Return the size of `observe_features`: place, velocity and Euler angles of the tracked body, place
        and velocity of each point."""
        return 9 + 6 * len(self.points)

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns that its recordings may have, in order."""
        tracked, points = self.tracked, (f"{point}_{axis}" for point in self.points for axis in "xyz")
        places = (*(f"{tracked}_{axis}" for axis in "xyz"), *(f"{tracked}_q{axis}" for axis in "wxyz"), *points)
        return ("time", *(f"command_{name}" for name in self.commands), *places, *self.joints)

    def load_model(self, actuators: ActuatorParameters | None = None) -> mujoco.MjModel:
        """The robot for C MuJoCo; `actuators` for one with BALLU's legs only."""
        return load_model(actuators, self.model)


@functools.cache
def ballu() -> RobotDescription:
    """The robot that comes with the package."""
    return read_description(assets() / "ballu.robot.json")


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
    driven = {_name(path, "commands", key): value for key, value in commands.items()}
    like = content.get("built_like")
    if like not in (None, BALLU):
        _refuse(path, f'"built_like" is {_shown(like)}', f'write "{BALLU}" for a robot with its legs, or leave it out')
    place = path.parent / file
    model = _load(path, place)
    _check_joints(path, model)
    _check_sites(path, model, tracked, points)
    _check_actuators(path, model, driven)
    for key, names in (("joints", joints), ("held", held)):
        for joint in names:
            index = _find(path, model, mujoco.mjtObj.mjOBJ_JOINT, key, joint)
            if model.jnt_type[index] == mujoco.mjtJoint.mjJNT_FREE:
                _refuse(path, f'"{key}" names {_shown(joint)}, a free joint', "name hinges and slides only")
    digest = hashlib.sha256(path.read_bytes() + b"\0" + place.read_bytes()).hexdigest()
    anchored = model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE
    found = RobotDescription(
        path, name, place, tracked, points, tuple(driven), joints, held, like == BALLU, bool(anchored), digest
    )
    twice = [column for number, column in enumerate(found.columns) if column in found.columns[:number]]
    if twice:
        _refuse(path, f"recordings would have two columns {twice[0]}", "name sites, commands and joints apart")
    if found.is_ballu:
        _check_legs(path, model, found)
    return found


def check_simulates(description: RobotDescription) -> None:
    """**Raises** `InputError` where MJX cannot simulate the model, with its reason."""
    try:
        mjx.put_model(description.load_model())
    except (NotImplementedError, ValueError) as error:
        _refuse(description.file, f"MJX cannot simulate {description.model.name} ({_said(error)})", "mend the model")


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


def _check_joints(path: Path, model: mujoco.MjModel) -> None:
    kinds = mujoco.mjtJoint
    if not model.njnt:
        _refuse(path, '"model" has no joints', "give a robot that moves")
    for index, kind in enumerate(model.jnt_type):
        if kind == kinds.mjJNT_BALL or (kind == kinds.mjJNT_FREE and index > 0):
            called = {int(kinds.mjJNT_BALL): "a ball joint", int(kinds.mjJNT_FREE): "a second free joint"}[int(kind)]
            mend = "make it of hinges and slides; one free joint may come first"
            _refuse(path, f'"model" has {called}, {_shown(model.joint(index).name)}', mend)
    count = CONTROL_TIMESTEP / model.opt.timestep
    if abs(count - round(count)) > 1e-6 or count < 1:
        problem = f'"model" has a time step of {model.opt.timestep:g} s'
        _refuse(path, problem, f"it must divide the control step of {CONTROL_TIMESTEP:g} s")


def _check_sites(path: Path, model: mujoco.MjModel, tracked: str, points: tuple[str, ...]) -> None:
    roots = []
    for key, site in (("tracked", tracked), *(("points", point) for point in points)):
        body = model.site_bodyid[_find(path, model, mujoco.mjtObj.mjOBJ_SITE, key, site)]
        roots.append(int(model.body_rootid[body]))
        if model.body_weldid[body] == 0:
            _refuse(path, f'"{key}" names {_shown(site)}, a site that does not move', "name sites of the robot only")
        if roots[-1] != roots[0]:
            problem = f'"{key}" names {_shown(site)}, which is of another robot than {tracked}'
            _refuse(path, problem, "give sites below one body of the world")


def _check_actuators(path: Path, model: mujoco.MjModel, driven: dict[str, Any]) -> None:
    own = [model.actuator(index).name for index in range(model.nu)]
    if list(driven.values()) != own:
        problem = f'"commands" has the actuators {_shown(list(driven.values()))}'
        _refuse(path, problem, f"name the model's, all in its order: {textwrap.shorten(', '.join(own), 200) or 'none'}")
    if model.na:
        _refuse(path, '"model" has actuators with states of their own', "give actuators without activation")
    for index, name in enumerate(own):
        if not model.actuator_ctrllimited[index] or tuple(model.actuator_ctrlrange[index]) != (0.0, 1.0):
            _refuse(
                path, f'the model\'s actuator {_shown(name)} has no ctrlrange "0 1"', "give it one, and a gain for it"
            )


def _check_legs(path: Path, model: mujoco.MjModel, found: RobotDescription) -> None:
    mend = 'leave "built_like" out, or name joints, sites and actuators as BALLU\'s'
    hinges = tuple(model.joint(index).name for index in range(1, model.njnt))
    legs = [f"{kind}_{side}" for kind in ("femur", "tibia", "arm") for side in SIDES]
    sites = [f"cable_{part}_{side}" for part in ("femur", "arm") for side in SIDES]
    kinds = mujoco.mjtObj
    needed = [(kinds.mjOBJ_BODY, name) for name in ("base", "balloon", *legs)]
    needed += [(kinds.mjOBJ_SITE, name) for name in sites]
    needed += [(kinds.mjOBJ_TENDON, f"cable_{side}") for side in SIDES]
    needed += [(kinds.mjOBJ_ACTUATOR, f"servo_{side}") for side in SIDES]
    missing = [name for kind, name in needed if mujoco.mj_name2id(model, kind, name) < 0]
    own = (found.tracked, found.points, found.commands, found.joints)
    feet = ("base", "foot_left", "foot_right")
    angles = ("motor_left", "motor_right", "knee_left", "knee_right")
    if found.anchored or hinges != JOINTS or missing or own != ("balloon", feet, SIDES, angles):
        _refuse(path, f'"built_like" is "{BALLU}", but it has other {missing[0] if missing else "names"}', mend)


# ---- values ----


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
