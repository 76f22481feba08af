"""Recordings cut into windows, and how far windows simulated with given parameters are from them.

A window starts in a measured state, runs under the recorded commands, and is compared with the recording at every
sample (multiple shooting). Its starting state is uncertain: a shift of it is a further unknown of each window.
Differences are in units of the measurements' noise. All functions that simulate compute in double precision and are to
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
from ballu_mjx.identification.parameters import LEAST_FRICTION, ParameterSet
from ballu_mjx.recordings.filters import interpolate, mean_command, savitzky_golay
from ballu_mjx.recordings.motion import Motion, ReconstructionParameters
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import with_fields
from ballu_mjx.sim.derived_constants import ReferencePose, with_derived_constants
from ballu_mjx.sim.drivetrain import filter_commands
from ballu_mjx.sim.sharding import chunks, shard_over_devices
from ballu_mjx.sim.step import PhysicsState, make_data, physics_step, put_model, state_at
from ballu_mjx.sim.vmap_last import nested_vmap, vmap_with_trailing_batch


def check_sampling_config(config: SamplingConfig) -> None:
    """Refuse sizes that make no sense.

    **Raises** `InputError` naming the option.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if not 0 < value < np.inf:
            raise InputError(f"--{field.name.replace('_', '-')} is {value}: it must be above 0.")


@dataclasses.dataclass(frozen=True)
class SamplingConfig:
    """How recordings are sampled, and what is known of their noise."""

    sample_timestep: float = 0.02
    """Seconds between two compared samples; rounded to physics steps."""
    angle_noise: float = float(np.deg2rad(0.3))
    """Standard deviation of a recorded joint coordinate (rad, m)."""
    position_window: float = 0.09
    """Width (s) of the Savitzky-Golay filter for starting positions."""
    rate_window: float = 0.19
    """The same for velocities."""
    order: int = 3
    """Of the filters' polynomials."""


@dataclasses.dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """A recording as identification takes it: states at samples, commands at physics steps, and their noise."""

    name: str
    model: mujoco.MjModel
    """The robot as it was recorded; motions of one fit may differ in numbers (a load), not in structure."""
    every: int
    """Physics steps from one sample to the next."""
    commands: Float[np.ndarray, "steps commands"]
    """In the actuators' units, at each physics step."""
    qpos: Float[np.ndarray, "samples nq"]
    """Measured."""
    start_qpos: Float[np.ndarray, "samples nq"]
    """Smoothed."""
    qvel: Float[np.ndarray, "samples nv"]
    position_noise: Float[np.ndarray, " nv"]
    """Standard deviations along the velocities' directions (m, rad)."""
    velocity_noise: Float[np.ndarray, " nv"]
    """Standard deviations (m/s, rad/s)."""

    @property
    def sample_timestep(self) -> float:
        return self.every * float(self.model.opt.timestep)


