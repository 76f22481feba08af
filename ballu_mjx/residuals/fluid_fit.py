"""Fit of the fluid residual to recordings of free motion, by least squares through MJX.

Recordings are cut into windows. Each window is simulated from its recorded first state under its recorded commands. The
fit minimizes the errors of the tracked body's position and orientation over the window. Derivatives are exact, by
forward-mode differentiation of the simulation. Windows become longer from stage to stage. Over a short window, errors
are nearly linear in the coefficients. A long window shows effects that accumulate.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.batched_solver import BatchedSolver, Evaluate
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.motion_windows import (
    MotionWindows,
    check_motion_windows,
    cut_motion_windows,
    simulate_motion_window,
)
from ballu_mjx.recordings.window_errors import OUTLIER_THRESHOLD, fill_diverged, pseudo_huber
from ballu_mjx.residuals.fluid import (
    TERM_SETS,
    FluidEstimate,
    FluidParameters,
    FluidResidual,
    TermSet,
    all_terms,
    terms_of,
)
from ballu_mjx.residuals.fluid_parametrization import (
    PASSIVE_SETS,
    AddedMass,
    FluidParametrization,
    FreeCoefficients,
    PassiveCoefficients,
    TrimParametrization,
)
from ballu_mjx.sim.observation import HISTORY
from ballu_mjx.sim.residual import BoundResidual
from ballu_mjx.sim.sharding import batch_size, chunks, shard_over_devices
from ballu_mjx.sim.simulator import Simulator


@dataclasses.dataclass(frozen=True)
class FluidConfig:
    """Options of the fit of the fluid residual."""

    terms: Literal["auto", TermSet] = "auto"
    """Set of terms: linear (direction of gravity, velocities), drag (velocities times the speed), quadratic (products
    of two velocities) or cubic (products of three velocities, divided by the speed). Each set includes the sets before
    it. auto fits every set, and takes the one with the lowest error on the validation recordings."""
    passive: bool = True
    """Allow only forces that add no energy to the body, as those of still air or water. Corrections of weight and
    centre of mass are exempt. Simulations then stay bounded, even far from the recordings. Passive forces have no cubic
    terms."""
    added_mass: bool = True
    """Fit the mass and the moments of inertia of the fluid that the body drags along. The model needs buoyancy: a body
    with `gravcomp`. Without it, there is no added mass."""
    mirror: bool = True
    """Fit forces that are symmetric about the body's xz plane, if the robot's description declares `mirror`."""
    window_seconds: tuple[float, ...] = (0.5, 1.0, 2.0)
    """Lengths of the windows, s, one for each stage. A last stage as long as the horizon that matters predicts it best.
    The recordings must be longer than the longest window."""
    windows: int = 200
    """Largest number of windows, for training and for validation each."""
    steps: int = 20
    """Largest number of Levenberg-Marquardt iterations in a stage. Iterations that only shorten the next step count,
    but take little time."""
    spread: float = 1.0
    """Standard deviation of the prior on the typical effect of each term, as an acceleration (m/s^2, rad/s^2)."""


def check_fluid_config(config: FluidConfig, control_timestep: float) -> None:
    """Check options for a robot with a control step of `control_timestep` (s).

    **Raises** `InputError` for an option out of range. The message names it.
    """
    if not config.window_seconds:
        raise InputError("--window-seconds names no length; give one or more, in seconds.")
    for seconds in config.window_seconds:
        check_motion_windows(seconds, seconds, control_timestep)
    if config.passive and config.terms == TERM_SETS[-1]:
        raise InputError(
            f"--terms {config.terms}: passive forces have no {config.terms} terms; give --no-passive, or --terms "
            f"{PASSIVE_SETS[-1]}."
        )
    for name in ("windows", "steps", "spread"):
        if not getattr(config, name) > 0:
            raise InputError(f"--{name} is {getattr(config, name)}: it must be greater than 0.")


@dataclasses.dataclass(frozen=True, eq=False)
class FluidFit:
    """Result of a fit of the fluid residual."""

    estimate: FluidEstimate
    scores: dict[str, float]
    """Robust RMS error on the validation windows, in units of the expected error, by set of terms. The key `none` is
    the error without residual. Of a trim: that of the earlier result, and that with the trim."""
    symmetric: bool
    """Whether the forces are symmetric about the xz plane."""
    windows: int
    """Number of training windows."""
    control_steps: int
    """Number of control steps that were simulated with the training and the validation windows."""


Report = Callable[[str, int, int, float], None]
"""Function of the stage, the iteration, the largest number of iterations, and the loss."""


def fit_fluid_forces(
    simulator: Simulator,
    training: Sequence[Motion],
    validation: Sequence[Motion],
    config: FluidConfig,
    report: Report = lambda stage, iteration, steps, loss: None,
    fixed_from: FluidEstimate | None = None,
) -> FluidFit:
    """Fit the parameters of the fluid residual.

    **Arguments**

    - `simulator`: the simulator to correct.
    - `training`: training motions.
    - `validation`: motions that choose the set of terms.
    - `config`: options of the fit.
    - `report`: function that is called after every iteration.
    - `fixed_from`: earlier result. Its parameters are kept, and only a trim is fitted (`TrimParametrization`).
      `config.passive`, `config.added_mass` and `config.mirror` then have no effect. If None, all parameters are fitted.

    **Raises** `InputError` for options out of range, if `config.terms` differs from those of `fixed_from`, and if no
    motion is as long as a window.
    """
    check_fluid_config(config, simulator.control_timestep)
    if fixed_from is not None:
        return _fit_trim(simulator, training, validation, config, report, fixed_from)
    centre, added = _centre(simulator), _added_mass(simulator) if config.added_mass else None
    program = _Program(simulator, added_mass=added is not None)
    windows, held_out = (_Windows(simulator, motions, config, program) for motions in (training, validation))
    symmetric = config.mirror and simulator.robot.mirror is not None
    sets = PASSIVE_SETS if config.passive else TERM_SETS
    chain = sets if config.terms == "auto" else sets[: sets.index(config.terms) + 1]
    prior = _priors(windows, config.spread)
    scores = {"none": held_out.score(FluidParameters.without_added_mass(np.zeros_like(prior)))}
    best: tuple[float, FluidEstimate] | None = None
    vector = np.zeros(0)
    for name in chain:
        coefficients = (
            PassiveCoefficients(name, prior, centre, symmetric=symmetric)
            if config.passive
            else FreeCoefficients(name, prior, symmetric=symmetric)
        )
        parametrization = FluidParametrization(coefficients, added)
        search = _Search(windows, parametrization)
        # The search starts from the result for the previous set, whose entries come first.
        start = np.concatenate([vector, parametrization.start[len(vector) :]])
        vector = search.run(start, config, lambda *progress, name=name: report(f"{name}, {progress[0]}", *progress[1:]))
        parameters = parametrization.parameters(vector)
        scores[name] = held_out.score(parameters)
        if config.terms in ("auto", name) and (best is None or scores[name] < best[0]):
            shown = slice(len(terms_of(name)))
            kept = [
                dataclasses.replace(each, coefficients=each.coefficients[shown])
                for each in (parameters, search.standard_errors(vector))
            ]
            best = scores[name], FluidEstimate(name, *kept)
    assert best is not None
    return FluidFit(best[1], scores, symmetric, windows.count, program.control_steps)


def _fit_trim(
    simulator: Simulator,
    training: Sequence[Motion],
    validation: Sequence[Motion],
    config: FluidConfig,
    report: Report,
    known: FluidEstimate,
) -> FluidFit:
    """Fit a trim in addition to the `known` parameters."""
    name = known.term_set
    if config.terms not in ("auto", name):
        raise InputError(f"--terms {config.terms} differs from {name}, the terms of the earlier result; leave it out.")
    program = _Program(simulator, added_mass=known.added_mass)
    windows, held_out = (_Windows(simulator, motions, config, program) for motions in (training, validation))
    parametrization = TrimParametrization(all_terms(known.values), _priors(windows, config.spread))
    search = _Search(windows, parametrization)
    vector = search.run(parametrization.start, config, lambda *progress: report(f"trim, {progress[0]}", *progress[1:]))
    found, errors = parametrization.parameters(vector), search.standard_errors(vector)
    scores = {
        "earlier": held_out.score(parametrization.parameters(parametrization.start)),
        "with the trim": held_out.score(found),
    }
    shown = slice(len(terms_of(name)))
    kept = [dataclasses.replace(each, coefficients=each.coefficients[shown]) for each in (found, errors)]
    return FluidFit(FluidEstimate(name, kept[0], kept[1]), scores, False, windows.count, program.control_steps)


def _thin(windows: MotionWindows, most: int) -> MotionWindows:
    """Return at most `most` windows, evenly chosen."""
    count = len(windows.qpos)
    if count <= most:
        return windows
    chosen = np.linspace(0, count - 1, most).astype(int)
    return _take(windows, chosen)


def _take(tree: Any, rows: Int[np.ndarray, " rows"]) -> Any:
    """Return the rows of all arrays of `tree`."""
    return jax.tree.map(lambda x: np.asarray(x)[rows], tree)


class _Program:
    """Compiled simulation of windows with all terms. All sets of terms share it; it compiles once for each length."""

    def __init__(self, simulator: Simulator, *, added_mass: bool) -> None:
        self._simulator = simulator
        model = simulator.mj_model
        self.forces = FluidResidual(simulator.robot, model, TERM_SETS[-1], added_mass=added_mass)
        self.errors = shard_over_devices(self._errors, shared=1)
        self.derivatives = shard_over_devices(self._derivative, shared=1)
        self.control_steps = 0
        """Number of control steps simulated so far."""

    def _derivative(
        self, params: FluidParameters, direction: FluidParameters, window: MotionWindows
    ) -> Float[Array, " entries"]:
        """Return the directional derivative of one window's errors."""
        return jax.jvp(lambda own: self._errors(own, window), (params,), (direction,))[1]

    def _errors(self, params: FluidParameters, window: MotionWindows) -> Float[Array, " entries"]:
        """Return the errors of one window, in units of the expected error."""
        simulator = self._simulator.with_residual(BoundResidual(self.forces, params))
        return simulate_motion_window(simulator, window).ravel()


