"""Write a robot's model with changed values as an MJCF file, with its assets in one folder."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.rotations import quaternion_to_matrix

_ELEMENTS: Mapping[str, tuple[str, str]] = {
    "dof_damping": ("joints", "damping"),
    "dof_armature": ("joints", "armature"),
    "dof_frictionloss": ("joints", "frictionloss"),
    "jnt_stiffness": ("joints", "stiffness"),
    "jnt_range": ("joints", "range"),
    "qpos_spring": ("joints", "springref"),
    "tendon_stiffness": ("tendons", "stiffness"),
    "tendon_damping": ("tendons", "damping"),
    "tendon_frictionloss": ("tendons", "frictionloss"),
    "tendon_lengthspring": ("tendons", "springlength"),
    "tendon_range": ("tendons", "range"),
    "geom_friction": ("geoms", "friction"),
    "actuator_gainprm": ("actuators", "gainprm"),
    "actuator_biasprm": ("actuators", "biasprm"),
    "actuator_forcerange": ("actuators", "forcerange"),
    "body_gravcomp": ("bodies", "gravcomp"),
}
"""Elements and attribute in MuJoCo's model specification (`mujoco.MjSpec`), by field of the compiled model."""
_ANGLES = ("jnt_range", "qpos_spring")
"""Fields that are angles for `_ANGULAR` joints. A specification may have them in degrees, compiled models in rad."""
_ANGULAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL))
_INERTIAL = ("body_mass", "body_ipos", "body_iquat", "body_inertia")
_ROTATED = ("body_iquat", "body_inertia")
"""Fields that form an inertia tensor together. Several pairs of principal axes and moments form the same one."""
WRITTEN_FIELDS = (*_ELEMENTS, *_INERTIAL)
"""Fields of the compiled model that `write_fields` writes."""
_ROUNDING = 1e-5
"""Relative difference of two values that count as equal."""
_ASSETS = "assets"


def write_mjcf(file: Path, wanted: mujoco.MjModel, folder: Path, name: str) -> dict[str, np.ndarray]:
    """Write the model in `file` with the values of `wanted` as `folder / name`, and its assets into `folder / assets`.

    **Returns** the fields that the MJCF file does not reproduce exactly, since its numbers have six digits. Names are
    `model/FIELD` and `option/FIELD`. Each is a whole field with the values of `wanted`.

    **Raises** `InputError` if an asset is missing, or if MuJoCo cannot read the file that it wrote.
    """
    spec = mujoco.MjSpec.from_file(str(file))
    write_fields(spec, wanted)
    _copy_assets(spec, file, folder)
    try:
        spec.compile()
        (folder / name).write_text(spec.to_xml(), encoding="utf-8")
        written = mujoco.MjModel.from_xml_path(str(folder / name))
    except (ValueError, mujoco.FatalError) as error:
        problem = " ".join(str(error).split())
        raise InputError(f"{file}: MuJoCo cannot write this model as one file ({problem}); simplify it.") from error
    return _differences(written, wanted, file)


def write_fields(spec: mujoco.MjSpec, wanted: mujoco.MjModel) -> None:
    """Set the values in which `wanted` differs from the compiled specification, in place.

    Fields without an attribute in the specification are skipped.
    """
    base = spec.compile()
    _hold_computed_values(spec, base)
    spec.option.iterations = wanted.opt.iterations
    for field, (kind, own) in _ELEMENTS.items():
        old, new = (getattr(model, field) for model in (base, wanted))
        parts = {part.id: part for part in getattr(spec, kind)}
        for place in np.argwhere(old != new):
            index = int(place[0])
            if field.startswith("dof_"):
                index = int(base.dof_jntid[index])
            elif field.startswith("qpos_"):
                index = int(np.flatnonzero(base.jnt_qposadr <= index)[-1])
            part, value = parts[index], float(new[tuple(place)])
            if field in _ANGLES and spec.compiler.degree and base.jnt_type[index] in _ANGULAR:
                value = math.degrees(value)
            if isinstance(getattr(part, own), np.ndarray):
                getattr(part, own)[int(place[1]) if len(place) > 1 else 0] = value
            else:
                setattr(part, own, value)
    moved = {
        int(row) for field in _INERTIAL for row in np.argwhere(getattr(base, field) != getattr(wanted, field))[:, 0]
    }
    compiler, automatic = spec.compiler, mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    if moved and (compiler.inertiafromgeom != automatic or compiler.settotalmass > 0):
        # With these settings the compiler would replace or scale the values below.
        compiler.inertiafromgeom, compiler.settotalmass = automatic, -1.0
        moved = set(range(1, base.nbody))
    for body in spec.bodies:
        if body.id in moved:
            body.explicitinertial = True
            body.mass, body.ipos = wanted.body_mass[body.id], wanted.body_ipos[body.id]
            body.iquat, body.inertia = wanted.body_iquat[body.id], wanted.body_inertia[body.id]
            # The compiler would compute both again from a full inertia matrix, and the axes from an angle.
            body.fullinertia, body.ialt.type = [np.nan, 0, 0, 0, 0, 0], mujoco.mjtOrientation.mjORIENTATION_QUAT