def measure(
    recording: Recording, robot: RobotDescription, model: mujoco.MjModel, config: SamplingConfig | None = None
) -> MeasuredMotion:
    """Return the states of a recording that has every joint of a model whose root is held.

    The noise of velocities is the root mean square difference between filters of the full and of half the width. It
    holds the noise that the narrow filter lets through and what the wide one smooths away.

    **Raises** `InputError` naming the joint that was not recorded, or a recording that is too short.
    """
    config = config or SamplingConfig()
    if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
        raise InputError(f"{recording.name}: {robot.name} has a free joint; reconstruct the motion, or hold the root.")
    joints = [model.joint(number).name for number in range(model.njnt)]
    for joint in joints:
        if joint not in recording.joint_angles:
            problem = f"{recording.name}: joint {joint} was not recorded"
            raise InputError(f'{problem}; add its column, and name it in "joints" of the robot description.')
    timestep = float(model.opt.timestep)
    every = max(1, round(config.sample_timestep / timestep))
    sample = every * timestep
    time = recording.time - recording.time[0]
    count = int(np.floor(time[-1] / sample + 1e-6)) + 1
    if count < 5:
        raise InputError(f"{recording.name}: {time[-1]:.3f} s is too short; record {5 * sample:g} s or more.")
    fine = max(1, round(sample / float(np.median(np.diff(time)))))
    grid = np.arange((count - 1) * fine + 1) * (sample / fine)
    angles = interpolate(grid, time, np.stack([recording.joint_angles[joint] for joint in joints], axis=1))
    filtered = partial(savitzky_golay, angles, step=sample / fine, order=config.order)
    rates, narrow = (filtered(width, derivative=1) for width in (config.rate_window, config.rate_window / 2))
    uncertainty = np.hypot(np.std(rates - narrow, axis=0), _SURE * np.std(rates, axis=0) + 1e-6)
    # A semi-implicit integrator's velocity is the mean over the time step that led to the position.
    rates = rates - np.gradient(rates, sample / fine, axis=0) * timestep / 2
    here = slice(None, None, fine)
    return MeasuredMotion(
        name=recording.name,
        model=model,
        every=every,
        commands=mean_command(recording, np.arange((count - 1) * every + 1) * timestep),
        qpos=angles[here],
        start_qpos=filtered(config.position_window, derivative=0)[here],
        qvel=rates[here],
        position_noise=np.full(model.nv, config.angle_noise),
        velocity_noise=uncertainty,
    )


def held_motion(
    recording: Recording, robot: RobotDescription, model: mujoco.MjModel, config: SamplingConfig | None = None
) -> Motion:
    """Return states at the control rate of a recording that has every joint of a model whose root is held: of what
    `reconstruct` gives for free recordings, all but distances to measured places.

    **Raises** `InputError` as `measure` does.
    """
    config = dataclasses.replace(config or SamplingConfig(), sample_timestep=robot.control_timestep)
    measured = measure(recording, robot, model, config)
    edges = np.arange(len(measured.qpos)) * robot.control_timestep
    return Motion(
        name=recording.name,
        time=edges,
        command=mean_command(recording, edges),
        qpos=measured.start_qpos,
        qvel=measured.qvel,
        residual_mm={},
        interpolated=dict(recording.interpolated),
        robot=recording.robot,
        joints=robot.joints,
    )


_SURE = 1e-3
"""Of the velocities' spread: no velocity is known better."""


def measured_from_motion(
    motion: Motion,
    model: mujoco.MjModel,
    parameters: ReconstructionParameters | None = None,
    velocity_noise: tuple[float, float, float] = (0.02, 0.1, 0.2),
) -> MeasuredMotion:
    """Return a reconstructed motion (of any robot, at the control rate) as identification takes it.

    **Arguments**

    - `velocity_noise`: standard deviations of a free joint's linear (m/s) and angular (rad/s) velocity, and of joints'
      velocities (rad/s, m/s).
    """
    parameters = parameters or ReconstructionParameters()
    every = round(float(motion.time[1] - motion.time[0]) / float(model.opt.timestep))
    free = model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    root = np.repeat([0, 1], 3) if free else np.zeros(0, int)
    kinds = np.concatenate([root, np.full(model.nv - len(root), 2)])
    positions = np.array([parameters.position_noise, parameters.rotation_noise, parameters.joint_noise])
    return MeasuredMotion(
        name=motion.name,
        model=model,
        every=every,
        commands=np.repeat(motion.command, every, axis=0),
        qpos=motion.qpos,
        start_qpos=motion.qpos,
        qvel=motion.qvel,
        position_noise=positions[kinds],
        velocity_noise=np.array(velocity_noise)[kinds],
    )


class Windows(NamedTuple):
    """Stretches of motions of the same length."""

    motion: Int[np.ndarray, " windows"]
    """Number of the motion that each is of."""
    first: Int[np.ndarray, " windows"]
    """Sample that each starts in."""
    samples: int
    """Compared in each, the first one included."""


