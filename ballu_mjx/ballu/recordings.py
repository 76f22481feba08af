"""BALLU's recordings: pairs (left, right) instead of single sites and joints, and checks that only BALLU needs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.model import SIDES
from ballu_mjx.recordings.recording import Kind, Recording
from ballu_mjx.recordings.validation import refuse_recording

FOOT_RADIUS = 0.004
"""Radius (m) of the model's foot spheres, and thus the height of their centres when they touch the floor."""
_FLOOR_TOLERANCE = 0.1
"""Largest distance (m) of the feet's lowest height from 0."""
_SMALLEST_STANCE = 0.02
"""Smallest lateral distance (m) between the feet at the start."""


# ---- pairs ----


def base_position(recording: Recording) -> Float[np.ndarray, "T 3"] | None:
    """Return the base's positions (m), or None if they are not recorded."""
    return recording.points.get("base")


def foot_position(recording: Recording) -> Float[np.ndarray, "T 2 3"] | None:
    """Return the feet's positions (m), (left, right), or None if one of them is not recorded."""
    feet = [recording.points.get(f"foot_{side}") for side in SIDES]
    return None if any(foot is None for foot in feet) else np.stack([np.asarray(foot) for foot in feet], axis=1)


def motor(recording: Recording) -> Float[np.ndarray, "T 2"] | None:
    """Return the motors' angles (rad), (left, right), or None if one of them is not recorded."""
    return _pair(recording, "motor")


def knee(recording: Recording) -> Float[np.ndarray, "T 2"] | None:
    """Return the knees' angles (rad), (left, right), or None if one of them is not recorded."""
    return _pair(recording, "knee")


def make_recording(
    *,
    name: str,
    kind: Kind,
    robot: str,
    time: Float[np.ndarray, " T"],
    command: Float[np.ndarray, "T 2"],
    notes: str = "",
    balloon_position: Float[np.ndarray, "T 3"] | None = None,
    balloon_quaternion: Float[np.ndarray, "T 4"] | None = None,
    base_position: Float[np.ndarray, "T 3"] | None = None,
    base_quaternion: Float[np.ndarray, "T 4"] | None = None,
    foot_position: Float[np.ndarray, "T 2 3"] | None = None,
    motor: Float[np.ndarray, "T 2"] | None = None,
    knee: Float[np.ndarray, "T 2"] | None = None,
) -> Recording:
    """Return a recording of BALLU from pairs (left, right). Arguments that are None are not recorded."""
    points = {} if base_position is None else {"base": base_position}
    if foot_position is not None:
        points |= {f"foot_{side}": foot_position[:, i] for i, side in enumerate(SIDES)}
    joints = {"motor": motor, "knee": knee}
    return Recording(
        name=name,
        kind=kind,
        robot=robot,
        notes=notes,
        time=time,
        command=command,
        tracked_position=balloon_position,
        tracked_quaternion=balloon_quaternion,
        points=points,
        orientations={} if base_quaternion is None else {"base": base_quaternion},
        joint_angles={
            f"{joint}_{side}": pair[:, i]
            for joint, pair in joints.items()
            if pair is not None
            for i, side in enumerate(SIDES)
        },
    )


def _pair(recording: Recording, joint: str) -> Float[np.ndarray, "T 2"] | None:
    angles: list[Any] = [recording.joint_angles.get(f"{joint}_{side}") for side in SIDES]
    return None if any(angle is None for angle in angles) else np.stack(angles, axis=1)


# ---- checks ----


def check_recording(path: Path, recording: Recording) -> None:
    """Refuse a recording that has only one of the two knees or motors, or a free recording in a wrong frame.

    At the start of a free recording, x must point forward, y left and z up, with the robot on a floor at z = 0. Only
    clear deviations are refused.

    **Raises** `InputError` that names the file, the column, the row and the fix.
    """
    for joint in ("motor", "knee"):
        have = [side for side in SIDES if f"{joint}_{side}" in recording.joint_angles]
        if len(have) == 1:
            (missing,) = set(SIDES) - set(have)
            fix = f"add it or delete {joint}_{have[0]}"
            refuse_recording(path, "the column is missing", fix, column=f"{joint}_{missing}", row=-1)
    if recording.kind == "free":
        _check_frame(path, recording)


def _check_frame(path: Path, recording: Recording) -> None:
    """Refuse a recording that at its start is clearly not in the frame that `check_recording` describes."""
    balloon, quaternion = recording.tracked_position, recording.tracked_quaternion
    base, feet = base_position(recording), foot_position(recording)
    assert balloon is not None and quaternion is not None and base is not None and feet is not None
    row = recording.trimmed[0]
    if not balloon[0, 2] > base[0, 2] > feet[0, :, 2].max():
        column = "balloon_z" if balloon[0, 2] <= base[0, 2] else "base_z"
        problem = "at the start the balloon is not above the base, or the base is not above the feet"
        refuse_recording(path, problem, "put the axes in the order x forward, y left, z up", column=column, row=row)
    lowest = feet[:, :, 2].min(axis=0)
    if abs(lowest.min()) > _FLOOR_TOLERANCE:
        side = int(lowest.argmin())
        problem = f"the lowest height of the feet is {lowest[side]:.3g} m and not that of the floor, 0"
        sample = row + int(feet[:, side, 2].argmin())
        column = f"foot_{SIDES[side]}_z"
        fix = "put the origin of the frame on the floor, or import with floor = 'feet' in the mapping file"
        refuse_recording(path, problem, fix, column=column, row=sample)
    rotation = Rotation.from_quat(quaternion[0], scalar_first=True).as_matrix()
    if rotation[2, 2] < 0 or rotation[0, 0] < 0:
        problem = "at the start the balloon is not upright, or it does not face along x"
        fix = "write the quaternion in w, x, y, z order, in a frame with x forward, y left, z up"
        refuse_recording(path, problem, fix, column="balloon_qw", row=row)
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    apart = feet[0, 0] - feet[0, 1]
    if apart @ np.array([-np.sin(yaw), np.cos(yaw), 0.0]) < _SMALLEST_STANCE:
        problem = "at the start the left foot is not to the left of the right one, seen along the balloon's x"
        fix = "swap the feet, or fix the frame: x forward, y left"
        refuse_recording(path, problem, fix, column="foot_left_y", row=row)
