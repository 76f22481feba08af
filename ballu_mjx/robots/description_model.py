"""Read the MJCF model of a robot description, and check that it has the named sites, joints and actuators."""

from __future__ import annotations

import hashlib
import os
import textwrap
from collections.abc import Mapping
from pathlib import Path

import mujoco

from ballu_mjx.robots.description_fields import is_name, refuse, said, shown
from ballu_mjx.robots.kinematic_trees import linked_roots


def read_model(path: Path, place: Path) -> mujoco.MjModel:
    """Return the model at `place`, which the description at `path` names.

    **Raises** `InputError` if there is no model that MuJoCo can read.
    """
    fix = "give an MJCF file, relative to the description"
    try:
        there = place.is_file()
    except (OSError, ValueError):  # the name is not a valid path
        there = False
    if not there:
        refuse(path, f'"model" is {shown(place.name)}, but there is no file of this name', fix)
    try:
        return mujoco.MjModel.from_xml_path(str(place))
    except (ValueError, mujoco.FatalError) as error:
        refuse(path, f'"model" is {shown(place.name)}, which MuJoCo cannot read ({said(error)})', fix)


def checksum(path: Path, place: Path) -> str:
    """Return one SHA-256 of a description and all files of its model."""
    parts = [path, place, *_named_files(place)]
    return hashlib.sha256(b"\0".join(part.read_bytes() for part in parts)).hexdigest()


def file_checksums(path: Path, place: Path) -> dict[str, str]:
    """Return the SHA-256 of each of these files, by path relative to the description's folder."""
    folder = path.resolve().parent
    return {
        Path(os.path.relpath(part.resolve(), folder)).as_posix(): hashlib.sha256(part.read_bytes()).hexdigest()
        for part in (path, place, *_named_files(place))
    }


def _named_files(place: Path) -> list[Path]:
    """Return the files that an MJCF file names, at any depth, without the file itself.

    MuJoCo searches for an asset in the compiler's folders and beside the file that names it, and takes the first match.
    Here all matches count as files of the model.
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


def check_joints(path: Path, model: mujoco.MjModel, control_timestep: float) -> None:
    """Check the joints and the time step of a model.

    **Raises** `InputError` if a joint is of a kind that is not supported, or if the time step does not divide the
    control step.
    """
    kinds = mujoco.mjtJoint
    if not model.njnt:
        refuse(path, '"model" has no joints', "give a model of a robot that moves")
    for index, kind in enumerate(model.jnt_type):
        if kind == kinds.mjJNT_BALL or (kind == kinds.mjJNT_FREE and index > 0):
            if kind == kinds.mjJNT_BALL:
                called = "a ball joint"
            else:
                later = model.jnt_type[0] != kinds.mjJNT_FREE
                called = "a free joint that is not the first joint" if later else "a second free joint"
            fix = "use hinges and slides; only the first joint may be free"
            refuse(path, f'"model" has {called}, {shown(model.joint(index).name)}', fix)
    count = control_timestep / model.opt.timestep
    if abs(count - round(count)) > 1e-6 or count < 1:
        problem = f'"model" has a time step of {model.opt.timestep:g} s'
        refuse(path, problem, f"it must divide the control step of {control_timestep:g} s")


def free_joints(model: mujoco.MjModel, held: tuple[str, ...]) -> list[str]:
    """Return the hinges and slides that have valid names in recordings and are not held."""
    names = (model.joint(index).name for index in range(model.njnt) if model.jnt_type[index] in _ONE_DIRECTION)
    return [name for name in names if is_name(name) and name not in held]


_ONE_DIRECTION = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def check_sites(path: Path, model: mujoco.MjModel, tracked: str, points: tuple[str, ...]) -> None:
    """Check the tracked site and the points.

    **Raises** `InputError` if a site is missing, does not move, or belongs to another robot than the tracked site. A
    free joint that does not move the tracked site is refused, too.
    """
    linked, roots = linked_roots(model), []
    for key, site in (("tracked", tracked), *(("points", point) for point in points)):
        body = model.site_bodyid[find_part(path, model, mujoco.mjtObj.mjOBJ_SITE, key, site)]
        roots.append(linked[int(model.body_rootid[body])])
        if model.body_weldid[body] == 0:
            refuse(path, f'"{key}" names {shown(site)}, a site that does not move', "name sites of the robot only")
        if roots[-1] != roots[0]:
            problem = f'"{key}" names {shown(site)}, which belongs to another robot than {tracked}'
            fix = "name sites below one child of the world body, or connect their bodies by an equality"
            refuse(path, problem, fix)
    root = model.body_rootid[model.site(tracked).bodyid[0]]
    if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE and model.jnt_bodyid[0] != root:
        problem = f'"model" has a free joint that does not move the site {tracked}, {shown(model.joint(0).name)}'
        refuse(path, problem, "remove it, since objects of the scene cannot move freely, or track a site of its body")


def check_actuators(
    path: Path, model: mujoco.MjModel, driven: Mapping[str, tuple[str, tuple[float, float] | None]]
) -> tuple[tuple[float, float], ...]:
    """Return the range of each command.

    **Raises** `InputError` if the actuators in `driven` are not those of the model.
    """
    own = [model.actuator(index).name for index in range(model.nu)]
    named = [name for name, _ in driven.values()]
    if named != own:
        problem = f'"commands" has the actuators {shown(named)}'
        refuse(
            path,
            problem,
            f"name the model's actuators, all in its order: {textwrap.shorten(', '.join(own), 200) or 'none'}",
        )
    if model.na:
        refuse(path, '"model" has actuators with activation states', "use actuators without them")
    ranges = []
    for index, (name, given) in enumerate(driven.values()):
        if given is None and not model.actuator_ctrllimited[index]:
            fix = f'give it one, or write {{"actuator": "{name}", "range": [low, high]}} in "commands"'
            refuse(path, f"the model's actuator {shown(name)} has no ctrlrange", fix)
        low, high = given or map(float, model.actuator_ctrlrange[index])
        if not low < high:
            refuse(path, f"the range of {shown(name)} is {low:g} to {high:g}", "give the smaller number first")
        ranges.append((low, high))
    return tuple(ranges)


def check_keyframe(path: Path, model: mujoco.MjModel, name: str) -> None:
    """Check that the model has a keyframe of this name.

    **Raises** `InputError` if it does not.
    """
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, name) < 0:
        own = ", ".join(model.key(index).name for index in range(model.nkey)) or "none"
        refuse(path, f'"keyframe" is {shown(name)}, which is no keyframe of the model', f"there are {own}")


def find_part(path: Path, model: mujoco.MjModel, kind: mujoco.mjtObj, key: str, name: str) -> int:
    """Return the index of a site or joint that the description names under `key`.

    **Raises** `InputError` if the model does not have it.
    """
    index = mujoco.mj_name2id(model, kind, name)
    if index < 0:
        what = "site" if kind == mujoco.mjtObj.mjOBJ_SITE else "joint"
        count, named = (model.nsite, model.site) if what == "site" else (model.njnt, model.joint)
        own = ", ".join(named(number).name for number in range(count)) or "none"
        refuse(
            path,
            f'"{key}" names {shown(name)}, which is no {what} of the model',
            f"there are {textwrap.shorten(own, 200)}",
        )
    return int(index)
