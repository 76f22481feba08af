"""Figures of a training run, drawn from arrays into PNG files; no display and no global state."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from ballu_mjx import robot, stepping
from ballu_mjx.identification import Identification
from ballu_mjx.recording import Recording
from ballu_mjx.robot import SIDES
from ballu_mjx.sweep import Sweep

COLOURS: Mapping[str, str] = {
    "recording": "black",
    "vanilla": "#d55e00",
    "vanilla+dr": "#cc79a7",
    "vanilla+sysid": "#0072b2",
    "vanilla+sysid+dr": "#e69f00",
    "supervised": "#56b4e9",
    "envmimic": "#009e73",
    "aerodynamic": "#882255",
    "analytic": "#999933",
    "aerodynamic+envmimic": "#332288",
    "aerodynamic+analytic": "#aa4499",
    "envmimic-shared": "#117733",
    "envmimic-near": "#88ccee",
    "envmimic-wrench": "#44aa99",
}
"""One colour for each simulator in all figures (Okabe and Ito's, six of Tol's: the colour-blind tell them apart)."""

LABELS: Mapping[str, str] = {
    "recording": "recording",
    "vanilla": "vanilla",
    "vanilla+dr": "vanilla+DR",
    "vanilla+sysid": "vanilla+sysid",
    "vanilla+sysid+dr": "vanilla+sysid+DR",
    "supervised": "supervised",
    "envmimic": "EnvMimic",
    "aerodynamic": "aerodynamic",
    "analytic": "analytic",
    "aerodynamic+envmimic": "aerodynamic+EnvMimic",
    "aerodynamic+analytic": "aerodynamic+analytic",
    "envmimic-shared": "EnvMimic, one for all tasks",
    "envmimic-near": "EnvMimic, near its data",
    "envmimic-wrench": "EnvMimic, wrench",
}


def colour_of(simulator: str) -> tuple[float, float, float]:
    """Of a simulator (a key of `COLOURS`), paler in each later round (`envmimic-2`); grey for a name unknown."""
    name, number = round_of(simulator)
    own = np.array(to_rgb(COLOURS.get(name, "grey")))
    red, green, blue = 1 - (1 - own) * _PALER ** (number - 1)
    return red, green, blue


def label_of(simulator: str) -> str:
    """A simulator's name in figures; one unknown is its own."""
    name, number = round_of(simulator)
    return LABELS.get(name, name) + (f", round {number}" if number > 1 else "")


def round_of(simulator: str) -> tuple[str, int]:
    """Its name in the first round, and which round it is."""
    name, _, number = simulator.rpartition("-")
    return (name, int(number)) if name in COLOURS and number.isdecimal() else (simulator, 1)


_PALER = 0.55
_QUANTITIES = ("x (m)", "y (m)", "yaw (deg)")
_DOTS_PER_INCH = 120
SIDE_COLOURS = ("#1f77b4", "#d64d1f")
"""Left and right, as in the model."""


@dataclasses.dataclass(frozen=True)
class TrackingPanel:
    """One recording, with what simulators make of its commands from its first state on.

    **Fields**

    - `title`: the recording's name, say.
    - `time`: s.
    - `recording`: the balloon's x (m), y (m) and yaw (rad).
    - `simulations`: the same by simulator (keys of `COLOURS`), one run, or several of which mean and range are drawn.
    """

    title: str
    time: Float[np.ndarray, " T"]
    recording: Float[np.ndarray, "T 3"]
    simulations: Mapping[str, Float[np.ndarray, "T 3"] | Float[np.ndarray, "runs T 3"]]


def tracking(path: Path, panels: Sequence[TrackingPanel]) -> None:
    """x, y and yaw over time, a column for each panel."""
    figure = Figure(figsize=(1.0 + 5.0 * len(panels), 7.0), layout="constrained")
    axes = figure.subplots(len(_QUANTITIES), len(panels), sharex="col", squeeze=False)
    for column, panel in zip(axes.T, panels, strict=True):
        column[0].set_title(panel.title)
        column[-1].set_xlabel("time (s)")
        curves = {**panel.simulations, "recording": panel.recording}  # the recording last, on top
        for name, values in curves.items():
            runs = unwrapped(values if values.ndim == 3 else values[None], float(panel.recording[0, 2]))
            for index, axis in enumerate(column):
                mean = runs[..., index].mean(axis=0)
                axis.plot(panel.time, mean, color=COLOURS[name], label=LABELS[name], linewidth=1.5)
                if len(runs) > 1:
                    low, high = runs[..., index].min(axis=0), runs[..., index].max(axis=0)
                    axis.fill_between(panel.time, low, high, color=COLOURS[name], alpha=0.2, linewidth=0)
        for axis in column:
            axis.grid(alpha=0.3)
    for axis, label in zip(axes[:, 0], _QUANTITIES, strict=True):
        axis.set_ylabel(label)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 3 * len(panels)))
    _save(figure, path)


