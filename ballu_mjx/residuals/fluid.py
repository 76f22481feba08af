"""The fluid residual: force and torque on the tracked body as polynomials of its motion, for any body in air or water.

In the body's axes, the wrench is a linear combination of terms. Terms are products of the velocity v, the angular
velocity w, the speed |v| and the direction of gravity. Lift, drag, side force and moments over angle of attack and
sideslip are such terms: |v|^2 alpha is v_x v_z for small angles. Rotary damping is linear in w. A wrong weight or
centre of mass is linear in the direction of gravity.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.residuals.body_motion import body_motion, smooth_speed
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_input import network_input
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.residual import Action, Commands, History, Residual

FLUID_FORMAT = "ballu-fluid/1"
FLUID_FILE = "fluid.json"

TermSet = Literal["linear", "drag", "quadratic", "cubic"]
TERM_SETS: tuple[TermSet, ...] = ("linear", "drag", "quadratic", "cubic")
"""Each has the terms of those before it. `linear`: gravity's direction, velocities. `drag`: these times the speed.
`quadratic`: products of two velocities. `cubic`: products of three velocities over the speed, at least two of them
linear."""
AXES = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")
"""Of a wrench (N, N m)."""
_MOTION = ("vx", "vy", "vz", "wx", "wy", "wz")
_GRAVITY = ("gx", "gy", "gz")
_ODD = ("vy", "wx", "wz", "gy")
"""What changes its sign in the mirror image about the xz plane."""
_ODD_AXES = np.array([False, True, False, True, False, True])


class Term(NamedTuple):
    """A product of components of the motion, times a power of the speed."""

    factors: tuple[str, ...]
    """Of `vx` ... `vz` (m/s), `wx` ... `wz` (rad/s), `gx` ... `gz` (unit vector along gravity)."""
    power: int
    """Of the speed (m/s)."""

    @property
    def name(self) -> str:
        """Return the term in words, such as `vx*vz` or `wy*|v|`."""
        return "*".join(self.factors) + {1: "*|v|", 0: "", -1: "/|v|"}[self.power]

    @property
    def odd(self) -> bool:
        """Return whether it changes its sign in the mirror image about the xz plane."""
        return sum(factor in _ODD for factor in self.factors) % 2 == 1


def terms_of(name: TermSet) -> tuple[Term, ...]:
    """Return the terms of a set."""
    products = itertools.combinations_with_replacement
    groups: dict[TermSet, list[Term]] = {
        "linear": [Term((factor,), 0) for factor in (*_GRAVITY, *_MOTION)],
        "drag": [Term((factor,), 1) for factor in _MOTION],
        "quadratic": [Term(pair, 0) for pair in products(_MOTION, 2)],
        "cubic": [
            Term(triple, -1)
            for triple in products(_MOTION, 3)
            if sum(factor.startswith("v") for factor in triple) >= _LEAST_LINEAR
        ],
    }
    return tuple(term for each in TERM_SETS[: TERM_SETS.index(name) + 1] for term in groups[each])


_LEAST_LINEAR = 2


def mirrored(terms: Sequence[Term]) -> Bool[np.ndarray, "terms 6"]:
    """Return which coefficients a body may have that is its own mirror image about the xz plane."""
    return np.array([term.odd for term in terms])[:, None] == _ODD_AXES


class FluidResidual(Residual):
    """The force model (see `sim.residual.Residual`) whose parameters are coefficients, (terms, 6), in SI units."""

    def __init__(self, robot: RobotDescription, model: mujoco.MjModel, term_set: TermSet) -> None:
        """Prepare for `robot`, whose C model is `model`."""
        self.robot, self.term_set, self.terms = robot, term_set, terms_of(term_set)
        gravity = np.asarray(model.opt.gravity)
        size = float(np.linalg.norm(gravity))
        self._down = jnp.asarray(gravity / size if size > 0 else gravity)
        every = [*_MOTION, *_GRAVITY]
        most = max(len(term.factors) for term in self.terms)
        # One past the components stands for 1.
        self._places = np.array(
            [[*map(every.index, term.factors), *[len(every)] * (most - len(term.factors))] for term in self.terms]
        )
        self._power = np.array([term.power for term in self.terms])

    @property
    def name(self) -> str:
        """Return what a simulator improved by it is called."""
        return "fluid"

    def inputs(self, history: History, commands: Commands) -> Float[Array, " inputs"]:
        """Return what networks see, for the range of what was recorded."""
        return network_input(history, commands, ForceNetworkConfig(), self.robot)

    def values(self, history: History) -> tuple[Float[Array, "3 3"], Float[Array, " terms"]]:
        """Return the body's rotation (to the world), and what the terms are."""
        frame, velocity, rate = body_motion(history, self.robot.control_timestep)
        speed = smooth_speed(velocity)
        components = jnp.concatenate([velocity, rate, frame.T @ self._down, jnp.ones(1)])
        return frame, jnp.prod(components[self._places], axis=1) * speed**self._power

    def act(
        self, params: Float[Array, "terms 6"], history: History, commands: Commands, key: Array | None = None
    ) -> Action:
        """Return the wrench by the motion in the middle of the coming control step."""
        del commands, key
        frame, values = self.values(history)
        own = values @ params
        return Action(jnp.concatenate([frame @ own[:3], frame @ own[3:]])[None])


