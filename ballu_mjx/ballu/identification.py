"""Identification of the actuators from a suspended sweep (paper, section "System Identification", Algorithm 1).

The legs hang from a base held still, so that each is identified by itself, both at once. Settled angles under a command
are the root of MJX's inverse dynamics at rest, differentiated as an implicit function: no derivative through a
simulation to rest. They are where the search begins. What decides is the whole motion, simulated from the first command
to the last and differentiated forwards, with what a command meets on its way: delay, backlash and dry friction
(`LegDynamics`), under which no leg is ever quite at rest.

All functions compute in double precision and are to be called inside `jax.enable_x64(True)`, but for `identify`, which
sees to it itself. A leg's parameters are a vector in the order of `NAMES`; a pair of angles is (motor, knee).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ballu_mjx.ballu.curves import curve_distances
from ballu_mjx.ballu.leg_parameters import (
    DEGREE,
    DYNAMICS_PRIOR,
    FIRST_DYNAMICS,
    FURTHER,
    LEG_PARAMETERS,
    SIMPLE_DYNAMICS,
    IdentificationConfig,
    LegDynamics,
    ParameterTransform,
    check_identification_config,
    dynamics_coordinates,
    leg_dynamics,
    nominal_leg,
)
from ballu_mjx.ballu.model import SIDES, ActuatorParameters
from ballu_mjx.ballu.suspended_leg import SuspendedLeg
from ballu_mjx.ballu.sweep import SAMPLE_TIMESTEP, Sweep
from ballu_mjx.identification.batched_solver import BatchedSolver, along_directions


class LegData(NamedTuple):
    """A `Sweep` with the legs (left, right) first and (motor, knee) last; rad. In its motion each recording is preceded
    by a stretch under its first command, in which the leg comes to rest."""

    command: Float[np.ndarray, "legs holds"]
    settled: Float[np.ndarray, "legs holds 2"]
    weights: Float[np.ndarray, "legs holds 2"]
    """Root of the samples in each mean: a mean of n samples counts as n of them, if the joint was at rest."""
    commanded: Float[np.ndarray, "legs times"]
    motion: Float[np.ndarray, "legs times 2"]
    counts: Bool[np.ndarray, " times"]
    begins: Bool[np.ndarray, " times"]


def leg_data(sweep: Sweep) -> LegData:
    """As the fit takes it."""
    firsts = np.flatnonzero(sweep.begins)
    rows = np.insert(np.arange(len(sweep.hold)), np.repeat(firsts, _AT_REST), np.repeat(firsts, _AT_REST))
    before = np.insert(np.zeros(len(sweep.hold), bool), np.repeat(firsts, _AT_REST), True)
    still = np.moveaxis(1 / np.hypot(1, sweep.drift / _DRIFT), -1, 0)
    return LegData(
        command=sweep.command.T,
        settled=np.moveaxis(sweep.settled, -1, 0),
        weights=np.sqrt(sweep.samples)[:, None] * still,
        commanded=sweep.command[sweep.hold[rows]].T,
        motion=np.moveaxis(sweep.motion[rows], -1, 0),
        counts=~before,
        begins=before & ~np.roll(before, 1),
    )


_AT_REST = round(2.0 / SAMPLE_TIMESTEP)
_DRIFT = 0.05 * DEGREE
"""A joint that creeps on by more has not arrived, and its angle counts for less."""


class CompiledLeg:
    """The two programs that hold MJX, compiled side by side: values and Jacobians in a `Space`'s coordinates, for
    batches of fixed sizes. The second, of the motion, only where it is wanted."""

    def __init__(self, space: ParameterTransform, batch: int, data: LegData, *, motion: bool) -> None:
        self.leg, self.batch = SuspendedLeg(), batch
        size, (legs, holds) = int(space.free.sum()), data.command.shape
        every = size + len(FIRST_DYNAMICS)

        def settled(coordinates: Array, command: Array) -> tuple[Array, Array]:
            vectors, by_coordinates = jax.vmap(lambda y: (space.vector(y), jax.jacfwd(space.vector)(y)))(coordinates)
            qpos, slopes = self.leg.settled(jnp.repeat(vectors, holds, axis=0), command.ravel())
            slopes = slopes.reshape(batch, holds, *slopes.shape[1:])
            return qpos.reshape(batch, holds, -1), slopes @ by_coordinates[:, None]

        def moving(coordinates: Array, command: Array) -> tuple[Array, Array]:
            def path(y: Array, command: Array) -> Array:
                return self.leg.motion(space.vector(y[:size]), leg_dynamics(y[size:]), command, data.begins)

            directions = jnp.tile(jnp.eye(every), (legs, 1, 1))
            return along_directions(path, (coordinates,), (directions,), (command,))

        programs = [jax.jit(settled).lower(jnp.zeros((batch, size)), jnp.zeros((batch, holds)))]
        if motion:
            programs.append(jax.jit(moving).lower(jnp.zeros((legs, every)), jnp.zeros(data.commanded.shape)))
        with ThreadPoolExecutor() as pool:
            self._compiled = list(pool.map(lambda program: program.compile(), programs))

    def settled(
        self, coordinates: Float[np.ndarray, "n size"], command: Float[np.ndarray, "n holds"]
    ) -> tuple[Float[np.ndarray, "n holds nq"], Float[np.ndarray, "n holds nq size"]]:
        """Positions at rest and their derivatives, for any number of coordinates."""
        values, slopes = [], []
        for first in range(0, len(coordinates), self.batch):
            count = min(self.batch, len(coordinates) - first)
            rows = np.minimum(first + np.arange(self.batch), first + count - 1)
            value, slope = self._compiled[0](jnp.asarray(coordinates[rows]), jnp.asarray(command[rows]))
            values.append(np.asarray(value)[:count])
            slopes.append(np.asarray(slope)[:count])
        return np.concatenate(values), np.concatenate(slopes)

    def motion(
        self, coordinates: Float[np.ndarray, "legs _"], commanded: Float[np.ndarray, "legs times"]
    ) -> tuple[Float[np.ndarray, "legs times 2"], Float[np.ndarray, "legs times 2 _"]]:
        """Both legs' motion and its derivatives; coordinates end with those of `leg_dynamics`."""
        value, jacobian = self._compiled[1](jnp.asarray(coordinates), jnp.asarray(commanded))
        return np.asarray(value), np.asarray(jacobian)


