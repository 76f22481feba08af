"""Figures of a training run, drawn from arrays and written as PNG files, without display and global state."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ballu_mjx.viz.style import colour_of, label_of, save_figure, step_axis, unwrapped

_QUANTITIES = ("x (m)", "y (m)", "yaw (deg)")


@dataclasses.dataclass(frozen=True)
class TrackingPanel:
    """A recording, and simulations of its commands from its first state.

    **Fields**

    - `title`: title of the panel, for example the name of the recording.
    - `time`: time (s).
    - `recording`: recorded x (m), y (m) and yaw (rad) of the tracked body.
    - `simulations`: simulated x, y and yaw, by the name of the simulator. An array has one run or several runs. For
      several runs, mean and range are drawn.
    """

    title: str
    time: Float[np.ndarray, " T"]
    recording: Float[np.ndarray, "T 3"]
    simulations: Mapping[str, Float[np.ndarray, "T 3"] | Float[np.ndarray, "runs T 3"]]


def tracking(path: Path, panels: Sequence[TrackingPanel]) -> None:
    """Draw x, y and yaw over time, with a column for each panel."""
    figure = Figure(figsize=(1.0 + 5.0 * len(panels), 7.0), layout="constrained")
    axes = figure.subplots(len(_QUANTITIES), len(panels), sharex="col", squeeze=False)
    for column, panel in zip(axes.T, panels, strict=True):
        column[0].set_title(panel.title)
        column[-1].set_xlabel("time (s)")
        curves = {**panel.simulations, "recording": panel.recording}  # the recording is drawn last, on top
        for name, values in curves.items():
            runs = unwrapped(values if values.ndim == 3 else values[None], float(panel.recording[0, 2]))
            for index, axis in enumerate(column):
                mean = runs[..., index].mean(axis=0)
                axis.plot(panel.time, mean, color=colour_of(name), label=label_of(name), linewidth=1.5)
                if len(runs) > 1:
                    low, high = runs[..., index].min(axis=0), runs[..., index].max(axis=0)
                    axis.fill_between(panel.time, low, high, color=colour_of(name), alpha=0.2, linewidth=0)
        for axis in column:
            axis.grid(alpha=0.3)
    for axis, label in zip(axes[:, 0], _QUANTITIES, strict=True):
        axis.set_ylabel(label)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 3 * len(panels)))
    save_figure(figure, path)


def learning_curve(
    path: Path,
    steps: Float[np.ndarray, " n"],
    reward: Float[np.ndarray, " n"],
    validation_steps: Float[np.ndarray, " m"],
    validation_error: Float[np.ndarray, " m"],
    best_step: int | None = None,
) -> None:
    """Draw the mean reward per control step, and the validation error, over control steps.

    The validation error is a ratio to that of the same simulator without the residual.
    """
    best = None if best_step is None else best_step / 1e6
    figure, upper, lower = _over_validation((validation_steps / 1e6, validation_error), "envmimic", "no residual", best)
    upper.plot(steps / 1e6, reward, color=colour_of("envmimic"))
    upper.set_ylabel("reward per control step")
    lower.set_ylabel("validation error (ratio to no residual)")
    lower.set_xlabel("control steps (millions)")
    save_figure(figure, path)


def fit_curve(
    path: Path,
    losses: Mapping[str, tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]],
    validation: tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]],
    label: str,
    simulator: str,
    best_step: int,
    networks: Mapping[str, int] | None = None,
) -> None:
    """Draw losses by name, and the validation error with the axis label `label`, over gradient steps.

    The curves have the simulator's colour. `networks` has the last gradient step of each network by name, if several
    were fitted one after another.
    """
    figure, upper, lower = _over_validation(validation, simulator, "no force", float(best_step))
    for (name, curve), style in zip(losses.items(), ("-", "--"), strict=False):
        upper.plot(*curve, color=colour_of(simulator), linestyle=style, label=name)
    before = 0
    for name, last in (networks or {}).items():
        upper.annotate(name, ((before + last) / 2, 0.93), xycoords=("data", "axes fraction"), ha="center")
        for axis in (upper, lower) if before else ():
            axis.axvline(before, color="black", linewidth=0.8)
        before = last
    upper.set_ylabel("loss")
    if len(losses) > 1:
        upper.legend()
    lower.set_ylabel(label)
    lower.set_xlabel("gradient steps, one network after another" if networks else "gradient steps")
    save_figure(figure, path)


def _over_validation(
    validation: tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]], simulator: str, base: str, best: float | None
) -> tuple[Figure, Axes, Axes]:
    """Return a figure with two panels.

    The lower panel has the validation error as a ratio to that of `base` (a label), and a line at the best checkpoint.
    The upper panel is empty.
    """
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    lower.plot(*validation, color=colour_of(simulator), marker="o", markersize=4)
    lower.axhline(1.0, color=colour_of("vanilla"), linestyle="--", label=base)
    if best is not None:
        lower.axvline(best, color="grey", linestyle=":", label="best checkpoint")
    lower.legend()
    for axis in (upper, lower):
        axis.grid(alpha=0.3)
    return figure, upper, lower


def compared(
    path: Path, panels: Mapping[tuple[str, str], Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]]]
) -> None:
    """Draw learning curves of several rows, with a panel for each metric and unit of its steps.

    `panels[metric, unit][row]` holds steps, mean, and half the width of the interval. An interval of NaN is not drawn.
    """
    figure = Figure(figsize=(8.0, 3.5 * len(panels)), layout="constrained")
    rows = list(dict.fromkeys(label for lines in panels.values() for label in lines))
    for axis, ((title, unit), lines) in zip(np.ravel(figure.subplots(len(panels), 1)), panels.items(), strict=True):
        across, one = step_axis(unit)
        for label, (steps, mean, half) in lines.items():
            colour = f"C{rows.index(label)}"
            axis.plot(steps / one, mean, color=colour, label=label)
            axis.fill_between(steps / one, mean - half, mean + half, color=colour, alpha=0.2, linewidth=0)
        axis.set_ylabel(title)
        axis.grid(alpha=0.3)
        axis.legend(fontsize="small", title="mean, 95 % interval")
        axis.set_xlabel(across)
    save_figure(figure, path)


def reward_curve(
    path: Path,
    steps: Float[np.ndarray, " n"],
    reward: Float[np.ndarray, " n"],
    validation_steps: Float[np.ndarray, " m"],
    validation_reward: Float[np.ndarray, " m"],
    simulator: str,
) -> None:
    """Draw the mean reward per control step (m/s) over control steps, in training and without exploration.

    The curves have the simulator's colour.
    """
    figure = Figure(figsize=(7.0, 3.5), layout="constrained")
    axis = figure.subplots()
    axis.plot(steps / 1e6, reward, color=colour_of(simulator), label=f"{label_of(simulator)}, training")
    validated = "without exploration, whole trials"
    axis.plot(
        validation_steps / 1e6, validation_reward, "o--", color=colour_of(simulator), markersize=4, label=validated
    )
    axis.set_xlabel("control steps (millions)")
    axis.set_ylabel("reward per control step (m/s)")
    axis.grid(alpha=0.3)
    axis.legend()
    save_figure(figure, path)
