"""The parameters of a leg and its drivetrain: units, ranges, and the unbounded coordinates that are searched."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.ballu.actuators import ActuatorParameters
from ballu_mjx.ballu.model import SIDES, load_suspended_leg
from ballu_mjx.common.errors import InputError

LEG_PARAMETERS = (
    "knee_spring_stiffness",
    "motor_gain",
    "default_motor_angle",
    "default_knee_angle",
    "torque_limit",
    "cable_slack",
    "motor_travel",
    "cable_stiffness",
    "knee_spring_reference",
)
"""A leg's parameters that settled angles depend on, in the order of a vector."""
DEGREE = float(np.pi / 180)


@dataclasses.dataclass(frozen=True)
class IdentificationConfig:
    """How actuators are identified. The defaults were chosen by measurement (docs/actuators.md)."""

    torque_limit: bool = True
    """Identify the servos' torque limits too. The paper's eight parameters alone can tell a weak servo only by a spring
    stiffer than the robot's."""
    cable_slack: bool = True
    """Identify the cables' slack too. Without it, springs and servos come out up to three times too strong."""
    motor_travel: bool = True
    """Identify what share of 90 deg a command of 1 asks for. Without it, a short travel passes for stiff springs, play
    and friction."""
    cable_stiffness: bool = True
    """Identify the cables' stiffness too."""
    knee_spring_reference: bool = False
    """Identify where the knees' springs would be at rest, and with it how far they are preloaded, too. Held by default:
    the design says where that is, and in a sweep it trades with the springs' stiffness."""
    nominal_springs: bool = True
    """With the richer model, hold the knees' springs at their nominal stiffness. A sweep shows the scale of forces by
    gravity alone, and small errors of the model decide it then."""
    motion: bool = True
    """Learn from the whole motion, not from settled angles alone; delay, lag, backlash, dry friction and the knee's
    damping are then further unknowns."""
    objective: Literal["pointwise", "hausdorff"] = "pointwise"
    """`pointwise`: least squares over all angles (Levenberg-Marquardt). `hausdorff`: the paper's distance between
    curves (L-BFGS), started from the pointwise solution; motion has no part in it."""
    degree: int = 7
    """Degree of the polynomials fitted to the curves of angle over command."""
    draws: int = 128
    """Parameters drawn at random for each leg, beside the nominal ones, to find good starts."""
    starts: int = 8
    """Searches for each leg, from the best draws. Of declared parameters: from the nominal values, then from draws from
    the priors."""
    steps: int = 40
    """Most iterations of a search."""
    seed: int = 0
    """Seeds the draws."""


PAPER_PARAMETERS = IdentificationConfig(
    torque_limit=False, cable_slack=False, motor_travel=False, cable_stiffness=False
)
"""The paper's four of a leg: spring stiffness, motor gain, motor angle at command 0, the knee's stop."""
ALL_PARAMETERS = IdentificationConfig(knee_spring_reference=True, nominal_springs=False)
"""Every parameter free, with either model."""


class ParameterRange(NamedTuple):
    """What is known of a parameter beforehand."""

    factor: float | None
    """Bounds are the nominal value divided and multiplied by this; or else:"""
    reach: tuple[float, float]
    """Bounds are the nominal value less and plus these."""
    prior: float
    """How much robots differ (standard deviation): of the logarithm where there is a factor, else of the value."""


# Makers of springs quote 10 % on the rate (Lee Spring, "Engineering Notes and Tolerances").
RANGES: dict[str, ParameterRange] = {
    "knee_spring_stiffness": ParameterRange(4.0, (0.0, 0.0), 0.1),
    "motor_gain": ParameterRange(16.0, (0.0, 0.0), 0.7),
    "default_motor_angle": ParameterRange(None, (20 * DEGREE, 20 * DEGREE), 5 * DEGREE),
    "default_knee_angle": ParameterRange(None, (15 * DEGREE, 15 * DEGREE), 3 * DEGREE),
    "torque_limit": ParameterRange(4.0, (0.0, 0.0), 0.3),
    "cable_slack": ParameterRange(None, (9e-5, 5e-3), 5e-4),
    "motor_travel": ParameterRange(None, (0.5, 0.3), 0.15),
    "cable_stiffness": ParameterRange(4.0, (0.0, 0.0), 0.5),
    "knee_spring_reference": ParameterRange(None, (15 * DEGREE, 15 * DEGREE), 3 * DEGREE),
}


class LegDynamics(NamedTuple):
    """What only the motion shows of a leg: what a command meets on its way to the joints, and what brakes these."""

    delay: Any
    """Seconds from a command to the servo's target."""
    motor_friction: Any
    """Dry friction (N m)."""
    knee_friction: Any
    """Dry friction (N m)."""
    backlash: Any
    """Width (rad) of the play between the motor's target and its arm."""
    lag: Any
    """Time constant (s) with which the motor's target follows the command."""
    knee_damping: Any
    """Viscous friction (N m s/rad)."""


FIRST_DYNAMICS = LegDynamics(0.03, 2e-3, 5e-4, 1 * DEGREE, 0.01, 2e-3)
"""Where the search begins."""


