"""Identification of declared parameters from recordings, for any robot.

The fit is Levenberg-Marquardt over windows of recordings (`identification.window_objective`), from several starts.
Derivatives are exact, by forward-mode differentiation of the simulation.

The identified parameters are always compared with the nominal ones on held-out windows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.bounded_solver import bounded_least_squares
from ballu_mjx.identification.measured_motion import MeasuredMotion
from ballu_mjx.identification.parameters import Direction, IdentifiedParameters, ParameterSet
from ballu_mjx.identification.uncertainty import analyse
from ballu_mjx.identification.window_objective import WindowConfig, WindowObjective, WindowSearch, robust_scatter
from ballu_mjx.identification.window_simulator import Windows, WindowSimulator, cut_windows


@dataclasses.dataclass(frozen=True)
class FitConfig(WindowConfig):
    """Options of the identification of declared parameters."""

    starts: int = 4
    """Number of searches: one from the expected values, the others from samples of the priors."""
    steps: int = 20
    """Maximum number of iterations of a search."""
    seed: int = 0
    """Seed of the samples of the priors."""
    reweigh: bool = True
    """Weight channels by the scatter of their residuals. If false, channels are weighted by the measurements' noise
    alone, and there is no second search."""


def check_fit_config(config: FitConfig) -> None:
    """Check the ranges of the options.

    **Raises** `InputError` naming the option.
    """
    for name in ("window_seconds", "interval_seconds", "starts", "steps", "outlying"):
        if getattr(config, name) is not None and getattr(config, name) <= 0:
            raise InputError(f"--{name.replace('_', '-')} is {getattr(config, name)}: it must be above 0.")
    if config.interval_seconds is not None and config.interval_seconds < config.window_seconds:
        raise InputError(
            f"--interval-seconds is {config.interval_seconds:g}, less than --window-seconds "
            f"({config.window_seconds:g}): windows would share samples, and standard errors would be too small; give "
            "windows that do not overlap."
        )
    if config.start_spread < 0:
        raise InputError(
            f"--start-spread is {config.start_spread}: it must be 0 or more; 0 takes starting states as measured."
        )
    if config.seed < 0:
        raise InputError(f"--seed is {config.seed}: it must be 0 or more.")


@dataclasses.dataclass(frozen=True, eq=False)
class HeldOut:
    """Errors on held-out windows, from measured starting states."""

    motion: Int[np.ndarray, " windows"]
    """Index of each window's motion."""
    first: Int[np.ndarray, " windows"]
    """Index of each window's first sample in its motion."""
    errors: Float[np.ndarray, "windows samples channels"]
    """Simulated minus recorded positions, in the coordinates of generalized velocities, then velocities (SI units)."""
    noise: Float[np.ndarray, " channels"]
    """Noise that `score` divides the errors by (SI units): the mean over the motions."""

    @property
    def score(self) -> float:
        """Return the median over windows of the root mean square error, in units of noise. inf if most diverge."""
        squares = np.mean((self.errors / self.noise) ** 2, axis=(1, 2))
        return float(np.sqrt(np.median(np.where(np.isfinite(squares), squares, np.inf))))

    @property
    def final_median(self) -> Float[np.ndarray, " channels"]:
        """Return the median over windows of the absolute error at their end (SI units)."""
        last = np.abs(self.errors[:, -1])
        return np.median(np.where(np.isfinite(last), last, np.inf), axis=0)


