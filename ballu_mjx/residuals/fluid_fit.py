"""Fit of the fluid residual to recordings of free motion, by least squares through MJX.

Recordings are cut into windows. Each window is simulated from its recorded first state under its recorded commands. The
fit minimizes the errors of the tracked body's position and orientation over the window. Derivatives are exact, by
forward-mode differentiation of the simulation. Windows become longer from stage to stage. Over a short window, errors
are nearly linear in the coefficients. A long window shows effects that accumulate.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.batched_solver import BatchedSolver
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.motion_windows import (
    MotionWindows,
    check_motion_windows,
    cut_motion_windows,
    simulate_motion_window,
)
from ballu_mjx.recordings.window_errors import OUTLIER_THRESHOLD, fill_diverged, pseudo_huber
from ballu_mjx.residuals.fluid import TERM_SETS, FluidCoefficients, FluidResidual, TermSet, terms_of
from ballu_mjx.residuals.fluid_parametrization import (
    PASSIVE_SETS,
    FreeCoefficients,
    Parametrization,
    PassiveCoefficients,
)
from ballu_mjx.sim.observation import HISTORY
from ballu_mjx.sim.residual import BoundResidual
from ballu_mjx.sim.sharding import chunks, shard_over_devices
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
    mirror: bool = True
    """Fit forces that are symmetric about the body's xz plane, if the robot's description declares `mirror`."""
    window_seconds: tuple[float, ...] = (0.5, 1.0, 2.0)
    """Lengths of the windows, s, one for each stage."""
    windows: int = 200
    """Largest number of windows, for training and for validation each."""
    steps: int = 12
    """Largest number of Levenberg-Marquardt iterations in a stage."""
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

    coefficients: FluidCoefficients
    scores: dict[str, float]
    """Robust RMS error on the validation windows, in units of the expected error, by set of terms. The key `none` is
    the error without residual."""
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
) -> FluidFit:
    """Fit the coefficients of the fluid residual.

    **Arguments**

    - `simulator`: the simulator to correct.
    - `training`: training motions.
    - `validation`: motions that choose the set of terms.
    - `config`: options of the fit.
    - `report`: function that is called after every iteration.

    **Raises** `InputError` for options out of range, and if no motion is as long as a window.
    """
    check_fluid_config(config, simulator.control_timestep)
    windows = _Windows(simulator, training, config)
    held_out = _Windows(simulator, validation, config, program=windows.program)
    symmetric = config.mirror and simulator.robot.mirror is not None
    sets = PASSIVE_SETS if config.passive else TERM_SETS
    chain = sets if config.terms == "auto" else sets[: sets.index(config.terms) + 1]
    prior = _priors(windows, config.spread)
    centre = _centre(simulator)
    scores = {"none": held_out.score(np.zeros_like(prior))}
    best: tuple[float, FluidCoefficients] | None = None
    vector = np.zeros(0)
    for name in chain:
        coefficients = (
            PassiveCoefficients(name, prior, centre, symmetric=symmetric)
            if config.passive
            else FreeCoefficients(name, prior, symmetric=symmetric)
        )
        search = _Search(windows, coefficients)
        # The search starts from the result for the previous set, whose entries come first.
        start = np.concatenate([vector, coefficients.start[len(vector) :]])
        vector = search.run(start, config, lambda *progress, name=name: report(f"{name}, {progress[0]}", *progress[1:]))
        table = coefficients.table(vector)
        scores[name] = held_out.score(table)
        if config.terms in ("auto", name) and (best is None or scores[name] < best[0]):
            shown = slice(len(terms_of(name)))
            errors = search.standard_errors(vector)
            best = scores[name], FluidCoefficients(name, table[shown], errors[shown])
    assert best is not None
    steps = windows.program.control_steps
    return FluidFit(best[1], scores, symmetric, windows.count, steps)


def _thin(windows: MotionWindows, most: int) -> MotionWindows:
    """Return at most `most` windows, evenly chosen."""
    count = len(windows.qpos)
    if count <= most:
        return windows
    chosen = np.linspace(0, count - 1, most).astype(int)
    return jax.tree.map(lambda x: np.asarray(x)[chosen], windows)


class _Program:
    """Compiled simulation of windows with all terms. All sets of terms share it; it compiles once for each length."""

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator
        self.forces = FluidResidual(simulator.robot, simulator.mj_model, TERM_SETS[-1])
        self.errors = shard_over_devices(self._errors, shared=1)
        self.derivatives = shard_over_devices(self._derivative, shared=1)
        self.control_steps = 0
        """Number of control steps simulated so far."""

    def _derivative(
        self, params: Float[Array, "terms 6"], direction: Float[Array, "terms 6"], window: MotionWindows
    ) -> Float[Array, " entries"]:
        """Return the directional derivative of one window's errors."""
        return jax.jvp(lambda own: self._errors(own, window), (params,), (direction,))[1]

    def _errors(self, params: Float[Array, "terms 6"], window: MotionWindows) -> Float[Array, " entries"]:
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
        program: _Program | None = None,
    ) -> None:
        seconds = max(config.window_seconds)
        self.simulator = simulator
        self.recorded = _thin(cut_motion_windows(simulator, motions, seconds, seconds), config.windows)
        self.program = _Program(simulator) if program is None else program
        self.count, self.steps = np.shape(self.recorded.features)[:2]

    def errors(self, params: Float[np.ndarray, "terms 6"]) -> Float[np.ndarray, "windows entries"]:
        """Return the errors of all windows, in units of the expected error. Diverged windows have constant errors."""
        self.program.control_steps += self.count * self.steps
        found = [self.program.errors(np.float32(params), self._chosen(rows)) for rows, _ in chunks(self.count, _BATCH)]
        return fill_diverged(np.concatenate(found).astype(np.float64)[: self.count])

    def derivatives(
        self, params: Float[np.ndarray, "terms 6"], directions: Float[np.ndarray, "size terms 6"]
    ) -> Float[np.ndarray, "windows entries size"]:
        """Return the derivatives of the errors along `directions`. They are 0 for diverged windows."""
        size = len(directions)
        self.program.control_steps += self.count * self.steps * size
        found = []
        for rows, _ in chunks(self.count * size, _BATCH):
            window, direction = np.divmod(rows, size)
            own = np.float32(directions[direction])
            found.append(self.program.derivatives(np.float32(params), own, self._chosen(window)))
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

    def score(self, params: Float[np.ndarray, "terms 6"]) -> float:
        """Return the robust RMS error of the windows, in units of the expected error."""
        return float(np.sqrt(np.mean(pseudo_huber(np.sum(self.errors(params) ** 2, axis=1))) / 6))

    def _chosen(self, rows: Int[np.ndarray, " rows"]) -> MotionWindows:
        return jax.tree.map(lambda x: np.asarray(x)[rows], self.recorded)


