"""The parameters of a leg and its drivetrain: units, ranges, priors, and the unbounded coordinates of the search."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.ballu.actuators import ActuatorParameters
from ballu_mjx.ballu.model import SIDES, leg_sides, load_suspended_leg
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
"""A leg's parameters that settled angles depend on, in the order of a parameter vector."""
DEGREE = float(np.pi / 180)
"""One degree (rad)."""


@dataclasses.dataclass(frozen=True)
class IdentificationConfig:
    """Options of the identification of actuators. The defaults were chosen by measurement (docs/actuators.md)."""

    torque_limit: bool = True
    """Identify the torque limits of the servos. Without them, only a knee spring that is too stiff can explain a weak
    servo."""
    cable_slack: bool = True
    """Identify the slack of the cables. Without it, springs and servos come out up to three times too strong."""
    motor_travel: bool = True
    """Identify the travel of the servos, as a fraction of 90 deg. Without it, a short travel is mistaken for stiff
    springs, backlash and friction."""
    cable_stiffness: bool = True
    """Identify the stiffness of the cables."""
    knee_spring_reference: bool = False
    """Identify the rest angle of the knee springs, and thus their preload. It is held at nominal by default: the design
    specifies it, and a sweep hardly separates it from the springs' stiffness."""
    nominal_springs: bool = True
    """Hold the knee springs at their nominal stiffness if the sweep requires the richer model (with travel, cable
    stiffness, lag and knee damping). In a sweep, only gravity shows the scale of the forces. Small errors of the model
    would therefore decide the stiffness."""
    motion: bool = True
    """Fit the whole motion instead of the settled angles alone. Delay, lag, backlash, dry friction and knee damping are
    then identified too."""
    objective: Literal["pointwise", "hausdorff"] = "pointwise"
    """Objective of the fit. `pointwise`: the squares of all angle errors (Levenberg-Marquardt). `hausdorff`: the
    paper's distance between curves (L-BFGS), starting from the pointwise solution and without the motion."""
    degree: int = 7
    """Degree of the polynomials that are fitted to the curves of angle over command, 1 or more."""
    draws: int = 128
    """Number of random parameter vectors for each leg, besides the nominal one, to find good starts; 1 or more."""
    starts: int = 8
    """Number of searches, 1 or more. For BALLU: for each leg, from the best draws. For declared parameters: from the
    nominal values, then from draws from the priors."""
    steps: int = 40
    """Largest number of iterations of a search, 1 or more."""
    seed: int = 0
    """Seed of the draws, 0 or more."""


PAPER_PARAMETERS = IdentificationConfig(
    torque_limit=False, cable_slack=False, motor_travel=False, cable_stiffness=False
)
"""Options for the paper's four parameters of a leg: spring stiffness, motor gain, motor angle at 0, knee stop."""
ALL_PARAMETERS = IdentificationConfig(knee_spring_reference=True, nominal_springs=False)
"""Options that free every parameter, in the simpler and in the richer model."""


class ParameterRange(NamedTuple):
    """Bounds and prior of a parameter. The gain also stays below `largest_motor_gain`."""

    factor: float | None
    """Factor by which the nominal value is divided and multiplied for the bounds. None if `reach` gives the bounds."""
    reach: tuple[float, float]
    """Distances of the lower and the upper bound from the nominal value. 0 if there is a factor."""
    prior: float
    """Standard deviation among robots: of the logarithm if there is a factor, otherwise of the value."""


# Makers of springs quote a tolerance of 10 % on the rate (Lee Spring, "Engineering Notes and Tolerances").
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
    """Parameters of a leg that only its motion shows: of the drivetrain, and friction and damping of the joints."""

    delay: Any
    """Time (s) from a command to the servo's target."""
    motor_friction: Any
    """Dry friction of the motor (N m)."""
    knee_friction: Any
    """Dry friction of the knee (N m)."""
    backlash: Any
    """Width (rad of motor angle) of the backlash in the motor's target."""
    lag: Any
    """Time constant (s) with which the motor's target follows the command."""
    knee_damping: Any
    """Viscous damping of the knee (N m s/rad)."""


