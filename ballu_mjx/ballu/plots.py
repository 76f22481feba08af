"""Figures of BALLU: gaits, actuator curves, and trajectories from above."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ballu_mjx.ballu.gait import planted_feet
from ballu_mjx.ballu.leg_results import Identification
from ballu_mjx.ballu.model import CONTROL_TIMESTEP, SIDES, load_model
from ballu_mjx.ballu.sweep import Sweep
from ballu_mjx.viz.style import COMMAND_COLOURS, colour_of, label_of, save_figure

SIDE_COLOURS = COMMAND_COLOURS[:2]
"""Colours of the left and the right leg, as in the model."""


def gait(
    path: Path, qpos: Float[np.ndarray, "states nq"], command: Float[np.ndarray, "steps 2"], *, start: float = 6.0
) -> None:
    """Draw a gait in four panels.

    - Stick figures from the side, one every quarter of a second.
    - The heights of the feet over time, with marks where a foot is planted (`gait.planted_feet`).
    - The commands over time.
    - The trajectory of the centre of mass from above, with the places of the planted feet.

    The first three panels show eight seconds from `start` (s) on. `qpos` and `command` are at the control rate.
    """
    period = CONTROL_TIMESTEP
    sticks, feet, com = _sticks(qpos)
    first = min(round(start / period), max(len(qpos) - 2, 0))
    shown = slice(first, min(first + round(8.0 / period), len(command)))
    time = np.arange(len(qpos)) * period
    planted = planted_feet(feet)
    figure = Figure(figsize=(12.0, 10.0), layout="constrained")
    strip, heights, commands, above = figure.subplots(4, 1, height_ratios=(1.6, 1.0, 1.0, 1.4))
    for state in range(shown.start, shown.stop, round(0.25 / period)):
        for part, colour in (("body", "grey"), (SIDES[0], SIDE_COLOURS[0]), (SIDES[1], SIDE_COLOURS[1])):
            strip.plot(sticks[part][state, :, 0], sticks[part][state, :, 2], color=colour, linewidth=1.0)
        strip.plot(*sticks["body"][state, -1, [0, 2]], "o", color="lightgrey", markersize=9)
    strip.axhline(0.0, color="black", linewidth=0.8)
    strip.set_aspect("equal", adjustable="datalim")
    strip.set_xlabel("x (m)")
    strip.set_ylabel("z (m)")
    for leg, side in enumerate(SIDES):
        height = feet[shown, leg, 2]
        heights.plot(time[shown], height, color=SIDE_COLOURS[leg], label=side)
        stance = np.where(planted[shown, leg], -0.01 - 0.01 * leg, np.nan)
        heights.plot(time[shown], stance, color=SIDE_COLOURS[leg], linewidth=3)
        commands.plot(time[shown], command[shown, leg], color=SIDE_COLOURS[leg])
    heights.set_ylabel("height of foot (m)")
    heights.legend(loc="upper right")
    commands.set_ylabel("command")
    commands.set_xlabel("time (s)")
    above.plot(com[:, 0], com[:, 1], color="black", label="centre of mass")
    for leg, side in enumerate(SIDES):
        down = feet[planted[:, leg], leg]
        above.plot(down[:, 0], down[:, 1], ".", color=SIDE_COLOURS[leg], markersize=3, label=f"{side} foot, stance")
    above.set_aspect("equal", adjustable="datalim")
    above.set_xlabel("x (m)")
    above.set_ylabel("y (m)")
    above.legend(loc="upper right")
    for axis in (heights, commands, above):
        axis.grid(alpha=0.3)
    save_figure(figure, path)


def draw_trajectories(
    path: Path,
    hardware: Sequence[Float[np.ndarray, "states 3"]],
    simulated: Sequence[Float[np.ndarray, "states 3"]],
    simulator: str,
) -> None:
    """Draw the centre of mass (m) from above in each trial, on the robot and in the policy's own simulator."""
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    axis = figure.subplots()
    for name, runs in ((simulator, simulated), ("recording", hardware)):
        for index, com in enumerate(runs):
            label = {"recording": "robot"}.get(name, f"{label_of(name)} (simulated)") if not index else None
            axis.plot(com[:, 0], com[:, 1], color=colour_of(name), label=label, linewidth=1.2)
            axis.plot(com[-1, 0], com[-1, 1], "o", color=colour_of(name), markersize=4)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("x (m)")
    axis.set_ylabel("y (m)")
    axis.grid(alpha=0.3)
    axis.legend()
    save_figure(figure, path)


def _sticks(qpos: Float[np.ndarray, "states nq"]) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Return polylines of body and legs, positions of the feet, and centres of mass in each state (m, world frame)."""
    model = load_model()
    data = mujoco.MjData(model)
    lines: dict[str, list[np.ndarray]] = {"body": [], **{side: [] for side in SIDES}}
    com = []
    for state in qpos:
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        lines["body"].append(np.stack([data.site("base").xpos, data.site("balloon").xpos]))
        for side in SIDES:
            leg = [data.body(f"femur_{side}").xpos, data.body(f"tibia_{side}").xpos, data.site(f"foot_{side}").xpos]
            lines[side].append(np.stack(leg))
        com.append(data.subtree_com[1].copy())
    sticks = {part: np.stack(line) for part, line in lines.items()}
    return sticks, np.stack([sticks[side][:, -1] for side in SIDES], axis=1), np.stack(com)


def actuator_curves(path: Path, sweep: Sweep, result: Identification) -> None:
    """Draw settled angles over commands: measured, nominal and identified, with one panel for each joint.

    This is the paper's figure of the actuators. Identified angles are those at the end of each hold in the simulated
    motion. Dotted lines are the equilibria of the same leg without friction and drivetrain. A fit of settled angles
    alone has only these.
    """
    figure = Figure(figsize=(9.0, 6.5), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    identified = label_of("vanilla+sysid")
    curves = [("vanilla", label_of("vanilla"), "-", result.nominal_settled)]
    if result.simulated is None:
        curves.append(("vanilla+sysid", identified, "-", result.settled))
    else:
        curves.append(("vanilla+sysid", identified, "-", result.simulated))
        curves.append(("vanilla+sysid", f"{identified} without friction and backlash", ":", result.settled))
    for row, joint in enumerate(("motor", "knee")):
        for column, side in enumerate(SIDES):
            axis, order = axes[row, column], np.argsort(sweep.command[:, column])
            command = sweep.command[order, column]
            for name, label, line, angles in curves:
                curve = np.rad2deg(angles[order, row, column])
                axis.plot(command, curve, line, color=colour_of(name), label=label, linewidth=1.5)
            measured = np.rad2deg(sweep.settled[order, row, column])
            axis.plot(command, measured, "o", color=colour_of("recording"), label="measured", markersize=3.5)
            axis.set_title(f"{joint}, {side}")
            axis.grid(alpha=0.3)
        axes[row, 0].set_ylabel("angle (deg)")
    for axis in axes[-1]:
        axis.set_xlabel("command")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    save_figure(figure, path)
