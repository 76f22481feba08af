"""Identification of the actuators from a suspended sweep (paper, section "System Identification", Algorithm 1).

The legs hang from a base held still, so that each is identified by itself, both at once. Settled angles under a command
are the root of MJX's inverse dynamics at rest, differentiated as an implicit function: no derivative through a
simulation to rest. They are where the search begins. What decides is the whole motion, simulated from the first command
to the last and differentiated forwards, with what a command meets on its way: delay, backlash and dry friction
(`LegDynamics`), under which no leg is ever quite at rest.

All functions compute in double precision and are to be called inside `jax.enable_x64(True)`, but for `identify_legs`,
which sees to it itself. A leg's parameters are a vector in the order of `LEG_PARAMETERS`; a pair of angles is (motor,
knee).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int
from scipy.stats import f as f_distribution

from ballu_mjx.ballu.actuators import ActuatorParameters
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
from ballu_mjx.ballu.model import SIDES
from ballu_mjx.ballu.suspended_leg import SuspendedLeg
from ballu_mjx.ballu.sweep import SAMPLE_TIMESTEP, Sweep
from ballu_mjx.identification.batched_solver import BatchedSolver, Evaluate, along_directions
from ballu_mjx.identification.effective_samples import integrated_autocorrelation_time
from ballu_mjx.identification.parameters import Direction
from ballu_mjx.identification.undeclared import SMALL_EFFECT


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
    """The two MJX programs, compiled side by side: values and Jacobians in a `ParameterTransform`'s coordinates, for
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


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """One leg, identified."""

    vector: Float[np.ndarray, " parameters"]
    standard_errors: Float[np.ndarray, " parameters"]
    """In the parameters' units, with all free parameters unknown, whether or not the simpler model was kept; 0 for
    those that the configuration holds. See `Identifier`."""
    correlations: Float[np.ndarray, "free free"]
    """Of the same errors."""
    directions: tuple[Direction, ...]
    """Of the parameters that were fitted, from the best to the least determined."""
    dynamics: LegDynamics | None
    """None: the motion had no part in the fit."""
    dynamics_errors: LegDynamics | None
    """Standard errors of `dynamics`."""
    residual: float
    """Root mean square (rad) of all residuals."""
    losses: Float[np.ndarray, " starts"]
    """Sums of squares (rad^2, settled angles) that the starts ended at, in ascending order."""

    @property
    def open_directions(self) -> tuple[Direction, ...]:
        """Those that the data leave open: held near the nominal values."""
        return tuple(d for d in self.directions if d.standard_error > 1.0)


class Selection(NamedTuple):
    """Whether the `FURTHER` parameters of both legs are worth having."""

    statistic: float
    """F, with as many samples as the residuals are worth."""
    threshold: float
    """F that chance exceeds in 5 of 100 sweeps."""
    effect: float
    """Cohen's f^2: what the further parameters explain of the squares, over what they leave."""

    @property
    def richer(self) -> bool:
        """Whether the richer model is kept: what it explains is neither chance nor negligible.

        With thousands of samples, an F-test sees errors of the simulator's time step: hundredths of a degree, which the
        further parameters would take up at the price of wrong springs and gains.
        """
        return self.statistic > self.threshold and self.effect > SMALL_EFFECT


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
    """Parameters that the configuration leaves free: those of `Fit.correlations`."""
    fitted: tuple[str, ...]
    """Those that were fitted: without `FURTHER`, where the simpler model was kept."""
    selection: Selection | None
    """None: no further parameter was free."""
    config: IdentificationConfig

    @property
    def keeps_simpler(self) -> bool:
        """Whether the `FURTHER` parameters could be fitted, and were not worth it."""
        return self.selection is not None and not self.selection.richer

    @property
    def parameters(self) -> ActuatorParameters:
        """What simulators take; without `FURTHER`, the nominal robot's, where the simpler model was kept."""
        rows: dict[str, np.ndarray] = dict(
            zip(LEG_PARAMETERS, np.stack([fit.vector for fit in self.fits], axis=1), strict=True)
        )
        dynamics = [fit.dynamics for fit in self.fits if fit.dynamics is not None]
        for name in LegDynamics._fields if dynamics else ():
            rows[name] = np.maximum([getattr(each, name) for each in dynamics], 0.0)
        kept = {name: row for name, row in rows.items() if not (self.keeps_simpler and name in FURTHER)}
        return ActuatorParameters(**{name: jnp.asarray(row, jnp.float32) for name, row in kept.items()})


