"""Conversion of trajectories in a capture's frame to a recording: sites, axes, origin, and commands."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ballu_mjx.recordings.importers.mapping import RoomMapping
from ballu_mjx.recordings.importers.trajectories import Body, Trajectories, refuse
from ballu_mjx.recordings.recording import Recording, cut
from ballu_mjx.recordings.recording_hooks import hooks_of
from ballu_mjx.robots.description import RobotDescription

_START_SAMPLES = 20
"""Number of samples at the start over which `turn = "start"` averages the orientation."""
_LOWEST_PERCENTILE = 1.0
"""Percentile of the heights of the sites on the floor. It is the lowest height without outliers."""


def place(trajectories: Trajectories, mapping: RoomMapping, robot: RobotDescription, name: str) -> Recording:
    """Return the recording of `robot` in `trajectories`, with x forward, y left, z up. Its commands are NaN.

    Positions and orientations are of the model's sites. Orientations change with the axes: a body that is aligned with
    the capture's axes is aligned with the new axes.

    **Raises** `InputError` if a required orientation is missing, or if a site was never seen.
    """
    mapped = {
        site: _site(trajectories, mapping, site, body, needs_orientation=site == robot.tracked)
        for site, body in trajectories.bodies.items()
    }
    for site, source in mapping.sources.items():
        if source.turn == "start":
            mapped[site] = _standing(mapped[site])
    if mapping.kind == "free":
        _to_floor(mapping, mapped, robot)
        if mapping.start:
            _to_start(mapped, robot)
    tracked = mapped.get(robot.tracked)
    return Recording(
        name=name,
        kind=mapping.kind,
        robot=mapping.robot,
        notes=mapping.notes,
        time=trajectories.time,
        command=np.full((len(trajectories.time), len(robot.commands)), np.nan),
        tracked_position=None if tracked is None else tracked.position,
        tracked_quaternion=None if tracked is None else tracked.quaternion,
        points={site: mapped[site].position for site in robot.points if site in mapped},
        orientations={
            site: quaternion
            for site in robot.oriented_points
            if site in mapped and (quaternion := mapped[site].quaternion) is not None
        },
        joint_angles={joint: trajectories.columns[joint] for joint in robot.joints if joint in trajectories.columns},
    )


def _site(trajectories: Trajectories, mapping: RoomMapping, role: str, body: Body, *, needs_orientation: bool) -> Body:
    """Return the trajectory of the model's site on a tracked body, in the new axes."""
    source = mapping.sources[role]
    axes = mapping.axes
    if np.isnan(body.position).all():
        refuse(trajectories.path, "", f"[{role}] was never seen", "fix the mapping or the labels")
    if body.quaternion is None:
        if needs_orientation:
            fix = "name an object or a segment, three or more markers, or columns"
            refuse(mapping.path, f"[{role}]", "its source has no orientation", fix)
        if source.turn == "start" or any(source.turn) or any(source.offset):
            fix = "leave turn and offset out, or name a source with an orientation"
            refuse(mapping.path, f"[{role}]", "its source has no orientation, which turn and offset need", fix)
        return Body(body.position @ axes.T)
    seen = ~np.isnan(body.quaternion).any(axis=1)
    if not seen.any():
        refuse(trajectories.path, "", f"the orientation of [{role}] was never seen", "fix the mapping or the labels")
    turned = Rotation.from_quat(body.quaternion[seen], scalar_first=True)
    position = body.position.copy()
    if any(source.offset):
        position[~seen] = np.nan
        position[seen] += turned.apply(source.offset)
    fixed = Rotation.identity() if source.turn == "start" else Rotation.from_rotvec(source.turn)
    rename = Rotation.from_matrix(axes)
    quaternion = np.full_like(body.quaternion, np.nan)
    quaternion[seen] = (rename * turned * fixed * rename.inv()).as_quat(scalar_first=True)
    return Body(position @ axes.T, quaternion)


