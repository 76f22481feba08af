"""Declarations of parameters that recordings may identify.

They are listed under the key `identify` of a robot description. An entry names an element of the model, and the field
to identify:

- `{"joint": "hinge", "field": "damping"}`. Fields: damping, armature, frictionloss, stiffness, springref.
- `{"actuator": "motor", "field": "kp"}`. Fields: kp (position feedback; scales gain and position bias together), kd
  (velocity feedback), strength (scales gain and bias), gain, bias, forcerange (upper end; the lower one in proportion).
- `{"tendon": "cable", "field": "springlength"}`. Fields: stiffness, damping, frictionloss, springlength (upper end).
- `{"geom": "tip", "field": "friction"}`. Field: friction (sliding).
- `{"body": "arm", "field": "mass"}`. Fields: mass (scales the inertia too), com (3 parameters), inertia (6), or
  mass_properties for all 10. Each of the ten is a field too, such as com_z or stretch_x.
- `{"command": "left", "field": "delay"}`. Fields: scale, offset, delay, backlash, rate_limit, lag (`sim.drivetrain`).
- Any other numeric field of an element, by MuJoCo's name: `{"joint": "hinge", "field": "jnt_range", "index": 0}`.

Elements in a list share one value: `{"joint": ["hinge_left", "hinge_right"], ...}`. `"targets"` is a list of
element-field pairs, each with an optional `"factor"`. It ties different fields to one value. One of a body's ten mass
properties is tied only to the same one of other bodies. It has a factor only if its nominal value is 0 (com and shear).
Optional keys: `name`, `unit`, `bounds`, `prior` (standard deviation among robots), `nominal`.

A shared `mass` has the value of the first body. With factors, the value is that of the first target over its factor.
The inertia of a body is parametrized by a deformation of its nominal mass distribution. The parameters are stretches
(`stretch_x`, ...) and shears (`shear_xy`, ...) along the nominal principal axes. They form a log-Cholesky factor
relative to nominal (Rucker and Wensing, RA-L 7(2), 2022). Any mass above 0 and any stretches above 0 give an inertia
that a rigid body can have.
"""

from __future__ import annotations

import math
import re
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import jax
import mujoco
import numpy as np
from mujoco import mjx

from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.identification.body_deformation import BODY_QUANTITIES, UNDEFORMED
from ballu_mjx.identification.parameters import BodyTarget, CommandTarget, FieldTarget, Parameter, ParameterSet, Target
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.c_model import DERIVED_FIELDS
from ballu_mjx.sim.drivetrain import QUANTITIES

_BODY_GROUPS = {
    "mass": BODY_QUANTITIES[:1],
    "com": BODY_QUANTITIES[1:4],
    "inertia": BODY_QUANTITIES[4:],
    "mass_properties": BODY_QUANTITIES,
    **{name: (name,) for name in BODY_QUANTITIES[1:]},
}


def declared_parameters(robot: RobotDescription, model: mujoco.MjModel) -> ParameterSet:
    """Return the parameters that a robot description declares under `identify`.

    **Raises** `InputError` naming the description, the entry and the fix.
    """
    if not robot.identify:
        raise InputError(f'{robot.file}: "identify" is missing; list the parameters to identify there.')
    found = parameters_of(robot, model, robot.identify)
    names = [parameter.name for parameter in found]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f'{robot.file}: "identify" has two parameters {name}; give them different names.')
    places = [(name, target[:2]) for name, p in zip(names, found, strict=True) for target in p.targets]
    for name, place in places:
        for other, same in places:
            if name != other and place == same:
                problem = f'"identify" sets the same number by {name} and {other}'
                raise InputError(f"{robot.file}: {problem}; leave one out.")
    return ParameterSet(found, len(robot.commands))