def cut_windows(
    motions: Sequence[MeasuredMotion], seconds: float, interval: float | None = None, skip: float = 0.0
) -> Windows:
    """Return windows of a length (s), one every `interval` (s; None: end to end), from `skip` (s) on.

    **Raises** `InputError` where no motion is as long.
    """
    found, samples = [], 0
    for number, motion in enumerate(motions):
        steps = max(1, round(seconds / motion.sample_timestep))
        samples = steps + 1
        every = max(1, round((interval or seconds) / motion.sample_timestep))
        begin = round(skip / motion.sample_timestep)
        found += [(number, first) for first in range(begin, len(motion.qpos) - steps, every)]
    if not found:
        raise InputError(f"No recording lasts {seconds:g} s; give longer ones, or shorter windows.")
    motion, first = np.array(found).T
    return Windows(motion, first, samples)


class Simulated(NamedTuple):
    """Windows' differences to the recording, in units of noise, and how they change."""

    values: Float[np.ndarray, "windows samples channels"]
    """Channels are the velocities' directions of positions, then the velocities."""
    by_parameters: Float[np.ndarray, "windows samples channels parameters"]
    """In the parameters' units."""
    by_start: Float[np.ndarray, "windows samples channels start"]
    """By the starting state, in units of its uncertainty."""


