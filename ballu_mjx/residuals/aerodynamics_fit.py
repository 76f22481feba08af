"""Identifying the air from recordings of free motion, by least squares through MJX.

The recordings are cut into short windows. Each is simulated from its recorded first state under its recorded commands;
what the place and orientation of the simulated tracked body differ by from the recorded ones is made small, by
nonlinear least squares with a loss that single bad windows, such as one with a slipping contact, do not dominate.

Slopes are taken over a parameter's order of magnitude, not at a point. Where contacts begin at other times than in the
recording, derivatives hold for less than a millinewton of lift and point nowhere beyond, while errors over thirty
change smoothly (`docs/white_box.md`, "Why not derivatives").
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
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
from ballu_mjx.recordings.window_errors import OUTLYING, count_lost, pseudo_huber
from ballu_mjx.residuals.aerodynamics import (
    AIR_PARAMETERS,
    SIGNED_AIR_PARAMETERS,
    Aerodynamics,
    AirParameters,
    longest_delay,
)
from ballu_mjx.sim.residual import BoundResidual
from ballu_mjx.sim.sharding import shard_over_devices
from ballu_mjx.sim.simulator import Simulator


@dataclasses.dataclass(frozen=True)
class AirConfig:
    """How to identify the air."""

    window_seconds: float = 2.0
    """Length of a window, s. Shorter ones leave more to the starting state, and gave the added mass a half too high."""
    interval_seconds: float = 2.0
    """Time between the starts of two windows, s."""
    evaluations: int = 15
    """Most steps of the least-squares solver with all parameters free; with fewer free, which cost less a step,
    accordingly more."""


class Scale(NamedTuple):
    """A parameter's order of magnitude: where the solver looks first, over what it takes slopes, and how far a weak
    prior lets it go."""

    typical: float
    prior: float = 3.0
    """Standard deviation of the prior, in multiples of `typical`."""


SCALES: dict[str, Scale] = {
    "added_mass": Scale(0.1),
    "added_inertia": Scale(2e-3),
    "lift": Scale(0.03),
    "centre": Scale(0.01),
    "linear_drag": Scale(0.03),
    "quadratic_drag": Scale(0.2),
    "turning_drag": Scale(3e-3),
    "delay": Scale(0.05),
}
"""By name; SI units."""
_AGAIN = 4
"""Most steps of the solver at each of the two whole delays next to the best."""
_INSIDE = 0.01
"""Of `typical`: so far from its bounds a search begins. On one, the solver takes its first steps for nothing."""
_GAIN, _STEP = 1e-4, 1e-3
"""Steps that gain less than that share of the cost, or are that short, are the contacts' noise."""


@dataclasses.dataclass(frozen=True)
class AirFit:
    """What came out."""

    parameters: AirParameters
    standard_errors: AirParameters
    """Of windows that err independently, by as much as expected; 0 for what was not free."""
    cost: tuple[float, float]
    """Half the sum of squares, softened, without the residual and at the end."""
    windows: int
    control_steps: int
    """Simulated for it."""


Report = Callable[[int, float], None]
"""(evaluations so far, cost)."""


def check_air_config(config: AirConfig, control_timestep: float) -> None:
    """**Raises** `InputError` for options out of range, naming the option."""
    check_motion_windows(config.window_seconds, config.interval_seconds, control_timestep)
    if config.evaluations < 1:
        raise InputError(f"--evaluations is {config.evaluations}: it must be 1 or more; 1 is the nearest.")