def _standing(body: Body) -> Body:
    """Return the body rotated in its own frame so that it is aligned with the recording's axes at the start."""
    assert body.quaternion is not None
    seen = np.flatnonzero(~np.isnan(body.quaternion).any(axis=1))
    turned = Rotation.from_quat(body.quaternion[seen], scalar_first=True)
    quaternion = body.quaternion.copy()
    quaternion[seen] = (turned * turned[:_START_SAMPLES].mean().inv()).as_quat(scalar_first=True)
    return Body(body.position, quaternion)


def _to_floor(mapping: RoomMapping, mapped: dict[str, Body], robot: RobotDescription) -> None:
    """Shift all sites vertically, in place, so that the floor is at height 0."""
    if isinstance(mapping.floor, str):
        standing = hooks_of(robot).floors[mapping.floor]
        heights = np.concatenate([mapped[site].position[:, 2] - above for site, above in standing.items()])
        floor = float(np.nanpercentile(heights, _LOWEST_PERCENTILE))
    else:
        floor = mapping.floor
    for role, body in mapped.items():
        mapped[role] = Body(body.position - [0.0, 0.0, floor], body.quaternion)


def _to_start(mapped: dict[str, Body], robot: RobotDescription) -> None:
    """Rotate all sites about the vertical and shift them horizontally, in place, to the start.

    Then the robot starts at the origin, and its tracked body faces x. Both are taken from the first sample that shows
    them.
    """
    tracked, over = mapped[robot.tracked], mapped[hooks_of(robot).origin or robot.tracked]
    assert tracked.quaternion is not None
    seen = ~np.isnan(tracked.quaternion).any(axis=1)
    forward = Rotation.from_quat(tracked.quaternion[int(seen.argmax())], scalar_first=True).as_matrix()[:, 0]
    turn = Rotation.from_euler("z", -np.arctan2(forward[1], forward[0]))
    origin = over.position[int((~np.isnan(over.position).any(axis=1)).argmax())] * [1.0, 1.0, 0.0]
    for role, body in mapped.items():
        position = turn.apply(body.position - origin)  # Keeps NaN.
        quaternion = body.quaternion
        if quaternion is not None:
            known = ~np.isnan(quaternion).any(axis=1)
            quaternion = quaternion.copy()
            quaternion[known] = (turn * Rotation.from_quat(quaternion[known], scalar_first=True)).as_quat(
                scalar_first=True
            )
        mapped[role] = Body(position, quaternion)


def with_commands(
    path: Path,
    recording: Recording,
    time: Float[np.ndarray, " N"],
    command: Float[np.ndarray, "N commands"],
) -> tuple[Recording, tuple[float, float]]:
    """Return `recording` with commands, each held until the next one.

    The last command is held as long as the longest one before it. Samples without a command are cut off.

    **Arguments**

    - `path`: the command log, for messages.
    - `recording`: a recording without commands.
    - `time`: times of the commands (s, the recording's clock).
    - `command`: the commands, in the actuators' units.

    **Returns** the recording, from time 0 on, and the durations (s) cut off at its start and at its end.

    **Raises** `InputError` if less than a second is left.
    """
    clock = recording.time
    last = time[-1] + (np.diff(time).max() if len(time) > 1 else 0.0)
    kept = np.flatnonzero((clock >= time[0] - 1e-9) & (clock <= last + 1e-9))
    if len(kept) < 2 or clock[kept[-1]] - clock[kept[0]] < 1.0:
        problem = f"its commands, from {time[0]:.2f} to {last:.2f} s of the capture's clock, do not overlap it"
        fix = f"the capture is from {clock[0]:.2f} to {clock[-1]:.2f} s; fix --offset, or give this trial's log"
        refuse(path, "", problem, fix)
    rows = slice(int(kept[0]), int(kept[-1]) + 1)
    lost = float(clock[rows.start] - clock[0]), float(clock[-1] - clock[rows.stop - 1])
    held = np.searchsorted(time, clock[rows] + 1e-9, side="right") - 1
    kept = cut(recording, rows)
    return dataclasses.replace(kept, time=kept.time - kept.time[0], command=command[held]), lost
