"""Summary of a recording in lines of text: length, rate, drop-outs, ranges and commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ballu_mjx.recordings.importers.table import Table
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription


def find_gaps(path: Path) -> dict[str, list[tuple[float, float]]]:
    """Return the drop-outs of a recording's CSV by column, each as the first and last time (s) without a sample."""
    table = Table(path)
    time = table.column("time")
    found: dict[str, list[tuple[float, float]]] = {}
    for name in table.header:
        edges = np.diff(np.concatenate([[0], np.isnan(table.column(name)), [0]]))
        starts, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0) - 1
        if len(starts):
            found[name] = [(float(time[a]), float(time[b])) for a, b in zip(starts, ends, strict=True)]
    return found


def summarize_recording(
    path: Path, recording: Recording, robot: RobotDescription, gaps: dict[str, list[tuple[float, float]]]
) -> str:
    """Return a summary in lines of text: length, rate, drop-outs (`gaps` from `find_gaps`), ranges and commands."""
    time = recording.time
    steps = np.diff(time)
    step = float(np.median(steps))
    jitter = 1e3 * float(np.sqrt(np.mean((steps - step) ** 2)))
    lines = [
        f"{path}: {recording.kind}, {recording.robot}",
        f"  {time[-1] - time[0]:.2f} s, {len(time)} samples, {1 / step:.4g} Hz, jitter {jitter:.2f} ms, "
        f"longest step {1e3 * steps.max():.3g} ms",
    ]
    if any(recording.trimmed):
        lines.append(f"  rows left out, since a column has no sample there: {recording.trimmed[0]} at the start, "
                     f"{recording.trimmed[1]} at the end")  # fmt: skip
    groups: dict[tuple[tuple[float, float], ...], list[str]] = {}
    for name, spans in gaps.items():
        groups.setdefault(tuple(spans), []).append(name)
    for spans, names in groups.items():
        lengths = [b - a + step for a, b in spans]
        shown = names[0] if len(names) == 1 else f"{names[0]} ... {names[-1]}"
        described = f"{len(spans)} drop-outs, {sum(lengths):.2f} s in all, the longest {max(lengths):.2f} s"
        lines.append(f"  {shown}: " + (described if len(spans) > 1 else f"1 drop-out of {lengths[0]:.2f} s"))
    for sites, count in held_sites(recording):
        lines.append(f"  {sites}: {count} samples repeat the one before to the last digit; they count as not seen")
    if not gaps and not recording.held:
        lines.append("  no drop-outs")
    for label, value in _ranges(recording, robot):
        low, high = value.min(axis=0), value.max(axis=0)
        lines.append(f"  {label}: " + ", ".join(f"{a:.3f} to {b:.3f}" for a, b in zip(low, high, strict=True)))
    for name, command in zip(robot.commands, recording.command.T, strict=True):
        changes = int((np.diff(command) != 0).sum())
        held = (time[-1] - time[0]) / (changes + 1)
        lines.append(
            f"  command_{name}: {command.min():.2f} to {command.max():.2f}, mean {command.mean():.2f}, "
            f"{changes} changes, held for {held:.2f} s on average"
        )
    return "\n".join(lines)


def held_sites(recording: Recording) -> list[tuple[str, int]]:
    """Return sites with equal numbers of held samples, joined to one text, and these numbers."""
    alike: dict[int, list[str]] = {}
    for site, count in recording.held.items():
        alike.setdefault(count, []).append(site)
    return [(", ".join(sites), count) for count, sites in alike.items()]


def _ranges(recording: Recording, robot: RobotDescription) -> list[tuple[str, np.ndarray]]:
    """Return columns with their labels in the summary. Angles of orientations are unwrapped."""

    def degrees(quaternion: np.ndarray) -> np.ndarray:
        angles = Rotation.from_quat(quaternion, scalar_first=True).as_euler("ZYX", degrees=True)
        return np.unwrap(angles, axis=0, period=360.0)

    places = {robot.tracked: recording.tracked_position, **recording.points}
    turns = {robot.tracked: recording.tracked_quaternion, **recording.orientations}
    values = []
    for site in (robot.tracked, *robot.points):
        if (place := places.get(site)) is not None:
            values.append((f"{site} x, y, z (m)", place))
        if (quaternion := turns.get(site)) is not None:
            values.append((f"{site} yaw, pitch, roll (deg)", degrees(quaternion)))
    values += [(f"{joint} (rad or m)", angle[:, None]) for joint, angle in recording.joint_angles.items()]
    return values
