"""Identifying the air from recordings of free motion, by derivatives through MJX.

The recordings are cut into short windows. Each is simulated from its recorded first state under its recorded commands;
what the simulated balloon's place and orientation differ by from the recorded ones is made small, by nonlinear least
squares with a loss that a slipped foot does not rule.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import scipy.optimize
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from ballu_mjx import aerodynamics, envmimic, simulation, windows
from ballu_mjx import robot as ballu
from ballu_mjx.aerodynamics import Aerodynamics, AirParameters
from ballu_mjx.errors import InputError
from ballu_mjx.reconstruction import Motion
from ballu_mjx.windows import OUTLYING, Windows


@dataclasses.dataclass(frozen=True)
class AirConfig:
    """How to identify the air."""

    window_seconds: float = 2.0
    """Length of a window, s. Shorter ones leave more to the starting state, and gave the added mass a half too high."""
    interval_seconds: float = 2.0
    """Time between the starts of two windows, s."""
    evaluations: int = 8
    """Most steps of the least-squares solver with all parameters free, at the first delay; with fewer free, which cost
    less a step, accordingly more."""


class Scale(NamedTuple):
    """A parameter's order of magnitude: where the solver looks first, and how far a weak prior lets it go."""

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
"""Most steps of the solver for each further delay, from the best fit so far."""
_LOST = 20.0
"""What a simulation that broke down counts as, in expected errors."""


@dataclasses.dataclass(frozen=True)
class AirFit:
    """What came out."""

    parameters: AirParameters
    standard_errors: AirParameters
    """Of windows that err independently, by as much as expected; 0 for what was not free."""
    cost: tuple[float, float]
    """Half the sum of squares, softened, without the residual and at the end."""
    windows: int


Report = Callable[[int, float], None]
"""(evaluations so far, cost)."""


def check(config: AirConfig) -> None:
    """**Raises** `InputError` for options out of range, naming the option."""
    windows.check(config.window_seconds, config.interval_seconds)
    if config.evaluations < 1:
        raise InputError(f"--evaluations is {config.evaluations}: it must be 1 or more; 1 is the nearest.")