class Direction(NamedTuple):
    """A combination of a leg's parameters, in units of what robots differ by (`RANGES`)."""

    weights: Float[np.ndarray, " free"]
    """Unit vector; entries in the order of the free parameters."""
    standard_error: float
    """Of the combination: below 1, the data know more than is known without them."""


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """One leg, identified."""

    vector: Float[np.ndarray, " parameters"]
    standard_errors: Float[np.ndarray, " parameters"]
    """In the parameters' units, from the Jacobian, the scatter of the residuals, which err together over `_MEMORY`, and
    what is known beforehand; 0 for those that were not free."""
    correlations: Float[np.ndarray, "free free"]
    directions: tuple[Direction, ...]
    """From the best to the least determined."""
    dynamics: LegDynamics | None
    """None: the motion had no part in the fit."""
    residual: float
    """Root mean square (rad) of all residuals."""
    losses: Float[np.ndarray, " starts"]
    """Sums of squares (rad^2, settled angles) that the starts ended at, in ascending order."""

    @property
    def open_directions(self) -> tuple[Direction, ...]:
        """Those that the data leave open: held near the nominal values."""
        return tuple(d for d in self.directions if d.standard_error > 1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Identification:
    """Both legs (left, right)."""

    fits: tuple[Fit, Fit]
    settled: Float[np.ndarray, "holds 2 2"]
    """Angles (rad) at which the identified robot is in balance, without friction and play; (motor, knee), (left, right)
    last, as in `Sweep`."""
    simulated: Float[np.ndarray, "holds 2 2"] | None
    """What its simulated motion comes to; None where that was not fitted."""
    nominal_settled: Float[np.ndarray, "holds 2 2"]
    """The same as `settled`, of the nominal robot."""
    free: tuple[str, ...]
    """Parameters that were fitted: without `FURTHER`, where these explain no more than noise would."""
    config: IdentificationConfig

    @property
    def parameters(self) -> ActuatorParameters:
        rows: dict[str, np.ndarray] = dict(
            zip(LEG_PARAMETERS, np.stack([fit.vector for fit in self.fits], axis=1), strict=True)
        )
        dynamics = [fit.dynamics for fit in self.fits if fit.dynamics is not None]
        for name in LegDynamics._fields if dynamics else ():
            rows[name] = np.maximum([getattr(each, name) for each in dynamics], 0.0)
        return ActuatorParameters(**{name: jnp.asarray(row, jnp.float32) for name, row in rows.items()})


_PATIENCE = 4
_WORTH = 10.0
"""F-statistic above which the further parameters are worth having."""
_MEMORY = 0.2
"""Seconds over which a model's errors go together."""
Report = Callable[[str, int, int, float], None]
"""(stage, iteration, most iterations, the lowest loss among the searches)."""


def identify_legs(
    sweep: Sweep, config: IdentificationConfig | None = None, report: Report | None = None
) -> Identification:
    """Fit both legs' parameters to a sweep.

    1. Settled angles alone, from several starts side by side, the best of many draws: searches that start with a servo
       that never saturates, say, end in a valley of their own.
    2. From the best of these, the whole motion.
       Both are done twice, with the `FURTHER` parameters held at their nominal values and with all. The richer model is
       kept where it explains what the simpler one leaves, by an F-test.
    3. With the richer model, or where the data leave directions open: with what is known of robots beforehand, so that
       what a sweep hardly shows stays near the nominal values.
    4. With `objective="hausdorff"`, the paper's distance between curves, from there.

    **Raises** `InputError` from `IdentificationConfig`'s check.
    """
    config = config or IdentificationConfig()
    check_identification_config(config)
    report = report or (lambda stage, iteration, steps, value: None)
    with jax.enable_x64(True):
        return Identifier(config, sweep, report).run(sweep, report)


class Identifier:
    """The stages of `identify`, compiled once for sweeps of the same sizes."""

    def __init__(self, config: IdentificationConfig, sweep: Sweep, report: Report) -> None:
        self.config = config
        data = leg_data(sweep)
        self._kept = np.ones(0, bool)
        starts = min(config.starts, config.draws + 1)
        report("compiling", 0, 1, float("nan"))
        self.space = ParameterTransform(nominal_leg(), config)
        self.physics = CompiledLeg(self.space, starts * len(SIDES), data, motion=config.motion)
        report("compiling", 1, 1, float("nan"))
        self._starts, self._size = starts, int(self.space.free.sum())
        further = np.isin(np.array(LEG_PARAMETERS)[self.space.free], FURTHER)
        dynamic = np.isin(LegDynamics._fields, FURTHER) if config.motion else np.zeros(0, bool)
        self._further = np.concatenate([further, dynamic])
        """Which coordinates the simpler model holds."""
        self._squares = BatchedSolver(optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5))
        self._shape = BatchedSolver(optx.LBFGS(rtol=1e-5, atol=1e-5))

        def objective(angles: Array, command: Array, measured: Array) -> Array:
            return jnp.sum(curve_distances(command, angles, measured, config.degree)[0])

        gradient = jax.value_and_grad(objective)
        self._curve_gradients = jax.jit(jax.vmap(lambda command, angles, measured: gradient(angles, command, measured)))

    def run(self, sweep: Sweep, report: Report) -> Identification:
        config, size, data = self.config, self._size, leg_data(sweep)
        legs = np.arange(len(SIDES))
        fitted = []
        for kept in (~self._further, np.ones_like(self._further))[0 if self._further.any() else 1 :]:
            self._kept = kept
            fitted.append(self._search(data, report))
        lost, left = fitted[0][1], fitted[-1][1]
        more = max(len(SIDES) * int(self._further.sum()), 1)
        gained = (lost - left) / max(left, 1e-300) * self._independent(data) / more
        coordinates, _, found = fitted[-1] if gained > _WORTH else fitted[0]
        self._kept = np.ones_like(self._further) if gained > _WORTH else ~self._further
        leg = np.repeat(legs, self._starts)
        ended = np.sum(self._settled_residuals(found, leg, data)[0] ** 2, axis=1).reshape(len(legs), -1)
        analyses = self._analyse(coordinates, data)
        if self._kept.all() or any(direction.standard_error > 1 for a in analyses for direction in a.directions):
            coordinates, _ = self._squares(
                lambda y: self._with_priors(y, data, analyses),
                coordinates,
                config.steps,
                partial(report, "priors"),
                _PATIENCE,
            )
            analyses = self._analyse(coordinates, data)
        if config.objective == "hausdorff":
            # From every search's end: a maximum over points and a sum over joints has more valleys still.
            starts = np.concatenate([coordinates[:, None, :size], found.reshape(len(legs), -1, size)[:, 1:]], axis=1)
            shaped, distances = self._shape(
                lambda y: self._distance(y, leg, data),
                starts.reshape(-1, size),
                config.steps,
                partial(report, "curves"),
            )
            best = np.argmin(distances.reshape(len(legs), -1), axis=1)
            shaped = shaped.reshape(len(legs), -1, size)[legs, best]
            coordinates = np.concatenate([shaped, coordinates[:, size:]], axis=1)
            analyses = self._analyse(coordinates, data)

        before = np.tile(self.space.coordinates(self.space.nominal), (len(legs), 1))
        settled = [self._angles(y, data.command)[0] for y in (coordinates[:, :size], before)]
        fits = [
            Fit(
                vector=np.asarray(self.space.vector(jnp.asarray(coordinates[leg, :size]))),
                standard_errors=analysis.standard_errors,
                correlations=analysis.correlations,
                directions=analysis.directions,
                dynamics=LegDynamics(*map(float, leg_dynamics(jnp.asarray(coordinates[leg, size:]))))
                if config.motion
                else None,
                residual=analysis.scatter,
                losses=np.sort(ended[leg]),
            )
            for leg, analysis in enumerate(analyses)
        ]
        after, nominal = (np.moveaxis(angles, 0, -1) for angles in settled)
        moving = None
        if config.motion:
            paths, _ = self.physics.motion(coordinates, data.commanded)
            moving = sweep.means(np.moveaxis(paths[:, data.counts], 0, -1))
        names = np.array(LEG_PARAMETERS)[self.space.free][self._kept[:size]]
        return Identification((fits[0], fits[1]), after, moving, nominal, tuple(map(str, names)), config)

    def _search(self, data: LegData, report: Report) -> tuple[np.ndarray, float, np.ndarray]:
        """Return coordinates of both legs, their sum of squares, and where the searches by settled angles ended; of the
        parameters that are kept."""
        config, size, legs = self.config, self._size, np.arange(len(SIDES))
        draws = self.space.draw(config.seed, config.draws)
        held = ~self._kept[:size]
        draws[:, held] = draws[0, held]
        coordinates, leg = np.tile(draws, (len(legs), 1)), np.repeat(legs, len(draws))
        report("draws", 0, 1, float("nan"))
        losses = np.sum(self._settled_residuals(coordinates, leg, data)[0] ** 2, axis=1).reshape(len(legs), -1)
        report("draws", 1, 1, float(losses.min()))
        best = np.argsort(losses, axis=1)[:, : self._starts]
        starts, leg = draws[best].reshape(-1, size), np.repeat(legs, self._starts)
        found, ended = self._squares(
            lambda y: self._settled_residuals(y, leg, data),
            starts,
            config.steps,
            partial(report, "settled angles"),
            _PATIENCE,
        )
        ended = ended.reshape(len(legs), -1)
        coordinates = found.reshape(len(legs), -1, size)[legs, np.argmin(ended, axis=1)]

        if config.motion:
            first = np.where(self._kept[size:], 0.0, dynamics_coordinates(SIMPLE_DYNAMICS))
            coordinates = np.concatenate([coordinates, np.tile(first, (len(legs), 1))], axis=1)
            coordinates, _ = self._squares(
                lambda y: self._residuals(y, data), coordinates, config.steps, partial(report, "motion"), _PATIENCE
            )
        return coordinates, float(np.sum(self._residuals(coordinates, data)[0] ** 2)), found

    def _independent(self, data: LegData) -> float:
        """Return how many of the residuals err independently."""
        values = data.motion[:, data.counts] if self.config.motion else data.settled
        return values.size / self._together

    def _angles(
        self, coordinates: Float[np.ndarray, "n size"], command: Float[np.ndarray, "n holds"]
    ) -> tuple[Float[np.ndarray, "n holds 2"], Float[np.ndarray, "n holds 2 size"]]:
        """Simulated settled angles (rad) and their derivatives."""
        qpos, slope = self.physics.settled(coordinates, command)
        return qpos[:, :, self.physics.leg.angles], slope[:, :, self.physics.leg.angles]

    def _settled_residuals(
        self, coordinates: Float[np.ndarray, "n size"], leg: Int[np.ndarray, " n"], data: LegData
    ) -> tuple[Float[np.ndarray, "n residuals"], Float[np.ndarray, "n residuals size"]]:
        """Simulated less measured settled angles, weighted, and their Jacobians."""
        angles, slope = self._angles(coordinates, data.command[leg])
        weights = data.weights[leg]
        count = len(coordinates)
        return (
            (weights * (angles - data.settled[leg])).reshape(count, -1),
            (weights[..., None] * slope).reshape(count, -1, self._size) * self._kept[: self._size],
        )

    def _residuals(
        self, coordinates: Float[np.ndarray, "legs size"], data: LegData
    ) -> tuple[Float[np.ndarray, "legs residuals"], Float[np.ndarray, "legs residuals size"]]:
        """The same for both legs, or the whole motion's."""
        legs = len(coordinates)
        if not self.config.motion:
            return self._settled_residuals(coordinates, np.arange(legs), data)
        paths, slopes = self.physics.motion(coordinates, data.commanded)
        values = (paths - data.motion)[:, data.counts]
        return values.reshape(legs, -1), slopes[:, data.counts].reshape(legs, -1, slopes.shape[-1]) * self._kept

    def _with_priors(
        self, coordinates: Float[np.ndarray, "legs size"], data: LegData, analyses: list[_Analysis]
    ) -> tuple[Float[np.ndarray, "legs residuals"], Float[np.ndarray, "legs residuals size"]]:
        """All residuals over their scatter, each counted for its share that is independent of its neighbours; then
        how far parameters are from nominal, in units of what robots differ by."""
        values, jacobians = self._residuals(coordinates, data)
        space, size = self.space, self._size
        rows, row_slopes = [], []
        for y in coordinates:
            vector, slope = self._parameters(y[:size])
            own = y[size:] / DYNAMICS_PRIOR[: len(y) - size]
            rows.append(np.concatenate([space.deviations(vector)[space.free], own]))
            slope = np.concatenate([slope / space.units(vector)[space.free, None], np.zeros((len(own), size))])
            beside = np.concatenate([np.zeros((size, len(own))), np.diag(1 / DYNAMICS_PRIOR[: len(own)])])
            row_slopes.append(np.concatenate([slope, beside], axis=1) * self._kept)
        scatter = np.array([analysis.scatter for analysis in analyses]) * np.sqrt(self._together)
        return (
            np.concatenate([values / scatter[:, None], np.array(rows)], axis=1),
            np.concatenate([jacobians / scatter[:, None, None], np.array(row_slopes)], axis=1),
        )

    @property
    def _together(self) -> float:
        """How many samples err together."""
        return _MEMORY / SAMPLE_TIMESTEP if self.config.motion else 1.0

    def _distance(
        self, coordinates: Float[np.ndarray, "n size"], leg: Int[np.ndarray, " n"], data: LegData
    ) -> tuple[Float[np.ndarray, "n 1"], Float[np.ndarray, "n 1 size"]]:
        """The legs' parts of the paper's objective."""
        angles, slope = self._angles(coordinates, data.command[leg])
        values, gradients = self._curve_gradients(data.command[leg], angles, data.settled[leg])
        return np.asarray(values)[:, None], np.einsum("nha,nhas->ns", gradients, slope)[:, None] * self._kept[
            : self._size
        ]

    def _parameters(self, coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A leg's parameters, and the free ones' derivatives in the coordinates."""
        vector = self.space.vector(jnp.asarray(coordinates))
        return np.asarray(vector), np.asarray(jax.jacfwd(self.space.vector)(jnp.asarray(coordinates)))[self.space.free]

    def _analyse(self, coordinates: Float[np.ndarray, "legs size"], data: LegData) -> list[_Analysis]:
        space, size = self.space, self._size
        results = []
        for y, value, jacobian in zip(coordinates, *self._residuals(coordinates, data), strict=True):
            scatter = float(np.sqrt(np.sum(value**2) / max(np.count_nonzero(value) - len(y), 1)))
            vector, slope = self._parameters(y[:size])
            kept = self._kept[:size]
            prior = space.units(vector)[space.free]
            # In units of the prior, whatever the coordinates; the dynamics projected out.
            spread = scatter * np.sqrt(self._together)
            known = (jacobian[:, :size] / np.diag(slope) * prior / spread)[:, kept]
            unknown, singular, _ = np.linalg.svd(jacobian[:, size:], full_matrices=False)
            unknown = unknown[:, singular > 1e-9 * singular.max(initial=0.0)]
            known = known - unknown @ (unknown.T @ known)
            _, singular, right = np.linalg.svd(known, full_matrices=False)
            errors = 1 / np.maximum(singular, 1e-12)
            covariance = right.T @ np.diag(1 / (1 + singular**2)) @ right
            deviation = np.sqrt(np.diag(covariance))
            standard_errors = np.zeros(len(LEG_PARAMETERS))
            standard_errors[np.flatnonzero(space.free)[kept]] = deviation * prior[kept]
            signed = [w * np.sign(w[np.argmax(np.abs(w))]) for w in right]
            directions = tuple(Direction(w, float(e)) for w, e in zip(signed, errors, strict=True))
            correlations = covariance / np.outer(deviation, deviation)
            results.append(_Analysis(scatter, standard_errors, correlations, directions))
        return results


class _Analysis(NamedTuple):
    scatter: float
    standard_errors: Float[np.ndarray, " parameters"]
    correlations: Float[np.ndarray, "free free"]
    directions: tuple[Direction, ...]
