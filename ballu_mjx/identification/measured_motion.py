"""Recordings as identification takes them: states at samples, commands at physics steps, and their noise."""

from __future__ import annotations

import dataclasses
from functools import partial

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.filters import interpolate, mean_command, savitzky_golay
from ballu_mjx.recordings.motion import Motion, ReconstructionParameters
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription


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
