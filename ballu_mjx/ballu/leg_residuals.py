"""Residuals of BALLU's suspended legs against a sweep, with their Jacobians: settled angles, the whole motion, and the
distances from nominal parameters.

Settled angles under a command are the root of MJX's inverse dynamics at rest, differentiated as an implicit function.
The motion is simulated from the first command to the last and differentiated forwards. All functions compute in double
precision and are to be called inside `jax.enable_x64(True)`.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ballu_mjx.ballu.leg_parameters import (
    DEGREE,
    DYNAMICS_PRIOR,
    FIRST_DYNAMICS,
    ParameterTransform,
    leg_dynamics,
)
from ballu_mjx.ballu.suspended_leg import SuspendedLeg
from ballu_mjx.ballu.sweep import SAMPLE_TIMESTEP, Sweep
from ballu_mjx.identification.batched_solver import along_directions
from ballu_mjx.identification.effective_samples import integrated_autocorrelation_time
from ballu_mjx.sim.sharding import chunks, compile_for_devices


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
        self.leg = SuspendedLeg()
        devices = len(jax.local_devices())
        self._batch = -(-batch // devices) * devices
        size, (legs, holds) = int(space.free.sum()), data.command.shape
        every = size + len(FIRST_DYNAMICS)

        def settled(coordinates: Array, command: Array) -> tuple[Array, Array]:
            vectors, by_coordinates = jax.vmap(lambda y: (space.vector(y), jax.jacfwd(space.vector)(y)))(coordinates)
            qpos, slopes = self.leg.settled(jnp.repeat(vectors, holds, axis=0), command.ravel())
            slopes = slopes.reshape(-1, holds, *slopes.shape[1:])
            return qpos.reshape(-1, holds, qpos.shape[-1]), slopes @ by_coordinates[:, None]

        def moving(coordinates: Array, command: Array) -> tuple[Array, Array]:
            def path(y: Array, command: Array) -> Array:
                return self.leg.motion(space.vector(y[:size]), leg_dynamics(y[size:]), command, data.begins)

            directions = jnp.tile(jnp.eye(every), (legs, 1, 1))
            return along_directions(path, (coordinates,), (directions,), (command,))

        spread = compile_for_devices(settled, shared=0, over=lambda batched: batched)
        programs = [spread.lower(jnp.zeros((self._batch, size)), jnp.zeros((self._batch, holds)))]
        if motion:
            programs.append(jax.jit(moving).lower(jnp.zeros((legs, every)), jnp.zeros(data.commanded.shape)))
        with ThreadPoolExecutor() as pool:
            self._compiled = list(pool.map(lambda program: program.compile(), programs))

    def settled(
        self, coordinates: Float[np.ndarray, "n size"], command: Float[np.ndarray, "n holds"]
    ) -> tuple[Float[np.ndarray, "n holds nq"], Float[np.ndarray, "n holds nq size"]]:
        """Positions at rest and their derivatives, for any number of coordinates."""
        values, slopes = [], []
        for rows, count in chunks(len(coordinates), self._batch):
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


CurveGradients = Callable[..., tuple[Array, Array]]
"""(command, angles, measured), each of n legs, to the paper's distances and their gradients by the angles."""