def differing_fields(one: mujoco.MjModel, other: mujoco.MjModel, names: Iterable[str]) -> tuple[str, ...]:
    """Return the fields among `names` in which two compiled models differ by more than rounding.

    Principal axes and moments are compared as inertia tensors.
    """
    return tuple(name for name in names if not _agree(one, other, name))


def _agree(one: mujoco.MjModel, other: mujoco.MjModel, name: str) -> bool:
    if name in _ROTATED:
        far = np.abs(_inertia_tensors(one) - _inertia_tensors(other)).max(axis=(1, 2))
        return bool(np.all(far <= _ROUNDING * other.body_inertia.max(axis=1)))
    return np.allclose(getattr(one, name), getattr(other, name), rtol=_ROUNDING, atol=1e-8, equal_nan=True)


def _inertia_tensors(model: mujoco.MjModel) -> Float[np.ndarray, "bodies 3 3"]:
    axes = quaternion_to_matrix(model.body_iquat)
    return np.einsum("bij,bj,bkj->bik", axes, model.body_inertia, axes)


def _hold_computed_values(spec: mujoco.MjSpec, base: mujoco.MjModel) -> None:
    """Replace attributes from which the compiler computes values by these values, in place.

    With changed masses the compiler would compute other values. `base` is the compiled specification.
    """
    for actuator in spec.actuators:
        if actuator.biasprm[2] > 0:  # a damping ratio
            actuator.biasprm[2] = base.actuator_biasprm[actuator.id, 2]
    for joint in spec.joints:
        if joint.springdamper.all():
            joint.springdamper = np.zeros(2)
            joint.stiffness[0] = base.jnt_stiffness[joint.id]
            joint.damping[0] = base.dof_damping[base.jnt_dofadr[joint.id]]


def _copy_assets(spec: mujoco.MjSpec, file: Path, folder: Path) -> None:
    """Copy the model's assets into one folder, and refer to the copies in the specification."""
    included = [Path(each).parent for each in mujoco.mju_getXMLDependencies(str(file)) if each.endswith(".xml")]
    places = [place / sub for place in (file.parent, *included) for sub in (spec.meshdir, spec.texturedir, "")]
    taken: dict[str, Path] = {}

    def copy(named: str) -> str:
        found = next((place / named for place in places if (place / named).is_file()), None)
        if found is None:
            raise InputError(f"{file}: its asset {named} is missing; restore it.")
        name, number = found.name, 0
        while taken.setdefault(name, found.resolve()) != found.resolve():
            number += 1
            name = f"{number}-{found.name}"
        (folder / _ASSETS).mkdir(parents=True, exist_ok=True)
        shutil.copyfile(found, folder / _ASSETS / name)
        return name

    for asset in (*spec.meshes, *spec.hfields, *spec.textures, *spec.skins):
        if asset.file:
            asset.name = asset.name or Path(asset.file).stem
            asset.file = copy(asset.file)
        for index, cube in enumerate(getattr(asset, "cubefiles", ())):
            if cube:
                asset.cubefiles[index] = copy(cube)
    spec.meshdir = spec.texturedir = _ASSETS
    spec.modelfiledir = str(folder)


def _differences(written: mujoco.MjModel, wanted: mujoco.MjModel, file: Path) -> dict[str, np.ndarray]:
    """Return the floating-point fields in which `written` differs from `wanted`, with the values of `wanted`."""
    found: dict[str, np.ndarray] = {}
    for owner, one, other in (("model", written, wanted), ("option", written.opt, wanted.opt)):
        for name in dir(other):
            value: Any = None if name.startswith("_") else getattr(other, name, None)
            if isinstance(value, float):
                value = np.array(value)
            if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
                continue
            own = np.asarray(getattr(one, name))
            if own.shape != value.shape:
                raise InputError(
                    f"{file}: MuJoCo changes the size of {name} when it writes this model; simplify the model."
                )
            if not np.array_equal(own, value, equal_nan=True):
                found[f"{owner}/{name}"] = value.copy()
    return found
