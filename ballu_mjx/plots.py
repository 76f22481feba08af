"""Figures of a training run, drawn from arrays into PNG files; no display and no global state."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ballu_mjx.identification import Identification
from ballu_mjx.robot import SIDES
from ballu_mjx.sweep import Sweep

COLOURS: Mapping[str, str] = {
    "recording": "black",
    "vanilla": "#d55e00",
    "vanilla+sysid": "#0072b2",
    "supervised": "#56b4e9",
    "envmimic": "#009e73",
}
"""One colour for each simulator in all figures (Okabe and Ito's, told apart by the colour-blind too)."""

LABELS: Mapping[str, str] = {
    "recording": "recording",
    "vanilla": "vanilla",
    "vanilla+sysid": "vanilla+sysid",
    "supervised": "supervised",
    "envmimic": "EnvMimic",
}
_QUANTITIES = ("x (m)", "y (m)", "yaw (deg)")
_DOTS_PER_INCH = 120


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
            runs = _unwrapped(values if values.ndim == 3 else values[None], panel.recording[0, 2])
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
    axes[0, 0].legend()
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


def actuator_curves(path: Path, sweep: Sweep, result: Identification) -> None:
    """Settled angles over commands, a panel for each joint: measured, nominal and identified (the paper's figure of the
    actuators)."""
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
            measured = np.rad2deg(sweep.settled[order, row, column])
            axis.plot(command, measured, "o", color=COLOURS["recording"], label="measured", markersize=3.5)
            axis.set_title(f"{joint}, {side}")
            axis.grid(alpha=0.3)
        axes[row, 0].set_ylabel("angle (deg)")
    for axis in axes[-1]:
        axis.set_xlabel("command")
    axes[0, 0].legend()
    _save(figure, path)


def _unwrapped(runs: Float[np.ndarray, "runs T 3"], start: float) -> Float[np.ndarray, "runs T 3"]:
    """Yaw in degrees without jumps, starting on the same turn as the recording's."""
    yaw = np.unwrap(runs[..., 2], axis=-1)
    yaw = yaw - 2 * np.pi * np.round((yaw[:, :1] - start) / (2 * np.pi))
    return np.concatenate([runs[..., :2], np.rad2deg(yaw)[..., None]], axis=-1)


def _save(figure: Figure, path: Path) -> None:
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=_DOTS_PER_INCH)