INITIAL_DYNAMICS = LegDynamics(0.03, 2e-3, 5e-4, 1 * DEGREE, 0.01, 2e-3)
"""Values at which the search begins."""


DYNAMICS_PRIOR = np.array([3.0, 1.0, 1.0, 1.0, 2.0, 2.0])
"""Standard deviations among robots, in the coordinates of the dynamics. The mean is the start of the search."""
NOMINAL_DYNAMICS = {"knee_damping": 1e-3}
"""Dynamics of the nominal robot. Those that are not listed are 0."""
SIMPLE_DYNAMICS = INITIAL_DYNAMICS._replace(lag=1e-4, **NOMINAL_DYNAMICS)
"""Start of the search with the simpler model: negligible lag, and the nominal damping."""
RICHER_PARAMETERS = ("motor_travel", "cable_stiffness", "knee_spring_reference", "lag", "knee_damping")
"""Parameters that only the richer model fits. Each trades against others within a weak direction of the data."""


def dynamics_coordinates(values: LegDynamics) -> Float[np.ndarray, " 6"]:
    """Return unbounded coordinates: linear in the delay, logarithmic in the others, and 0 at `INITIAL_DYNAMICS`."""
    others = np.log(np.array(values[1:]) / np.array(INITIAL_DYNAMICS[1:]))
    return np.array([(values.delay - INITIAL_DYNAMICS.delay) / DELAY_UNIT, *others])


def leg_dynamics(coordinates: Float[Array, " 6"]) -> LegDynamics:
    """Return the inverse of `dynamics_coordinates`."""
    delay, *others = coordinates
    return LegDynamics(
        INITIAL_DYNAMICS.delay + DELAY_UNIT * delay,
        *(f * jnp.exp(x) for f, x in zip(INITIAL_DYNAMICS[1:], others, strict=True)),
    )


DELAY_UNIT = 0.01
"""Change of the delay (s) for a change of its coordinate by 1."""


_CAP_SHARPNESS = 8.0
"""Sharpness of the gain's smooth limit, in inverse units of its logarithm."""