def learning_curve(
    path: Path,
    steps: Float[np.ndarray, " n"],
    reward: Float[np.ndarray, " n"],
    validation_steps: Float[np.ndarray, " m"],
    validation_error: Float[np.ndarray, " m"],
    best_step: int | None = None,
) -> None:
    """Mean reward per control step, and the validation error as a ratio to vanilla's, against control steps."""
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.plot(steps / 1e6, reward, color=COLOURS["envmimic"])
    upper.set_ylabel("reward per control step")
    lower.plot(validation_steps / 1e6, validation_error, color=COLOURS["envmimic"], marker="o", markersize=4)
    lower.axhline(1.0, color=COLOURS["vanilla"], linestyle="--", label="vanilla")
    if best_step is not None:
        lower.axvline(best_step / 1e6, color="grey", linestyle=":", label="best checkpoint")
    lower.set_ylabel("validation error (ratio to vanilla)")
    lower.set_xlabel("control steps (millions)")
    lower.legend()
    for axis in (upper, lower):
        axis.grid(alpha=0.3)
    _save(figure, path)


def fit_curve(
    path: Path,
    losses: Mapping[str, tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]],
    validation: tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]],
    label: str,
    simulator: str,
    best_step: int,
) -> None:
    """Losses by name and the validation error, called `label`, against gradient steps, in the simulator's colour."""
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    for (name, curve), style in zip(losses.items(), ("-", "--"), strict=False):
        upper.plot(*curve, color=COLOURS[simulator], linestyle=style, label=name)
    lower.plot(*validation, color=COLOURS[simulator], marker="o", markersize=4)
    lower.axhline(1.0, color=COLOURS["vanilla"], linestyle="--", label="no force")
    lower.axvline(best_step, color="grey", linestyle=":", label="best checkpoint")
    upper.set_ylabel("loss")
    lower.set_ylabel(label)
    lower.set_xlabel("gradient steps")
    for axis in (upper, lower):
        axis.legend()
        axis.grid(alpha=0.3)
    _save(figure, path)


def compared(path: Path, panels: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]]]) -> None:
    """Learning curves side by side: by axis label, by row, control steps, mean, and half the interval's width (not a
    number: none is drawn)."""
    figure = Figure(figsize=(8.0, 3.5 * len(panels)), layout="constrained")
    rows = list(dict.fromkeys(label for lines in panels.values() for label in lines))
    for axis, (title, lines) in zip(
        np.ravel(figure.subplots(len(panels), 1, sharex=True)), panels.items(), strict=True
    ):
        for label, (steps, mean, half) in lines.items():
            colour = f"C{rows.index(label)}"
            axis.plot(steps / 1e6, mean, color=colour, label=label)
            axis.fill_between(steps / 1e6, mean - half, mean + half, color=colour, alpha=0.2, linewidth=0)
        axis.set_ylabel(title)
        axis.grid(alpha=0.3)
        axis.legend(fontsize="small", title="mean, 95 % interval")
        axis.set_xlabel("control steps (millions)")
    _save(figure, path)


def reward_curve(
    path: Path,
    steps: Float[np.ndarray, " n"],
    reward: Float[np.ndarray, " n"],
    validation_steps: Float[np.ndarray, " m"],
    validation_reward: Float[np.ndarray, " m"],
    simulator: str,
) -> None:
    """Mean reward per control step (m/s) against control steps, in the simulator's colour: of training, and of the
    policy without exploration."""
    figure = Figure(figsize=(7.0, 3.5), layout="constrained")
    axis = figure.subplots()
    axis.plot(steps / 1e6, reward, color=COLOURS[simulator], label=f"{LABELS[simulator]}, training")
    validated = "without exploration, whole trials"
    axis.plot(validation_steps / 1e6, validation_reward, "o--", color=COLOURS[simulator], markersize=4, label=validated)
    axis.set_xlabel("control steps (millions)")
    axis.set_ylabel("reward per control step (m/s)")
    axis.grid(alpha=0.3)
    axis.legend()
    _save(figure, path)


def gait(
    path: Path, qpos: Float[np.ndarray, "states nq"], command: Float[np.ndarray, "steps 2"], *, start: float = 6.0
) -> None:
    """What a gait looks like: a strip of stick figures from the side, one every quarter of a second; the feet's heights
    and the commands over time, stance marked (a foot near the floor and at rest; a swinging foot may graze the floor);
    the way from above.

    Strip and time plots show eight seconds from `start` (s) on; all are at the control rate.
    """
    period = robot.CONTROL_TIMESTEP
    sticks, feet, com = _sticks(qpos)
    first = min(round(start / period), max(len(qpos) - 2, 0))
    shown = slice(first, min(first + round(8.0 / period), len(command)))
    time = np.arange(len(qpos)) * period
    planted = stepping.planted(feet)
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
    _save(figure, path)