def parameters_of(
    robot: RobotDescription, model: mujoco.MjModel, entries: Sequence[Mapping[str, Any]]
) -> list[Parameter]:
    """Return the parameters of entries that are written as under `identify`.

    **Raises** `InputError` naming the description, the entry and the fix.
    """
    return [
        parameter
        for number, entry in enumerate(entries, 1)
        for parameter in _Declaration(robot, model, number, entry).parameters()
    ]


_ELEMENTS = ("joint", "actuator", "tendon", "geom", "body", "command")
_TARGET_KEYS = ("field", "index", "factor")
"""Keys of a target besides that of its element."""
_KEYS = (*_ELEMENTS, *_TARGET_KEYS, "targets", "name", "unit", "nominal", "bounds", "prior")
_FIELDS: Mapping[str, Mapping[str, str]] = {
    "joint": {
        "damping": "dof_damping",
        "armature": "dof_armature",
        "frictionloss": "dof_frictionloss",
        "stiffness": "jnt_stiffness",
        "springref": "qpos_spring",
    },
    "actuator": {"gain": "actuator_gainprm", "bias": "actuator_biasprm"},
    "tendon": {
        "stiffness": "tendon_stiffness",
        "damping": "tendon_damping",
        "frictionloss": "tendon_frictionloss",
        "springlength": "tendon_lengthspring",
    },
    "geom": {"friction": "geom_friction"},
    "body": {},
}
_FIXED_INDEX = {"actuator_gainprm": 0, "actuator_biasprm": 0, "tendon_lengthspring": 1, "geom_friction": 0}
_SERVO_FIELDS = ("kp", "kd", "strength", "forcerange")
_PREFIXES = {
    "joint": ("jnt_", "dof_", "qpos_"),
    "actuator": ("actuator_",),
    "tendon": ("tendon_",),
    "geom": ("geom_",),
    "body": ("body_",),
}
_OBJECTS = {
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "body": mujoco.mjtObj.mjOBJ_BODY,
}
_UNITS = {
    "damping": "N m s/rad",
    "armature": "kg m^2",
    "frictionloss": "N m",
    "stiffness": "N m/rad",
    "springref": "rad",
    "kp": "N m/rad",
    "kd": "N m s/rad",
    "forcerange": "N m",
    "springlength": "m",
    "mass": "kg",
    "delay": "s",
    "lag": "s",
}
_UNITS_OF_LENGTHS = {
    "damping": "N s/m",
    "armature": "kg",
    "frictionloss": "N",
    "stiffness": "N/m",
    "springref": "m",
    "kp": "N/m",
    "kd": "N s/m",
    "forcerange": "N",
}
"""Units of slides and tendons."""
_SCALAR_JOINTS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_DERIVED = (*DERIVED_FIELDS, "dof_M0", "tendon_length0", "actuator_acc0")
"""Fields that MuJoCo computes from others."""
_SIGNED = ("springref", "bias", "offset")
"""Fields whose values may be below 0."""
_FACTOR = 4.0
"""Default bounds are the nominal value divided and multiplied by this factor."""
_SPREAD = 0.3
"""Default prior standard deviation, relative to the nominal value."""
_RADIUS = 0.5
"""Default bound on the shift of a body's centre of mass, relative to its radius of gyration, and on its shears."""