class _Windows:
    """Windows of recorded motions, with the length of the longest stage."""

    def __init__(
        self,
        simulator: Simulator,
        motions: Sequence[Motion],
        config: FluidConfig,
        program: _Program,
    ) -> None:
        seconds = max(config.window_seconds)
        self.simulator = simulator
        self.recorded = _thin(cut_motion_windows(simulator, motions, seconds, seconds), config.windows)
        self.program = program
        self.count, self.steps = np.shape(self.recorded.features)[:2]

    def errors(self, params: FluidParameters) -> Float[np.ndarray, "windows entries"]:
        """Return the errors of all windows, in units of the expected error. Diverged windows have constant errors."""
        self.program.control_steps += self.count * self.steps
        params = _single(params)
        batches = chunks(self.count, batch_size(self.count, _BATCH))
        found = [self.program.errors(params, _take(self.recorded, rows)) for rows, _ in batches]
        return fill_diverged(np.concatenate(found).astype(np.float64)[: self.count])

    def derivatives(
        self, params: FluidParameters, directions: FluidParameters
    ) -> Float[np.ndarray, "windows entries size"]:
        """Return the derivatives of the errors along `directions`. They are 0 for diverged windows."""
        params, directions, size = _single(params), _single(directions), len(directions.added_mass)
        self.program.control_steps += self.count * self.steps * size
        found = []
        for rows, _ in chunks(self.count * size, batch_size(self.count * size, _BATCH)):
            window, direction = np.divmod(rows, size)
            own = _take(directions, direction)
            found.append(self.program.derivatives(params, own, _take(self.recorded, window)))
        derivatives = np.concatenate(found).astype(np.float64)[: self.count * size].reshape(self.count, size, -1)
        derivatives[~np.isfinite(derivatives).all(axis=(1, 2))] = 0.0
        return np.swapaxes(derivatives, 1, 2)

    def shortened(self, seconds: float) -> _Windows:
        """Return the same windows, shortened to `seconds` (s)."""
        steps = round(seconds / self.simulator.control_timestep)
        commands = self.recorded.commands[:, : steps + HISTORY - 1]
        other = copy.copy(self)
        other.recorded = self.recorded._replace(commands=commands, features=self.recorded.features[:, :steps])
        other.steps = steps
        return other

    def score(self, params: FluidParameters) -> float:
        """Return the robust RMS error of the windows, in units of the expected error."""
        return float(np.sqrt(np.mean(pseudo_huber(np.sum(self.errors(params) ** 2, axis=1))) / 6))


