"""Parameters that recordings may identify: the entries of a model or a drivetrain that they set, and their bounds.

`identification.declarations` makes them from a robot description.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from ballu_mjx.identification.body_deformation import UNDEFORMED, deform_body
from ballu_mjx.sim.drivetrain import DrivetrainParameters, count_slots, identity_drivetrain


class Direction(NamedTuple):
    """A linear combination of parameters, each in units of its prior standard deviation (among robots)."""

    weights: Float[np.ndarray, " parameters"]
    """Unit vector, in the order of the free parameters."""
    standard_error: float
    """Standard error of the combination, from the data alone. Above 1, the data say less than the prior."""


def principal_directions(slopes: Float[np.ndarray, "rows parameters"]) -> tuple[Direction, ...]:
    """Return the combinations of parameters that data determine independently, from the best to the least determined.

    The weight with the largest magnitude is positive in each.

    - `slopes`: Jacobian of the fit's residuals, in units of their scatter, with respect to the parameters, in units of
      their prior standard deviation.
    """
    _, singular, right = np.linalg.svd(slopes, full_matrices=False)
    signed = [row * np.sign(row[np.argmax(np.abs(row))]) for row in right]
    return tuple(Direction(row, float(1 / max(s, 1e-12))) for row, s in zip(signed, singular, strict=True))


class FieldTarget(NamedTuple):
    """An entry of a model field. It is set to the parameter's value times `factor`."""

    field: str
    index: tuple[int, ...]
    factor: float


class BodyTarget(NamedTuple):
    """One of the ten numbers that deform a body's nominal mass distribution, by its index `place` in `BODY_QUANTITIES`.

    It is set to the parameter's value times `factor`.
    """

    body: int
    place: int
    factor: float


class CommandTarget(NamedTuple):
    """A quantity of a command's drivetrain. It is set to the parameter's value times `factor`."""

    command: int
    quantity: str
    factor: float


Target = FieldTarget | BodyTarget | CommandTarget


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A parameter that may be identified."""

    name: str
    unit: str
    nominal: float
    """Value without identification."""
    bounds: tuple[float, float]
    prior: float
    """Standard deviation among robots, in the parameter's unit. inf if only the bounds are known."""
    logarithmic: bool
    """Whether the search uses the logarithm of the value."""
    targets: tuple[Target, ...]
    """Entries that the parameter sets. Several targets share its value."""

    def __post_init__(self) -> None:
        low, high = self.bounds
        if not low <= self.nominal <= high or low == high:
            raise ValueError(f"{self.name}: nominal {self.nominal:g} is not within bounds {low:g} to {high:g}")
        if self.logarithmic and low <= 0:
            raise ValueError(f"{self.name}: bounds of a logarithmic parameter must be above 0")


class Shares:
    """Conversion between values and shares. A share is 0 at the lower bound and 1 at the upper bound.

    It is linear in the value, or in the logarithm of a logarithmic parameter. Searches use shares, because units that
    differ by a factor of 30 make a search worse.
    """

    def __init__(
        self,
        lower: Float[np.ndarray, " size"],
        upper: Float[np.ndarray, " size"],
        logarithmic: Bool[np.ndarray, " size"],
    ) -> None:
        self._logarithmic = logarithmic
        self._low, self._high = self._scaled(lower), self._scaled(upper)

    def of(self, values: Float[np.ndarray, "*batch size"]) -> Float[np.ndarray, "*batch size"]:
        """Return the shares of values."""
        return (self._scaled(values) - self._low) / (self._high - self._low)

    def values(self, shares: Float[np.ndarray, "*batch size"]) -> Float[np.ndarray, "*batch size"]:
        """Return the values at shares."""
        scaled = self._low + shares * (self._high - self._low)
        return np.where(self._logarithmic, np.exp(np.where(self._logarithmic, scaled, 0.0)), scaled)

    def slopes(self, values: Float[np.ndarray, " size"]) -> Float[np.ndarray, " size"]:
        """Return the derivatives of values with respect to their shares."""
        return (self._high - self._low) * np.where(self._logarithmic, values, 1.0)

    def _scaled(self, values: np.ndarray) -> np.ndarray:
        return np.where(self._logarithmic, np.log(np.where(self._logarithmic, values, 1.0)), values)


