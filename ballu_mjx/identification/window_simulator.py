"""Windows of recordings, and their differences from simulations with given parameters.

A window starts in a measured state, runs under the recorded commands, and is compared with the recording at every
sample (multiple shooting). Its starting state is uncertain, so the shift of this state is a further unknown of each
window. Differences are in units of the measurements' noise. All functions that simulate use double precision, and must
be called inside `jax.enable_x64(True)`.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int
from mujoco import mjx

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.rotations import quaternion_conjugate, quaternion_integrate, quaternion_product
from ballu_mjx.identification.measured_motion import MeasuredMotion
from ballu_mjx.identification.parameters import LEAST_FRICTION, ParameterSet
from ballu_mjx.robots.model import raise_iterations, with_fields
from ballu_mjx.sim.derived_constants import ReferencePose, with_derived_constants
from ballu_mjx.sim.drivetrain import filter_commands
from ballu_mjx.sim.sharding import chunks, shard_over_devices
from ballu_mjx.sim.step import PhysicsState, has_dry_friction, make_data, physics_step, put_model, state_at
from ballu_mjx.sim.vmap_last import nested_vmap, vmap_with_trailing_batch


class Windows(NamedTuple):
    """Windows of motions, all of the same length."""

    motion: Int[np.ndarray, " windows"]
    """Index of each window's motion."""
    first: Int[np.ndarray, " windows"]
    """Index of each window's first sample in its motion."""
    samples: int
    """Number of compared samples in each window, including the first."""


def cut_windows(
    motions: Sequence[MeasuredMotion], seconds: float, interval: float | None = None, skip: float = 0.0
) -> Windows:
    """Return windows of a given length (s), one every `interval` (s; None: end to end), after the first `skip` (s).

    **Raises** `InputError` if no motion is long enough.
    """
    found, samples = [], 0
    for number, motion in enumerate(motions):
        steps = max(1, round(seconds / motion.sample_timestep))
        samples = steps + 1
        every = max(1, round((interval or seconds) / motion.sample_timestep))
        begin = round(skip / motion.sample_timestep)
        found += [(number, first) for first in range(begin, len(motion.qpos) - steps, every)]
    if not found:
        names = ", ".join(motion.name for motion in motions)
        raise InputError(f"{names}: no recording lasts {seconds:g} s; give longer recordings, or shorter windows.")
    motion, first = np.array(found).T
    return Windows(motion, first, samples)


class Simulated(NamedTuple):
    """Differences between simulated windows and the recording, in units of noise, with derivatives."""

    values: Float[np.ndarray, "windows samples channels"]
    """Channels are the positions, in the coordinates of generalized velocities, then these velocities."""
    by_parameters: Float[np.ndarray, "windows samples channels parameters"]
    """Derivatives with respect to the parameters, in their units."""
    by_start: Float[np.ndarray, "windows samples channels start"]
    """Derivatives with respect to the starting state, in units of the measurements' noise."""


