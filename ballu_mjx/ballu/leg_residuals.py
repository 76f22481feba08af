"""Residuals of BALLU's suspended legs on a sweep, with their Jacobians.

A residual is here the difference between a simulated and a measured angle, or between a parameter and its prior. It is
not a residual force.

The settled angles under a command are the root of MJX's inverse dynamics at rest. They are differentiated as an
implicit function. The motion is simulated from the first command to the last, and differentiated in forward mode. All
functions compute in double precision and must be called inside `jax.enable_x64(True)`.
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
    INITIAL_DYNAMICS,
    ParameterTransform,
    leg_dynamics,
)
from ballu_mjx.ballu.suspended_leg import SuspendedLeg
from ballu_mjx.ballu.sweep import SAMPLE_TIMESTEP, Sweep
from ballu_mjx.identification.batched_solver import directional_derivatives
from ballu_mjx.identification.effective_samples import integrated_autocorrelation_time
from ballu_mjx.sim.sharding import chunks, compile_for_devices


class LegData(NamedTuple):
    """A `Sweep` with the axis (left, right) first and the axis (motor, knee) last. Angles are in rad.

    In its motion, each recording is preceded by 2 s under its first command, in which the leg comes to rest.
    """

    command: Float[np.ndarray, "legs holds"]
    """Command of each hold."""
    settled: Float[np.ndarray, "legs holds 2"]
    """Settled angles (rad)."""
    weights: Float[np.ndarray, "legs holds 2"]
    """Square roots of the number of samples in each mean, reduced for joints that still creep."""
    commanded: Float[np.ndarray, "legs times"]
    """Mean command from each time of the motion to the next."""
    motion: Float[np.ndarray, "legs times 2"]
    """Measured angles (rad) at each time."""
    counts: Bool[np.ndarray, " times"]
    """Whether a time enters the residuals. The added 2 s do not."""
    begins: Bool[np.ndarray, " times"]
    """Whether the leg is set to rest at a time: at the beginning of the added 2 s."""


def leg_data(sweep: Sweep) -> LegData:
    """Return a sweep in the form that the fit uses."""
    firsts = np.flatnonzero(sweep.begins)
    rows = np.insert(np.arange(len(sweep.hold)), np.repeat(firsts, _AT_REST), np.repeat(firsts, _AT_REST))
    before = np.insert(np.zeros(len(sweep.hold), bool), np.repeat(firsts, _AT_REST), True)
    still = np.moveaxis(1 / np.hypot(1, sweep.drift / _DRIFT), -1, 0)
    return LegData(
        command=sweep.command.T,
        settled=np.moveaxis(sweep.settled, -1, 0),
        weights=np.sqrt(sweep.samples)[:, None] * still,
        commanded=sweep.commanded[rows].T,
        motion=np.moveaxis(sweep.motion[rows], -1, 0),
        counts=~before,
        begins=before & ~np.roll(before, 1),
    )


_AT_REST = round(2.0 / SAMPLE_TIMESTEP)
"""Number of samples before each recording in which the leg comes to rest."""
_DRIFT = 0.05 * DEGREE
"""Drift (rad) above which a joint has not reached its settled angle, so that the angle has a lower weight."""


class CompiledLeg:
    """Two compiled MJX programs, for settled angles and for the motion.

    They return values and Jacobians in the coordinates of a `ParameterTransform`, for batches of fixed sizes. They are
    compiled in parallel, the second only if `motion` is True.
    """

    def __init__(self, space: ParameterTransform, batch: int, data: LegData, *, motion: bool) -> None:
        self.leg = SuspendedLeg()
        devices = len(jax.local_devices())
        self._batch = -(-batch // devices) * devices
        size, (legs, holds) = int(space.free.sum()), data.command.shape
        every = size + len(INITIAL_DYNAMICS)

        def settled(coordinates: Array, command: Array) -> tuple[Array, Array]:
            vectors, by_coordinates = jax.vmap(lambda y: (space.vector(y), jax.jacfwd(space.vector)(y)))(coordinates)
            qpos, jacobians = self.leg.settled(jnp.repeat(vectors, holds, axis=0), command.ravel())
            jacobians = jacobians.reshape(-1, holds, *jacobians.shape[1:])
            return qpos.reshape(-1, holds, qpos.shape[-1]), jacobians @ by_coordinates[:, None]

        def moving(coordinates: Array, command: Array) -> tuple[Array, Array]:
            def path(y: Array, command: Array) -> Array:
                return self.leg.motion(space.vector(y[:size]), leg_dynamics(y[size:]), command, data.begins)

            directions = jnp.tile(jnp.eye(every), (legs, 1, 1))
            return directional_derivatives(path, (coordinates,), (directions,), (command,))

        spread = compile_for_devices(settled, shared=0, over=lambda batched: batched)
        programs = [spread.lower(jnp.zeros((self._batch, size)), jnp.zeros((self._batch, holds)))]
        if motion:
            programs.append(jax.jit(moving).lower(jnp.zeros((legs, every)), jnp.zeros(data.commanded.shape)))
        with ThreadPoolExecutor() as pool:
            self._compiled = list(pool.map(lambda program: program.compile(), programs))

    def settled(
        self, coordinates: Float[np.ndarray, "n size"], command: Float[np.ndarray, "n holds"]
    ) -> tuple[Float[np.ndarray, "n holds nq"], Float[np.ndarray, "n holds nq size"]]:
        """Return generalized positions at rest and their derivatives, for any number of coordinate vectors."""
        values, jacobians = [], []
        for rows, count in chunks(len(coordinates), self._batch):
            value, jacobian = self._compiled[0](jnp.asarray(coordinates[rows]), jnp.asarray(command[rows]))
            values.append(np.asarray(value)[:count])
            jacobians.append(np.asarray(jacobian)[:count])
        return np.concatenate(values), np.concatenate(jacobians)

    def motion(
        self, coordinates: Float[np.ndarray, "legs _"], commanded: Float[np.ndarray, "legs times"]
    ) -> tuple[Float[np.ndarray, "legs times 2"], Float[np.ndarray, "legs times 2 _"]]:
        """Return both legs' motion and its derivatives. The coordinates end with those of `leg_dynamics`."""
        value, jacobian = self._compiled[1](jnp.asarray(coordinates), jnp.asarray(commanded))
        return np.asarray(value), np.asarray(jacobian)


