"""Fluid residual: force and torque on the tracked body as polynomials of its motion, for any body in air or water.

In the body frame, the wrench is a linear combination of terms. Terms are products of the velocity v, the angular
velocity w, the speed |v| and the direction of gravity. These terms include lift, drag, side force and moments as
functions of angle of attack and sideslip: |v|^2 alpha is v_x v_z for small angles. Rotary damping is linear in w. The
effect of a wrong weight or centre of mass is linear in the direction of gravity.

Fluid that the body drags along adds mass and moments of inertia to the body. Its weight is balanced by its buoyancy.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.residuals.added_mass import DraggingBody
from ballu_mjx.residuals.body_motion import body_motion, smooth_speed
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_input import network_input
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.residual import Action, Commands, Fields, History, Residual

FLUID_FORMAT = "ballu-fluid/2"
_OLD_FORMAT = "ballu-fluid/1"
"""Format without added mass."""
FLUID_FILE = "fluid.json"

TermSet = Literal["linear", "drag", "quadratic", "cubic"]
TERM_SETS: tuple[TermSet, ...] = ("linear", "drag", "quadratic", "cubic")
"""Sets of terms. Each set also has the terms of the sets before it.

- `linear`: direction of gravity, and velocities (linear and angular).
- `drag`: velocities times the speed.
- `quadratic`: products of two velocities.
- `cubic`: products of three velocities divided by the speed. At least two of the three are linear velocities.
"""
AXES = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")
"""Components of a wrench (N, N m), in the body frame."""
_MOTION = ("vx", "vy", "vz", "wx", "wy", "wz")
_GRAVITY = ("gx", "gy", "gz")
_ODD = ("vy", "wx", "wz", "gy")
"""Components of the motion whose sign changes under reflection at the xz plane."""
_ODD_AXES = np.array([False, True, False, True, False, True])
"""Mask of the components of a wrench whose sign changes under this reflection."""


class Term(NamedTuple):
    """A term: a product of components of the motion, times a power of the speed."""

    factors: tuple[str, ...]
    """Names of the components: `vx`, `vy`, `vz` (velocity, m/s), `wx`, `wy`, `wz` (angular velocity, rad/s), `gx`,
    `gy`, `gz` (unit vector along gravity)."""
    power: int
    """Exponent of the speed (m/s)."""

    @property
    def name(self) -> str:
        """Return the name of the term, for example `vx*vz` or `wy*|v|`."""
        return "*".join(self.factors) + {1: "*|v|", 0: "", -1: "/|v|"}[self.power]

    @property
    def odd(self) -> bool:
        """Return whether the sign of the term changes under reflection at the xz plane."""
        return sum(factor in _ODD for factor in self.factors) % 2 == 1


def terms_of(name: TermSet) -> tuple[Term, ...]:
    """Return the terms of a set, including those of the sets before it."""
    products = itertools.combinations_with_replacement
    groups: dict[TermSet, list[Term]] = {
        "linear": [Term((factor,), 0) for factor in (*_GRAVITY, *_MOTION)],
        "drag": [Term((factor,), 1) for factor in _MOTION],
        "quadratic": [Term(pair, 0) for pair in products(_MOTION, 2)],
        "cubic": [
            Term(triple, -1)
            for triple in products(_MOTION, 3)
            if sum(factor.startswith("v") for factor in triple) >= _MIN_LINEAR
        ],
    }
    return tuple(term for each in TERM_SETS[: TERM_SETS.index(name) + 1] for term in groups[each])


_MIN_LINEAR = 2
"""Smallest number of linear velocities in a cubic term."""


def symmetric_mask(terms: Sequence[Term]) -> Bool[np.ndarray, "terms 6"]:
    """Return a mask of the coefficients that may differ from 0 for a body that is symmetric about the xz plane."""
    return np.array([term.odd for term in terms])[:, None] == _ODD_AXES


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class FluidParameters:
    """Parameters of the fluid residual, or their standard errors. Leading axes, if any, are batch axes."""

    coefficients: Float[Array | np.ndarray, "*batch terms 6"]
    """Coefficients (SI units) of each term, for the components of the wrench (`AXES`)."""
    added_mass: Float[Array | np.ndarray, "*batch"]
    """Mass of the fluid that the body drags along (kg)."""
    added_inertia: Float[Array | np.ndarray, "*batch 3"]
    """Moments of inertia of this fluid (kg m^2), about the principal axes of the tracked body."""

    @staticmethod
    def without_added_mass(coefficients: Float[Array | np.ndarray, "terms 6"]) -> FluidParameters:
        """Return parameters with these coefficients and no added mass."""
        return FluidParameters(coefficients, np.zeros(()), np.zeros(3))


def all_terms(params: FluidParameters) -> FluidParameters:
    """Return parameters with the coefficients of all terms of the largest set. Those of other terms are 0."""
    missing = len(terms_of(TERM_SETS[-1])) - len(params.coefficients)
    return dataclasses.replace(params, coefficients=np.pad(np.asarray(params.coefficients), [(0, missing), (0, 0)]))


class FluidResidual(Residual):
    """Fluid residual (`sim.residual.Residual`). Its parameters are `FluidParameters`."""

    def __init__(
        self, robot: RobotDescription, model: mujoco.MjModel, term_set: TermSet, *, added_mass: bool = False
    ) -> None:
        """Prepare the residual.

        **Arguments**

        - `robot`: robot.
        - `model`: the robot's C model without the residual.
        - `term_set`: set of terms.
        - `added_mass`: whether the residual changes the tracked body's mass and inertia. If not, the residual ignores
          these parameters.
        """
        self.robot, self.terms, self.added_mass = robot, terms_of(term_set), added_mass
        self.term_set: TermSet = term_set
        gravity = np.asarray(model.opt.gravity)
        size = float(np.linalg.norm(gravity))
        self._down = jnp.asarray(gravity / size if size > 0 else gravity)
        self._body = DraggingBody(robot, model)
        every = [*_MOTION, *_GRAVITY]
        most = max(len(term.factors) for term in self.terms)
        # Terms with fewer factors are filled up with the index after the last component, whose value is 1.
        self._factors = np.array(
            [[*map(every.index, term.factors), *[len(every)] * (most - len(term.factors))] for term in self.terms]
        )
        self._power = np.array([term.power for term in self.terms])

    @property
    def name(self) -> str:
        """Return the name of a simulator with this residual."""
        return "fluid"

    def inputs(self, history: History, commands: Commands) -> Float[Array, " inputs"]:
        """Return `network_input` with default options. It only serves for the training range; loads do not use it."""
        return network_input(history, commands, ForceNetworkConfig(), self.robot)

    def values(self, history: History) -> tuple[Float[Array, "3 3"], Float[Array, " terms"]]:
        """Return the body's rotation matrix (body to world), and the values of the terms."""
        frame, velocity, rate = body_motion(history, self.robot.control_timestep)
        speed = smooth_speed(velocity)
        components = jnp.concatenate([velocity, rate, frame.T @ self._down, jnp.ones(1)])
        return frame, jnp.prod(components[self._factors], axis=1) * speed**self._power

    def fields(self, params: FluidParameters) -> Fields:
        """Return model fields with the tracked body's mass, inertia and buoyancy. Without `added_mass`, return none."""
        if not self.added_mass:
            return {}
        return self._body.fields(params.added_mass, params.added_inertia)

    def act(self, params: FluidParameters, history: History, commands: Commands, key: Array | None = None) -> Action:
        """Return the wrench for the motion in the middle of the coming control step."""
        del commands, key
        frame, values = self.values(history)
        wrench = values @ params.coefficients
        return Action(jnp.concatenate([frame @ wrench[:3], frame @ wrench[3:]])[None])