@dataclasses.dataclass(frozen=True, eq=False)
class RobotFit:
    """Result of an identification: values, their uncertainty, and errors on held-out windows."""

    parameters: ParameterSet
    values: Float[np.ndarray, " parameters"]
    standard_errors: Float[np.ndarray, " parameters"]
    """Robust standard errors. They assume only that windows err independently (`analyse`)."""
    white_noise_errors: Float[np.ndarray, " parameters"]
    """Standard errors if the residuals of the fit are white noise."""
    correlations: Float[np.ndarray, "parameters parameters"]
    directions: tuple[Direction, ...]
    """Combinations of parameters, from the best to the least determined."""
    unseen: tuple[str, ...]
    """Parameters that these recordings cannot show, according to the data check."""
    at_bounds: tuple[str, ...]
    """Parameters that the recordings show, and whose value is at a bound."""
    scatter: Float[np.ndarray, " positions"]
    """Robust standard deviation of the remaining position errors, in units of the measurements' noise."""
    losses: Float[np.ndarray, " starts"]
    """Final losses of the searches, in ascending order."""
    windows: Windows
    """Windows of the training motions that were fitted; the held-out ones are not among them."""
    nominal: HeldOut
    identified: HeldOut
    earlier: HeldOut | None = None
    """Errors of the expected values of an earlier identification. None if nominal values were expected."""

    @property
    def improves(self) -> bool:
        """Return whether the identified values have a lower score on held-out windows than the nominal ones."""
        return self.identified.score < self.nominal.score

    @property
    def best(self) -> IdentifiedParameters:
        """Return the identified values, or the nominal ones if the identified values do not improve on them."""
        values = self.values if self.improves else self.parameters.nominal
        return IdentifiedParameters(jnp.asarray(values), self.parameters)

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Return the combinations of parameters that the data do not determine, in words."""
        return tuple(self._words(d) for d in self.directions if d.standard_error > 1)

    @property
    def strong_correlations(self) -> tuple[tuple[str, str, float], ...]:
        """Return the pairs of parameters with an absolute correlation above 0.9, with their correlation."""
        names, found = self.parameters.names, self.correlations
        pairs = zip(*np.triu_indices(len(names), 1), strict=True)
        return tuple((names[i], names[j], float(found[i, j])) for i, j in pairs if abs(found[i, j]) > _STRONG)

    def _words(self, direction: Direction) -> str:
        order = np.argsort(-np.abs(direction.weights))
        named = [i for i in order if abs(direction.weights[i]) > _NAMED]
        return " ".join(f"{direction.weights[i]:+.2f} {self.parameters.names[i]}" for i in named)


_STRONG = 0.9
_NAMED = 0.3
"""Smallest weight of a parameter that is named in a combination."""
Report = Callable[[str, int, int, float], None]
"""Callback with the arguments (stage, iteration, maximum number of iterations, lowest loss of all searches)."""


class Visibility(NamedTuple):
    """Result of the data check: the effect of each parameter on the data."""

    names: tuple[str, ...]
    signal: Float[np.ndarray, " parameters"]
    """Change of the data when a parameter changes by its prior standard deviation, in standard deviations of the noise.
    The part that starting states can compensate is subtracted."""

    @property
    def unseen(self) -> tuple[str, ...]:
        """Return the parameters whose prior standard deviation changes the data by less than their noise."""
        return tuple(name for name, signal in zip(self.names, self.signal, strict=True) if signal < 1)


def check_data(
    parameters: ParameterSet, motions: Sequence[MeasuredMotion], config: FitConfig | None = None
) -> Visibility:
    """Check which parameters these recordings can show.

    The signal of a parameter is the largest at the expected values and at two samples of the priors.

    **Raises** `InputError` if an option is out of range, or if no recording is as long as a window.
    """
    config = config or FitConfig()
    check_fit_config(config)
    with jax.enable_x64(True):
        windows = cut_windows(motions, config.window_seconds, config.interval_seconds)
        return _visibility(WindowObjective(WindowSimulator(parameters, motions, windows), config), config)


def fit_robot(
    parameters: ParameterSet,
    training: Sequence[MeasuredMotion],
    validation: Sequence[MeasuredMotion] | None = None,
    config: FitConfig | None = None,
    report: Report | None = None,
    on_data_check: Callable[[Visibility], None] | None = None,
    on_evaluation: Callable[[Float[np.ndarray, " parameters"]], None] | None = None,
) -> RobotFit:
    """Fit parameters to recorded motions.

    1. Check which parameters the data can show. The others stay near their expected values, because of their priors.
    2. Search from several starts, one after the other.
    3. Weight each channel by its scatter at the best solution, and continue the search from there.
    4. Replay held-out windows with nominal, expected and identified values.

    **Arguments**

    - `validation`: motions that the fit does not use. None: every fourth window is held out.
    - `report`: called at every iteration.
    - `on_data_check`: called with the result of the first step.
    - `on_evaluation`: called with the values of each evaluation in a search.

    **Raises** `InputError` if an option is out of range, if no recording is as long as a window, or if there are too
    few windows to hold some out.
    """
    config = config or FitConfig()
    check_fit_config(config)
    report = report or (lambda stage, iteration, steps, value: None)
    with jax.enable_x64(True):
        windows = cut_windows(training, config.window_seconds, config.interval_seconds)
        if validation is None:
            if len(windows.first) < _EVERY:
                problem = (
                    f"{len(windows.first)} windows of {config.window_seconds:g} s are too few to hold out every fourth"
                )
                raise InputError(f"{training[0].name}: {problem}; give validation recordings, or shorter windows.")
            held = np.arange(len(windows.first)) % _EVERY == _EVERY - 1
            held_out = Windows(windows.motion[held], windows.first[held], windows.samples)
            windows = Windows(windows.motion[~held], windows.first[~held], windows.samples)
            simulator = WindowSimulator(parameters, training, held_out)
        else:
            held_out = cut_windows(validation, config.window_seconds, config.interval_seconds)
            simulator = WindowSimulator(parameters, validation, held_out)
        objective = WindowObjective(WindowSimulator(parameters, training, windows), config)
        report("data check", 0, 1, float("nan"))
        visibility = _visibility(objective, config)
        report("data check", 1, 1, float("nan"))
        if on_data_check is not None:
            on_data_check(visibility)
        if config.reweigh:
            objective.rescale(objective.simulator.differences(parameters.expected))
        searches, lowest = [], np.inf

        def report_search(stage: str, before: int, whole: int, iteration: int, steps: int, value: float) -> None:
            report(stage, before + iteration, whole, min(value, lowest))

        for number, begin in enumerate(parameters.draw(config.seed, config.starts)):
            search, before = WindowSearch(objective, objective.measured_start(), on_evaluation), number * config.steps
            tell = partial(report_search, "search", before, config.starts * config.steps)
            found, loss = bounded_least_squares(search, parameters.shares(begin), config.steps, tell, _PATIENCE)
            lowest = min(lowest, loss)
            searches.append((loss, found, search))
        losses = np.array([loss for loss, _, _ in searches])
        _, shares, best = searches[int(np.argmin(losses))]
        if config.reweigh:
            objective.rescale(best.residuals)
            best, lowest = WindowSearch(objective, best.start, on_evaluation), np.inf
            tell = partial(report_search, "refinement", 0, config.steps)
            shares, _ = bounded_least_squares(best, shares, config.steps, tell, _PATIENCE)
            objective.rescale(best.residuals)
        values = parameters.at_shares(shares)
        analysis = analyse(objective(values, best.start)[0], parameters)
        pair = [_held_out(simulator, point) for point in (parameters.nominal, values)]
        earlier = _held_out(simulator, parameters.expected) if parameters.refines else None
    return RobotFit(
        parameters=parameters,
        values=values,
        standard_errors=analysis.robust,
        white_noise_errors=analysis.white,
        correlations=analysis.correlations,
        directions=analysis.directions,
        unseen=visibility.unseen,
        at_bounds=tuple(name for name in parameters.at_bounds(values) if name not in visibility.unseen),
        scatter=robust_scatter(best.residuals[..., : objective.simulator.nv]),
        losses=np.sort(losses),
        windows=windows,
        nominal=pair[0],
        identified=pair[1],
        earlier=earlier,
    )


_EVERY = 4
"""Interval of the held-out windows if there are no validation motions."""
_PATIENCE = 6
"""Evaluations without a sufficient decrease of the loss after which a search ends."""


def replay(
    parameters: ParameterSet,
    motions: Sequence[MeasuredMotion],
    points: Sequence[Float[np.ndarray, " parameters"]],
    seconds: float,
    interval: float | None = None,
) -> tuple[HeldOut, ...]:
    """Replay motions with each of several parameter vectors (`points`), from measured starting states.

    Windows last `seconds` (s), and there is one every `interval` (s; None: end to end).

    **Raises** `InputError` if no motion is long enough.
    """
    with jax.enable_x64(True):
        simulator = WindowSimulator(parameters, motions, cut_windows(motions, seconds, interval))
        return tuple(_held_out(simulator, np.asarray(values, float)) for values in points)


def _visibility(objective: WindowObjective, config: FitConfig) -> Visibility:
    parameters = objective.parameters
    start = objective.measured_start()
    signal = np.zeros(len(parameters))
    for values in parameters.draw(config.seed, _DRAWS):
        reduced, _ = objective(values, start)
        signal = np.maximum(signal, np.sqrt(np.sum((reduced.slopes * parameters.unit) ** 2, axis=(0, 1))))
    return Visibility(parameters.names, signal)


_DRAWS = 3
"""Number of parameter vectors in the data check: the expected values, then samples of the priors."""


def _held_out(simulator: WindowSimulator, values: Float[np.ndarray, " parameters"]) -> HeldOut:
    motions = simulator.motions
    noise = np.array([np.concatenate([m.position_noise, m.velocity_noise]) for m in motions])
    errors = simulator.differences(values) * noise[simulator.windows.motion][:, None]
    return HeldOut(simulator.windows.motion, simulator.windows.first, errors, noise.mean(axis=0))