class WindowSimulator:
    """Simulator of windows of motions for any values of the parameters. It compiles once for each kind of call."""

    def __init__(self, parameters: ParameterSet, motions: Sequence[MeasuredMotion], windows: Windows) -> None:
        """Prepare the simulation of `windows`. Call this inside `jax.enable_x64(True)`."""
        self.parameters, self.motions, self.windows = parameters, tuple(motions), windows
        model = motions[0].model
        self.model, self.nv = model, model.nv
        self.timestep, self.every = float(model.opt.timestep), motions[0].every
        for motion in motions:
            if (motion.every, motion.model.opt.timestep) != (self.every, model.opt.timestep):
                raise InputError(
                    f"{motion.name}: its time step differs from that of {motions[0].name}; make them equal."
                )
        own = [put_model(_with_friction_rows(motion.model, parameters)) for motion in motions]
        self._mjx = own[0]
        self._pose = ReferencePose.of(model)
        self._data = make_data(_with_friction_rows(model, parameters))
        self._own_fields, own_values = _differing(own, [motion.name for motion in motions])
        self._slots = parameters.slots(self.timestep)
        self._longest = max(len(motion.commands) for motion in motions)
        self._commands = np.stack(
            [np.pad(m.commands, [(0, self._longest - len(m.commands)), (0, 0)], "edge") for m in motions]
        )
        steps = (windows.samples - 1) * self.every
        self._steps = windows.first[:, None] * self.every + np.arange(steps)
        place = windows.first[:, None] + np.arange(windows.samples)
        pairs = list(zip(windows.motion, place, strict=True))
        start = [(motions[m].start_qpos[p[0]], motions[m].qvel[p[0]]) for m, p in pairs]
        noise = [np.concatenate([motion.position_noise, motion.velocity_noise]) for motion in motions]
        self._held = (
            np.array([qpos for qpos, _ in start]),
            np.array([qvel for _, qvel in start]),
            np.array([motions[m].qpos[p] for m, p in pairs]),
            np.array([motions[m].qvel[p] for m, p in pairs]),
            np.array([noise[m] for m in windows.motion]),
            *(value[windows.motion] for value in own_values),
        )
        self._values = shard_over_devices(self._path, shared=0)
        over = partial(nested_vmap, inner=len(parameters) + self.channels, store_operands=has_dry_friction(self._mjx))
        self._linear = shard_over_devices(self._linearized, shared=0, over=over)
        self._ctrl = jax.jit(self._filtered)
        self._ctrl_slopes = jax.jit(self._filtered_slopes)

    @property
    def count(self) -> int:
        """Return the number of windows."""
        return len(self.windows.first)

    @property
    def channels(self) -> int:
        """Return the number of channels that are compared at each sample."""
        return 2 * self.nv

    def differences(
        self, values: Float[np.ndarray, " parameters"], start: Float[np.ndarray, "windows start"] | None = None
    ) -> Float[np.ndarray, "windows samples channels"]:
        """Return the differences of all windows. `start` shifts starting states, in units of the noise."""
        start = np.zeros((self.count, self.channels)) if start is None else start
        ctrl = self._of_windows(np.asarray(self._ctrl(jnp.asarray(values))))
        found = []
        for rows, kept in self._chunks(_CHUNK):
            vectors = np.tile(values, (len(rows), 1))
            part = self._values(vectors, start[rows], ctrl[rows], *(x[rows] for x in self._held))
            found.append(part[:kept])
        return np.concatenate(found)

    def linearize(
        self, values: Float[np.ndarray, " parameters"], start: Float[np.ndarray, "windows start"]
    ) -> Simulated:
        """Return the differences and their derivatives, by forward-mode differentiation of the simulation.

        If `start` has no columns, windows start as measured, without derivatives with respect to the starting state.
        Windows that diverge have no finite derivatives. Their derivatives are set to 0, and their differences to a
        large number.
        """
        size, directions = len(self.parameters), len(self.parameters) + start.shape[1]
        start = start if start.shape[1] else np.zeros((self.count, self.channels))
        ctrl, slopes = self._ctrl_slopes(jnp.asarray(values))
        ctrl, slopes = self._of_windows(np.asarray(ctrl)), self._of_windows(np.asarray(slopes))
        found = []
        for rows, kept in self._chunks(max(1, _CHUNK // directions)):
            by_ctrl = np.zeros((len(rows), directions, ctrl.shape[1]))
            by_ctrl[:, np.flatnonzero(self.parameters.in_drivetrain)] = np.moveaxis(slopes[rows], -1, 1)
            points = np.tile(values, (len(rows), 1)), start[rows], ctrl[rows], by_ctrl
            found.append([x[:kept] for x in self._linear(*points, *(x[rows] for x in self._held))])
        value, jacobian = (np.concatenate(parts) for parts in zip(*found, strict=True))
        diverged = ~(np.isfinite(value).all(axis=(1, 2)) & np.isfinite(jacobian).all(axis=(1, 2, 3)))
        value[diverged], jacobian[diverged] = DIVERGED, 0.0
        return Simulated(value, jacobian[..., :size], jacobian[..., size:])

    def _linearized(
        self,
        values: Float[Array, " parameters"],
        start: Float[Array, " start"],
        ctrl: Float[Array, " ctrl"],
        by_ctrl: Float[Array, "directions ctrl"],
        *held: Array,
    ) -> tuple[Float[Array, "samples channels"], Float[Array, "samples channels directions"]]:
        """Return one window's differences, and their derivatives with respect to the parameters.

        With more directions, derivatives with respect to the starting state follow. The window itself is the same for
        all directions, and is simulated only once.
        """
        units = jnp.eye(len(values) + len(start))[: len(by_ctrl)]

        def along(*moves: Array) -> tuple[Array, Array]:
            return jax.jvp(lambda *point: self._path(*point, *held), (values, start, ctrl), moves)

        found, changes = jax.vmap(along)(units[:, : len(values)], units[:, len(values) :], by_ctrl)
        return found[0], jnp.moveaxis(changes, 0, -1)

    def _path(
        self,
        values: Float[Array, " parameters"],
        start: Float[Array, " start"],
        ctrl: Float[Array, " ctrl"],
        qpos: Float[Array, " nq"],
        qvel: Float[Array, " nv"],
        measured_qpos: Float[Array, "samples nq"],
        measured_qvel: Float[Array, "samples nv"],
        noise: Float[Array, " channels"],
        *own: Array,
    ) -> Float[Array, "samples channels"]:
        """Return one window's differences, in units of noise."""

        def path(values: Array, shift: Array, ctrl: Array, qpos: Array, qvel: Array, *own: Array) -> tuple:
            model = self._mjx.replace(**dict(zip(self._own_fields, own, strict=True)))  # pyright: ignore
            fields = self.parameters.fields(model, values)
            model = with_fields(model, with_derived_constants(self._pose, model, fields))
            first = state_at(self._moved(qpos, shift[: self.nv]), qvel + shift[self.nv :])

            def sample(state: PhysicsState, ctrl: Array) -> tuple[PhysicsState, tuple[Array, Array]]:
                step = lambda number, state: physics_step(  # noqa: E731
                    model,
                    self._data.replace(ctrl=ctrl[number]),
                    state,  # pyright: ignore
                )
                state = jax.lax.fori_loop(0, self.every, step, state)
                return state, (state.qpos, state.qvel)

            _, (places, rates) = jax.lax.scan(sample, first, ctrl.reshape(-1, self.every, self._commands.shape[-1]))
            return jnp.concatenate([first.qpos[None], places]), jnp.concatenate([first.qvel[None], rates])

        qpos, qvel = vmap_with_trailing_batch(path, has_dry_friction(self._mjx))(
            values, start * noise, ctrl, qpos, qvel, *own
        )
        places = jax.vmap(self._difference)(qpos, measured_qpos)
        return jnp.concatenate([places, qvel - measured_qvel], axis=1) / noise

    def _moved(self, qpos: Float[Array, " nq"], change: Float[Array, " nv"]) -> Float[Array, " nq"]:
        """Return `qpos` moved by `change`, in the coordinates of generalized velocities."""
        if len(qpos) == len(change):
            return qpos + change
        turned = quaternion_integrate(qpos[3:7], change[3:6])
        return jnp.concatenate([qpos[:3] + change[:3], turned, qpos[7:] + change[6:]])

    def _difference(self, qpos: Float[Array, " nq"], other: Float[Array, " nq"]) -> Float[Array, " nv"]:
        """Return the change from `other` to `qpos`, in the coordinates of generalized velocities."""
        if len(qpos) == self.nv:
            return qpos - other
        turn = quaternion_product(quaternion_conjugate(other[3:7]), qpos[3:7])
        turn = 2 * turn[1:] * jnp.where(turn[0] < 0, -1.0, 1.0)  # rotation vector of a small angle
        return jnp.concatenate([qpos[:3] - other[:3], turn, qpos[7:] - other[7:]])

    def _filtered(self, values: Float[Array, " parameters"]) -> Float[Array, "motions steps commands"]:
        """Return the actuators' `ctrl` in all motions. Drivetrains start at rest under each motion's first command."""
        drivetrain = self.parameters.drivetrain(values)
        commands = jnp.asarray(self._commands)
        if not self.parameters.in_drivetrain.any():
            return commands
        return jax.vmap(lambda own: filter_commands(drivetrain, own, self.timestep, self._slots))(commands)

    def _filtered_slopes(
        self, values: Float[Array, " parameters"]
    ) -> tuple[Float[Array, "motions steps commands"], Float[Array, "motions steps commands drivetrain"]]:
        """Return `_filtered` and its derivatives with respect to the drivetrain's parameters."""
        units = jnp.eye(len(self.parameters))[np.flatnonzero(self.parameters.in_drivetrain)]
        if not len(units):
            return self._filtered(values), jnp.zeros((*self._commands.shape, 0))
        along = jax.vmap(lambda unit: jax.jvp(self._filtered, (values,), (unit,)), out_axes=(None, -1))
        return along(units)

    def _of_windows(self, ctrl: Float[np.ndarray, "motions steps ..."]) -> Float[np.ndarray, "windows ctrl ..."]:
        """Cut `ctrl` of all motions into windows. Steps and commands become one axis."""
        cut = ctrl[self.windows.motion[:, None], self._steps]
        return cut.reshape(self.count, cut.shape[1] * cut.shape[2], *cut.shape[3:])

    def _chunks(self, most: int) -> Iterator[tuple[Int[np.ndarray, " chunk"], int]]:
        """Return chunks of equal size. It suits these windows, because the program is compiled for them anyway."""
        parts = -(-self.count // most)
        return chunks(self.count, -(-self.count // parts))


_CHUNK = 1024
"""Largest number of windows times directions that are simulated in parallel."""
DIVERGED = 1e3
"""Difference assigned to a window that diverged, in units of noise."""


def _with_friction_rows(model: mujoco.MjModel, parameters: ParameterSet) -> mujoco.MjModel:
    """Return a copy with dry friction above 0 where it is a parameter. MJX omits friction rows that are 0 at first.

    The solver makes as many iterations as in simulations with the identified values (`robots.model.load_model`).
    """
    model = copy.copy(model)
    for field, places in (
        (model.dof_frictionloss, parameters.friction_dofs),
        (model.tendon_frictionloss, parameters.friction_tendons),
    ):
        field[places] = np.maximum(field[places], LEAST_FRICTION)
    raise_iterations(model)
    return model


def _differing(models: Sequence[mjx.Model], names: Sequence[str]) -> tuple[tuple[str, ...], list[np.ndarray]]:
    """Return the fields in which models differ, and their stacked values.

    **Raises** `InputError` if they differ in structure.
    """
    fields, values = [], []
    for field in dataclasses.fields(models[0]):  # pyright: ignore
        own = [getattr(model, field.name) for model in models]
        if isinstance(own[0], jax.Array):
            if any(x.shape != own[0].shape for x in own):
                wrong = next(n for x, n in zip(own, names, strict=True) if x.shape != own[0].shape)
                raise InputError(
                    f"{wrong}: its model differs in structure from that of {names[0]}; give models of equal structure."
                )
            stacked = np.stack([np.asarray(x) for x in own])
            if np.any(stacked != stacked[:1]):
                fields.append(field.name)
                values.append(stacked)
    return tuple(fields), values