def _single(parameters: FluidParameters) -> FluidParameters:
    return jax.tree.map(np.float32, parameters)


class _Search:
    """Fit of one set of terms."""

    def __init__(self, windows: _Windows, parametrization: FluidParametrization | TrimParametrization) -> None:
        self._windows, self._parametrization = windows, parametrization

    def run(self, start: Float[np.ndarray, " size"], config: FluidConfig, report: Report) -> Float[np.ndarray, " size"]:
        """Fit stage by stage, and return the resulting vector."""
        vector = start
        # The default cutoff of 0.99 hardly ever lets steps grow again.
        solver = eqx.tree_at(lambda own: own.search.high_cutoff, optx.LevenbergMarquardt(rtol=1e-3, atol=1e-3), 0.75)
        batched = BatchedSolver(solver)
        for seconds in config.window_seconds:
            found, _ = batched(
                self._evaluation(self._windows.shortened(seconds)),
                vector[None],
                config.steps,
                lambda *progress, seconds=seconds: report(f"windows of {seconds:g} s", *progress),
                patience=_PATIENCE,
                small_gain=_SMALL_GAIN,
            )
            vector = found[0]
        return vector

    def standard_errors(self, vector: Float[np.ndarray, " size"]) -> FluidParameters:
        """Return the standard errors of the parameters.

        They are sandwich estimates: they assume that windows have independent errors, but no certain distribution.
        """
        directions = self._parametrization.directions(vector)
        params = self._parametrization.parameters(vector)
        errors, jacobian = self._windows.errors(params), self._windows.derivatives(params, directions)
        weight = 1 / np.sqrt(1 + np.sum(errors**2, axis=1) / OUTLIER_THRESHOLD**2)
        scores = np.einsum("we,wes->ws", errors, jacobian) * weight[:, None]
        prior = np.eye(len(vector))
        bread = np.linalg.inv(np.einsum("w,wes,wet->st", weight, jacobian, jacobian, optimize=True) + prior)
        covariance = bread @ (scores.T @ scores + prior) @ bread
        return jax.tree.map(
            lambda own: np.sqrt(np.einsum("s...,su,u...->...", own, covariance, own, optimize=True)), directions
        )

    def _evaluation(self, windows: _Windows) -> Evaluate:
        """Return the function that the solver calls."""
        own = self._parametrization
        return robust_least_squares(
            lambda vector: windows.errors(own.parameters(vector)),
            lambda vector: windows.derivatives(own.parameters(vector), own.directions(vector)),
        )