@dataclasses.dataclass(frozen=True, eq=False)
class FluidCoefficients:
    """What a fit found."""

    term_set: TermSet
    values: Float[np.ndarray, "terms 6"]
    standard_errors: Float[np.ndarray, "terms 6"]
    """0 where a coefficient is held at 0."""

    def to_json(self) -> str:
        """Return the content of `FLUID_FILE`: coefficients by axis and term."""
        rows = {
            axis: {
                term.name: {"value": float(value), "standard_error": float(error)}
                for term, value, error in zip(terms_of(self.term_set), values, errors, strict=True)
                if value != 0 or error != 0
            }
            for axis, values, errors in zip(AXES, self.values.T, self.standard_errors.T, strict=True)
        }
        return json.dumps({"format": FLUID_FORMAT, "terms": self.term_set, "coefficients": rows}, indent=2) + "\n"

    def table(self) -> str:
        """Return the coefficients that differ from 0 by two standard errors or more, as text."""
        lines = [f"{'':10}{'term':12}{'value':>12}{'std. error':>12}"]
        for axis, values, errors in zip(AXES, self.values.T, self.standard_errors.T, strict=True):
            for term, value, error in zip(terms_of(self.term_set), values, errors, strict=True):
                if abs(value) >= 2 * error > 0:
                    lines.append(f"{axis:10}{term.name:12}{value:>12.5f}{error:>12.5f}")
        lines.append(
            f"Terms: {self.term_set}; SI units, the body's axes. Coefficients within two std. errors are left out."
        )
        return "\n".join(lines)


def read_fluid(path: Path) -> FluidCoefficients:
    """Return the coefficients in a file of the format `ballu-fluid/1`, which `train fluid` writes.

    **Raises** `InputError` naming file, key and fix.
    """
    fix = "restore it or identify again"
    content = files.read_json(path, fix)
    if content.get("format") != FLUID_FORMAT or content.get("terms") not in TERM_SETS:
        raise InputError(f'{path}: is not of the format "{FLUID_FORMAT}"; give one that this program wrote.')
    terms = terms_of(content["terms"])
    names = [term.name for term in terms]
    found = np.zeros((2, len(terms), len(AXES)))
    rows = content.get("coefficients")
    if not isinstance(rows, dict) or not set(rows) <= set(AXES):
        raise InputError(f'{path}: "coefficients" must have the keys {", ".join(AXES)}; {fix}.')
    for axis, row in rows.items():
        for name, entry in row.items() if isinstance(row, dict) else [("", None)]:
            numbers = [entry.get(key) for key in ("value", "standard_error")] if isinstance(entry, dict) else [None]
            if name not in names or not all(map(is_number, numbers)):
                raise InputError(f"{path}: {axis} of {name!r} is no term with value and standard_error; {fix}.")
            found[:, names.index(name), AXES.index(axis)] = numbers
    return FluidCoefficients(content["terms"], *found)