_PATIENCE = 4
_LEVEL = 0.05
"""Of the F-test."""
_FIRST_DAMPING = 5 * DEGREE
"""Unit of angles in a search, which starts with Levenberg's damping at 1. In radians, weak directions are damped for
dozens of iterations."""
_INSIDE = 4.0
"""Largest coordinate that a search of the motion starts from: 2 % of the bounds' span inside them. A slack that settled
angles put at its bound has next to no slope left, and would stay there."""
_SHORT = 6
"""Iterations after which one of two searches goes on."""
_LEAST_SPREAD = 1e-9
"""rad"""
Report = Callable[[str, int, int, float], None]
"""(stage, iteration, most iterations, the lowest loss among the searches)."""


def identify_legs(
    sweep: Sweep, config: IdentificationConfig | None = None, report: Report | None = None
) -> Identification:
    """Fit both legs' parameters to a sweep.

    1. Settled angles alone, from several starts side by side, the best of many draws: searches that start with a servo
       that never saturates, say, end in a valley of their own.
    2. From the end whose motion is nearest, the whole motion.
       Both are done twice, with the `FURTHER` parameters held at their nominal values and with all. The second search
       has the first's solution among its starts. The richer model is kept where it explains what the simpler one
       leaves (`Selection`).
    3. With the richer model the springs are held at their nominal stiffness, which sets the scale of all forces
       (`nominal_springs`).
    4. With the richer model, or where the data leave directions open: with what is known of robots beforehand, so that
       what a sweep hardly shows stays near the nominal values.
    5. With `objective="hausdorff"`, the paper's distance between curves, from there.

    **Raises** `InputError` from `IdentificationConfig`'s check.
    """
    config = config or IdentificationConfig()
    check_identification_config(config)
    report = report or (lambda stage, iteration, steps, value: None)
    with jax.enable_x64(True):
        return Identifier(config, sweep, report).run(sweep, report)


def _levenberg_marquardt() -> optx.LevenbergMarquardt:
    """Return Levenberg-Marquardt that damps ten times less after a step which gained 90 % of what was foretold. By
    default it is 3.5 times after 99 %, which steps along a curved valley hardly ever gain."""
    solver = optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5)
    region = optx.ClassicalTrustRegion(high_cutoff=0.9, high_constant=10.0)
    return eqx.tree_at(lambda solver: solver.search, solver, region)


