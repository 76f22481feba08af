"""Fit of fluid forces to recordings of free motion, by least squares through MJX.

Recordings are cut into windows. Each is simulated from its recorded first state under its recorded commands. The fit
minimizes how far the tracked body's position and orientation end up from the recorded ones. Derivatives are exact,
taken forwards through the simulation. Windows grow from stage to stage: over a short window, errors are nearly linear
in the coefficients; a long one shows what adds up.
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
from ballu_mjx.recordings.window_errors import OUTLYING, count_lost, pseudo_huber
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
    """How fluid forces are fitted."""

    terms: Literal["auto", TermSet] = "auto"
    """Which terms: linear (gravity's direction, velocities), drag (these times the speed), quadratic (products of two
    velocities), cubic (of three, over the speed); each has those before it. auto fits every set, and takes the one with
    the lowest error on the validation recordings."""
    passive: bool = True
    """Whether the forces only take energy from the body, as those of still air or water do: simulations then stay
    bounded far from the recordings too. There are then no cubic terms."""
    mirror: bool = True
    """Whether the forces are symmetric about the body's xz plane where the robot's description declares `mirror`."""
    window_seconds: tuple[float, ...] = (0.5, 1.0, 2.0)
    """Lengths of the windows, s, one for each stage."""
    windows: int = 200
    """Most windows of a stage."""
    steps: int = 12
    """Most iterations of Levenberg-Marquardt in a stage."""
    spread: float = 1.0
    """Standard deviation of the prior on each term's typical effect, as an acceleration (m/s^2, rad/s^2)."""


def check_fluid_config(config: FluidConfig, control_timestep: float) -> None:
    """Check options.

    **Raises** `InputError` naming the option that is out of range.
    """
    if not config.window_seconds:
        raise InputError("--window-seconds names no length; give one or more, in seconds.")
    for seconds in config.window_seconds:
        check_motion_windows(seconds, seconds, control_timestep)
    if config.passive and config.terms == TERM_SETS[-1]:
        raise InputError(
            f"--terms {config.terms}: passive forces have no such terms; give --no-passive, or {PASSIVE_SETS[-1]}."
        )
    for name in ("windows", "steps", "spread"):
        if not getattr(config, name) > 0:
            raise InputError(f"--{name} is {getattr(config, name)}: it must be above 0.")


@dataclasses.dataclass(frozen=True, eq=False)
class FluidFit:
    """What a fit found, and how good it is."""

    coefficients: FluidCoefficients
    scores: dict[str, float]
    """Root mean square error on validation windows, in expected errors, by set of terms; `none`: without forces."""
    symmetric: bool
    """Whether the forces are symmetric about the xz plane."""
    windows: int
    control_steps: int
    """Simulated for it."""


Report = Callable[[str, int, int, float], None]
"""(stage, iteration, most iterations, loss)."""


def fit_fluid_forces(
    simulator: Simulator,
    training: Sequence[Motion],
    validation: Sequence[Motion],
    config: FluidConfig,
    report: Report = lambda stage, iteration, steps, loss: None,
) -> FluidFit:
    """Fit coefficients to `training`; `validation` chooses the set of terms.

    **Raises** `InputError` for options out of range, and where no recording is as long as a window.
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
        # From the set before, whose entries come first.
        start = np.concatenate([vector, coefficients.start[len(vector) :]])
        vector = search.run(start, config, lambda *told, name=name: report(f"{name}, {told[0]}", *told[1:]))
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
    """Return at most so many windows, evenly chosen."""
    count = len(windows.qpos)
    if count <= most:
        return windows
    chosen = np.linspace(0, count - 1, most).astype(int)
    return jax.tree.map(lambda x: np.asarray(x)[chosen], windows)


class _Program:
    """Simulation of windows under all terms; compiles once for each length of windows, whatever the set of terms."""

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator
        self.forces = FluidResidual(simulator.robot, simulator.mj_model, TERM_SETS[-1])
        self.errors = shard_over_devices(self._errors, shared=1)
        self.slopes = shard_over_devices(self._along, shared=1)
        self.control_steps = 0
        """Simulated so far."""

    def _along(
        self, params: Float[Array, "terms 6"], direction: Float[Array, "terms 6"], window: MotionWindows
    ) -> Float[Array, " entries"]:
        return jax.jvp(lambda own: self._errors(own, window), (params,), (direction,))[1]

    def _errors(self, params: Float[Array, "terms 6"], window: MotionWindows) -> Float[Array, " entries"]:
        """One window's errors, in expected errors."""
        simulator = self._simulator.with_residual(BoundResidual(self.forces, params))
        return simulate_motion_window(simulator, window).ravel()