class LegResiduals:
    """Residuals of both legs against one sweep, in a `ParameterTransform`'s coordinates, and then those of
    `dynamics_coordinates`. `kept` says which parameters are free; the others' derivatives are 0."""

    def __init__(
        self,
        space: ParameterTransform,
        physics: CompiledLeg,
        data: LegData,
        curve_gradients: CurveGradients,
        *,
        motion: bool,
    ) -> None:
        self.space, self.physics, self.data, self.moves = space, physics, data, motion
        self.size = int(space.free.sum())
        """Free parameters that settled angles depend on."""
        self._curve_gradients = curve_gradients

    def angles(
        self, coordinates: Float[np.ndarray, "n size"], command: Float[np.ndarray, "n holds"]
    ) -> tuple[Float[np.ndarray, "n holds 2"], Float[np.ndarray, "n holds 2 size"]]:
        """Simulated settled angles (rad) and their derivatives."""
        qpos, slope = self.physics.settled(coordinates, command)
        return qpos[:, :, self.physics.leg.angles], slope[:, :, self.physics.leg.angles]

    def settled(
        self,
        coordinates: Float[np.ndarray, "n size"],
        leg: Int[np.ndarray, " n"],
        kept: Bool[np.ndarray, " _"],
    ) -> tuple[Float[np.ndarray, "n residuals"], Float[np.ndarray, "n residuals size"]]:
        """Simulated less measured settled angles, weighted, and their Jacobians by the parameters that are `kept`."""
        angles, slope = self.angles(coordinates, self.data.command[leg])
        weights = self.data.weights[leg]
        count = len(coordinates)
        return (
            (weights * (angles - self.data.settled[leg])).reshape(count, -1),
            (weights[..., None] * slope).reshape(count, -1, self.size) * kept[: self.size],
        )

    def __call__(
        self, coordinates: Float[np.ndarray, "legs size"], kept: Bool[np.ndarray, " size"]
    ) -> tuple[Float[np.ndarray, "legs residuals"], Float[np.ndarray, "legs residuals size"]]:
        """The same for both legs, or the whole motion's."""
        legs = len(coordinates)
        if not self.moves:
            return self.settled(coordinates, np.arange(legs), kept)
        paths, slopes = self.physics.motion(coordinates, self.data.commanded)
        values = (paths - self.data.motion)[:, self.data.counts]
        return values.reshape(legs, -1), slopes[:, self.data.counts].reshape(legs, -1, slopes.shape[-1]) * kept

    def with_priors(
        self,
        coordinates: Float[np.ndarray, "legs size"],
        kept: Bool[np.ndarray, " size"],
        spread: Float[np.ndarray, "legs residuals"],
    ) -> tuple[Float[np.ndarray, "legs rows"], Float[np.ndarray, "legs rows size"]]:
        """All residuals for what they are worth; then how far parameters are from nominal, in units of what robots
        differ by."""
        values, jacobians = self(coordinates, kept)
        space, size = self.space, self.size
        rows, row_slopes = [], []
        for y in coordinates:
            vector, slope = self.parameters(y[:size])
            own = y[size:] / DYNAMICS_PRIOR[: len(y) - size]
            rows.append(np.concatenate([space.deviations(vector)[space.free], own]))
            slope = np.concatenate([slope / space.units(vector)[space.free, None], np.zeros((len(own), size))])
            beside = np.concatenate([np.zeros((size, len(own))), np.diag(1 / DYNAMICS_PRIOR[: len(own)])])
            row_slopes.append(np.concatenate([slope, beside], axis=1) * kept)
        return (
            np.concatenate([values / spread, np.array(rows)], axis=1),
            np.concatenate([jacobians / spread[..., None], np.array(row_slopes)], axis=1),
        )

    def curve_distances(
        self,
        coordinates: Float[np.ndarray, "n size"],
        leg: Int[np.ndarray, " n"],
        kept: Bool[np.ndarray, " _"],
    ) -> tuple[Float[np.ndarray, "n 1"], Float[np.ndarray, "n 1 size"]]:
        """The legs' parts of the paper's objective."""
        angles, slope = self.angles(coordinates, self.data.command[leg])
        values, gradients = self._curve_gradients(self.data.command[leg], angles, self.data.settled[leg])
        changes = np.einsum("nha,nhas->ns", gradients, slope)[:, None]
        return np.asarray(values)[:, None], changes * kept[: self.size]

    def parameters(self, coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A leg's parameters, and the free ones' derivatives in the coordinates."""
        vector = self.space.vector(jnp.asarray(coordinates))
        return np.asarray(vector), np.asarray(jax.jacfwd(self.space.vector)(jnp.asarray(coordinates)))[self.space.free]

    def spread(self, coordinates: Float[np.ndarray, "legs size"]) -> Float[np.ndarray, "legs residuals"]:
        """Return what each residual is divided by to count for what it is worth: scatter, times the root of the
        integrated autocorrelation time. Never 0: a model's own recording leaves nothing but rounding."""
        values, _ = self(coordinates, np.ones(coordinates.shape[1], bool))
        if not self.moves:
            count = max(values.shape[1] - coordinates.shape[1], 1)
            spread = np.sqrt(np.sum(values**2, axis=1, keepdims=True) / count)
            return np.repeat(np.maximum(spread, _LEAST_SPREAD), values.shape[1], axis=1)
        begins = np.roll(self.data.begins, _AT_REST)[self.data.counts]
        paths = values.reshape(len(values), -1, 2)
        count = max(paths.shape[1] - coordinates.shape[1] / 2, 1)
        together = np.stack([integrated_autocorrelation_time(path, begins) for path in paths])
        spread = np.maximum(np.sqrt(np.sum(paths**2, axis=1) / count * together), _LEAST_SPREAD)
        return np.broadcast_to(spread[:, None], paths.shape).reshape(values.shape)


_LEAST_SPREAD = 1e-9
"""rad"""