class Identifier:
    """The stages of `identify_legs`, compiled once for sweeps of the same sizes.

    Priors and standard errors divide residuals by their scatter and by the root of their integrated autocorrelation
    time, both of the richer model's residuals, by leg and channel: where a model lacks something, its errors go
    together in time, and many samples are worth few.
    """

    def __init__(self, config: IdentificationConfig, sweep: Sweep, report: Report) -> None:
        self.config = config
        data = leg_data(sweep)
        starts = min(config.starts, config.draws + 1)
        report("compiling", 0, 1, float("nan"))
        self.space = ParameterTransform(nominal_leg(), config)
        self.physics = CompiledLeg(self.space, starts * len(SIDES), data, motion=config.motion)
        report("compiling", 1, 1, float("nan"))
        self._starts, self._size = starts, int(self.space.free.sum())
        self._squares = BatchedSolver(_levenberg_marquardt())
        self._shape = BatchedSolver(optx.LBFGS(rtol=1e-5, atol=1e-5))

        def objective(angles: Array, command: Array, measured: Array) -> Array:
            return jnp.sum(curve_distances(command, angles, measured, config.degree)[0])

        gradient = jax.value_and_grad(objective)
        self._curve_gradients = jax.jit(jax.vmap(lambda command, angles, measured: gradient(angles, command, measured)))

    def run(self, sweep: Sweep, report: Report) -> Identification:
        """Return both legs' identification from a sweep of the sizes that were compiled for."""
        config, size, data = self.config, self._size, leg_data(sweep)
        legs = np.arange(len(SIDES))
        free = np.array(LEG_PARAMETERS)[self.space.free]
        further = np.isin([*free, *(LegDynamics._fields if config.motion else ())], FURTHER)
        every = np.ones_like(further)
        spring = list(free).index("knee_spring_stiffness")
        kept, selection = every, None
        if further.any():
            simpler, ends = self._search(data, ~further, report)
            rich = every & ~(config.nominal_springs & np.isin(np.arange(len(every)), spring))
            coordinates, richer_ends = self._search(data, rich, report, simpler)
            spread = self._spread(coordinates, data)
            more = int(rich.sum()) - int((~further).sum())
            selection = self._select(simpler, coordinates, more, spread, data)
            if selection.richer:
                # The simpler search may have ended in a valley that the richer one left.
                again = np.where(further, simpler, coordinates)
                again = self._follow(again, data, ~further, report, config.steps)
                simpler = self._nearest([simpler, again], data, ~further)
                selection = self._select(simpler, coordinates, more, spread, data)
            if selection.richer:
                kept, ends = rich, richer_ends
            else:
                kept, coordinates = ~further, simpler
        else:
            coordinates, ends = self._search(data, every, report)
            spread = self._spread(coordinates, data)
        leg = np.repeat(legs, self._starts)
        ended = np.sum(self._settled_residuals(ends, leg, data, kept)[0] ** 2, axis=1).reshape(len(legs), -1)
        analyses = self._analyse(coordinates, data, kept, spread)
        if kept[further].any() or any(d.standard_error > 1 for each in analyses for d in each.directions):
            coordinates, _ = self._squares(
                lambda y: self._with_priors(y, data, kept, spread),
                coordinates,
                2 * config.steps,  # along the weakest directions, which the data alone left open
                partial(report, "priors"),
                _PATIENCE,
            )
            analyses = self._analyse(coordinates, data, kept, spread)
        if config.objective == "hausdorff":
            # From every search's end: a maximum over points and a sum over joints has more valleys still.
            starts = np.concatenate([coordinates[:, None, :size], ends.reshape(len(legs), -1, size)[:, 1:]], axis=1)
            shaped, distances = self._shape(
                lambda y: self._distance(y, leg, data, kept),
                starts.reshape(-1, size),
                config.steps,
                partial(report, "curves"),
            )
            best = np.argmin(distances.reshape(len(legs), -1), axis=1)
            shaped = shaped.reshape(len(legs), -1, size)[legs, best]
            coordinates = np.concatenate([shaped, coordinates[:, size:]], axis=1)
            analyses = self._analyse(coordinates, data, kept, spread)

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
                dynamics_errors=analysis.dynamics_errors,
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
        return Identification(
            fits=(fits[0], fits[1]),
            settled=after,
            simulated=moving,
            nominal_settled=nominal,
            free=tuple(map(str, free)),
            fitted=tuple(map(str, free[kept[:size]])),
            selection=selection,
            config=config,
        )

    def _search(
        self, data: LegData, kept: Bool[np.ndarray, " size"], report: Report, simpler: np.ndarray | None = None
    ) -> tuple[Float[np.ndarray, "legs size"], Float[np.ndarray, "searches settled_size"]]:
        """Return coordinates of both legs, and where the searches by settled angles ended, of the parameters that are
        `kept`; never worse than `simpler`, a model's with fewer."""
        config, size, legs = self.config, self._size, np.arange(len(SIDES))
        draws = self.space.draw(config.seed, config.draws)
        held = ~kept[:size]
        draws[:, held] = draws[0, held]
        coordinates, leg = np.tile(draws, (len(legs), 1)), np.repeat(legs, len(draws))
        report("draws", 0, 1, float("nan"))
        values, _ = self._settled_residuals(coordinates, leg, data, kept)
        losses = np.sum(values**2, axis=1).reshape(len(legs), -1)
        report("draws", 1, 1, float(losses.min()))
        starts = draws[np.argsort(losses, axis=1)[:, : self._starts]]
        if simpler is not None:
            simpler = np.where(kept, simpler, np.concatenate([draws[0], np.zeros(simpler.shape[1] - size)]))
            starts[:, -1] = simpler[:, :size]
        leg = np.repeat(legs, self._starts)
        ends, ended = self._least_squares(
            lambda y: self._settled_residuals(y, leg, data, kept),
            starts.reshape(-1, size),
            config.steps,
            partial(report, "settled angles"),
        )
        nearest = np.argmin(ended.reshape(len(legs), -1), axis=1)
        by_leg = ends.reshape(len(legs), -1, size)
        if not config.motion:
            return by_leg[legs, nearest], ends
        by_leg = np.clip(by_leg, -_INSIDE, _INSIDE)
        # Settled angles leave much open, and a servo far from its limit has no gradient by it. The motion says from
        # which end to go on: where it begins nearest, or soon gets nearest.
        first = np.where(kept[size:], 0.0, dynamics_coordinates(SIMPLE_DYNAMICS))
        candidates = [np.concatenate([y, np.tile(first, (len(legs), 1))], axis=1) for y in np.moveaxis(by_leg, 1, 0)]
        candidates += [] if simpler is None else [simpler]
        coordinates, by_settled = self._nearest(candidates, data, kept), np.stack(candidates)[nearest, legs]
        if not np.array_equal(coordinates, by_settled):
            both = [self._follow(y, data, kept, report, _SHORT) for y in (coordinates, by_settled)]
            coordinates = self._nearest(both, data, kept)
        ended = self._follow(coordinates, data, kept, report, config.steps)
        # Stiction, lag and play can stand in for each other, and a slack at its bound has no slope: once more, with the
        # dynamics back where they began and what stands at a bound back at its nominal value.
        inside = np.where(np.abs(ended[:, :size]) > _INSIDE, draws[0], ended[:, :size])
        again = np.concatenate([inside, np.tile(first, (len(legs), 1))], axis=1)
        return self._nearest([ended, self._follow(again, data, kept, report, config.steps)], data, kept), ends

    def _follow(
        self,
        start: Float[np.ndarray, "legs size"],
        data: LegData,
        kept: Bool[np.ndarray, " size"],
        report: Report,
        steps: int,
    ) -> Float[np.ndarray, "legs size"]:
        """Return where a search by all residuals ends."""
        stage = "motion" if self.config.motion else "settled angles"
        return self._least_squares(lambda y: self._residuals(y, data, kept), start, steps, partial(report, stage))[0]

    def _least_squares(
        self,
        evaluate: Evaluate,
        start: Float[np.ndarray, "n size"],
        steps: int,
        report: Callable[[int, int, float], None],
    ) -> tuple[Float[np.ndarray, "n size"], Float[np.ndarray, " n"]]:
        """Return where searches end that minimize squares of angles, and their losses (rad^2)."""

        def scaled(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            values, jacobians = evaluate(y)
            return values / _FIRST_DAMPING, jacobians / _FIRST_DAMPING

        ends, losses = self._squares(
            scaled,
            start,
            steps,
            lambda iteration, most, loss: report(iteration, most, loss * _FIRST_DAMPING**2),
            _PATIENCE,
        )
        return ends, losses * _FIRST_DAMPING**2

    def _nearest(
        self,
        candidates: Sequence[Float[np.ndarray, "legs size"]],
        data: LegData,
        kept: Bool[np.ndarray, " size"],
    ) -> Float[np.ndarray, "legs size"]:
        """Return for each leg the candidate with the lowest sum of squares."""
        losses = [np.sum(self._residuals(y, data, kept)[0] ** 2, axis=1) for y in candidates]
        return np.stack(candidates)[np.argmin(losses, axis=0), np.arange(len(SIDES))]

    def _select(
        self,
        simpler: Float[np.ndarray, "legs size"],
        richer: Float[np.ndarray, "legs size"],
        more: int,
        spread: Float[np.ndarray, "legs residuals"],
        data: LegData,
    ) -> Selection:
        """Compare two models that differ by `more` parameters a leg."""
        every = np.ones(richer.shape[1], bool)
        lost, left = (self._residuals(y, data, every)[0] for y in (simpler, richer))
        worth = float(np.sum(left**2 / spread**2))
        between, within = more * len(SIDES), max(worth - richer.size, 1.0)
        statistic = float(np.sum((lost**2 - left**2) / spread**2)) / between
        effect = float(np.sum(lost**2 - left**2) / max(np.sum(left**2), np.finfo(float).tiny))
        return Selection(statistic, float(f_distribution.ppf(1 - _LEVEL, between, within)), effect)

    def _spread(
        self, coordinates: Float[np.ndarray, "legs size"], data: LegData
    ) -> Float[np.ndarray, "legs residuals"]:
        """Return what each residual is divided by to count for what it is worth: scatter, times the root of the
        integrated autocorrelation time. Never 0: a model's own recording leaves nothing but rounding."""
        values, _ = self._residuals(coordinates, data, np.ones(coordinates.shape[1], bool))
        if not self.config.motion:
            count = max(values.shape[1] - coordinates.shape[1], 1)
            spread = np.sqrt(np.sum(values**2, axis=1, keepdims=True) / count)
            return np.repeat(np.maximum(spread, _LEAST_SPREAD), values.shape[1], axis=1)
        begins = np.roll(data.begins, _AT_REST)[data.counts]
        paths = values.reshape(len(values), -1, 2)
        count = max(paths.shape[1] - coordinates.shape[1] / 2, 1)
        together = np.stack([integrated_autocorrelation_time(path, begins) for path in paths])
        spread = np.maximum(np.sqrt(np.sum(paths**2, axis=1) / count * together), _LEAST_SPREAD)
        return np.broadcast_to(spread[:, None], paths.shape).reshape(values.shape)

    def _angles(
        self, coordinates: Float[np.ndarray, "n size"], command: Float[np.ndarray, "n holds"]
    ) -> tuple[Float[np.ndarray, "n holds 2"], Float[np.ndarray, "n holds 2 size"]]:
        """Simulated settled angles (rad) and their derivatives."""
        qpos, slope = self.physics.settled(coordinates, command)
        return qpos[:, :, self.physics.leg.angles], slope[:, :, self.physics.leg.angles]

    def _settled_residuals(
        self,
        coordinates: Float[np.ndarray, "n size"],
        leg: Int[np.ndarray, " n"],
        data: LegData,
        kept: Bool[np.ndarray, " _"],
    ) -> tuple[Float[np.ndarray, "n residuals"], Float[np.ndarray, "n residuals size"]]:
        """Simulated less measured settled angles, weighted, and their Jacobians by the parameters that are `kept`."""
        angles, slope = self._angles(coordinates, data.command[leg])
        weights = data.weights[leg]
        count = len(coordinates)
        return (
            (weights * (angles - data.settled[leg])).reshape(count, -1),
            (weights[..., None] * slope).reshape(count, -1, self._size) * kept[: self._size],
        )

    def _residuals(
        self, coordinates: Float[np.ndarray, "legs size"], data: LegData, kept: Bool[np.ndarray, " size"]
    ) -> tuple[Float[np.ndarray, "legs residuals"], Float[np.ndarray, "legs residuals size"]]:
        """The same for both legs, or the whole motion's."""
        legs = len(coordinates)
        if not self.config.motion:
            return self._settled_residuals(coordinates, np.arange(legs), data, kept)
        paths, slopes = self.physics.motion(coordinates, data.commanded)
        values = (paths - data.motion)[:, data.counts]
        return values.reshape(legs, -1), slopes[:, data.counts].reshape(legs, -1, slopes.shape[-1]) * kept

    def _with_priors(
        self,
        coordinates: Float[np.ndarray, "legs size"],
        data: LegData,
        kept: Bool[np.ndarray, " size"],
        spread: Float[np.ndarray, "legs residuals"],
    ) -> tuple[Float[np.ndarray, "legs rows"], Float[np.ndarray, "legs rows size"]]:
        """All residuals for what they are worth; then how far parameters are from nominal, in units of what robots
        differ by."""
        values, jacobians = self._residuals(coordinates, data, kept)
        space, size = self.space, self._size
        rows, row_slopes = [], []
        for y in coordinates:
            vector, slope = self._parameters(y[:size])
            own = y[size:] / DYNAMICS_PRIOR[: len(y) - size]
            rows.append(np.concatenate([space.deviations(vector)[space.free], own]))
            slope = np.concatenate([slope / space.units(vector)[space.free, None], np.zeros((len(own), size))])
            beside = np.concatenate([np.zeros((size, len(own))), np.diag(1 / DYNAMICS_PRIOR[: len(own)])])
            row_slopes.append(np.concatenate([slope, beside], axis=1) * kept)
        return (
            np.concatenate([values / spread, np.array(rows)], axis=1),
            np.concatenate([jacobians / spread[..., None], np.array(row_slopes)], axis=1),
        )

    def _distance(
        self,
        coordinates: Float[np.ndarray, "n size"],
        leg: Int[np.ndarray, " n"],
        data: LegData,
        kept: Bool[np.ndarray, " _"],
    ) -> tuple[Float[np.ndarray, "n 1"], Float[np.ndarray, "n 1 size"]]:
        """The legs' parts of the paper's objective."""
        angles, slope = self._angles(coordinates, data.command[leg])
        values, gradients = self._curve_gradients(data.command[leg], angles, data.settled[leg])
        changes = np.einsum("nha,nhas->ns", gradients, slope)[:, None]
        return np.asarray(values)[:, None], changes * kept[: self._size]

    def _parameters(self, coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A leg's parameters, and the free ones' derivatives in the coordinates."""
        vector = self.space.vector(jnp.asarray(coordinates))
        return np.asarray(vector), np.asarray(jax.jacfwd(self.space.vector)(jnp.asarray(coordinates)))[self.space.free]

    def _analyse(
        self,
        coordinates: Float[np.ndarray, "legs size"],
        data: LegData,
        kept: Bool[np.ndarray, " size"],
        spread: Float[np.ndarray, "legs residuals"],
    ) -> list[_Analysis]:
        """Directions of the parameters that are kept; standard errors with all unknown, beside what is known of robots
        beforehand."""
        space, size = self.space, self._size
        results = []
        rows = zip(coordinates, *self._residuals(coordinates, data, np.ones_like(kept)), spread, strict=True)
        for y, value, jacobian, worth in rows:
            scatter = float(np.sqrt(np.sum(value**2) / max(np.count_nonzero(value) - np.count_nonzero(kept), 1)))
            vector, slope = self._parameters(y[:size])
            units = space.units(vector)[space.free]
            priors = np.concatenate([units / np.diag(slope), DYNAMICS_PRIOR[: len(y) - size]])
            # In units of the prior, whatever the coordinates.
            shown = jacobian * priors / worth[:, None]
            covariance = np.linalg.inv(shown.T @ shown + np.eye(len(y)))
            deviation = np.sqrt(np.diag(covariance))
            standard_errors = np.zeros(len(LEG_PARAMETERS))
            standard_errors[space.free] = deviation[:size] * units
            # Of each direction, what the dynamics cannot take up.
            known, unknown = shown[:, :size][:, kept[:size]], shown[:, size:][:, kept[size:]]
            unknown, singular, _ = np.linalg.svd(unknown, full_matrices=False)
            unknown = unknown[:, singular > 1e-9 * singular.max(initial=0.0)]
            _, singular, right = np.linalg.svd(known - unknown @ (unknown.T @ known), full_matrices=False)
            signed = [w * np.sign(w[np.argmax(np.abs(w))]) for w in right]
            errors = 1 / np.maximum(singular, 1e-12)
            results.append(
                _Analysis(
                    scatter=scatter,
                    standard_errors=standard_errors,
                    dynamics_errors=_dynamics_errors(y[size:], deviation[size:]) if self.config.motion else None,
                    correlations=(covariance / np.outer(deviation, deviation))[:size, :size],
                    directions=tuple(Direction(w, float(e)) for w, e in zip(signed, errors, strict=True)),
                )
            )
        return results


def _dynamics_errors(coordinates: Float[np.ndarray, " 6"], deviation: Float[np.ndarray, " 6"]) -> LegDynamics:
    """Return standard errors in the dynamics' units from those in units of their priors."""
    slope = np.diag(np.asarray(jax.jacfwd(lambda y: jnp.stack(leg_dynamics(y)))(jnp.asarray(coordinates))))
    return LegDynamics(*map(float, slope * DYNAMICS_PRIOR * deviation))


class _Analysis(NamedTuple):
    scatter: float
    standard_errors: Float[np.ndarray, " parameters"]
    dynamics_errors: LegDynamics | None
    correlations: Float[np.ndarray, "free free"]
    directions: tuple[Direction, ...]