class _Windows:
    """Windows of recorded motions, as long as the last stage's."""

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
        """Return the errors of all windows, in expected errors (`window_errors.count_lost`)."""
        self.program.control_steps += self.count * self.steps
        found = [self.program.errors(np.float32(params), self._chosen(rows)) for rows, _ in chunks(self.count, _BATCH)]
        return count_lost(np.concatenate(found).astype(np.float64)[: self.count])

    def slopes(
        self, params: Float[np.ndarray, "terms 6"], directions: Float[np.ndarray, "size terms 6"]
    ) -> Float[np.ndarray, "windows entries size"]:
        """Return how errors change along directions; diverged windows do not."""
        size = len(directions)
        self.program.control_steps += self.count * self.steps * size
        found = []
        for rows, _ in chunks(self.count * size, _BATCH):
            window, direction = np.divmod(rows, size)
            own = np.float32(directions[direction])
            found.append(self.program.slopes(np.float32(params), own, self._chosen(window)))
        slopes = np.concatenate(found).astype(np.float64)[: self.count * size].reshape(self.count, size, -1)
        slopes[~np.isfinite(slopes).all(axis=(1, 2))] = 0.0
        return np.swapaxes(slopes, 1, 2)

    def shortened(self, seconds: float) -> _Windows:
        """Return the same windows, cut off after so many seconds."""
        steps = round(seconds / self.simulator.control_timestep)
        commands = self.recorded.commands[:, : steps + HISTORY - 1]
        other = copy.copy(self)
        other.recorded = self.recorded._replace(commands=commands, features=self.recorded.features[:, :steps])
        other.steps = steps
        return other

    def score(self, params: Float[np.ndarray, "terms 6"]) -> float:
        """Return the root of the mean robust loss of windows, in expected errors."""
        return float(np.sqrt(np.mean(pseudo_huber(np.sum(self.errors(params) ** 2, axis=1))) / 6))

    def _chosen(self, rows: Int[np.ndarray, " rows"]) -> MotionWindows:
        return jax.tree.map(lambda x: np.asarray(x)[rows], self.recorded)


class _Search:
    """The fit of one set of terms."""

    def __init__(self, windows: _Windows, coefficients: Parametrization) -> None:
        self._windows, self._coefficients = windows, coefficients

    def run(self, start: Float[np.ndarray, " size"], config: FluidConfig, report: Report) -> Float[np.ndarray, " size"]:
        """Return the vector that fits best."""
        vector = start
        solver = BatchedSolver(optx.LevenbergMarquardt(rtol=1e-3, atol=1e-3))
        for seconds in config.window_seconds:
            windows = self._windows.shortened(seconds)

            def evaluate(points: np.ndarray, windows: _Windows = windows) -> tuple[np.ndarray, np.ndarray]:
                values, slopes = self._rows(points[0], windows)
                return values[None], slopes[None]

            found, _ = solver(
                evaluate,
                vector[None],
                config.steps,
                lambda *told, seconds=seconds: report(f"windows of {seconds:g} s", *told),
                patience=_PATIENCE,
            )
            vector = found[0]
        return vector

    def standard_errors(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "terms 6"]:
        """Return the table's standard errors, which hold for windows that err independently, in whatever way
        (sandwich)."""
        directions = self._coefficients.directions(vector)
        params = self._coefficients.table(vector)
        errors, slopes = self._windows.errors(params), self._windows.slopes(params, directions)
        weight = 1 / np.sqrt(1 + np.sum(errors**2, axis=1) / OUTLYING**2)
        scores = np.einsum("we,wes->ws", errors, slopes) * weight[:, None]
        prior = np.eye(len(vector))
        bread = np.linalg.inv(np.einsum("w,wes,wet->st", weight, slopes, slopes, optimize=True) + prior)
        covariance = bread @ (scores.T @ scores + prior) @ bread
        return np.sqrt(np.einsum("sta,su,uta->ta", directions, covariance, directions, optimize=True))

    def _rows(
        self, vector: Float[np.ndarray, " size"], windows: _Windows
    ) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows size"]]:
        """Return softened errors and the prior, and how they change."""
        params = self._coefficients.table(vector)
        errors, slopes = windows.errors(params), windows.slopes(params, self._coefficients.directions(vector))
        # Iteratively reweighted: the weight of a window is held where its slopes are taken.
        weight = (1 + np.sum(errors**2, axis=1)[:, None] / OUTLYING**2) ** -0.25
        values = np.concatenate([(weight * errors).ravel(), vector])
        return values, np.concatenate([(weight[..., None] * slopes).reshape(-1, len(vector)), np.eye(len(vector))])


def _priors(windows: _Windows, spread: float) -> Float[np.ndarray, "terms 6"]:
    """Return the coefficients whose terms accelerate the robot by `spread`, at the terms' size in the recordings."""
    history = jnp.asarray(windows.recorded.history)
    _, terms = jax.jit(jax.vmap(windows.program.forces.values))(history)
    typical = np.sqrt(np.mean(np.asarray(terms, np.float64) ** 2, axis=0))
    mass, inertia = _whole_body(windows.simulator)
    force = np.array([mass] * 3 + [inertia] * 3) * spread
    return force / np.maximum(typical, _LEAST * typical.max())[:, None]


_PATIENCE = 5
"""Iterations without gain, such as those that only shorten the next step, after which a stage ends."""
_BATCH = 1024
"""Simulations side by side."""
_LEAST = 1e-3
"""Of the largest typical term: smaller ones count as so large, so that no coefficient may grow without limit."""


def _centre(simulator: Simulator) -> Float[np.ndarray, " 3"]:
    """Return the tracked body's centre of mass from the tracked site, in the body's axes (m)."""
    model = simulator.mj_model
    site = model.site(simulator.robot.tracked)
    return model.body_ipos[model.site_bodyid[site.id]] - site.pos


def _whole_body(simulator: Simulator) -> tuple[float, float]:
    """Return the robot's mass (kg) and the tracked body's mean moment of inertia about its centre (kg m^2)."""
    model = simulator.mj_model
    body = int(model.site_bodyid[model.site(simulator.robot.tracked).id])
    return float(model.body_subtreemass[model.body_rootid[body]]), float(np.mean(model.body_inertia[body]))
