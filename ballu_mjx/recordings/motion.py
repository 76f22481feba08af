"""Recordings as simulator states at the control rate (motions), and the parameters of their reconstruction."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.robots.description import RobotDescription


@dataclasses.dataclass(frozen=True)
class ReconstructionParameters:
    """Measurement noise, which weighs the measurements, and widths of the filters.

    The widths were chosen on noisy recordings of the nominal BALLU (`benchmarks/inverse_kinematics.py`). The
    criterion was the error of a simulation that starts from the reconstructed states. Velocity errors harm it far more
    than position errors.
    """

    position_noise: float = 5e-4
    """Standard deviation (m) of a measured position, per axis."""
    rotation_noise: float = float(np.deg2rad(0.3))
    """Standard deviation (rad) of a measured orientation, per axis."""
    joint_noise: float = float(np.deg2rad(0.3))
    """Standard deviation (rad) of a measured joint angle. A slide has `position_noise`."""
    position_window: float = 0.09
    """Width (s) of the Savitzky-Golay filter of the root's position and of all joints."""
    rate_window: float = 0.19
    """Width (s) of the filter of their velocities. The root and all joints share it, so that a point in contact with
    the ground has zero velocity. A narrower filter follows sudden stops better, but velocity noise does more harm."""
    rotation_window: float = 0.31
    """Width (s) of the filter of the tracked body's orientation and angular velocity."""
    order: int = 3
    """Polynomial order of the filters."""


@dataclasses.dataclass(frozen=True, eq=False)
class MeasurementGrid:
    """Measurements of a free recording at uniform times from 0."""

    step: float
    """Time (s) between samples."""
    samples_per_step: int
    """Number of samples per control step."""
    command: Float[np.ndarray, "T commands"]
    """Mean of the held commands until the next sample, in the actuators' units."""
    positions: Mapping[str, Float[np.ndarray, "T 3"]]
    """Positions (m) by site, the tracked one first."""
    orientations: Mapping[str, Float[np.ndarray, "T 4"]]
    """Orientations (w, x, y, z) by site, the tracked one first."""
    joint_angles: Mapping[str, Float[np.ndarray, " T"]]
    """Joint angles (rad) or displacements (m) by joint, without jumps where the recording counts turns from 0 again."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """A recording as states and commands at the control rate.

    A simulator set to `(qpos[k], qvel[k])` and driven by `command[k]` moves from `time[k]` to `time[k + 1]`.
    """

    name: str
    """Name of the recording."""
    time: Float[np.ndarray, " states"]
    """Times (s) from 0, one control step apart. There is one more than commands."""
    command: Float[np.ndarray, "steps commands"]
    """Mean of the held commands over each control step, in the actuators' units."""
    qpos: Float[np.ndarray, "states nq"]
    """MuJoCo's generalized positions (m, unit quaternion w x y z, rad)."""
    qvel: Float[np.ndarray, "states nv"]
    """MuJoCo's generalized velocities. The free joint's linear velocity is in the world frame, its angular one in the
    body frame."""
    fit_error_mm: Mapping[str, float]
    """RMS distance (mm) between measured and fitted positions before smoothing, by site."""
    interpolated: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Number of samples that were interpolated when the recording was read, by column."""
    robot: str = ""
    """Robot that was recorded."""
    joints: tuple[str, ...] = ()
    """Joints whose positions were recorded. Others are inferred."""
    uncertainty: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Uncertainties that the robot's adapter reports for its part of the reconstruction, by name."""


def measured_hinges(robot: RobotDescription, model: mujoco.MjModel, motion: Motion) -> dict[str, int]:
    """Return the indices in `qpos` of the hinges whose angles are recorded, by name. Held joints are left out."""
    found = {name: model.joint(name) for name in robot.joints if name in motion.joints and name not in robot.held}
    return {
        name: int(joint.qposadr[0]) for name, joint in found.items() if joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE
    }
