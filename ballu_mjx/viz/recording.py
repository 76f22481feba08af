"""Figure of a recording over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.viz.style import save_figure

_Lines = Sequence[tuple[str, Float[np.ndarray, " T"], Sequence[str]]]
"""Label, values and recording columns of each line."""


def draw_recording(
    path: Path, seen: Recording, robot: RobotDescription, gaps: Mapping[str, Sequence[tuple[float, float]]]
) -> None:
    """Draw a recording: position and orientation of the tracked body, heights of the points, joints and commands.

    Drop-outs are shaded. `gaps` has their first and last times (s), by column of the recording.
    """
    panels = _panels(seen, robot)
    figure = Figure(figsize=(9.0, 1.0 + 1.7 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (title, lines) in zip(axes, panels.items(), strict=True):
        for number, (label, value, _) in enumerate(lines):
            axis.plot(seen.time, value, color=f"C{number % 10}", label=label, linewidth=0.9)
        spans = {span for _, _, columns in lines for column in columns for span in gaps.get(column, ())}
        for first, last in spans:
            axis.axvspan(first, last, color="0.85", linewidth=0)
        axis.set_ylabel(title)
        axis.legend(loc="upper right", fontsize="small", ncols=3)
    axes[-1].set_xlabel("time (s)")
    axes[0].set_title(f"{seen.name} ({seen.kind}, {seen.robot})")
    save_figure(figure, path)


def _panels(seen: Recording, robot: RobotDescription) -> dict[str, _Lines]:
    panels: dict[str, _Lines] = {}
    if (place := seen.tracked_position) is not None:
        names = [f"{robot.tracked}_{axis}" for axis in "xyz"]
        panels[f"{robot.tracked} (m)"] = [(axis, place[:, i], (names[i],)) for i, axis in enumerate("xyz")]
    if (quaternion := seen.tracked_quaternion) is not None:
        angles = np.rad2deg(Rotation.from_quat(quaternion, scalar_first=True).as_euler("ZYX"))
        angles = np.unwrap(angles, axis=0, period=360.0)
        columns = [f"{robot.tracked}_q{axis}" for axis in "wxyz"]
        turns = enumerate(("yaw", "pitch", "roll"))
        panels[f"{robot.tracked} (deg)"] = [(name, angles[:, i], columns) for i, name in turns]
    if seen.points:
        panels["heights (m)"] = [(site, place[:, 2], (f"{site}_z",)) for site, place in seen.points.items()]
    model = robot.load_model()
    kinds = {joint: model.joint(joint).type[0] for joint in seen.joint_angles}
    hinges = [joint for joint, kind in kinds.items() if kind == mujoco.mjtJoint.mjJNT_HINGE]
    slides = [joint for joint in kinds if joint not in hinges]
    if hinges:
        panels["joints (deg)"] = [(each, np.rad2deg(seen.joint_angles[each]), (each,)) for each in hinges]
    if slides:
        panels["joints (m)"] = [(each, seen.joint_angles[each], (each,)) for each in slides]
    sent = zip(robot.commands, seen.command.T, strict=True)
    panels["command"] = [(name, value, (f"command_{name}",)) for name, value in sent]
    return panels
