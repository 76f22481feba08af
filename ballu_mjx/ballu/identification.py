"""Identification of the actuators from a suspended sweep (paper, section "System Identification", Algorithm 1).

The legs hang from a base held still, so that each is identified by itself, both at once. Settled angles under a command
are the root of MJX's inverse dynamics at rest, differentiated as an implicit function: no derivative through a
simulation to rest. They are where the search begins. What decides is the whole motion, simulated from the first command
to the last and differentiated forwards, with what a command meets on its way: delay, backlash and dry friction
(`Drivetrain`), under which no leg is ever quite at rest.

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
    FIRST_DRIVETRAIN,
    LEG_PARAMETERS,
    Drivetrain,
    IdentificationConfig,
    ParameterTransform,
    check_identification_config,
    drivetrain,
    nominal_leg,
)
from ballu_mjx.ballu.model import SIDES, ActuatorParameters
from ballu_mjx.ballu.suspended_leg import SuspendedLeg
from ballu_mjx.ballu.sweep import SAMPLE_TIMESTEP, Sweep
from ballu_mjx.identification.batched_solver import BatchedSolver, along_directions
from ballu_mjx.identification.parameters import Direction


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
        every = size + len(FIRST_DRIVETRAIN)

        def settled(coordinates: Array, command: Array) -> tuple[Array, Array]:
            vectors, by_coordinates = jax.vmap(lambda y: (space.vector(y), jax.jacfwd(space.vector)(y)))(coordinates)
            qpos, slopes = self.leg.settled(jnp.repeat(vectors, holds, axis=0), command.ravel())
            slopes = slopes.reshape(batch, holds, *slopes.shape[1:])
            return qpos.reshape(batch, holds, -1), slopes @ by_coordinates[:, None]

        def moving(coordinates: Array, command: Array) -> tuple[Array, Array]:
            def path(y: Array, command: Array) -> Array:
                return self.leg.motion(space.vector(y[:size]), drivetrain(y[size:]), command, data.begins)

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
        """Both legs' motion and its derivatives; coordinates end with those of `drivetrain`."""
        value, jacobian = self._compiled[1](jnp.asarray(coordinates), jnp.asarray(commanded))
        return np.asarray(value), np.asarray(jacobian)


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """One leg, identified."""

    vector: Float[np.ndarray, " parameters"]
    standard_errors: Float[np.ndarray, " parameters"]
    """In the parameters' units, from the Jacobian and the scatter of the residuals taken as white noise; 0 for those
    that were not free, and of the prior's size at most along open directions."""
    correlations: Float[np.ndarray, "free free"]
    directions: tuple[Direction, ...]
    """From the best to the least determined."""
    drivetrain: Drivetrain | None
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
    """Settled angles (rad) of the identified robot; (motor, knee), (left, right) last, as in `Sweep`."""
    with_drivetrain: Float[np.ndarray, "holds 2 2"] | None
    """What its motion comes to with the identified drivetrain."""
    nominal_settled: Float[np.ndarray, "holds 2 2"]
    """The same as `settled`, of the nominal robot."""
    config: IdentificationConfig

    @property
    def parameters(self) -> ActuatorParameters:
        return ActuatorParameters(
            *(jnp.asarray(row, jnp.float32) for row in np.stack([f.vector for f in self.fits], 1))
        )


Report = Callable[[str, int, int, float], None]
"""(stage, iteration, most iterations, the lowest loss among the searches)."""