class _Search:
    """Fit of one set of terms."""

    def __init__(self, windows: _Windows, coefficients: Parametrization) -> None:
        self._windows, self._coefficients = windows, coefficients

    def run(self, start: Float[np.ndarray, " size"], config: FluidConfig, report: Report) -> Float[np.ndarray, " size"]:
        """Fit stage by stage, and return the resulting vector."""
        vector = start
        solver = BatchedSolver(optx.LevenbergMarquardt(rtol=1e-3, atol=1e-3))
        for seconds in config.window_seconds:
            windows = self._windows.shortened(seconds)

            def evaluate(points: np.ndarray, windows: _Windows = windows) -> tuple[np.ndarray, np.ndarray]:
                values, jacobian = self._rows(points[0], windows)
                return values[None], jacobian[None]

            found, _ = solver(
                evaluate,
                vector[None],
                config.steps,
                lambda *progress, seconds=seconds: report(f"windows of {seconds:g} s", *progress),
                patience=_PATIENCE,
            )
            vector = found[0]
        return vector

    def standard_errors(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "terms 6"]:
        """Return the standard errors of the coefficients.

        They are sandwich estimates: they assume that windows have independent errors, but no certain distribution.
        """
        directions = self._coefficients.directions(vector)
        params = self._coefficients.table(vector)
        errors, jacobian = self._windows.errors(params), self._windows.derivatives(params, directions)
        weight = 1 / np.sqrt(1 + np.sum(errors**2, axis=1) / OUTLIER_THRESHOLD**2)
        scores = np.einsum("we,wes->ws", errors, jacobian) * weight[:, None]
        prior = np.eye(len(vector))
        bread = np.linalg.inv(np.einsum("w,wes,wet->st", weight, jacobian, jacobian, optimize=True) + prior)
        covariance = bread @ (scores.T @ scores + prior) @ bread
        return np.sqrt(np.einsum("sta,su,uta->ta", directions, covariance, directions, optimize=True))

    def _rows(
        self, vector: Float[np.ndarray, " size"], windows: _Windows
    ) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows size"]]:
        """Return the rows of the least-squares problem (weighted errors, then the prior), and their Jacobian."""
        params = self._coefficients.table(vector)
        errors = windows.errors(params)
        jacobian = windows.derivatives(params, self._coefficients.directions(vector))
        # Iteratively reweighted least squares: the derivatives take the weight of a window as constant.
        weight = (1 + np.sum(errors**2, axis=1)[:, None] / OUTLIER_THRESHOLD**2) ** -0.25
        values = np.concatenate([(weight * errors).ravel(), vector])
        return values, np.concatenate([(weight[..., None] * jacobian).reshape(-1, len(vector)), np.eye(len(vector))])


def _priors(windows: _Windows, spread: float) -> Float[np.ndarray, "terms 6"]:
    """Return the standard deviations of the coefficients' priors.

    A coefficient of this size accelerates the robot by `spread` (m/s^2, rad/s^2) if its term has its RMS value over the
    recordings.
    """
    history = jnp.asarray(windows.recorded.history)
    _, terms = jax.jit(jax.vmap(windows.program.forces.values))(history)
    typical = np.sqrt(np.mean(np.asarray(terms, np.float64) ** 2, axis=0))
    mass, inertia = _whole_body(windows.simulator)
    force = np.array([mass] * 3 + [inertia] * 3) * spread
    return force / np.maximum(typical, _SMALLEST_TERM * typical.max())[:, None]


_PATIENCE = 5
"""Iterations without gain after which a stage ends. An iteration that only shortens the next step has no gain."""
_BATCH = 1024
"""Number of windows that are simulated in parallel."""
_SMALLEST_TERM = 1e-3
"""Lower bound of a term's RMS value, as a fraction of the largest one. It limits the prior of coefficients whose terms
are nearly 0 in the recordings."""


def _centre(simulator: Simulator) -> Float[np.ndarray, " 3"]:
    """Return the position of the tracked body's centre of mass relative to the tracked site (m, body frame)."""
    model = simulator.mj_model
    site = model.site(simulator.robot.tracked)
    return model.body_ipos[model.site_bodyid[site.id]] - site.pos


def _whole_body(simulator: Simulator) -> tuple[float, float]:
    """Return the robot's mass (kg), and the tracked body's mean principal moment of inertia (kg m^2)."""
    model = simulator.mj_model
    body = int(model.site_bodyid[model.site(simulator.robot.tracked).id])
    return float(model.body_subtreemass[model.body_rootid[body]]), float(np.mean(model.body_inertia[body]))