def robust_least_squares(
    errors: Callable[[Float[np.ndarray, " size"]], Float[np.ndarray, "windows entries"]],
    derivatives: Callable[[Float[np.ndarray, " size"]], Float[np.ndarray, "windows entries size"]],
) -> Evaluate:
    """Return the function that a solver calls, which computes rows of the least-squares problem and their Jacobian.

    The rows are scaled errors of windows, then the prior. Their sum of squares is the robust loss of all windows
    (`window_errors.pseudo_huber`) plus that of the prior. The Jacobian is scaled so that its product with the rows is
    the gradient of half of it. It takes most of the time, and is 0 at points that the solver certainly rejects.

    **Arguments**

    - `errors`: errors of the windows at a point.
    - `derivatives`: their derivatives.
    """
    bound = lowest = math.inf  # The loss at the solver's point is at most `bound`. `lowest` is the lowest loss so far.

    def evaluate(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nonlocal bound, lowest
        (vector,) = points
        found, size = errors(vector), len(vector)
        root = np.sqrt(1 + np.sum(found**2, axis=1, keepdims=True) / OUTLIER_THRESHOLD**2)
        factor = np.sqrt(2 / (1 + root))  # The loss divided by the squared norm is 2 / (1 + root), also at 0.
        values = np.concatenate([(factor * found).ravel(), vector])
        loss = float(np.sum(values**2))
        if loss >= bound:
            return values[None], np.zeros((1, len(values), size))
        # The solver rejects a decrease that is small relative to the predicted one. It predicts at most the whole loss.
        if lowest == math.inf or loss < lowest - _ACCEPTED * bound:
            bound = loss
        lowest = min(lowest, loss)
        jacobian = derivatives(vector) / (root * factor)[..., None]
        return values[None], np.concatenate([jacobian.reshape(-1, size), np.eye(size)])[None]

    return evaluate


def _priors(windows: _Windows, spread: float) -> Float[np.ndarray, "terms 6"]:
    """Return the standard deviations of the coefficients' priors.

    A coefficient of this size accelerates the robot by `spread` (m/s^2, rad/s^2) if its term has its RMS value over the
    recordings.
    """
    history = jnp.asarray(windows.recorded.history)
    _, terms = jax.jit(jax.vmap(windows.program.forces.values))(history)
    typical = np.sqrt(np.mean(np.asarray(terms, np.float64) ** 2, axis=0))
    mass, inertia = _whole_body(windows.simulator)
    force = np.array([mass] * 3 + [inertia.mean()] * 3) * spread
    return force / np.maximum(typical, _SMALLEST_TERM * typical.max())[:, None]


_PATIENCE = 8
"""Iterations without gain after which a stage ends. An iteration that only shortens the next step has no gain."""
_SMALL_GAIN = 5e-3
"""Relative decrease of the loss below which a stage ends, if it is not 0."""
_ACCEPTED = 0.01
"""Fraction of the predicted decrease from which the solver accepts a step (Optimistix, `ClassicalTrustRegion`)."""
_BATCH = 1024
"""Largest number of windows that are simulated in parallel."""
_SMALLEST_TERM = 1e-3
"""Lower bound of a term's RMS value, as a fraction of the largest one. It limits the prior of coefficients whose terms
are nearly 0 in the recordings."""


def _centre(simulator: Simulator) -> Float[np.ndarray, " 3"]:
    """Return the position of the tracked body's centre of mass relative to the tracked site (m, body frame)."""
    model = simulator.mj_model
    site = model.site(simulator.robot.tracked)
    return model.body_ipos[model.site_bodyid[site.id]] - site.pos


def _added_mass(simulator: Simulator) -> AddedMass | None:
    """Return the priors of the added mass. None for a model without buoyancy.

    Half of the displaced mass is the added mass of a sphere (Lamb, Hydrodynamics, section 92).
    """
    model = simulator.mj_model
    if not model.ngravcomp:
        return None
    displaced = float(np.sum(model.body_mass * model.body_gravcomp))
    return AddedMass(0.5 * displaced, 0.3 * _whole_body(simulator)[1])


def _whole_body(simulator: Simulator) -> tuple[float, Float[np.ndarray, " 3"]]:
    """Return the robot's mass (kg), and the tracked body's principal moments of inertia (kg m^2)."""
    model = simulator.mj_model
    body = int(model.site_bodyid[model.site(simulator.robot.tracked).id])
    return float(model.body_subtreemass[model.body_rootid[body]]), model.body_inertia[body].copy()
