"""Noise again: a recording with as much capture noise added as it has already, for the noise floor of errors."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from ballu_mjx.recordings.filters import sign_continuous
from ballu_mjx.recordings.motion import ReconstructionParameters
from ballu_mjx.recordings.recording import Recording


def add_capture_noise(
    recording: Recording, parameters: ReconstructionParameters | None = None, seed: int = 0
) -> Recording:
    """`recording` with as much white noise again as `parameters` say that its measurements have.

    Reconstructed, it is off from the original by as much as the original is from the truth, as far as noise goes.
    """
    parameters = parameters or ReconstructionParameters()
    rng = np.random.default_rng(seed)

    def shaken(values: np.ndarray, spread: float) -> np.ndarray:
        return values + spread * rng.normal(size=values.shape)

    def turned(values: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(shaken(np.zeros((len(values), 3)), parameters.rotation_noise))
        return sign_continuous((turn * Rotation.from_quat(values, scalar_first=True)).as_quat(scalar_first=True))

    position, quaternion = recording.tracked_position, recording.tracked_quaternion
    return dataclasses.replace(
        recording,
        tracked_position=None if position is None else shaken(position, parameters.position_noise),
        tracked_quaternion=None if quaternion is None else turned(quaternion),
        points={name: shaken(place, parameters.position_noise) for name, place in recording.points.items()},
        orientations={name: turned(each) for name, each in recording.orientations.items()},
        joint_angles={name: shaken(angle, parameters.joint_noise) for name, angle in recording.joint_angles.items()},
    )
