"""Additional capture noise on a recording, from which the noise floor of errors follows."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from ballu_mjx.recordings.filters import sign_continuous
from ballu_mjx.recordings.motion import ReconstructionParameters
from ballu_mjx.recordings.recording import Recording


def add_capture_noise(
    recording: Recording, model: mujoco.MjModel, parameters: ReconstructionParameters | None = None, seed: int = 0
) -> Recording:
    """Return `recording` with additional white noise, as large as the measurement noise in `parameters`.

    The noise of joints is that of angles for hinges, and that of positions for slides of the robot's `model`.
    The reconstruction of the result differs from that of the original recording by about as much as noise makes the
    latter differ from the truth.
    """
    parameters = parameters or ReconstructionParameters()
    rng = np.random.default_rng(seed)

    def noisy(values: np.ndarray, spread: float) -> np.ndarray:
        return values + spread * rng.normal(size=values.shape)

    def noisy_rotation(values: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(noisy(np.zeros((len(values), 3)), parameters.rotation_noise))
        return sign_continuous((turn * Rotation.from_quat(values, scalar_first=True)).as_quat(scalar_first=True))

    def noisy_joint(name: str, values: np.ndarray) -> np.ndarray:
        slides = model.joint(name).type[0] == mujoco.mjtJoint.mjJNT_SLIDE
        return noisy(values, parameters.position_noise if slides else parameters.joint_noise)

    position, quaternion = recording.tracked_position, recording.tracked_quaternion
    return dataclasses.replace(
        recording,
        tracked_position=None if position is None else noisy(position, parameters.position_noise),
        tracked_quaternion=None if quaternion is None else noisy_rotation(quaternion),
        points={name: noisy(place, parameters.position_noise) for name, place in recording.points.items()},
        orientations={name: noisy_rotation(each) for name, each in recording.orientations.items()},
        joint_angles={name: noisy_joint(name, each) for name, each in recording.joint_angles.items()},
    )