class ParameterTransform:
    """Transform between a leg's parameters in their units and the unbounded coordinates of the search.

    A logistic function maps a coordinate to the interval between the bounds. The interval is that of the logarithm for
    stiffness, gain and torque limit, and that of the value for angles, slack and travel. The gain is then limited
    smoothly to `largest_motor_gain`, which changes gains below half of it by less than 0.1 %. Parameters that are not
    free keep their nominal value.
    """

    def __init__(self, nominal: Float[np.ndarray, " parameters"], config: IdentificationConfig) -> None:
        ranges = [RANGES[name] for name in LEG_PARAMETERS]
        factors = np.array([r.factor or 1.0 for r in ranges])
        below, above = np.array([r.reach for r in ranges]).T
        self.nominal = nominal
        self.relative = np.array([r.factor is not None for r in ranges])
        self.lower, self.upper = nominal / factors - below, nominal * factors + above
        self._gain = np.array(LEG_PARAMETERS) == "motor_gain"
        self._largest_gain = largest_motor_gain(load_suspended_leg(SIDES[0]))
        self.prior = np.array([r.prior for r in ranges])
        """Standard deviation of each parameter among robots: of its logarithm if it is `relative`."""
        self.free = np.isin(LEG_PARAMETERS, free_parameters(config))

    def vector(self, coordinates: Float[Array, " free"]) -> Float[Array, " parameters"]:
        """Return a leg's parameters in their units."""
        free, relative = self.free, self.relative[self.free]
        lower, upper = self.lower[free], self.upper[free]
        ratio = np.where(relative, upper / np.where(relative, lower, 1.0), 1.0)
        share = jax.nn.sigmoid(coordinates)
        values = jnp.where(relative, lower * ratio**share, lower + share * (upper - lower))
        gain, largest = self._gain[free], self._largest_gain
        below = _CAP_SHARPNESS * (np.log(largest) - jnp.log(jnp.asarray(jnp.where(gain, values, 1.0))))
        values = jnp.where(gain, largest * jnp.exp(-jax.nn.softplus(below) / _CAP_SHARPNESS), values)
        return jnp.asarray(self.nominal).at[np.flatnonzero(free)].set(values)

    def coordinates(self, vector: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " free"]:
        """Return the inverse of `vector`, for values within the bounds and a gain below the largest."""
        below = _CAP_SHARPNESS * np.log(self._largest_gain / np.where(self._gain, vector, 1.0))
        uncapped = self._largest_gain * np.exp(-(below + np.log(-np.expm1(-below))) / _CAP_SHARPNESS)
        vector = np.where(self._gain, uncapped, vector)
        share = (vector - self.lower) / (self.upper - self.lower)
        logs = [np.log(np.where(self.relative, x, 1.0)) for x in (vector, self.lower, self.upper)]
        span = np.where(self.relative, logs[2] - logs[1], 1.0)
        share = np.where(self.relative, (logs[0] - logs[1]) / span, share)[self.free]
        return np.log(share / (1 - share))

    def deviations(self, vector: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " parameters"]:
        """Return the distances of parameters from nominal, in standard deviations among robots."""
        logarithms = np.log(np.where(self.relative, vector / np.where(self.relative, self.nominal, 1.0), 1.0))
        return np.where(self.relative, logarithms, vector - self.nominal) / self.prior

    def units(self, vector: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " parameters"]:
        """Return one standard deviation among robots at these values, in the parameters' units."""
        return self.prior * np.where(self.relative, vector, 1.0)

    def draw(self, seed: int, count: int) -> Float[np.ndarray, "draws free"]:
        """Return coordinates of the nominal values, then of uniform draws from the middle half between the bounds."""
        shares = np.random.default_rng(seed).uniform(0.25, 0.75, (count, int(self.free.sum())))
        return np.concatenate([self.coordinates(self.nominal)[None], np.log(shares / (1 - shares))])


def largest_motor_gain(model: mujoco.MjModel) -> float:
    """Return half of the position gain (N m/rad) at which a servo becomes unstable at the model's time step.

    A servo has inertia I and damping b. The integrator takes velocities at the end of a step of length h, and is
    implicit in the damping. It is stable for gains below 2 (2 I + h b) / h^2 (Jury's criterion for its characteristic
    polynomial). Near this gain the arm oscillates from step to step between its torque limits, and derivatives grow
    exponentially with time. The other half is for the stiffness of the cable.
    """
    dof, step = int(model.jnt_dofadr[model.joint(f"motor_{leg_sides(model)[0]}").id]), float(model.opt.timestep)
    inertia = float(model.dof_M0[dof])
    return (2 * inertia + step * float(model.dof_damping[dof])) / step**2


def nominal_leg() -> Float[np.ndarray, " parameters"]:
    """Return a leg's nominal parameters."""
    nominal = ActuatorParameters.nominal(load_suspended_leg(SIDES[0]))
    return np.concatenate([np.asarray(getattr(nominal, name), float) for name in LEG_PARAMETERS])


def check_identification_config(config: IdentificationConfig) -> None:
    """Check the ranges of the options that are numbers.

    **Raises** `InputError` that names the option.
    """
    for name in ("draws", "starts", "steps", "degree"):
        if getattr(config, name) < 1:
            raise InputError(f"--{name} is {getattr(config, name)}: it must be 1 or more; 1 is the nearest.")
    if config.seed < 0:
        raise InputError(f"--seed is {config.seed}: it must be 0 or more; 0 is the nearest.")


def free_parameters(config: IdentificationConfig) -> tuple[str, ...]:
    """Return the parameters of a leg without those whose option of the same name is off."""
    return tuple(name for name in LEG_PARAMETERS if getattr(config, name, True))
