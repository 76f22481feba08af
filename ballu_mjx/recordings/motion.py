"""A recording as simulator states at the control rate, and the noise that is assumed of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ballu_mjx.recordings.filters import sign_continuous
from ballu_mjx.recordings.recording import Recording


@dataclasses.dataclass(frozen=True)
class ReconstructionParameters:
    """Noise that weighs the measurements, and widths of the filters.

    The widths were chosen on noisy recordings of the nominal robot by how far a simulator, started from the states
    found, goes astray (`benchmarks/inverse_kinematics.py`). Errors of velocity cost far more than those of position.
    """

    position_noise: float = 5e-4
    """Standard deviation (m) of a measured position, per axis."""
    rotation_noise: float = float(np.deg2rad(0.3))
    """Standard deviation (rad) of a measured orientation, per axis."""
    joint_noise: float = float(np.deg2rad(0.3))
    """Standard deviation (rad) of a measured knee angle."""
    pitch_prior: float = float(np.deg2rad(60.0))
    """Standard deviation (rad) of the base's pitch about the balloon's: keeps a single sample's problem well posed."""
    torque_noise: float = 1e-3
    """Standard deviation (N m) of the base's torque balance, a sample at 100 Hz; 1 deg of pitch is 2e-4 N m."""
    position_window: float = 0.09
    """Width (s) of the Savitzky-Golay filter for the base's place and all hinges."""
    rate_window: float = 0.19
    """The same for their velocities. One width for base and legs, so that a standing foot's velocity comes out as 0.
    Wider than what follows a knee's sudden stops best: noise in a velocity does the simulator more harm."""
    rotation_window: float = 0.31
    """The same for the balloon's orientation and its rate."""
    force_window: float = 0.15
    """The same for the accelerations in the base's torque balance."""
    order: int = 3
    """Order of the filters' polynomials."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """A recording as states and commands at the control rate.

    A simulator set to `(qpos[k], qvel[k])` and driven by `command[k]` goes from `time[k]` to `time[k + 1]`.
    """

    name: str
    """The recording's."""
    time: Float[np.ndarray, " states"]
    """s, from 0 in steps of `CONTROL_TIMESTEP`; one more entry than commands."""
    command: Float[np.ndarray, "steps commands"]
    """Mean over each control step of the held commands, (left, right) for BALLU, in [0, 1]."""
    qpos: Float[np.ndarray, "states nq"]
    """MuJoCo's generalized positions (m, unit quaternion w x y z, rad)."""
    qvel: Float[np.ndarray, "states nv"]
    """MuJoCo's generalized velocities; the free joint's linear one in the world's frame, the angular in the body's."""
    residual_mm: Mapping[str, float]
    """Root-mean-square distance (mm) between measured and fitted positions before smoothing: balloon, base, feet."""
    interpolated: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Samples that the recording's reader filled in, by column."""
    robot: str = ""
    """Which robot was recorded."""
    pitch_deviation: float = 0.0
    """Standard deviation (rad) of the base's pitch by the fit's own account. Neck and hips share this error with the
    opposite sign; balloon, legs and feet in the world do not."""


def add_capture_noise(
    recording: Recording, parameters: ReconstructionParameters | None = None, seed: int = 0
) -> Recording:
    """`recording` with as much white noise again as `parameters` say that its measurements have.

    Reconstructed, it is off from the original by as much as the original is from the truth, as far as noise goes.
    """
    parameters = parameters or ReconstructionParameters()
    rng = np.random.default_rng(seed)
    spreads = dict.fromkeys(("balloon_position", "base_position", "foot_position"), parameters.position_noise)
    spreads |= dict.fromkeys(("motor", "knee"), parameters.joint_noise)

    def shaken(values: np.ndarray, spread: float) -> np.ndarray:
        return values + spread * rng.normal(size=values.shape)

    changed: dict[str, Any] = {
        "points": {name: shaken(place, parameters.position_noise) for name, place in recording.points.items()},
        "angles": {name: shaken(angle, parameters.joint_noise) for name, angle in recording.angles.items()},
    }
    for name, spread in spreads.items():
        if (values := getattr(recording, name)) is not None:
            changed[name] = shaken(values, spread)
    for name in ("balloon_quaternion", "base_quaternion"):
        if (values := getattr(recording, name)) is not None:
            turn = Rotation.from_rotvec(shaken(np.zeros((len(values), 3)), parameters.rotation_noise))
            turned = (turn * Rotation.from_quat(values, scalar_first=True)).as_quat(scalar_first=True)
            changed[name] = sign_continuous(turned)
    return dataclasses.replace(recording, **changed)