def identify(
    model: mujoco.MjModel,
    motions: Sequence[Motion],
    config: AirConfig,
    report: Report = lambda evaluations, cost: None,
    *,
    known: AirParameters | None = None,
    free: Sequence[str] = aerodynamics.NAMES,
) -> AirFit:
    """Fit `AirParameters` to recorded motions.

    **Arguments**

    - `model`: the robot without the residual, its actuators identified.
    - `report`: told of every evaluation.
    - `known`: where to start, and the values of what is not `free`; None: no air.
    - `free`: names of the parameters to fit.

    **Raises** `InputError` where no recording is as long as a window.
    """
    check(config)
    simulated = _Fit(model, motions, config)
    none = AirParameters.none()
    start, unravel = ravel_pytree(none if known is None else known)
    start = np.asarray(start, np.float64)
    owner = np.repeat(aerodynamics.NAMES, [getattr(none, name).size for name in aerodynamics.NAMES])
    scale, prior = np.array([SCALES[name] for name in owner]).T
    step = ballu.CONTROL_TIMESTEP / simulation.substeps(model)
    delays = np.arange(0.0, aerodynamics.LONGEST_DELAY + step / 2, step)
    places = np.flatnonzero(np.isin(owner, [name for name in free if name != "delay"]))
    low = np.where(np.isin(owner, aerodynamics.SIGNED), -np.inf, 0.0)[places]
    evaluations = 0

    def residuals(vector: np.ndarray) -> np.ndarray:
        nonlocal evaluations
        evaluations += 1
        prior_part = (vector / (scale * prior))[places]
        total = np.concatenate([_soften(simulated.errors(vector))[0].ravel(), prior_part])
        report(evaluations, _cost(total))
        return total

    def with_delay(vector: np.ndarray) -> np.ndarray:
        """With the best delay of whole physics steps: a cost that moves by steps has no derivative to follow."""
        tried = [np.where(owner == "delay", delay, vector) for delay in delays]
        return min(tried, key=lambda each: _cost(residuals(each)))

    def fitted(vector: np.ndarray, most: int) -> Optimum:
        """The best of the other parameters, in so many steps at most."""

        def whole(x: np.ndarray) -> np.ndarray:
            moved = vector.copy()
            moved[places] = x * scale[places]
            return moved

        def jacobian(x: np.ndarray) -> np.ndarray:
            here = whole(x)
            along = [simulated.linear(here, scale[place] * np.eye(len(here))[place]) for place in places]
            softened = _soften(along[0][0], np.stack([slopes for _, slopes in along], axis=-1))[1]
            return np.concatenate([softened.reshape(-1, len(x)), np.diag(1 / prior[places])])

        solution = scipy.optimize.least_squares(
            lambda x: residuals(whole(x)),
            vector[places] / scale[places],
            jacobian,  # pyright: ignore[reportArgumentType]
            bounds=(low, np.inf),
            max_nfev=most * len(start) // len(places),
        )
        variance = np.zeros(len(start))
        variance[places] = np.diag(np.linalg.pinv(solution.jac.T @ solution.jac)) * scale[places] ** 2
        return Optimum(whole(solution.x), variance, _cost(solution.fun))

    without = _cost(residuals(start))
    best = start
    if known is None:  # not from the bounds, where what must be positive has nowhere to go but up
        best = np.where(np.isin(owner, aerodynamics.SIGNED), 0.0, scale)
    if "delay" in free:
        best = with_delay(best)
    if not len(places):
        found = Optimum(best, np.zeros(len(start)), _cost(residuals(best)))
    else:
        found = fitted(best, config.evaluations)
        if "delay" in free:
            found = over_delays(found, owner == "delay", delays, lambda vector: fitted(vector, _AGAIN))
    return AirFit(
        parameters=unravel(jnp.asarray(found.vector, jnp.float32)),
        standard_errors=unravel(jnp.asarray(np.sqrt(found.variance), jnp.float32)),
        cost=(without, found.cost),
        windows=simulated.count,
    )


class Optimum(NamedTuple):
    """Of a fit: all parameters, their variances, and the cost."""

    vector: Float[np.ndarray, " parameters"]
    variance: Float[np.ndarray, " parameters"]
    cost: float


def over_delays(
    first: Optimum,
    delay: Bool[np.ndarray, " parameters"],
    delays: Float[np.ndarray, " delays"],
    fitted: Callable[[np.ndarray], Optimum],
) -> Optimum:
    """The best fit of all, found by walking from `first` along the delays, with all else fitted again at each: a delay
    and an added mass explain much the same motion. To variances comes what the delay's own uncertainty, by the costs
    beside the best, makes of them."""
    place = int(np.argmin(np.abs(delays - first.vector[delay])))
    fits = {place: first}
    while True:
        best = min(fits, key=lambda at: fits[at].cost)
        missing = [at for at in (best - 1, best + 1) if 0 <= at < len(delays) and at not in fits]
        if not missing:
            break
        fits[missing[0]] = fitted(np.where(delay, delays[missing[0]], fits[best].vector))
    beside = [at for at in (best - 1, best + 1) if at in fits]
    step = delays[1] - delays[0]
    # Costs are half squares of expected errors: a parabola through three of them is a normal distribution's exponent.
    curvature = 2 * np.mean([fits[at].cost - fits[best].cost for at in beside]) / step**2
    variance = 1 / max(curvature, 1 / delays[-1] ** 2) + step**2 / 12
    near = [*beside, best]
    slope = (fits[max(near)].vector - fits[min(near)].vector) / (delays[max(near)] - delays[min(near)])
    return fits[best]._replace(variance=fits[best].variance + slope**2 * variance)


