"""Fit of the aerodynamic parameters to recordings of free motion, by least squares through MJX.

The recordings are cut into short windows. Each window is simulated from its recorded first state under its recorded
commands. Nonlinear least squares minimizes the errors of the tracked body's position and orientation. The loss is
robust, so that single bad windows, for example with a slipping contact, do not dominate.

Finite differences over a parameter's order of magnitude replace derivatives. If contacts begin at other times than in
the recording, derivatives with respect to the lift hold for less than 1 mN. The errors change smoothly over tens of mN
(`docs/white_box.md`, "Why not derivatives").
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
import scipy.optimize
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.motion_windows import (
    MotionWindows,
    check_motion_windows,
    cut_motion_windows,
    simulate_motion_window,
)
from ballu_mjx.recordings.window_errors import OUTLIER_THRESHOLD, fill_diverged, pseudo_huber
from ballu_mjx.residuals.aerodynamics import (
    AIR_PARAMETERS,
    FREE_BY_DEFAULT,
    LEAST_FRICTION,
    SIGNED_AIR_PARAMETERS,
    Aerodynamics,
    AirParameters,
    longest_delay,
)
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.residual import BoundResidual
from ballu_mjx.sim.sharding import shard_over_devices
from ballu_mjx.sim.simulator import Simulator


@dataclasses.dataclass(frozen=True)
class AirConfig:
    """Options of the fit of the aerodynamic parameters."""

    window_seconds: float = 2.0
    """Length of a window, s. Shorter windows depend more on the starting state. With them, the fitted added mass was
    too high by half."""
    interval_seconds: float = 2.0
    """Time between the starts of two windows, s."""
    evaluations: int = 15
    """Largest number of evaluations of the least-squares solver with all parameters free. With fewer free parameters,
    which take less time for an evaluation, it is proportionally larger."""
    frictions: int = 9
    """Largest number of values of the contacts' friction that are tried, if it is identified. All other parameters are
    fitted again at each, in up to four evaluations."""


class Scale(NamedTuple):
    """Order of magnitude of a parameter, with its prior."""

    typical: float
    """Order of magnitude (SI units): step of the finite differences, scale of the solver's first step, and starting
    value of parameters that cannot be negative."""
    prior: float = 3.0
    """Standard deviation of the weak prior, in multiples of `typical`."""


def air_scales(robot: RobotDescription, model: mujoco.MjModel) -> dict[str, Scale]:
    """Return the scales of the parameters by name, from the robot's nominal `model` alone.

    The lift of the tracked body is taken as the weight of the air that it displaces, and the body as a sphere of this
    volume, with radius r:

    - Added mass: half of the displaced air, as for a sphere in an ideal fluid (Lamb, Hydrodynamics, section 92).
    - Added inertia: a tenth of the added mass times r^2. An ideal fluid does not turn with a sphere.
    - Lift: 1 % of the nominal lift. Centre: 3 % of r.
    - Quadratic drag: that of a sphere with drag coefficient 0.47. Linear drag: its slope at a speed of 0.25 m/s.
    - Rotary drag: the linear drag times r^2.
    - Delay: a control step.
    - Friction: a fifth of the model's.
    """
    body = int(model.site_bodyid[model.site(robot.tracked).id])
    displaced = float(model.body_mass[body] * model.body_gravcomp[body])
    radius = (3 * displaced / _AIR_DENSITY / (4 * math.pi)) ** (1 / 3)
    added = displaced / 2
    drag = _AIR_DENSITY / 2 * _SPHERE_DRAG * math.pi * radius**2
    return {
        "added_mass": Scale(added),
        "added_inertia": Scale(0.1 * added * radius**2),
        "lift": Scale(0.01 * displaced * float(np.linalg.norm(model.opt.gravity))),
        "centre": Scale(0.03 * radius),
        "linear_drag": Scale(_SLOW * drag),
        "quadratic_drag": Scale(drag),
        "turning_drag": Scale(_SLOW * drag * radius**2),
        "delay": Scale(robot.control_timestep),
        "friction": Scale(0.2),
    }


_AIR_DENSITY, _SPHERE_DRAG, _SLOW = 1.2, 0.47, 0.25
"""Density of air (kg/m^3), drag coefficient of a sphere, and a speed (m/s) at which drag is linearized."""
_FEW_EVALUATIONS = 4
"""Largest number of evaluations of the solver at each friction that is tried, and at each of the two whole delays next
to the fitted delay."""
_FRICTION_STEP = 0.05
_FRICTION_ROUNDS = ((-0.2, 0.2, -0.4, 0.4, -0.6), (-0.1, 0.1), (-_FRICTION_STEP, _FRICTION_STEP))
"""Changes of the friction that are tried in each round, from the best friction of the rounds before."""
_MARGIN = 0.01
"""Distance of a starting value from its bounds, in multiples of `typical`. A solver that starts on a bound wastes its
first steps."""
_GAIN, _STEP = 1e-4, 1e-3
"""Relative gain in cost and relative length of a step at which the solver stops. Smaller ones are noise of contacts."""


@dataclasses.dataclass(frozen=True)
class AirFit:
    """Result of a fit of the aerodynamic parameters."""

    parameters: AirParameters
    standard_errors: AirParameters
    """Standard errors, for windows with independent errors of the expected size. 0 for parameters that were fixed."""
    cost: tuple[float, float]
    """Half the robust sum of squares before and after the fit. Before the fit there is no residual, or that of
    `fixed_from`."""
    windows: int
    """Number of windows."""
    control_steps: int
    """Number of control steps that were simulated."""


Report = Callable[[int, float], None]
"""Function of the number of evaluations so far and of the cost."""


def check_air_config(config: AirConfig, control_timestep: float) -> None:
    """Check options for a robot with a control step of `control_timestep` (s).

    **Raises** `InputError` for an option out of range. The message names it.
    """
    check_motion_windows(config.window_seconds, config.interval_seconds, control_timestep)
    if config.evaluations < 1:
        raise InputError(f"--evaluations is {config.evaluations}: it must be 1 or more.")
    if config.frictions < 0:
        raise InputError(f"--frictions is {config.frictions}: it must be 0 or more.")


def identify_air(
    simulator: Simulator,
    motions: Sequence[Motion],
    config: AirConfig,
    report: Report = lambda evaluations, cost: None,
    *,
    fixed_from: AirParameters | None = None,
    free: Sequence[str] = FREE_BY_DEFAULT,
) -> AirFit:
    """Fit `AirParameters` to recorded motions.

    **Arguments**

    - `simulator`: simulator of the robot with identified actuators, without the residual.
    - `motions`: training motions.
    - `config`: options of the fit.
    - `report`: function that is called after every evaluation.
    - `fixed_from`: starting values, and values of the parameters that are not in `free`. If None, the fixed parameters
      are 0. Free ones then start at their order of magnitude, or at 0 if they may be negative.
    - `free`: names of the parameters to fit.

    **Raises** `InputError` for options out of range, and if no motion is as long as a window.
    """
    check_air_config(config, simulator.robot.control_timestep)
    simulated = AirWindows(simulator, motions, config)
    none = AirParameters.none()
    start, unravel = ravel_pytree(none if fixed_from is None else fixed_from)
    start = np.asarray(start, np.float64)
    owner = np.repeat(AIR_PARAMETERS, [getattr(none, name).size for name in AIR_PARAMETERS])
    scales = air_scales(simulator.robot, simulator.mj_model)
    scale, prior = np.array([scales[name] for name in owner]).T
    is_delay, is_friction = owner == "delay", owner == "friction"
    low = np.where(np.isin(owner, SIGNED_AIR_PARAMETERS), -np.inf, 0.0)
    low[is_friction] = LEAST_FRICTION
    high = np.where(is_delay, simulated.longest_delay, np.inf)
    evaluations = 0

    def fitted(vector: np.ndarray, places: Int[np.ndarray, " free"], most: int) -> Optimum:
        """Fit the parameters at the indices `places` of `vector`, in about `most` evaluations."""
        spread, middle = scale[places], np.clip(vector, low + _MARGIN * scale, high - _MARGIN * scale)[places]

        # The solver's variables are differences from the start, in units of the scales. The solver takes the norm of
        # its starting point as the size of its first trust region, or 1 if that norm is 0, as it is here.
        def whole(x: np.ndarray) -> np.ndarray:
            moved = vector.copy()
            moved[places] = middle + x * spread
            return moved

        def residuals(x: np.ndarray) -> np.ndarray:
            nonlocal evaluations
            evaluations += 1
            moved = whole(x)
            total = np.concatenate([_soften(simulated.errors(moved))[0].ravel(), (moved / scale / prior)[places]])
            report(evaluations, _cost(total))
            return total

        def jacobian(x: np.ndarray) -> np.ndarray:
            errors, slopes = simulated.linear(whole(x), places, spread)
            softened = _soften(errors, slopes * spread)[1]
            return np.concatenate([softened.reshape(-1, len(x)), np.diag(1 / prior[places])])

        if not len(places):
            return Optimum(vector, np.zeros((len(vector), len(vector))), _cost(residuals(np.zeros(0))))
        solution = scipy.optimize.least_squares(
            residuals,
            np.zeros(len(places)),
            jacobian,  # pyright: ignore[reportArgumentType]
            bounds=((low[places] - middle) / spread, (high[places] - middle) / spread),
            max_nfev=_limit(most, len(places)),
            ftol=_GAIN,
            xtol=_STEP,
        )
        covariance = np.zeros((len(vector), len(vector)))
        covariance[np.ix_(places, places)] = np.linalg.pinv(solution.jac.T @ solution.jac)
        return Optimum(whole(solution.x), covariance * np.outer(scale, scale), _cost(solution.fun))

    without = fitted(start, np.zeros(0, int), 1).cost
    places = np.flatnonzero(np.isin(owner, list(free)))
    if fixed_from is None:  # Parameters that cannot be negative do not start at their bound 0.
        start[places] = np.where(np.isin(owner, SIGNED_AIR_PARAMETERS), 0.0, scale)[places]
    others = places[~is_friction[places]]
    found = fitted(start, others, config.evaluations)
    if "friction" in free:
        found = along_friction(
            found, is_friction, config.frictions, lambda vector: fitted(vector, others, _FEW_EVALUATIONS)
        )
        if found.vector[is_friction] != start[is_friction]:
            found = fitted(found.vector, others, config.evaluations)
        covariance = fitted(found.vector, places, 1).covariance
        found = found._replace(covariance=with_rounding(covariance, is_friction, _FRICTION_STEP))
    if "delay" in free:
        found = at_whole_delay(
            found,
            is_delay,
            simulated.timestep,
            lambda vector: fitted(vector, others[~is_delay[others]], _FEW_EVALUATIONS),
        )
    return AirFit(
        parameters=unravel(jnp.asarray(found.vector, jnp.float32)),
        standard_errors=unravel(jnp.asarray(np.sqrt(np.diag(found.covariance)), jnp.float32)),
        cost=(without, found.cost),
        windows=simulated.count,
        control_steps=simulated.control_steps,
    )


def most_evaluations(config: AirConfig, free: Sequence[str]) -> int:
    """Return the largest number of evaluations of `identify_air`."""
    none = AirParameters.none()
    others = sum(getattr(none, name).size for name in free if name != "friction")
    found = 1 + _limit(config.evaluations, others)
    if "friction" in free:
        found += config.frictions * _limit(_FEW_EVALUATIONS, others) + _limit(config.evaluations, others) + 1
    if "delay" in free:
        found += 2 * _limit(_FEW_EVALUATIONS, others - 1)
    return found


def _limit(most: int, free: int) -> int:
    """Return the limit of evaluations with `free` parameters, if it is `most` with all of them. Few take more steps."""
    every = ravel_pytree(AirParameters.none())[0].size
    return most * every // free if free else 1


class Optimum(NamedTuple):
    """Optimum of a fit: all parameters, their covariance, and the cost."""

    vector: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    """Covariance of the parameters. 0 for parameters that were fixed."""
    cost: float


def along_friction(
    found: Optimum, friction: Bool[np.ndarray, " parameters"], most: int, fitted: Callable[[np.ndarray], Optimum]
) -> Optimum:
    """Try several frictions, fit the other parameters again at each, and return the optimum of lowest cost.

    Contacts stick or slide. The cost is rough along the friction, so the solver stops too early if it fits the friction
    together with the other parameters (`docs/white_box.md`, "Friction of contacts").

    **Arguments**

    - `found`: optimum at the starting value of the friction.
    - `friction`: mask of the friction in the vector of parameters.
    - `most`: largest number of frictions to try.
    - `fitted`: function that fits the other parameters, from a vector with another friction.
    """
    tried = 0
    for changes in _FRICTION_ROUNDS:
        middle = found.vector
        for change in changes:
            moved = np.where(friction, middle + change, middle)
            if tried < most and moved[friction][0] >= LEAST_FRICTION:
                tried += 1
                found = min(found, fitted(moved), key=lambda fit: fit.cost)
    return found


def at_whole_delay(
    found: Optimum, delay: Bool[np.ndarray, " parameters"], step: float, fitted: Callable[[np.ndarray], Optimum]
) -> Optimum:
    """Round the delay of an optimum to a whole number of physics steps, and fit the other parameters again.

    Both whole delays next to the delay of `found` are tried, and the one with the lower cost is kept. The covariance is
    that of `found`, plus the effect of rounding (`with_rounding`).

    **Arguments**

    - `found`: optimum with any delay.
    - `delay`: mask of the delay in the vector of parameters.
    - `step`: duration of a physics step (s).
    - `fitted`: function that fits the other parameters, from a vector with a whole delay.
    """
    steps = float(found.vector[delay][0]) / step
    neighbours = {int(np.floor(steps + _ROUNDING)), int(np.ceil(steps - _ROUNDING))}
    best = min((fitted(np.where(delay, step * whole, found.vector)) for whole in neighbours), key=lambda fit: fit.cost)
    return best._replace(covariance=with_rounding(found.covariance, delay, step))


def with_rounding(
    covariance: Float[np.ndarray, "parameters parameters"], rounded: Bool[np.ndarray, " parameters"], step: float
) -> Float[np.ndarray, "parameters parameters"]:
    """Return a covariance with the effect of rounding one parameter to steps, also on those correlated with it.

    A rounding error is uniformly distributed over a step, so its variance is step^2 / 12.
    """
    place = int(np.flatnonzero(rounded)[0])
    regression = covariance[place] / max(covariance[place, place], np.finfo(float).tiny)
    return covariance + np.outer(regression, regression) * step**2 / 12


_ROUNDING = 1e-3
"""Tolerance within which a delay counts as whole (physics steps)."""


def _cost(residuals: np.ndarray) -> float:
    return float(np.sum(residuals**2)) / 2


def _soften(
    errors: Float[np.ndarray, "windows entries"], slopes: Float[np.ndarray, "windows entries directions"] | None = None
) -> tuple[Float[np.ndarray, "windows entries"], Float[np.ndarray, "windows entries directions"]]:
    """Scale the errors of each window, and their finite differences `slopes`.

    The sum of squares of a window's scaled errors is its robust loss, `window_errors.pseudo_huber`.
    """
    squared = np.sum(errors**2, axis=1)[:, None] + 1e-12
    loss = pseudo_huber(squared)
    factor = np.sqrt(loss / squared)
    if slopes is None:
        return factor * errors, np.zeros((*errors.shape, 0))
    # The derivative of the factor with respect to the squared error, times the change of that along each direction.
    steepness = 1 / np.sqrt(1 + squared / OUTLIER_THRESHOLD**2)
    change = (steepness - loss / squared) / (2 * factor * squared)
    along = 2 * np.einsum("we,wed->wd", errors, slopes)[:, None, :]
    return factor * errors, factor[..., None] * slopes + change[..., None] * along * errors[..., None]


class AirWindows:
    """Windows of recorded motions, and their simulation with any aerodynamic parameters.

    The simulation compiles once. A `vector` is a flattened `AirParameters`.
    """

    def __init__(self, simulator: Simulator, motions: Sequence[Motion], config: AirConfig) -> None:
        """Cut the windows, and prepare their simulation in `simulator`."""
        self._simulator = simulator
        self._air = Aerodynamics(simulator.robot, simulator.mj_model)
        self.longest_delay = longest_delay(simulator.robot)
        """Longest possible delay (s)."""
        none, self._unravel = ravel_pytree(AirParameters.none())
        self._delay = int(self._unravel(jnp.arange(len(none), dtype=none.dtype)).delay)
        self.windows = cut_motion_windows(self._simulator, motions, config.window_seconds, config.interval_seconds)
        self._run = shard_over_devices(self.simulate, shared=1)
        self.timestep = float(simulator.mj_model.opt.timestep)
        self.control_steps = 0
        """Number of control steps simulated so far, in all windows."""

    @property
    def count(self) -> int:
        """Return the number of windows."""
        return len(self.windows.qpos)

    def errors(self, vector: np.ndarray) -> Float[np.ndarray, "windows entries"]:
        """Return the errors of the simulated windows, in units of the expected error."""
        return self.linear(vector, np.zeros(0, int), np.zeros(0))[0]

    def linear(
        self, vector: np.ndarray, places: Int[np.ndarray, " free"], steps: Float[np.ndarray, " free"]
    ) -> tuple[Float[np.ndarray, "windows entries"], Float[np.ndarray, "windows entries free"]]:
        """Return `errors`, and their finite differences with respect to the parameters at the indices `places`.

        Each finite difference is over the parameter's step in `steps`. Commands arrive at the start of a physics step.
        The errors for a delay between two physics steps are therefore interpolated between the errors at both. Finite
        differences with respect to the delay are over one physics step; those with respect to other parameters are at
        the nearest whole delay.
        """
        before, after, share = self._neighbours(vector)
        nearest = before if share < 0.5 else after
        between, is_delay = share >= _ROUNDING, places == self._delay
        first = self._whole(before)
        second = self._whole(after) if between or is_delay.any() else first
        near = first if share < 0.5 else second
        slopes = np.zeros((*first.shape, len(places)))
        for number, (place, step) in enumerate(zip(places, steps, strict=True)):
            if is_delay[number]:
                slopes[..., number] = (second - first) / self.timestep
            else:
                moved = nearest.copy()
                moved[place] += step
                slopes[..., number] = (self._whole(moved) - near) / step
        return (1 - share) * first + share * second if between else first, slopes

    def _neighbours(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return `vector` with each of the two whole delays next to its own, and the fraction between them (0 to 1)."""
        most = round(self.longest_delay / self.timestep)
        steps = vector[self._delay] / self.timestep
        first = min(int(steps + _ROUNDING), most - 1)
        before, after = vector.copy(), vector.copy()
        before[self._delay], after[self._delay] = first * self.timestep, (first + 1) * self.timestep
        return before, after, float(np.clip(steps - first, 0.0, 1.0))

    def _whole(self, vector: np.ndarray) -> Float[np.ndarray, "windows entries"]:
        """Return `errors` for a vector with a whole delay."""
        self.control_steps += math.prod(np.shape(self.windows.features)[:2])
        return fill_diverged(np.array(self._run(np.float32(vector), self.windows), np.float64))

    def simulate(self, vector: Float[Array, " parameters"], window: MotionWindows) -> Float[Array, " entries"]:
        """Return `errors` of one window for a vector with a whole delay. JAX transformations apply."""
        air = self._unravel(vector)
        simulator = self._simulator.with_residual(BoundResidual(self._air, air))
        return simulate_motion_window(simulator, window).ravel()