class _Declaration:
    """One entry of `identify`."""

    def __init__(self, robot: RobotDescription, model: mujoco.MjModel, number: int, entry: Mapping[str, Any]) -> None:
        self.file, self.robot, self.model, self.entry = Path(robot.file), robot, model, entry
        self.label = f'"identify" entry {number}'
        for key in entry:
            if key not in _KEYS:
                self.refuse(f'has the key "{key}"', f"the keys are {', '.join(_KEYS)}")

    def refuse(self, problem: str, fix: str) -> NoReturn:
        """Raise `InputError` with the file, the entry, the problem and the fix."""
        raise InputError(f"{self.file}: {self.label} {problem}; {fix}.")

    def parameters(self) -> list[Parameter]:
        """Return the parameters of this entry: one, or several of a body."""
        parts = self._parts()
        kind, _, field, _ = parts[0]
        if kind == "body" and field in _BODY_GROUPS:
            return [self._body_parameter(parts, quantity) for quantity in _BODY_GROUPS[field]]
        nominals, targets = [], []
        for kind, element, field, factor in parts:
            if kind == "body" and field in _BODY_GROUPS:
                self.refuse(
                    "ties a body's mass properties to another quantity", "tie them to those of other bodies only"
                )
            nominal, own = self._targets(kind, element, field)
            nominals.append(nominal / factor)
            targets += [target._replace(factor=target.factor * factor) for target in own]
        nominal = self._number("nominal", nominals[0])
        if any(not math.isclose(x, nominals[0], rel_tol=1e-6, abs_tol=1e-12) for x in nominals):
            shown = ", ".join(f"{x:g}" for x in nominals)
            self.refuse(
                f"ties elements whose nominal values differ ({shown})", 'write "targets", each with its "factor"'
            )
        name = "_and_".join(dict.fromkeys(str(part[1]) for part in parts)) + f"_{parts[0][2]}"
        name = re.sub(r"\W+", "_", name).strip("_")
        name = name if name.isidentifier() else f"_{name}"
        return [self._parameter(name, parts[0], nominal, tuple(targets))]

    def _parts(self) -> list[tuple[str, str, str, float]]:
        """Return (kind, element, field, factor) of each target of the entry."""
        if "targets" in self.entry:
            for key in (*_ELEMENTS, *_TARGET_KEYS):
                if key in self.entry:
                    self.refuse(f'has the key "{key}" beside "targets"', "write it in a target")
            targets = self.entry["targets"]
            if not isinstance(targets, list) or not targets or not all(isinstance(each, dict) for each in targets):
                self.refuse(
                    'has "targets" that are not a list of objects', 'write [{"joint": ..., "field": ..., "factor": 1}]'
                )
            for target in targets:
                for key in target:
                    if key not in (*_ELEMENTS, *_TARGET_KEYS):
                        self.refuse(
                            f'has a target with the key "{key}"',
                            f"its keys are an element and {', '.join(_TARGET_KEYS)}",
                        )
            return [part for target in targets for part in self._part(target)]
        return self._part(self.entry)

    def _part(self, entry: Mapping[str, Any]) -> list[tuple[str, str, str, float]]:
        kinds = [kind for kind in _ELEMENTS if kind in entry]
        if len(kinds) != 1:
            self.refuse(f"names {len(kinds)} kinds of elements", f"name one of {', '.join(_ELEMENTS)}")
        elements, field, factor = entry[kinds[0]], entry.get("field"), entry.get("factor", 1.0)
        elements = elements if isinstance(elements, list) else [elements]
        if not elements or not all(isinstance(each, str) for each in elements):
            self.refuse(f'has "{kinds[0]}" {elements!r}', "write a name, or a list of names that share the value")
        if not isinstance(field, str):
            self.refuse('has no "field"', f"write one of {', '.join(self._known(kinds[0]))}")
        if not is_number(factor) or factor == 0:
            self.refuse(f'has the "factor" {factor!r}', "write a number other than 0")
        signed = field in _SIGNED or (kinds[0] == "body" and field != "mass")
        if factor < 0 and not signed and field in self._known(kinds[0]):
            self.refuse(f'has the "factor" {factor!r}', f"{field} must be 0 or more; write a factor above 0")
        if "index" in entry:
            field = f"{field}[{entry['index']}]"
        return [(kinds[0], each, field, float(factor)) for each in elements]

    def _known(self, kind: str) -> tuple[str, ...]:
        if kind == "command":
            return QUANTITIES
        own = (*_FIELDS[kind], *(_SERVO_FIELDS if kind == "actuator" else ()))
        return (*own, *(_BODY_GROUPS if kind == "body" else ()))

    def _id(self, kind: str, element: str) -> int:
        index = mujoco.mj_name2id(self.model, _OBJECTS[kind], element)
        if index < 0:
            count = {"joint": "njnt", "actuator": "nu", "tendon": "ntendon", "geom": "ngeom", "body": "nbody"}[kind]
            own = [getattr(self.model, kind)(number).name for number in range(getattr(self.model, count))]
            self.refuse(
                f"names {element!r}, which is no {kind} of the model",
                f"there are {', '.join(filter(None, own)) or 'none'}",
            )
        return int(index)

    def _targets(self, kind: str, element: str, field: str) -> tuple[float, tuple[Target, ...]]:
        """Return the nominal value of a field, and the targets that set it."""
        if kind == "command":
            if element not in self.robot.commands:
                self.refuse(f"names {element!r}, which is no command", f"there are {', '.join(self.robot.commands)}")
            if field not in QUANTITIES:
                self.refuse(f'has the field "{field}"', f"there are {', '.join(QUANTITIES)}")
            command = self.robot.commands.index(element)
            nominal = {"scale": 1.0, "rate_limit": math.inf}.get(field, 0.0)
            return nominal, (CommandTarget(command, field, 1.0),)
        index = self._id(kind, element)
        if kind == "actuator" and field in _SERVO_FIELDS:
            return self._position_control(index, element, field)
        if field in _FIELDS[kind]:
            own = _FIELDS[kind][field]
            rest = (_FIXED_INDEX[own],) if own in _FIXED_INDEX else ()
        else:
            own, rest = self._raw(kind, field)
        if own == "actuator_biasprm" and not self.model.actuator_biastype[index]:
            self.refuse(f"declares the bias of {element}, which has none", 'give the actuator biastype="affine"')
        if kind == "joint":
            address = {"dof_": self.model.jnt_dofadr, "qpos_": self.model.jnt_qposadr}.get(own.split("_")[0] + "_")
            if address is not None:
                if int(self.model.jnt_type[index]) not in _SCALAR_JOINTS:
                    self.refuse(f"names {element}, which is no hinge or slide", "name hinges and slides only")
                index = int(address[index])
        place = (index, *rest)
        array = np.asarray(getattr(self.model, own))
        if array[place].ndim or not np.issubdtype(array.dtype, np.floating):
            self.refuse(f"has the field {own}, which has the shape {array.shape[1:]}", 'add the "index" of one number')
        targets = [FieldTarget(own, place, 1.0)]
        if field == "springlength" and array[index, 0] == array[index, 1]:
            targets.append(FieldTarget(own, (index, 0), 1.0))  # without a dead band, both ends are equal
        return float(array[place]), tuple(targets)

    def _raw(self, kind: str, field: str) -> tuple[str, tuple[int, ...]]:
        """Return MuJoCo's name of a field, and the index within the element's row (empty without one)."""
        name, _, rest = field.partition("[")
        known = name.startswith(_PREFIXES[kind]) and isinstance(getattr(self.model, name, None), np.ndarray)
        if not known or name in ("body_mass", "body_ipos", "body_iquat", "body_inertia"):
            self.refuse(f'has the field "{field}"', f"there are {', '.join(self._known(kind))}, and MuJoCo's own names")
        if name in _DERIVED:
            self.refuse(f'has the field "{field}", which MuJoCo derives', "name a field that it follows from")
        if typing.get_type_hints(mjx.Model).get(name) is not jax.Array:
            self.refuse(f'has the field "{field}", which MJX does not simulate', "name another field")
        shape = getattr(self.model, name).shape[1:]
        number = rest.removesuffix("]")
        if not rest:
            return name, ()
        if not number.isdecimal() or len(shape) != 1 or int(number) >= shape[0]:
            self.refuse(f"has the index {number} in {name}, which has the shape {shape}", "give an index within it")
        return name, (int(number),)

    def _position_control(self, index: int, element: str, field: str) -> tuple[float, tuple[Target, ...]]:
        """Return the nominal value of an actuator's kp, kd, strength or forcerange, and the targets that set it."""
        model = self.model
        gain, bias = model.actuator_gainprm[index], model.actuator_biasprm[index]
        affine = model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_AFFINE

        def of(name: str, place: int, factor: float) -> FieldTarget:
            return FieldTarget(f"actuator_{name}", (index, place), factor)

        if field == "forcerange":
            low, high = model.actuator_forcerange[index]
            if not model.actuator_forcelimited[index] or high <= 0:
                self.refuse(f"declares the forcerange of {element}, which has none", "give the actuator a forcerange")
            return float(high), (of("forcerange", 0, float(low / high)), of("forcerange", 1, 1.0))
        if field == "strength":
            prms = [("gainprm", gain), *([("biasprm", bias)] if affine else [])]
            return 1.0, tuple(of(n, i, float(x)) for n, prm in prms for i, x in enumerate(prm[:3]) if x)
        place = {"kp": 1, "kd": 2}[field]
        if not affine or (field == "kp" and bias[place] == 0):
            self.refuse(f"declares {field} of {element}, which has no such feedback", "use a position actuator")
        value = float(-bias[place])
        if field == "kd":
            return value, (of("biasprm", 2, -1.0),)
        others = [of("gainprm", 0, float(gain[0] / value)), of("biasprm", 0, float(bias[0] / value))]
        return value, (of("biasprm", 1, -1.0), *others)

    def _body_parameter(self, parts: list[tuple[str, str, str, float]], quantity: str) -> Parameter:
        place, targets = BODY_QUANTITIES.index(quantity), []
        first = self._id("body", parts[0][1])
        mass, inertia = float(self.model.body_mass[first]), self.model.body_inertia[first]
        if mass <= 0 or np.any(2 * inertia >= inertia.sum()):
            problem = (
                f"declares mass properties of {parts[0][1]}, whose nominal mass or inertia is not that of a rigid body"
            )
            self.refuse(
                problem,
                "give it a mass above 0, and moments of inertia that are each smaller than the sum of the other two",
            )
        for kind, element, field, factor in parts:
            if kind != "body" or field != parts[0][2]:
                self.refuse(
                    "ties a body's mass properties to another quantity", "tie them to those of other bodies only"
                )
            if factor != 1.0 and UNDEFORMED[place] != 0:
                self.refuse(
                    f'has a "factor" of {quantity}', "leave it out: bodies that share mass or stretch keep their ratio"
                )
            body = self._id("body", element)
            targets.append(BodyTarget(body, place, 1 / mass if quantity == "mass" else factor))
        nominal = mass if quantity == "mass" else UNDEFORMED[place]
        name = "_and_".join(part[1] for part in parts) + f"_{quantity}"
        group = len(_BODY_GROUPS[parts[0][2]]) > 1
        radius = math.sqrt(float(inertia.sum()) / 2 / mass) if quantity.startswith("com_") else 1.0
        reach = _RADIUS * radius / abs(parts[0][3])
        bounds = (-reach, reach) if nominal == 0 else (nominal / _FACTOR, nominal * _FACTOR)
        for key in ("nominal", "unit", *(("bounds", "prior") if group else ())):
            if key in self.entry:
                why = " for several parameters" if group else ", which follows from the model"
                self.refuse(f'has "{key}"{why}', "leave it out")
        if not group:
            bounds = self._bounds(bounds, nominal)
        if nominal > 0 and bounds[0] <= 0:
            self.refuse(f'has "bounds" that begin at {bounds[0]:g}', f"{quantity} must be above 0")
        prior = _SPREAD * (nominal or reach)
        unit = {"m": "kg", "c": "m"}.get(quantity[0], "1")
        prior = prior if group else self._positive("prior", prior)
        name = name if group else self._text("name", name)
        return Parameter(name, unit, nominal, bounds, prior, nominal > 0 and bounds[0] > 0, tuple(targets))

    def _parameter(
        self, name: str, part: tuple[str, str, str, float], nominal: float, targets: tuple[Target, ...]
    ) -> Parameter:
        kind, element, field, _ = part
        bounds: tuple[float, float] | None = None
        if nominal > 0 and math.isfinite(nominal) and field not in _SIGNED:
            bounds = nominal / _FACTOR, nominal * _FACTOR
        span = 0.0
        if kind == "command":
            low, high = self.robot.command_ranges[self.robot.commands.index(element)]
            span = high - low
            bounds = {
                "scale": (0.5, 1.5),
                "offset": (-0.25 * span, 0.25 * span),
                "delay": (0.0, 0.1),
                "backlash": (0.0, 0.2 * span),
                "rate_limit": (0.1 * span, span / float(self.model.opt.timestep)),
                "lag": (0.0, 0.2),
            }[field]
        bounds = self._bounds(bounds, nominal)
        nominal = min(nominal, bounds[1])
        if kind == "command":
            # The prior of a rate limit is wide, because its nominal value means that no limit is known.
            prior = {"scale": 0.1, "delay": 0.02, "lag": 0.03, "rate_limit": nominal}.get(field, 0.05 * span)
        elif nominal > 0 and field not in _SIGNED:
            prior = _SPREAD * nominal
        else:
            prior = (bounds[1] - bounds[0]) / 4
        if field not in _SIGNED and bounds[0] < 0 and field in self._known(kind):
            self.refuse(f'has "bounds" that begin at {bounds[0]:g}', f"{field} must be 0 or more")
        return Parameter(
            name=self._text("name", name),
            unit=self._text("unit", self._unit(kind, element, field)),
            nominal=nominal,
            bounds=bounds,
            prior=self._positive("prior", prior),
            logarithmic=nominal > 0 and bounds[0] > 0,
            targets=targets,
        )

    def _unit(self, kind: str, element: str, field: str) -> str:
        if kind in ("joint", "actuator"):
            joint = self._id(kind, element)
            if kind == "actuator":
                joint = int(self.model.actuator_trnid[joint, 0])
                on_joint = self.model.actuator_trntype[self._id(kind, element)] == mujoco.mjtTrn.mjTRN_JOINT
            else:
                on_joint = True
            if on_joint and self.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
                return _UNITS.get(field, "1" if field == "strength" else "")
            return _UNITS_OF_LENGTHS.get(field, "1" if field == "strength" else "")
        if kind == "tendon":
            return _UNITS_OF_LENGTHS.get(field, _UNITS.get(field, ""))
        return {"scale": "1", "friction": "1", "rate_limit": "1/s"}.get(field, _UNITS.get(field, ""))

    def _bounds(self, default: tuple[float, float] | None, nominal: float) -> tuple[float, float]:
        value = self.entry.get("bounds", default)
        if value is None:
            self.refuse('has no "bounds", and its nominal value gives no default', 'add "bounds": [low, high]')
        pair = isinstance(value, list | tuple) and len(value) == 2 and all(map(is_number, value))
        if not pair or not value[0] < value[1]:
            self.refuse(f'has "bounds" {value!r}', "write two numbers, the smaller first")
        low, high = map(float, value)
        # An infinite nominal value (no rate limit) counts as the upper bound.
        if nominal < low or (nominal > high and math.isfinite(nominal)):
            self.refuse(f'has "bounds" {low:g} to {high:g}, which exclude the nominal {nominal:g}', "widen them")
        return low, high

    def _number(self, key: str, default: float) -> float:
        value = self.entry.get(key, default)
        if key in self.entry and not is_number(value):
            self.refuse(f'has "{key}" {value!r}', "write a number")
        return float(value)

    def _positive(self, key: str, default: float) -> float:
        value = self._number(key, default)
        if value <= 0:
            self.refuse(f'has "{key}" {value:g}', "write a number above 0")
        return value

    def _text(self, key: str, default: str) -> str:
        value = self.entry.get(key, default)
        if not isinstance(value, str) or (key == "name" and not value.isidentifier()):
            self.refuse(f'has "{key}" {value!r}', "write text; a name has letters, digits and underscores only")
        return value