DYNAMICS_PRIOR = np.array([3.0, 1.0, 1.0, 1.0, 2.0, 2.0])
"""How much robots differ (standard deviation) in the coordinates of the dynamics, about where the search begins."""
NOMINAL_DYNAMICS = {"knee_damping": 1e-3}
"""The nominal robot's; the others are 0."""
SIMPLE_DYNAMICS = FIRST_DYNAMICS._replace(lag=1e-4, **NOMINAL_DYNAMICS)
"""The same of the simpler model: no lag to speak of, and the nominal damping."""
FURTHER = ("motor_travel", "cable_stiffness", "knee_spring_reference", "lag", "knee_damping")
"""Parameters that are fitted only where a sweep asks for them: each trades against others within a weak direction."""


def dynamics_coordinates(values: LegDynamics) -> Float[np.ndarray, " 6"]:
    """Unbounded coordinates: of the delay linear, of the others logarithms; 0 where the search begins."""
    others = np.log(np.array(values[1:]) / np.array(FIRST_DYNAMICS[1:]))
    return np.array([(values.delay - FIRST_DYNAMICS.delay) / DELAY_UNIT, *others])


def leg_dynamics(coordinates: Float[Array, " 6"]) -> LegDynamics:
    """The inverse of `dynamics_coordinates`."""
    delay, *others = coordinates
    return LegDynamics(
        FIRST_DYNAMICS.delay + DELAY_UNIT * delay,
        *(f * jnp.exp(x) for f, x in zip(FIRST_DYNAMICS[1:], others, strict=True)),
    )


DELAY_UNIT = 0.01
"""Seconds of delay that a coordinate of 1 stands for."""


class ParameterTransform:
    """Between a leg's parameters in their units and the unbounded coordinates that are searched.

    A coordinate runs through a logistic function from the lower to the upper bound: of the logarithm for stiffness,
    gain and torque limit, of the value itself for angles and slack. Parameters that are not free keep their nominal
    value.
    """

    def __init__(self, nominal: Float[np.ndarray, " parameters"], config: IdentificationConfig) -> None:
        ranges = [RANGES[name] for name in LEG_PARAMETERS]
        factors = np.array([r.factor or 1.0 for r in ranges])
        below, above = np.array([r.reach for r in ranges]).T
        self.nominal = nominal
        self.relative = np.array([r.factor is not None for r in ranges])
        self.lower, self.upper = nominal / factors - below, nominal * factors + above
        self.prior = np.array([r.prior for r in ranges])
        """Standard deviation of each parameter among robots: of its logarithm where it is relative."""
        self.free = np.isin(LEG_PARAMETERS, free_parameters(config))

    def vector(self, coordinates: Float[Array, " free"]) -> Float[Array, " parameters"]:
        """A leg's parameters, in their units."""
        free, relative = self.free, self.relative[self.free]
        lower, upper = self.lower[free], self.upper[free]
        ratio = np.where(relative, upper / np.where(relative, lower, 1.0), 1.0)
        share = jax.nn.sigmoid(coordinates)
        values = jnp.where(relative, lower * ratio**share, lower + share * (upper - lower))
        return jnp.asarray(self.nominal).at[np.flatnonzero(free)].set(values)

    def coordinates(self, vector: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " free"]:
        """The inverse of `vector`, for values within the bounds."""
        share = (vector - self.lower) / (self.upper - self.lower)
        logs = [np.log(np.where(self.relative, x, 1.0)) for x in (vector, self.lower, self.upper)]
        span = np.where(self.relative, logs[2] - logs[1], 1.0)
        share = np.where(self.relative, (logs[0] - logs[1]) / span, share)[self.free]
        return np.log(share / (1 - share))

    def deviations(self, vector: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " parameters"]:
        """Return how far parameters are from nominal, in standard deviations among robots."""
        logarithms = np.log(np.where(self.relative, vector / np.where(self.relative, self.nominal, 1.0), 1.0))
        return np.where(self.relative, logarithms, vector - self.nominal) / self.prior

    def units(self, vector: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " parameters"]:
        """Return one standard deviation among robots at these values, in the parameters' units."""
        return self.prior * np.where(self.relative, vector, 1.0)

    def draw(self, seed: int, count: int) -> Float[np.ndarray, "draws free"]:
        """Coordinates: of the nominal values, then of uniform draws from the middle half of the bounds' span."""
        shares = np.random.default_rng(seed).uniform(0.25, 0.75, (count, int(self.free.sum())))
        return np.concatenate([self.coordinates(self.nominal)[None], np.log(shares / (1 - shares))])


def nominal_leg() -> Float[np.ndarray, " parameters"]:
    """A leg's nominal parameters."""
    nominal = ActuatorParameters.nominal(load_suspended_leg(SIDES[0]))
    return np.concatenate([np.asarray(getattr(nominal, name), float) for name in LEG_PARAMETERS])


def check_identification_config(config: IdentificationConfig) -> None:
    """Refuse sizes that make no sense.

    **Raises** `InputError` naming the option.
    """
    for name in ("draws", "starts", "steps", "degree"):
        if getattr(config, name) < 1:
            raise InputError(f"--{name} is {getattr(config, name)}: it must be 1 or more; 1 is the nearest.")
    if config.seed < 0:
        raise InputError(f"--seed is {config.seed}: it must be 0 or more; 0 is the nearest.")


def free_parameters(config: IdentificationConfig) -> tuple[str, ...]:
    """All but those that have an option of their name which is off."""
    return tuple(name for name in LEG_PARAMETERS if getattr(config, name, True))
