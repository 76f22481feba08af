"""Reconstruction of simulator states at the control rate from a recording, for any robot.

1. Measurements are interpolated on a uniform grid, at about their own rate. The control grid is a subset of it.
2. Positions follow from least-squares inverse kinematics over all joints at once (`inverse_kinematics`). A joint that
   no measurement shows is an error.
3. The robot's adapter refines positions that single samples determine badly
   (`recording_hooks.RecordingHooks.complete_positions`).
4. Velocities follow from a centred (hence lag-free) Savitzky-Golay differentiator. Its window is widest for the tracked
   body's rotation, whose rates matter most to a simulation that starts from the state.
5. The adapter fills in joints that follow from the commands (`complete_joints`).
"""

from __future__ import annotations

import dataclasses
import functools

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ballu_mjx.common.rotations import quaternion_to_matrix
from ballu_mjx.recordings.filters import (
    control_grid,
    interpolate,
    mean_command,
    savitzky_golay,
    sign_continuous,
    smooth_rotation,
    unwound,
)
from ballu_mjx.recordings.inverse_kinematics import solve_inverse_kinematics
from ballu_mjx.recordings.kinematic_tree import KinematicTree
from ballu_mjx.recordings.motion import MeasurementGrid, Motion, ReconstructionParameters
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.recordings.recording_hooks import hooks_of
from ballu_mjx.recordings.validation import check_complete
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.drivetrain import DrivetrainParameters, count_slots, filter_commands
from ballu_mjx.sim.simulator import Simulator

_STOP_TOLERANCE = {False: float(np.deg2rad(0.5)), True: 5e-4}
"""Distance by which a hinge (False, rad) or a slide (True, m) may exceed its range. Stops are soft, and springs press
joints into them."""
_OVERSHOOT = {False: 0.05, True: 5e-3}
"""Largest distance beyond the range that noise and filters explain, for a hinge (False, rad) or a slide (True, m).
Joints farther beyond their range keep their fitted values."""


def reconstruct(
    recording: Recording,
    robot: RobotDescription,
    model: mujoco.MjModel | None = None,
    parameters: ReconstructionParameters | None = None,
    drivetrain: DrivetrainParameters | None = None,
) -> Motion:
    """Return states and commands at the control rate from a free recording.

    **Arguments**

    - `recording`: a free recording without missing values, as `csv_format.read_recording` returns it.
    - `model`: the model to be simulated from these states, for example with identified actuators. None for the nominal
      model.
    - `parameters`: noise and filters. The defaults suit motion capture with noise of 0.5 mm and 0.3 deg.
    - `drivetrain`: parameters of the drivetrain (delay, lag, backlash) between commands and actuators. Joints that
      follow from the commands are computed from its output. None if there is no drivetrain.

    **Raises** `InputError` if the measurements do not determine a joint or do not fit the model, if a value is missing,
    and for a recording shorter than two control steps. **Raises** `ValueError` for a suspended recording.
    """
    parameters, hooks = parameters or ReconstructionParameters(), hooks_of(robot)
    simulated = robot.load_model() if model is None else model
    grid = resample(recording, simulated, robot)
    fit, distance = solve_inverse_kinematics(simulated, robot, grid, parameters, recording.name)
    qpos, qvel = differentiate(fit.qpos, simulated, robot, grid.step, parameters)
    # A semi-implicit integrator's velocity is the mean over the physics step before the position.
    qvel -= np.gradient(qvel, grid.step, axis=0) * simulated.opt.timestep / 2
    _keep_ranges(simulated, qpos)
    qpos, qvel = hooks.complete_joints(simulated, _driven(grid, drivetrain), qpos, qvel)
    states = slice(None, None, grid.samples_per_step)
    edges = np.arange(len(qpos[states])) * robot.control_timestep
    return Motion(
        name=recording.name,
        time=edges,
        command=mean_command(recording, edges),
        qpos=qpos[states],
        qvel=qvel[states],
        fit_error_mm=distance,
        interpolated=dict(recording.interpolated),
        robot=recording.robot,
        joints=tuple(recording.joint_angles),
        uncertainty=fit.uncertainty,
    )


def reconstruct_for_simulator(recording: Recording, simulator: Simulator) -> Motion:
    """Return states from which `simulator` follows a recording: `reconstruct` with its model and drivetrain.

    **Raises** as `reconstruct` does.
    """
    return reconstruct(recording, simulator.robot, simulator.mj_model, drivetrain=simulator.drivetrain)


def _driven(grid: MeasurementGrid, drivetrain: DrivetrainParameters | None) -> MeasurementGrid:
    """Return the measurements with commands replaced by the drivetrain's output."""
    if drivetrain is None:
        return grid
    slots = count_slots(float(np.max(drivetrain.delay)), grid.step)
    arrived = filter_commands(drivetrain, jnp.asarray(grid.command, jnp.float32), grid.step, slots)
    return dataclasses.replace(grid, command=np.asarray(arrived, float))