def identify_air(
    simulator: Simulator,
    motions: Sequence[Motion],
    config: AirConfig,
    report: Report = lambda evaluations, cost: None,
    *,
    fixed_from: AirParameters | None = None,
    free: Sequence[str] = AIR_PARAMETERS,
) -> AirFit:
    """Fit `AirParameters` to recorded motions.

    **Arguments**

    - `simulator`: the robot without the residual, its actuators identified.
    - `report`: told of every evaluation.
    - `fixed_from`: where to start, and the values of what is not `free`; None: no air.
    - `free`: names of the parameters to fit.

    **Raises** `InputError` where no recording is as long as a window.
    """
    check_air_config(config, simulator.robot.control_timestep)
    simulated = AirWindows(simulator, motions, config)
    none = AirParameters.none()
    start, unravel = ravel_pytree(none if fixed_from is None else fixed_from)
    start = np.asarray(start, np.float64)
    owner = np.repeat(AIR_PARAMETERS, [getattr(none, name).size for name in AIR_PARAMETERS])
    scale, prior = np.array([SCALES[name] for name in owner]).T
    is_delay = owner == "delay"
    low = np.where(np.isin(owner, SIGNED_AIR_PARAMETERS), -np.inf, 0.0)
    high = np.where(is_delay, simulated.longest_delay, np.inf)
    evaluations = 0

    def fitted(vector: np.ndarray, places: Int[np.ndarray, " free"], most: int) -> Optimum:
        """The best of the parameters at `places`, in so many steps at most."""
        spread, middle = scale[places], np.clip(vector, low + _INSIDE * scale, high - _INSIDE * scale)[places]

        # Counted from the start: the solver first trusts a region as large as what it starts with, 1 where that is 0.
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
            max_nfev=most * len(start) // len(places),
            ftol=_GAIN,
            xtol=_STEP,
        )
        covariance = np.zeros((len(vector), len(vector)))
        covariance[np.ix_(places, places)] = np.linalg.pinv(solution.jac.T @ solution.jac)
        return Optimum(whole(solution.x), covariance * np.outer(scale, scale), _cost(solution.fun))

    without = fitted(start, np.zeros(0, int), 1).cost
    places = np.flatnonzero(np.isin(owner, list(free)))
    if fixed_from is None:  # not from the bounds, where what must be positive has nowhere to go but up
        start[places] = np.where(np.isin(owner, SIGNED_AIR_PARAMETERS), 0.0, scale)[places]
    found = fitted(start, places, config.evaluations)
    if "delay" in free:
        found = at_whole_delay(
            found, is_delay, simulated.timestep, lambda vector: fitted(vector, places[~is_delay[places]], _AGAIN)
        )
    return AirFit(
        parameters=unravel(jnp.asarray(found.vector, jnp.float32)),
        standard_errors=unravel(jnp.asarray(np.sqrt(np.diag(found.covariance)), jnp.float32)),
        cost=(without, found.cost),
        windows=simulated.count,
        control_steps=simulated.control_steps,
    )


class Optimum(NamedTuple):
    """Of a fit: all parameters, their covariance, and the cost."""

    vector: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    cost: float


def at_whole_delay(
    found: Optimum, delay: Bool[np.ndarray, " parameters"], step: float, fitted: Callable[[np.ndarray], Optimum]
) -> Optimum:
    """The better one of the two whole delays next to the one `found`, with all else fitted again. To the covariance of
    `found` comes what rounding the delay does to it and to what passes for it."""
    place = int(np.flatnonzero(delay)[0])
    steps = found.vector[place] / step
    neighbours = {int(np.floor(steps + _JUST)), int(np.ceil(steps - _JUST))}
    best = min((fitted(np.where(delay, step * whole, found.vector)) for whole in neighbours), key=lambda fit: fit.cost)
    with_it = found.covariance[place] / max(found.covariance[place, place], np.finfo(float).tiny)
    return best._replace(covariance=found.covariance + np.outer(with_it, with_it) * step**2 / 12)


_JUST = 1e-3
"""Physics steps: so near, a delay is whole."""


def _cost(residuals: np.ndarray) -> float:
    return float(np.sum(residuals**2)) / 2