def identify_legs(
    sweep: Sweep, config: IdentificationConfig | None = None, report: Report | None = None
) -> Identification:
    """Fit both legs' parameters to a sweep.

    1. Settled angles alone, from several starts side by side, the best of many draws: searches that start with a servo
       that never saturates, say, end in a valley of their own.
    2. From the best of these, the whole motion.
    3. Directions that the data leave open, if any, are drawn to the nominal values, and to nothing else.
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
        starts = min(config.starts, config.draws + 1)
        report("compiling", 0, 1, float("nan"))
        self.space = ParameterTransform(nominal_leg(), config)
        self.physics = CompiledLeg(self.space, starts * len(SIDES), data, motion=config.motion)
        report("compiling", 1, 1, float("nan"))
        self._starts, self._size = starts, int(self.space.free.sum())
        self._squares = BatchedSolver(optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5))
        self._shape = BatchedSolver(optx.LBFGS(rtol=1e-5, atol=1e-5))

        def objective(angles: Array, command: Array, measured: Array) -> Array:
            return jnp.sum(curve_distances(command, angles, measured, config.degree)[0])

        gradient = jax.value_and_grad(objective)
        self._curve_gradients = jax.jit(jax.vmap(lambda command, angles, measured: gradient(angles, command, measured)))

    def run(self, sweep: Sweep, report: Report) -> Identification:
        config, size, data = self.config, self._size, leg_data(sweep)
        legs = np.arange(len(SIDES))

        draws = self.space.draw(config.seed, config.draws)
        coordinates, leg = np.tile(draws, (len(legs), 1)), np.repeat(legs, len(draws))
        report("draws", 0, 1, float("nan"))
        losses = np.sum(self._settled_residuals(coordinates, leg, data)[0] ** 2, axis=1).reshape(len(legs), -1)
        report("draws", 1, 1, float(losses.min()))
        best = np.argsort(losses, axis=1)[:, : self._starts]
        starts, leg = draws[best].reshape(-1, size), np.repeat(legs, self._starts)
        found, ended = self._squares(
            lambda y: self._settled_residuals(y, leg, data), starts, config.steps, partial(report, "settled angles")
        )
        ended = ended.reshape(len(legs), -1)
        coordinates = found.reshape(len(legs), -1, size)[legs, np.argmin(ended, axis=1)]

        if config.motion:
            coordinates = np.concatenate([coordinates, np.zeros((len(legs), len(FIRST_DRIVETRAIN)))], axis=1)
            coordinates, _ = self._squares(
                lambda y: self._residuals(y, data), coordinates, config.steps, partial(report, "motion")
            )
        analyses = self._analyse(coordinates, data)
        if any(direction.standard_error > 1 for a in analyses for direction in a.directions):
            coordinates, _ = self._squares(
                lambda y: self._drawn(y, data, analyses), coordinates, config.steps, partial(report, "open directions")
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
                drivetrain=Drivetrain(*map(float, drivetrain(jnp.asarray(coordinates[leg, size:]))))
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
        return Identification((fits[0], fits[1]), after, moving, nominal, config)

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
            (weights[..., None] * slope).reshape(count, -1, self._size),
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
        return values.reshape(legs, -1), slopes[:, data.counts].reshape(legs, -1, slopes.shape[-1])

    def _drawn(
        self, coordinates: Float[np.ndarray, "legs size"], data: LegData, analyses: list[_Analysis]
    ) -> tuple[Float[np.ndarray, "legs residuals"], Float[np.ndarray, "legs residuals size"]]:
        """All residuals over their scatter, then how far from nominal along open directions, in units of the prior."""
        values, jacobians = self._residuals(coordinates, data)
        space, size = self.space, self._size
        rows, row_slopes = [], []
        for y, analysis in zip(coordinates, analyses, strict=True):
            directions = np.array([d.weights if d.standard_error > 1 else np.zeros(size) for d in analysis.directions])
            vector, slope = self._parameters(y[:size])
            directions = directions / space.prior[space.free]
            rows.append(directions @ (vector - space.nominal)[space.free])
            row_slopes.append(np.pad(directions @ slope, [(0, 0), (0, len(y) - size)]))
        scatter = np.array([analysis.scatter for analysis in analyses])
        return (
            np.concatenate([values / scatter[:, None], np.array(rows)], axis=1),
            np.concatenate([jacobians / scatter[:, None, None], np.array(row_slopes)], axis=1),
        )

    def _distance(
        self, coordinates: Float[np.ndarray, "n size"], leg: Int[np.ndarray, " n"], data: LegData
    ) -> tuple[Float[np.ndarray, "n 1"], Float[np.ndarray, "n 1 size"]]:
        """The legs' parts of the paper's objective."""
        angles, slope = self._angles(coordinates, data.command[leg])
        values, gradients = self._curve_gradients(data.command[leg], angles, data.settled[leg])
        return np.asarray(values)[:, None], np.einsum("nha,nhas->ns", gradients, slope)[:, None]

    def _parameters(self, coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A leg's parameters, and the free ones' derivatives in the coordinates."""
        vector = self.space.vector(jnp.asarray(coordinates))
        return np.asarray(vector), np.asarray(jax.jacfwd(self.space.vector)(jnp.asarray(coordinates)))[self.space.free]

    def _analyse(self, coordinates: Float[np.ndarray, "legs size"], data: LegData) -> list[_Analysis]:
        space, size = self.space, self._size
        results = []
        for y, value, jacobian in zip(coordinates, *self._residuals(coordinates, data), strict=True):
            scatter = float(np.sqrt(np.sum(value**2) / max(np.count_nonzero(value) - len(y), 1)))
            prior = space.prior[space.free]
            # In units of the prior, whatever the coordinates; the drivetrain, of which nobody knows anything, projected
            # out.
            known = jacobian[:, :size] / np.diag(self._parameters(y[:size])[1]) * prior / scatter
            unknown, singular, _ = np.linalg.svd(jacobian[:, size:], full_matrices=False)
            unknown = unknown[:, singular > 1e-9 * singular.max(initial=0.0)]
            known = known - unknown @ (unknown.T @ known)
            _, singular, right = np.linalg.svd(known, full_matrices=False)
            errors = 1 / np.maximum(singular, 1e-12)
            variances = np.where(errors > 1, 1 / (1 + singular**2), errors**2)
            covariance = right.T @ np.diag(variances) @ right
            deviation = np.sqrt(np.diag(covariance))
            standard_errors = np.zeros(len(LEG_PARAMETERS))
            standard_errors[space.free] = deviation * prior
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
