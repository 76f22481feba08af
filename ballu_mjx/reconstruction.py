"""From a recording to the robot's full generalized state at the control rate.

Positions come from a batched least-squares inverse kinematics over MJX's forward kinematics, velocities from a
centred (hence lag-free) Savitzky-Golay differentiator, motor angles from the model's own servo where the recording
has no motor columns. The base's pitch, which the markers hardly show, is fused with the base's torque balance.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optimistix as optx
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Array, Float
from mujoco import mjx
from scipy.signal import savgol_filter

from ballu_mjx.recording import Recording
from ballu_mjx.robot import CABLE_SLACK, CONTROL_TIMESTEP, HIPS, KNEES, MOTORS, SERVO_RANGE, SIDES

_CHUNK = 512
"""Samples per compiled call: recordings of any length share one program."""
_SERVO_SUBSTEP = 1e-3
"""Longest step (s) of the servo's simulation; its fastest time constant is about 9 ms."""
_UNKNOWNS = np.r_[0:6, 6, 7, 8, 10, 11]
"""Degrees of freedom that markers can show: all but the motors (places in `qvel`)."""


@dataclasses.dataclass(frozen=True)
class ReconstructionParameters:
    """Noise levels that weigh the measurements, and the filters' windows.

    **Fields**

    - `position_noise`: standard deviation (m) of a marker group's position, per axis.
    - `rotation_noise`: standard deviation (rad) of a measured orientation, per axis.
    - `joint_noise`: standard deviation (rad) of measured knee angles.
    - `pitch_prior`: standard deviation (rad) of the base's pitch about the balloon's, used per sample.
    - `torque_noise`: standard deviation (N m) of the base's torque balance, per sample at 100 Hz.
    - `window`: width (s) of the Savitzky-Golay filter for joints.
    - `window_slow`: the same for the base's position, orientation.
    - `order`: order of its polynomial.
    """

    position_noise: float = 5e-4
    rotation_noise: float = float(np.deg2rad(0.3))
    joint_noise: float = float(np.deg2rad(0.3))
    pitch_prior: float = float(np.deg2rad(20.0))
    torque_noise: float = 1e-3
    window: float = 0.09
    window_slow: float = 0.09
    order: int = 3
    clip: bool = True


@dataclasses.dataclass(frozen=True)
class Motion:
    """A recording as the simulator's states and commands at the control rate.

    A simulator set to `(qpos[k], qvel[k])` and driven by `command[k]` goes from `time[k]` to `time[k + 1]`.

    **Fields**

    - `name`: the recording's.
    - `time`: s, from 0, steps of `CONTROL_TIMESTEP`.
    - `command`: mean of the held command (left, right) in [0, 1] over each control step.
    - `qpos`, `qvel`: MuJoCo's generalized position and velocity; of the free joint, the linear velocity is in the
      world's frame and the angular one in the body's.
    - `residual_mm`: root-mean-square distance (mm) between measured and fitted positions, by marker group
      (`balloon`, `base`, `feet`).
    - `pitch_deviation`: estimated standard deviation (rad) of the base's pitch about its fit, a sample before
      smoothing, averaged; large where the recording has no base orientation.
    - `interpolated`: samples that the recording's reader filled in, by column.
    """

    name: str
    time: Float[np.ndarray, " states"]
    command: Float[np.ndarray, "steps 2"]
    qpos: Float[np.ndarray, "states nq"]
    qvel: Float[np.ndarray, "states nv"]
    residual_mm: dict[str, float]
    pitch_deviation: float
    interpolated: dict[str, int]