def _soften(
    errors: Float[np.ndarray, "windows entries"], slopes: Float[np.ndarray, "windows entries directions"] | None = None
) -> tuple[Float[np.ndarray, "windows entries"], Float[np.ndarray, "windows entries directions"]]:
    """Scale errors (and their derivatives), window by window.

    The sum of squares becomes `window_errors.pseudo_huber` of each window's whole error."""
    squared = np.sum(errors**2, axis=1)[:, None] + 1e-12
    loss = pseudo_huber(squared)
    factor = np.sqrt(loss / squared)
    if slopes is None:
        return factor * errors, np.zeros((*errors.shape, 0))
    # The factor's derivative by the squared error, along each direction.
    steepness = 1 / np.sqrt(1 + squared / OUTLYING**2)
    change = (steepness - loss / squared) / (2 * factor * squared)
    along = 2 * np.einsum("we,wed->wd", errors, slopes)[:, None, :]
    return factor * errors, factor[..., None] * slopes + change[..., None] * along * errors[..., None]


class AirWindows:
    """Windows of recorded motions, and their simulation in any air; compiles once. A vector is a flattened
    `AirParameters`."""

    def __init__(self, simulator: Simulator, motions: Sequence[Motion], config: AirConfig) -> None:
        self._simulator = simulator
        self._air = Aerodynamics(simulator.robot, simulator.mj_model)
        self.longest_delay = longest_delay(simulator.robot)
        """s."""
        none, self._unravel = ravel_pytree(AirParameters.none())
        self._delay = int(self._unravel(jnp.arange(len(none), dtype=none.dtype)).delay)
        self.windows = cut_motion_windows(self._simulator, motions, config.window_seconds, config.interval_seconds)
        self._run = shard_over_devices(self.simulate, shared=1)
        self.timestep = float(simulator.mj_model.opt.timestep)
        self.control_steps = 0
        """Simulated so far, in all windows."""

    @property
    def count(self) -> int:
        """Of the windows."""
        return len(self.windows.qpos)

    def errors(self, vector: np.ndarray) -> Float[np.ndarray, "windows entries"]:
        """Errors of the simulated windows, in expected ones."""
        return self.linear(vector, np.zeros(0, int), np.zeros(0))[0]

    def linear(
        self, vector: np.ndarray, places: Int[np.ndarray, " free"], steps: Float[np.ndarray, " free"]
    ) -> tuple[Float[np.ndarray, "windows entries"], Float[np.ndarray, "windows entries free"]]:
        """`errors`, and their slopes along the parameters at `places`, each over a step of so much.

        Commands arrive with a physics step; for a delay between two, errors are a mean of what the one and the other
        give, and change by it as from the one to the other. Along other parameters: at the nearest whole delay.
        """
        before, after, share = self._neighbours(vector)
        nearest = before if share < 0.5 else after
        between, is_delay = share >= _JUST, places == self._delay
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
        """With the two whole delays next to that of `vector`, and how far it is from the first to the second."""
        most = round(self.longest_delay / self.timestep)
        steps = vector[self._delay] / self.timestep
        first = min(int(steps + _JUST), most - 1)
        before, after = vector.copy(), vector.copy()
        before[self._delay], after[self._delay] = first * self.timestep, (first + 1) * self.timestep
        return before, after, float(np.clip(steps - first, 0.0, 1.0))

    def _whole(self, vector: np.ndarray) -> Float[np.ndarray, "windows entries"]:
        """`errors`, at a whole delay."""
        self.control_steps += math.prod(np.shape(self.windows.features)[:2])
        return count_lost(np.array(self._run(np.float32(vector), self.windows), np.float64))

    def simulate(self, vector: Float[Array, " parameters"], window: MotionWindows) -> Float[Array, " entries"]:
        """`errors` of one window, at a whole delay; JAX's own transformations apply."""
        air = self._unravel(vector)
        simulator = self._simulator.with_residual(BoundResidual(self._air, air))
        return simulate_motion_window(simulator, window).ravel()