@dataclasses.dataclass(frozen=True, eq=False)
class FluidEstimate:
    """Identified parameters of a fluid residual, with their standard errors."""

    term_set: TermSet
    values: FluidParameters
    standard_errors: FluidParameters
    """Standard errors. 0 for parameters that were not fitted."""

    @property
    def added_mass(self) -> bool:
        """Whether there is an added mass."""
        return bool(self.values.added_mass > 0)

    def residual(self, robot: RobotDescription, model: mujoco.MjModel) -> FluidResidual:
        """Return the residual of these parameters, for the C model of `robot` without the residual."""
        return FluidResidual(robot, model, self.term_set, added_mass=self.added_mass)

    @property
    def params(self) -> FluidParameters:
        """The parameters of the residual, in single precision."""
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), self.values)

    def to_json(self) -> str:
        """Return the content of `FLUID_FILE`: coefficients by component of the wrench and by term, and added mass."""
        groups: dict[str, Any] = {axis: {} for axis in AXES}
        for group, name, value, error in self._entries():
            if value != 0 or error != 0:
                groups.setdefault(group, {})[name] = {"value": value, "standard_error": error}
        added = {"added": groups.pop("added")} if "added" in groups else {}
        content = {"format": FLUID_FORMAT, "terms": self.term_set, "coefficients": groups, **added}
        return json.dumps(content, indent=2) + "\n"

    def table(self) -> str:
        """Return a table of the parameters that differ from 0 by two standard errors or more, as text."""
        lines = [f"{'':10}{'term':12}{'value':>12}{'std. error':>12}"]
        lines += [
            f"{group:10}{name:12}{value:>12.4g}{error:>12.2g}"
            for group, name, value, error in self._entries()
            if abs(value) >= 2 * error > 0
        ]
        lines.append(
            f"Terms: {self.term_set}; SI units, body frame. Parameters within two standard errors of 0 are left out."
        )
        return "\n".join(lines)

    def _entries(self) -> Iterator[tuple[str, str, float, float]]:
        """Yield group (component of the wrench, or `added`), name, value and standard error of each parameter."""
        terms = [term.name for term in terms_of(self.term_set)]
        both = self.values, self.standard_errors
        for axis, *columns in zip(AXES, *(each.coefficients.T for each in both), strict=True):
            for name, value, error in zip(terms, *columns, strict=True):
                yield axis, name, float(value), float(error)
        added = (np.append(each.added_mass, each.added_inertia) for each in both)
        for name, value, error in zip(_ADDED, *added, strict=True):
            yield "added", name, float(value), float(error)


