"""Recordings in the form that identification takes: states at samples, commands at physics steps, and their noise."""

from __future__ import annotations

import dataclasses
from functools import partial

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.filters import interpolate, mean_command, noise_gain, odd_window, savitzky_golay, unwound
from ballu_mjx.recordings.motion import Motion, ReconstructionParameters
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.coordinates import translations


def check_sampling_config(config: SamplingConfig) -> None:
    """Check that all options are above 0 and finite.

    **Raises** `InputError` naming the option.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if not 0 < value < np.inf:
            raise InputError(f"--{field.name.replace('_', '-')} is {value}: it must be above 0.")


@dataclasses.dataclass(frozen=True)
class SamplingConfig:
    """Sampling of recordings, and noise of their measurements."""

    sample_timestep: float = 0.02
    """Time between two compared samples (s), rounded to physics steps."""
    angle_noise: float = float(np.deg2rad(0.3))
    """Standard deviation of a recorded joint angle (rad)."""
    slide_noise: float = 5e-4
    """Standard deviation of a recorded displacement of a slide (m)."""
    position_window: float = 0.09
    """Width of the Savitzky-Golay filter for starting positions (s)."""
    rate_window: float = 0.19
    """Width of the Savitzky-Golay filter for velocities (s)."""
    order: int = 3
    """Order of the filters' polynomials."""


@dataclasses.dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """A recording in the form that identification takes: states at samples, their noise, commands at physics steps."""

    name: str
    model: mujoco.MjModel
    """Model of the robot as it was recorded. Models in one fit may differ in values (a load), but not in structure."""
    every: int
    """Physics steps between two samples."""
    commands: Float[np.ndarray, "steps commands"]
    """Commands at each physics step, in the actuators' units."""
    qpos: Float[np.ndarray, "samples nq"]
    """Measured generalized positions."""
    start_qpos: Float[np.ndarray, "samples nq"]
    """Smoothed generalized positions, for starting states."""
    qvel: Float[np.ndarray, "samples nv"]
    """Generalized velocities."""
    position_noise: Float[np.ndarray, " nv"]
    """Standard deviations of positions, in the coordinates of generalized velocities (m, rad)."""
    velocity_noise: Float[np.ndarray, " nv"]
    """Standard deviations of generalized velocities (m/s, rad/s)."""

    @property
    def sample_timestep(self) -> float:
        """Return the time between two samples (s)."""
        return self.every * float(self.model.opt.timestep)


def measure(
    recording: Recording, robot: RobotDescription, model: mujoco.MjModel, config: SamplingConfig | None = None
) -> MeasuredMotion:
    """Return a recording of all joints of an anchored robot, in the form that identification takes.

    The noise of velocities is the standard deviation of the difference between filters of the full and of half the
    width. It contains the noise that the narrow filter passes and the motion that the wide filter removes. It is not
    below the noise of angles that the wide filter passes: with few samples, both filters have the same width.

    **Raises** `InputError` naming a joint that was not recorded, or a recording that is too short.
    """
    config = config or SamplingConfig()
    if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
        raise InputError(
            f"{recording.name}: {robot.name} has a free joint; reconstruct its motion, or use a model without it."
        )
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
    counted = [unwound(model, joint, recording.joint_angles[joint]) for joint in joints]
    angles = interpolate(grid, time, np.stack(counted, axis=1))
    filtered = partial(savitzky_golay, angles, step=sample / fine, order=config.order)
    rates, narrow = (filtered(width, derivative=1) for width in (config.rate_window, config.rate_window / 2))
    window = odd_window(config.rate_window, sample / fine, config.order, len(grid))
    noise = np.where(translations(model), config.slide_noise, config.angle_noise)
    passed = noise * noise_gain(window, config.order, sample / fine, derivative=1)
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
        position_noise=noise,
        velocity_noise=np.maximum(uncertainty, passed),
    )


def held_motion(
    recording: Recording, robot: RobotDescription, model: mujoco.MjModel, config: SamplingConfig | None = None
) -> Motion:
    """Return the states of a recording of all joints of an anchored robot, at control steps.

    The result has the fields that `reconstruct` returns for free recordings, except distances to measured positions.

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
        fit_error_mm={},
        interpolated=dict(recording.interpolated),
        robot=recording.robot,
        joints=robot.joints,
    )


_SURE = 1e-3
"""Smallest noise of a velocity, relative to the standard deviation of that velocity."""


def measured_from_motion(
    motion: Motion,
    model: mujoco.MjModel,
    parameters: ReconstructionParameters | None = None,
    velocity_noise: tuple[float, float, float] = (0.02, 0.1, 0.2),
) -> MeasuredMotion:
    """Return a reconstructed motion (of any robot, at control steps) in the form that identification takes.

    **Arguments**

    - `velocity_noise`: standard deviations of a free joint's linear velocity (m/s), of its angular velocity (rad/s),
      and of the other joints' velocities (rad/s, m/s).
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
        position_noise=np.where(translations(model), parameters.position_noise, positions[kinds]),
        velocity_noise=np.array(velocity_noise)[kinds],
    )