class ParameterSet:
    """Parameters of a model. Their values are a vector, in the parameters' units or as shares (see `Shares`)."""

    def __init__(
        self,
        parameters: Sequence[Parameter],
        commands: int,
        expected: Float[np.ndarray, " parameters"] | None = None,
    ) -> None:
        """`expected`: values at which searches start and priors are centred. None for the nominal values."""
        self.parameters = tuple(parameters)
        self.commands = commands
        """Number of the robot's commands. Each has a drivetrain."""
        self.names = tuple(p.name for p in self.parameters)
        self.nominal = np.array([p.nominal for p in self.parameters])
        self.expected = self.nominal if expected is None else expected
        self.lower, self.upper = np.array([p.bounds for p in self.parameters]).reshape(-1, 2).T
        self.prior = np.array([p.prior for p in self.parameters])
        self.unit = np.where(np.isfinite(self.prior), self.prior, (self.upper - self.lower) / 2)
        """Scale of each parameter: its prior standard deviation, or half its range if the prior is infinite."""
        self._span = Shares(self.lower, self.upper, np.array([p.logarithmic for p in self.parameters], bool))

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def refines(self) -> bool:
        """Return whether expected values differ from the nominal ones."""
        return not np.array_equal(self.expected, self.nominal)

    def expecting(self, values: Float[np.ndarray, " parameters"]) -> ParameterSet:
        """Return the same parameters with other expected values."""
        return ParameterSet(self.parameters, self.commands, values)

    def shares(self, values: Float[np.ndarray, "*batch parameters"]) -> Float[np.ndarray, "*batch parameters"]:
        """Return the shares of values: 0 at the lower bound, 1 at the upper bound."""
        return self._span.of(values)

    def at_shares(self, shares: Float[np.ndarray, "*batch parameters"]) -> Float[np.ndarray, "*batch parameters"]:
        """Return the values at shares."""
        return self._span.values(shares)

    def with_respect_to_shares(self, values: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " parameters"]:
        """Return the derivatives of values with respect to their shares."""
        return self._span.slopes(values)

    def draw(self, seed: int, count: int) -> Float[np.ndarray, "count parameters"]:
        """Return the expected values, then samples of the priors.

        A parameter is sampled uniformly over its shares if it has no prior, or if its sample is outside the bounds.
        Values on or near a bound are moved inside.
        """
        rng = np.random.default_rng(seed)
        spread = np.where(np.isfinite(self.prior), self.prior, 0.0)
        values = self.expected + spread * rng.normal(size=(max(count - 1, 0), len(self)))
        uniform = self.at_shares(rng.uniform(size=values.shape))
        outside = (values < self.lower) | (values > self.upper) | ~np.isfinite(self.prior)
        begins = np.concatenate([self.expected[None], np.where(outside, uniform, values)])[:count]
        return self.at_shares(np.clip(self.shares(begins), _INSIDE, 1 - _INSIDE))

    def at_bounds(self, values: Float[np.ndarray, " parameters"]) -> tuple[str, ...]:
        """Return the names of the parameters at a bound, within 1 % of the range between the bounds."""
        return tuple(
            name for name, s in zip(self.names, self.shares(values), strict=True) if s < _AT_BOUND or s > 1 - _AT_BOUND
        )

    def fields(
        self, model: mujoco.MjModel | mjx.Model, values: Float[Array | np.ndarray, " parameters"]
    ) -> dict[str, Array]:
        """Return the fields of `model` that carry the values, by name, for `mjx.Model.replace`.

        Bodies are deformed relative to `model`. All other entries are set. Dry friction stays above 0, because MJX
        treats a friction row of 0 as one that never slips.
        """
        found: dict[str, Array] = {}
        deformed: dict[int, dict[int, Array]] = {}
        for value, parameter in zip(jnp.asarray(values), self.parameters, strict=True):
            for target in parameter.targets:
                if isinstance(target, FieldTarget):
                    field = found.get(target.field, jnp.asarray(getattr(model, target.field)))
                    entry = value * target.factor
                    if target.field in ("dof_frictionloss", "tendon_frictionloss"):
                        # The derivative of `maximum` is 0 at a bound of 0, so that a search could not leave the bound.
                        entry = entry + jax.lax.stop_gradient(jnp.maximum(LEAST_FRICTION - entry, 0.0))
                    found[target.field] = field.at[target.index].set(entry)
                elif isinstance(target, BodyTarget):
                    deformed.setdefault(target.body, {})[target.place] = value * target.factor
        for body, changes in deformed.items():
            names = ("body_mass", "body_ipos", "body_iquat", "body_inertia")
            mass, ipos, iquat, inertia = (found.get(n, jnp.asarray(getattr(model, n))) for n in names)
            numbers = [changes.get(place, jnp.asarray(one)) for place, one in enumerate(UNDEFORMED)]
            turned = any(place >= 4 for place in changes)
            own = deform_body(mass[body], ipos[body], iquat[body], inertia[body], jnp.stack(numbers), turned=turned)
            for name, field, entry in zip(names, (mass, ipos, iquat, inertia), own, strict=True):
                found[name] = field.at[body].set(entry)
        return found

    def drivetrain(self, values: Float[Array | np.ndarray, " parameters"]) -> DrivetrainParameters:
        """Return the drivetrain of all commands. Other quantities have the values of `identity_drivetrain`."""
        found = identity_drivetrain(self.commands)._asdict()
        for value, parameter in zip(jnp.asarray(values), self.parameters, strict=True):
            for target in parameter.targets:
                if isinstance(target, CommandTarget):
                    own = found[target.quantity].at[target.command]
                    found[target.quantity] = own.set(value * target.factor)
        return DrivetrainParameters(**found)

    @property
    def longest_delay(self) -> float:
        """Return the largest delay (s) within the bounds."""
        delays = [
            p.bounds[1] * t.factor
            for p in self.parameters
            for t in p.targets
            if isinstance(t, CommandTarget) and t.quantity == "delay"
        ]
        return max(delays, default=0.0)

    def slots(self, timestep: float) -> int:
        """Return the number of commands that `sim.drivetrain.DrivetrainState` must store at this physics step (s)."""
        return count_slots(self.longest_delay, timestep)

    @property
    def in_drivetrain(self) -> np.ndarray:
        """Return a mask of the parameters that change the drivetrain. Ties may also change the model."""
        return np.array([any(isinstance(t, CommandTarget) for t in p.targets) for p in self.parameters], bool)

    @property
    def friction_dofs(self) -> np.ndarray:
        """Return the indices of the degrees of freedom whose dry friction is a parameter."""
        return self._indices("dof_frictionloss")

    @property
    def friction_tendons(self) -> np.ndarray:
        """Return the indices of the tendons whose dry friction is a parameter."""
        return self._indices("tendon_frictionloss")

    def _indices(self, field: str) -> np.ndarray:
        targets = [t for p in self.parameters for t in p.targets if isinstance(t, FieldTarget) and t.field == field]
        return np.array(sorted({target.index[0] for target in targets}), int)


LEAST_FRICTION = 1e-9
"""Dry friction (N m or N) that is above 0 but has no effect."""
_INSIDE = 0.02
"""Smallest distance of a search's start from a bound, as a share. A search does not move from the bound itself."""
_AT_BOUND = 0.01
"""Distance from a bound, as a share, below which a parameter counts as at the bound."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class IdentifiedParameters:
    """Values of a `ParameterSet`, in the form that simulators take (`robots.model.ModelParameters`)."""

    values: Float[Array, " parameters"]
    declared: ParameterSet = dataclasses.field(metadata={"static": True})

    def fields(self, model: mujoco.MjModel) -> dict[str, Array]:
        """Return the fields of `model` that carry the values, by name."""
        return self.declared.fields(model, self.values)

    def drivetrain(self) -> DrivetrainParameters:
        """Return the drivetrain of all commands."""
        return self.declared.drivetrain(self.values)