class WindowSimulator:
    """Simulates windows of motions for any values of the parameters; compiles once for each kind of call."""

    def __init__(self, parameters: ParameterSet, motions: Sequence[MeasuredMotion], windows: Windows) -> None:
        """To be called inside `jax.enable_x64(True)`."""
        self.parameters, self.motions, self.windows = parameters, tuple(motions), windows
        model = motions[0].model
        self.model, self.nv = model, model.nv
        self.timestep, self.every = float(model.opt.timestep), motions[0].every
        for motion in motions:
            if (motion.every, motion.model.opt.timestep) != (self.every, model.opt.timestep):
                raise InputError(f"{motion.name}: its time step differs from {motions[0].name}'s; make them equal.")
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
        over = partial(nested_vmap, inner=len(parameters) + self.channels)
        self._linear = shard_over_devices(self._linearized, shared=0, over=over)
        self._ctrl = jax.jit(self._filtered)
        self._ctrl_slopes = jax.jit(self._filtered_slopes)

    @property
    def count(self) -> int:
        """Of the windows."""
        return len(self.windows.first)

    @property
    def channels(self) -> int:
        """Compared at each sample."""
        return 2 * self.nv

    def differences(
        self, values: Float[np.ndarray, " parameters"], start: Float[np.ndarray, "windows start"] | None = None
    ) -> Float[np.ndarray, "windows samples channels"]:
        """Return the differences of all windows; `start` shifts starting states, in units of their uncertainty."""
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
        """Return the differences and their derivatives, taken forwards through the simulation.

        `start` without columns: windows start as measured, and nothing is derived by that. Windows that diverge have no
        finite derivatives; theirs are 0, and their differences a large number.
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
        lost = ~(np.isfinite(value).all(axis=(1, 2)) & np.isfinite(jacobian).all(axis=(1, 2, 3)))
        value[lost], jacobian[lost] = _LOST, 0.0
        return Simulated(value, jacobian[..., :size], jacobian[..., size:])

    def _linearized(
        self,
        values: Float[Array, " parameters"],
        start: Float[Array, " start"],
        ctrl: Float[Array, " ctrl"],
        by_ctrl: Float[Array, "directions ctrl"],
        *held: Array,
    ) -> tuple[Float[Array, "samples channels"], Float[Array, "samples channels directions"]]:
        """One window's differences, and how they change by the parameters and, where there are more directions, by the
        starting state. The window itself is the same for all directions, and simulated once for all."""
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
        """One window's differences, in units of noise."""

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

        qpos, qvel = vmap_with_trailing_batch(path)(values, start * noise, ctrl, qpos, qvel, *own)
        places = jax.vmap(self._difference)(qpos, measured_qpos)
        return jnp.concatenate([places, qvel - measured_qvel], axis=1) / noise

    def _moved(self, qpos: Float[Array, " nq"], change: Float[Array, " nv"]) -> Float[Array, " nq"]:
        """Return `qpos` moved along the velocities' directions."""
        if len(qpos) == len(change):
            return qpos + change
        turned = quaternion_integrate(qpos[3:7], change[3:6])
        return jnp.concatenate([qpos[:3] + change[:3], turned, qpos[7:] + change[6:]])

    def _difference(self, qpos: Float[Array, " nq"], other: Float[Array, " nq"]) -> Float[Array, " nv"]:
        """Return what leads from `other` to `qpos`, along the velocities' directions."""
        if len(qpos) == self.nv:
            return qpos - other
        turn = quaternion_product(quaternion_conjugate(other[3:7]), qpos[3:7])
        turn = 2 * turn[1:] * jnp.where(turn[0] < 0, -1.0, 1.0)  # the small angle between them
        return jnp.concatenate([qpos[:3] - other[:3], turn, qpos[7:] - other[7:]])

    def _filtered(self, values: Float[Array, " parameters"]) -> Float[Array, "motions steps commands"]:
        """What the drivetrains make of all motions' commands, each from rest under its first."""
        drivetrain = self.parameters.drivetrain(values)
        commands = jnp.asarray(self._commands)
        if not self.parameters.in_drivetrain.any():
            return commands
        return jax.vmap(lambda own: filter_commands(drivetrain, own, self.timestep, self._slots))(commands)

    def _filtered_slopes(
        self, values: Float[Array, " parameters"]
    ) -> tuple[Float[Array, "motions steps commands"], Float[Array, "motions steps commands drivetrain"]]:
        units = jnp.eye(len(self.parameters))[np.flatnonzero(self.parameters.in_drivetrain)]
        if not len(units):
            return self._filtered(values), jnp.zeros((*self._commands.shape, 0))
        along = jax.vmap(lambda unit: jax.jvp(self._filtered, (values,), (unit,)), out_axes=(None, -1))
        return along(units)

    def _of_windows(self, ctrl: Float[np.ndarray, "motions steps ..."]) -> Float[np.ndarray, "windows ctrl ..."]:
        """Cut what is of all motions' physics steps into windows, steps and commands in one axis."""
        cut = ctrl[self.windows.motion[:, None], self._steps]
        return cut.reshape(self.count, cut.shape[1] * cut.shape[2], *cut.shape[3:])

    def _chunks(self, most: int) -> Iterator[tuple[Int[np.ndarray, " chunk"], int]]:
        """Return chunks of windows, all about as large: a program is compiled for these windows anyway."""
        parts = -(-self.count // most)
        return chunks(self.count, -(-self.count // parts))


_CHUNK = 1024
"""Windows times directions that are simulated side by side."""
_LOST = 1e3
"""Difference, in units of noise, that a window counts as that diverged."""


def _with_friction_rows(model: mujoco.MjModel, parameters: ParameterSet) -> mujoco.MjModel:
    """Return a copy that has dry friction wherever it is a parameter: MJX leaves out what has none when it begins."""
    model = copy.copy(model)
    for field, places in (
        (model.dof_frictionloss, parameters.rubbing_dofs),
        (model.tendon_frictionloss, parameters.rubbing_tendons),
    ):
        field[places] = np.maximum(field[places], LEAST_FRICTION)
    return model


def _differing(models: Sequence[mjx.Model], names: Sequence[str]) -> tuple[tuple[str, ...], list[np.ndarray]]:
    """Return the fields in which models differ, and their values, stacked.

    **Raises** `InputError` where they differ in structure.
    """
    fields, values = [], []
    for field in dataclasses.fields(models[0]):  # pyright: ignore
        own = [getattr(model, field.name) for model in models]
        if isinstance(own[0], jax.Array):
            if any(x.shape != own[0].shape for x in own):
                wrong = next(n for x, n in zip(own, names, strict=True) if x.shape != own[0].shape)
                raise InputError(f"{wrong}: its model differs from {names[0]}'s in structure; give models alike.")
            stacked = np.stack([np.asarray(x) for x in own])
            if np.any(stacked != stacked[:1]):
                fields.append(field.name)
                values.append(stacked)
    return tuple(fields), values