def _cost(residuals: np.ndarray) -> float:
    return float(np.sum(residuals**2)) / 2


def _soften(
    errors: Float[np.ndarray, "windows entries"], slopes: Float[np.ndarray, "windows entries directions"] | None = None
) -> tuple[Float[np.ndarray, "windows entries"], Float[np.ndarray, "windows entries directions"]]:
    """Errors (and their derivatives) shortened, window by window, so that their sum of squares is `windows.soften` of
    each window's whole error."""
    squared = np.sum(errors**2, axis=1)[:, None] + 1e-12
    loss = windows.soften(squared)
    factor = np.sqrt(loss / squared)
    if slopes is None:
        return factor * errors, np.zeros((*errors.shape, 0))
    # The factor's derivative by the squared error, along each direction.
    steepness = 1 / np.sqrt(1 + squared / OUTLYING**2)
    change = (steepness - loss / squared) / (2 * factor * squared)
    along = 2 * np.einsum("we,wed->wd", errors, slopes)[:, None, :]
    return factor * errors, factor[..., None] * slopes + change[..., None] * along * errors[..., None]


class _Fit:
    """Windows of recorded motions, and their simulation; compiles once."""

    def __init__(self, model: mujoco.MjModel, motions: Sequence[Motion], config: AirConfig) -> None:
        self._simulator, self._air = envmimic.Simulator(model), Aerodynamics(model)
        _, self._unravel = ravel_pytree(AirParameters.none())
        self._windows = windows.cut(self._simulator, motions, config.window_seconds, config.interval_seconds)
        self._run = windows.spread(self._linear_one, shared=2)

    @property
    def count(self) -> int:
        """Of the windows."""
        return len(self._windows.qpos)

    def errors(self, vector: np.ndarray) -> Float[np.ndarray, "windows entries"]:
        """Errors of the simulated windows, in expected ones."""
        return self.linear(vector, np.zeros_like(vector))[0]

    def linear(
        self, vector: np.ndarray, direction: np.ndarray
    ) -> tuple[Float[np.ndarray, "windows entries"], Float[np.ndarray, "windows entries"]]:
        """`errors`, and their derivative along a direction of the parameters."""
        found = self._run(np.float32(vector), np.float32(direction), self._windows)
        errors, slopes = (np.array(x, np.float64) for x in found)
        lost = ~(np.isfinite(errors).all(axis=1) & np.isfinite(slopes).all(axis=1))
        errors[lost], slopes[lost] = _LOST / np.sqrt(errors.shape[1]), 0.0
        return errors, slopes

    def _linear_one(self, vector: Array, direction: Array, window: Windows) -> tuple[Array, Array]:
        return jax.jvp(lambda vector: self._one(vector, window), (vector,), (direction,))

    def _one(self, vector: Float[Array, " parameters"], window: Windows) -> Float[Array, " entries"]:
        air = self._unravel(vector)
        simulator = self._simulator.altered(self._air.fields(air))
        # What the parameters will move depends on them from the start, formally: JAX then traces the loops once.
        nothing = 0.0 * vector[0]
        state = jax.tree.map(lambda x: x + nothing, simulation.at(jnp.asarray(window.qpos), jnp.asarray(window.qvel)))

        def step(carry: tuple, time: Int[Array, ""]) -> tuple[tuple, Array]:
            state, history = carry
            seen = jax.lax.dynamic_slice_in_dim(window.commands, time, envmimic.HISTORY)
            wrench = self._air.wrench(air, history, seen)
            state = simulator.step(state, self._air.command(air, seen), wrench)
            features, _ = simulator.observe(state)
            return (state, jnp.concatenate([history[1:], features[None]])), features

        _, features = jax.lax.scan(step, (state, window.history + nothing), jnp.arange(len(window.features)))
        return windows.errors(features, window.features).ravel()