def resample(recording: Recording, model: mujoco.MjModel, robot: RobotDescription) -> MeasurementGrid:
    """Return the measurements at uniform times, interpolated linearly.

    A spline would overshoot where jitter brings noisy samples close together.

    **Raises** `ValueError` for a suspended recording. **Raises** `InputError` from `check_complete`, and for one
    shorter than two control steps.
    """
    position, quaternion = recording.tracked_position, recording.tracked_quaternion
    if recording.kind != "free" or position is None or quaternion is None:
        raise ValueError(f"{recording.name}: a suspended recording has no motion to reconstruct; give a free one.")
    check_complete(recording, robot)
    per_step, grid = control_grid(recording, robot.control_timestep)
    linear = functools.partial(interpolate, grid, recording.time - recording.time[0])

    def unit(values: np.ndarray) -> np.ndarray:
        values = linear(values)
        return values / np.linalg.norm(values, axis=1, keepdims=True)

    command = mean_command(recording, grid)
    return MeasurementGrid(
        step=robot.control_timestep / per_step,
        samples_per_step=per_step,
        command=np.concatenate([command, command[-1:]]),
        positions={robot.tracked: linear(position)}
        | {point: linear(recording.points[point]) for point in robot.points},
        orientations={robot.tracked: unit(quaternion)}
        | {point: unit(value) for point, value in recording.orientations.items()},
        joint_angles={joint: linear(unwound(model, joint, value)) for joint, value in recording.joint_angles.items()},
    )


def differentiate(
    qpos: Float[np.ndarray, "T nq"],
    model: mujoco.MjModel,
    robot: RobotDescription,
    step: float,
    parameters: ReconstructionParameters,
) -> tuple[Float[np.ndarray, "T nq"], Float[np.ndarray, "T nv"]]:
    """Return smoothed generalized positions and their velocities at the same instants, in MuJoCo's conventions.

    The positions `qpos` are `step` (s) apart. The filters act on the root's position, the tracked body's orientation
    and all joints. If the root is not the tracked body, its orientation follows from that of the tracked body and the
    joints between them.
    """
    order = parameters.order
    smooth = savitzky_golay(qpos, parameters.position_window, step, order, 0)
    rates = savitzky_golay(qpos, parameters.rate_window, step, order, 1)
    if robot.anchored:
        return smooth, rates
    body = int(model.site_bodyid[model.site(robot.tracked).id])
    tree = KinematicTree(model, [], [body])
    relative, _ = _from_root(tree, qpos)
    tracked = _to_quaternions(quaternion_to_matrix(qpos[:, 3:7]) @ relative)
    quaternion, angular = smooth_rotation(sign_continuous(tracked), parameters.rotation_window, step, order)
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    relative, jacobian = _from_root(tree, smooth)
    root = _to_quaternions(quaternion_to_matrix(quaternion) @ relative.transpose(0, 2, 1))
    turning = (jacobian[:, :, 6:] @ rates[:, 7:, None])[..., 0]
    angular = (relative @ angular[..., None])[..., 0] - turning
    return (
        np.concatenate([smooth[:, :3], sign_continuous(root), smooth[:, 7:]], axis=1),
        np.concatenate([rates[:, :3], angular, rates[:, 7:]], axis=1),
    )


def _from_root(
    tree: KinematicTree, qpos: Float[np.ndarray, "T nq"]
) -> tuple[Float[np.ndarray, "T 3 3"], Float[np.ndarray, "T 3 nv"]]:
    """Return the tracked body's orientation in the root's frame, and its rotational Jacobian there."""
    placed = np.concatenate([np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(qpos), 1)), qpos[:, 7:]], axis=1)
    poses = tree.pose(placed)
    return poses.rotations[0], tree.rotation_jacobian(poses, 0)


def _to_quaternions(matrices: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, "T 4"]:
    return Rotation.from_matrix(matrices).as_quat(scalar_first=True)


def _keep_ranges(model: mujoco.MjModel, qpos: Float[np.ndarray, "T nq"]) -> None:
    """Move joints that are slightly beyond their ranges back to them, in place."""
    for joint in np.flatnonzero(model.jnt_limited):
        slides = bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)
        angle, (low, high) = qpos[:, model.jnt_qposadr[joint]], model.jnt_range[joint]
        kept = np.clip(angle, low - _STOP_TOLERANCE[slides], high + _STOP_TOLERANCE[slides])
        beyond = np.abs(angle - np.clip(angle, low, high)) > _OVERSHOOT[slides]
        qpos[:, model.jnt_qposadr[joint]] = np.where(beyond, angle, kept)