CurveGradients = Callable[..., tuple[Array, Array]]
"""Function of (command, angles, measured) of n legs. It returns the paper's distances and their gradients with respect
to the angles."""


class LegResiduals:
    """Residuals of both legs on one sweep, as functions of coordinates.

    The coordinates are those of a `ParameterTransform`, followed by those of `dynamics_coordinates`. `kept` marks the
    parameters that are fitted. Derivatives with respect to the others are set to 0.
    """

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
        """Number of free parameters that settled angles depend on."""
        self._curve_gradients = curve_gradients

    def angles(
        self, coordinates: Float[np.ndarray, "n size"], command: Float[np.ndarray, "n holds"]
    ) -> tuple[Float[np.ndarray, "n holds 2"], Float[np.ndarray, "n holds 2 size"]]:
        """Return simulated settled angles (rad) and their derivatives."""
        qpos, jacobian = self.physics.settled(coordinates, command)
        return qpos[:, :, self.physics.leg.angles], jacobian[:, :, self.physics.leg.angles]

    def settled(
        self,
        coordinates: Float[np.ndarray, "n size"],
        leg: Int[np.ndarray, " n"],
        kept: Bool[np.ndarray, " _"],
    ) -> tuple[Float[np.ndarray, "n residuals"], Float[np.ndarray, "n residuals size"]]:
        """Return the simulated minus the measured settled angles, weighted, and their Jacobians."""
        angles, jacobian = self.angles(coordinates, self.data.command[leg])
        weights = self.data.weights[leg]
        count = len(coordinates)
        return (
            (weights * (angles - self.data.settled[leg])).reshape(count, -1),
            (weights[..., None] * jacobian).reshape(count, -1, self.size) * kept[: self.size],
        )

    def __call__(
        self, coordinates: Float[np.ndarray, "legs size"], kept: Bool[np.ndarray, " size"]
    ) -> tuple[Float[np.ndarray, "legs residuals"], Float[np.ndarray, "legs residuals size"]]:
        """Return the residuals of both legs and their Jacobians: of the whole motion, or else of settled angles.

        A motion is unstable if it or its derivatives are not finite, or derivatives are huge: small changes grow until
        the leg oscillates between the servo's torque limits. All its residuals are `_UNSTABLE`, and its Jacobian is 0.
        A search then turns back.
        """
        legs = len(coordinates)
        if not self.moves:
            return self.settled(coordinates, np.arange(legs), kept)
        paths, jacobians = self.physics.motion(coordinates, self.data.commanded)
        values = (paths - self.data.motion)[:, self.data.counts].reshape(legs, -1)
        jacobians = jacobians[:, self.data.counts].reshape(legs, -1, jacobians.shape[-1])
        unstable = _are_unstable(values, jacobians)
        values = np.where(unstable[:, None], _UNSTABLE, values)
        return values, np.where(unstable[:, None, None], 0.0, jacobians) * kept

    def with_priors(
        self,
        coordinates: Float[np.ndarray, "legs size"],
        kept: Bool[np.ndarray, " size"],
        spread: Float[np.ndarray, "legs residuals"],
    ) -> tuple[Float[np.ndarray, "legs rows"], Float[np.ndarray, "legs rows size"]]:
        """Return residuals divided by `spread`, followed by those of the priors, and their Jacobians.

        The residuals of the priors are distances in standard deviations among robots. Parameters that settled angles
        depend on have them from nominal. The dynamics have them from `INITIAL_DYNAMICS`: their coordinates are
        logarithms, and most of their nominal values are 0.
        """
        values, jacobians = self(coordinates, kept)
        space, size = self.space, self.size
        rows, row_jacobians = [], []
        for y in coordinates:
            vector, jacobian = self.parameters(y[:size])
            own = y[size:] / DYNAMICS_PRIOR[: len(y) - size]
            rows.append(np.concatenate([space.deviations(vector)[space.free], own]))
            jacobian = np.concatenate([jacobian / space.units(vector)[space.free, None], np.zeros((len(own), size))])
            beside = np.concatenate([np.zeros((size, len(own))), np.diag(1 / DYNAMICS_PRIOR[: len(own)])])
            row_jacobians.append(np.concatenate([jacobian, beside], axis=1) * kept)
        return (
            np.concatenate([values / spread, np.array(rows)], axis=1),
            np.concatenate([jacobians / spread[..., None], np.array(row_jacobians)], axis=1),
        )

    def curve_distances(
        self,
        coordinates: Float[np.ndarray, "n size"],
        leg: Int[np.ndarray, " n"],
        kept: Bool[np.ndarray, " _"],
    ) -> tuple[Float[np.ndarray, "n 1"], Float[np.ndarray, "n 1 size"]]:
        """Return the legs' parts of the paper's objective, and their gradients."""
        angles, jacobian = self.angles(coordinates, self.data.command[leg])
        values, gradients = self._curve_gradients(self.data.command[leg], angles, self.data.settled[leg])
        changes = np.einsum("nha,nhas->ns", gradients, jacobian)[:, None]
        return np.asarray(values)[:, None], changes * kept[: self.size]

    def parameters(self, coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a leg's parameters, and the derivatives of the free ones with respect to the coordinates."""
        vector = self.space.vector(jnp.asarray(coordinates))
        return np.asarray(vector), np.asarray(jax.jacfwd(self.space.vector)(jnp.asarray(coordinates)))[self.space.free]

    def spread(self, coordinates: Float[np.ndarray, "legs size"]) -> Float[np.ndarray, "legs residuals"]:
        """Return the divisors that give each residual the weight of its information.

        They are the scatter of settled angles. For the motion, the scatter is multiplied by the square root of the
        integrated autocorrelation time. Divisors are never 0, because a fit to a recording of the model itself leaves
        only rounding errors.
        """
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


def _are_unstable(
    values: Float[np.ndarray, "legs residuals"], jacobians: Float[np.ndarray, "legs residuals size"]
) -> Bool[np.ndarray, " legs"]:
    with np.errstate(invalid="ignore"):
        steep = ~(np.abs(jacobians).max(axis=(1, 2)) < _STEEPEST)  # also if one is NaN
    return steep | ~np.isfinite(values).all(axis=1)


_STEEPEST = 100.0
"""Derivative of an angle (rad) by a coordinate above which a motion counts as unstable. Those of stable motions are of
the order of 1, those of unstable ones up to 1e20 and more."""
_UNSTABLE = float(np.pi / 2)
"""Residual (rad) of an unstable motion."""
_LEAST_SPREAD = 1e-9
"""Smallest divisor (rad)."""