_ADDED = ("mass", "inertia_x", "inertia_y", "inertia_z")
"""Names of the added mass and inertias in files and tables."""


def read_fluid(path: Path) -> FluidEstimate:
    """Read parameters from a file of the format `ballu-fluid/2`, which `train fluid` writes, or `ballu-fluid/1`.

    **Raises** `InputError` if the file is damaged. The message names file, key and fix.
    """
    fix = "restore it or identify again"
    content = files.read_json(path, fix)
    if content.get("format") not in (FLUID_FORMAT, _OLD_FORMAT) or content.get("terms") not in TERM_SETS:
        raise InputError(f'{path}: is not of the format "{FLUID_FORMAT}"; give one that this program wrote.')
    terms = [term.name for term in terms_of(content["terms"])]
    found = np.zeros((2, len(terms), len(AXES)))
    rows = content.get("coefficients")
    if not isinstance(rows, dict) or not set(rows) <= set(AXES):
        raise InputError(f'{path}: "coefficients" must have the keys {", ".join(AXES)}; {fix}.')
    for axis, row in rows.items():
        _read_entries(path, axis, row, terms, found[..., AXES.index(axis)], fix)
    added = np.zeros((2, len(_ADDED)))
    if "added" in content:
        _read_entries(path, "added", content["added"], _ADDED, added, fix)
        if np.any(added < 0):
            raise InputError(f'{path}: "added" has a number below 0; {fix}.')
    values, errors = (FluidParameters(table, row[0], row[1:]) for table, row in zip(found, added, strict=True))
    return FluidEstimate(content["terms"], values, errors)


def _read_entries(
    path: Path, key: str, row: Any, names: Sequence[str], found: Float[np.ndarray, "2 names"], fix: str
) -> None:
    """Fill `found` with the values and standard errors of a JSON object whose keys are among `names`."""
    for name, entry in row.items() if isinstance(row, dict) else [("", None)]:
        numbers = [entry.get(part) for part in ("value", "standard_error")] if isinstance(entry, dict) else [None]
        if name not in names or not all(map(is_number, numbers)):
            raise InputError(
                f'{path}: {key} has the entry {name!r}, which is no term with "value" and "standard_error"; {fix}.'
            )
        found[:, names.index(name)] = numbers