def ways(
    path: Path,
    hardware: Sequence[Float[np.ndarray, "states 3"]],
    simulated: Sequence[Float[np.ndarray, "states 3"]],
    simulator: str,
) -> None:
    """The centre of mass from above in each trial (m): on the robot, and in the policy's own simulator."""
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    axis = figure.subplots()
    for name, runs in ((simulator, simulated), ("recording", hardware)):
        for index, com in enumerate(runs):
            label = {"recording": "robot"}.get(name, f"{LABELS[name]} (simulated)") if not index else None
            axis.plot(com[:, 0], com[:, 1], color=COLOURS[name], label=label, linewidth=1.2)
            axis.plot(com[-1, 0], com[-1, 1], "o", color=COLOURS[name], markersize=4)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("x (m)")
    axis.set_ylabel("y (m)")
    axis.grid(alpha=0.3)
    axis.legend()
    _save(figure, path)


def _sticks(qpos: Float[np.ndarray, "states nq"]) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Polylines (m, world) of body and legs, positions of the feet, and the centre of mass, for each state."""
    model = robot.load_model()
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
    """Settled angles over commands, a panel for each joint: measured, nominal and identified (the paper's figure of the
    actuators); dotted, identified with the drivetrain that belongs to it."""
    figure = Figure(figsize=(9.0, 6.5), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    simulations = {"vanilla": result.nominal_settled, "vanilla+sysid": result.settled}
    for row, joint in enumerate(("motor", "knee")):
        for column, side in enumerate(SIDES):
            axis, order = axes[row, column], np.argsort(sweep.command[:, column])
            command = sweep.command[order, column]
            for name, angles in simulations.items():
                curve = np.rad2deg(angles[order, row, column])
                axis.plot(command, curve, color=COLOURS[name], label=LABELS[name], linewidth=1.5)
            if result.with_drivetrain is not None:
                curve = np.rad2deg(result.with_drivetrain[order, row, column])
                label = f"{LABELS['vanilla+sysid']}, with friction and backlash"
                axis.plot(command, curve, ":", color=COLOURS["vanilla+sysid"], label=label, linewidth=1.5)
            measured = np.rad2deg(sweep.settled[order, row, column])
            axis.plot(command, measured, "o", color=COLOURS["recording"], label="measured", markersize=3.5)
            axis.set_title(f"{joint}, {side}")
            axis.grid(alpha=0.3)
        axes[row, 0].set_ylabel("angle (deg)")
    for axis in axes[-1]:
        axis.set_xlabel("command")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    _save(figure, path)


def unwrapped(runs: Float[np.ndarray, "runs T 3"], start: float) -> Float[np.ndarray, "runs T 3"]:
    """Yaw in degrees without jumps, starting on the same turn as the recording's."""
    yaw = np.unwrap(runs[..., 2], axis=-1)
    yaw = yaw - 2 * np.pi * np.round((yaw[:, :1] - start) / (2 * np.pi))
    return np.concatenate([runs[..., :2], np.rad2deg(yaw)[..., None]], axis=-1)


def _save(figure: Figure, path: Path) -> None:
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=_DOTS_PER_INCH)


def recording(path: Path, seen: Recording, gaps: Mapping[str, Sequence[tuple[float, float]]]) -> None:
    """A recording over time: where the robot goes, heights, how the legs bend, commands. Drop-outs (first and last time
    by column) are shaded."""
    panels: list[tuple[str, list[tuple[str, np.ndarray, str]], str]] = []
    if seen.base_position is not None:
        panels.append(("base (m)", [(axis, seen.base_position[:, i], f"C{i}") for i, axis in enumerate("xyz")], "base"))
    if seen.balloon_position is not None and seen.balloon_quaternion is not None:
        angles = np.rad2deg(Rotation.from_quat(seen.balloon_quaternion, scalar_first=True).as_euler("ZYX"))
        angles = np.unwrap(angles, axis=0, period=360.0)
        lines = [(name, angles[:, i], f"C{i}") for i, name in enumerate(("yaw", "pitch", "roll"))]
        panels.append(("balloon (deg)", lines, "balloon"))
    if seen.foot_position is not None:
        lines = [(s, seen.foot_position[:, i, 2], SIDE_COLOURS[i]) for i, s in enumerate(SIDES)]
        panels.append(("feet, height (m)", lines, "foot"))
    for name, value in (("motor", seen.motor), ("knee", seen.knee)):
        if value is not None:
            lines = [(s, np.rad2deg(value[:, i]), SIDE_COLOURS[i]) for i, s in enumerate(SIDES)]
            panels.append((f"{name}s (deg)", lines, name))
    lines = [(s, seen.command[:, i], SIDE_COLOURS[i]) for i, s in enumerate(SIDES)]
    panels.append(("command", lines, "command"))
    figure = Figure(figsize=(9.0, 1.0 + 1.7 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (title, lines, prefix) in zip(axes, panels, strict=True):
        for label, value, colour in lines:
            axis.plot(seen.time, value, color=colour, label=label, linewidth=0.9)
        for first, last in {span for name, spans in gaps.items() if name.startswith(prefix) for span in spans}:
            axis.axvspan(first, last, color="0.85", linewidth=0)
        axis.set_ylabel(title)
        axis.legend(loc="upper right", fontsize="small", ncols=3)
    axes[-1].set_xlabel("time (s)")
    axes[0].set_title(f"{seen.name} ({seen.kind}, {seen.robot})")
    _save(figure, path)
