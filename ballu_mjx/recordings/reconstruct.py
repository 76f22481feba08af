"""From a recording to generalized states at the control rate, for robots of any build.

Positions are a least-squares inverse kinematics over all joints at once, sample after sample, each from where the last
one ended; velocities a centred Savitzky-Golay derivative. Joints that no measurement shows are refused. What only BALLU
has, a base that hardly shows its pitch and servos behind cables, is `reconstruction.py`'s.
"""

from __future__ import annotations

import functools

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.reconstruct import reconstruct_ballu
from ballu_mjx.recordings.filters import (
    control_grid,
    interpolate,
    mean_command,
    savitzky_golay,
    sign_continuous,
    smooth_rotation,
)
from ballu_mjx.recordings.inverse_kinematics import MeasurementGrid, solve_inverse_kinematics
from ballu_mjx.recordings.motion import Motion, ReconstructionParameters
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import CONTROL_TIMESTEP


def reconstruct(
    recording: Recording,
    model: mujoco.MjModel,
    robot: RobotDescription,
    parameters: ReconstructionParameters | None = None,
) -> Motion:
    """States and commands at the control rate from a free recording; see `reconstruct.reconstruct_ballu`, which does it
    for robots built like BALLU.

    **Raises** `InputError` where measurements leave a joint open, or do not fit the model.
    """
    if robot.is_ballu:
        return reconstruct_ballu(recording, model, parameters)
    parameters = parameters or ReconstructionParameters()
    grid = _resample(recording, robot)
    fitted, distance = solve_inverse_kinematics(model, robot, grid, parameters, recording.name)
    qpos, qvel = _differentiate(fitted, grid.step, robot.anchored, parameters)
    # A semi-implicit integrator's velocity is the mean over the time step that led to the position.
    qvel -= np.gradient(qvel, grid.step, axis=0) * model.opt.timestep / 2
    states = slice(None, None, grid.samples_per_step)
    edges = np.arange(len(qpos[states])) * CONTROL_TIMESTEP
    return Motion(
        name=recording.name,
        time=edges,
        command=mean_command(recording, edges),
        qpos=qpos[states],
        qvel=qvel[states],
        residual_mm=distance,
        interpolated=dict(recording.interpolated),
        robot=recording.robot,
    )


def _resample(recording: Recording, robot: RobotDescription) -> MeasurementGrid:
    assert recording.balloon_position is not None and recording.balloon_quaternion is not None
    per_step, grid = control_grid(recording)
    time = recording.time - recording.time[0]

    linear = functools.partial(interpolate, grid, time)
    quaternion = linear(recording.balloon_quaternion)
    return MeasurementGrid(
        step=CONTROL_TIMESTEP / per_step,
        samples_per_step=per_step,
        places=linear(np.stack([recording.balloon_position, *(recording.points[p] for p in robot.points)], axis=1)),
        quaternion=quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        angles={name: linear(value) for name, value in recording.angles.items()},
    )


def _differentiate(
    qpos: Float[np.ndarray, "T nq"], step: float, anchored: bool, parameters: ReconstructionParameters
) -> tuple[Float[np.ndarray, "T nq"], Float[np.ndarray, "T nv"]]:
    """Smoothed generalized positions and their velocities at the same instants, in MuJoCo's conventions."""
    order = parameters.order
    narrow, wide, rotation = parameters.position_window, parameters.rate_window, parameters.rotation_window
    smooth = savitzky_golay(qpos, narrow, step, order, 0)
    rates = savitzky_golay(qpos, wide, step, order, 1)
    if anchored:
        return smooth, rates
    quaternion = sign_continuous(qpos[:, 3:7])
    turned, angular = smooth_rotation(quaternion, rotation, step, order)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return (
        np.concatenate([smooth[:, :3], turned, smooth[:, 7:]], axis=1),
        np.concatenate([rates[:, :3], angular, rates[:, 7:]], axis=1),
    )
