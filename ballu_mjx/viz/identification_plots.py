"""Figures of a fit of declared parameters, drawn from arrays and written as PNG files."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ballu_mjx.viz.style import colour_of, save_figure

_NAMES = {"measured": "recording", "nominal": "vanilla", "identified": "vanilla+sysid"}
"""Simulator whose colour a measured or simulated motion has."""


@dataclasses.dataclass(frozen=True)
class HeldOutPanel:
    """Curves of a held-out window.

    **Fields**

    - `title`: name of the window.
    - `time`: time from the window's start (s).
    - `curves`: measured and simulated motions, by name (measured, nominal, identified).
    """

    title: str
    time: Float[np.ndarray, " samples"]
    curves: Mapping[str, Float[np.ndarray, "samples channels"]]


def held_out_windows(path: Path, panels: Sequence[HeldOutPanel], channels: Sequence[str]) -> None:
    """Draw channels over time, with a row for each of `channels` (names with units) and a column for each panel."""
    figure = Figure(figsize=(1.5 + 3.5 * len(panels), 1.5 + 1.8 * len(channels)), layout="constrained")
    axes = figure.subplots(len(channels), len(panels), sharex="col", squeeze=False)
    for column, panel in zip(axes.T, panels, strict=True):
        column[0].set_title(panel.title, fontsize="small")
        column[-1].set_xlabel("time (s)")
        for name, values in panel.curves.items():
            dash = "--" if name == "nominal" else "-"
            for channel, axis in enumerate(column):
                axis.plot(
                    panel.time, values[:, channel], dash, color=colour_of(_NAMES[name]), label=name, linewidth=1.3
                )
        for axis in column:
            axis.grid(alpha=0.3)
    for axis, label in zip(axes[:, 0], channels, strict=True):
        axis.set_ylabel(label)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    save_figure(figure, path)


def residual_autocorrelation(
    path: Path,
    lag: Float[np.ndarray, " lags"],
    correlations: Mapping[str, Float[np.ndarray, "lags channels"]],
    channels: Sequence[str],
) -> None:
    """Draw the autocorrelation of the errors with nominal and identified values, with a panel for each channel.

    Lags are in s.
    """
    figure = Figure(figsize=(7.0, 1.0 + 1.8 * len(channels)), layout="constrained")
    axes = figure.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
    for channel, axis in enumerate(axes):
        for name, values in correlations.items():
            axis.plot(lag, values[:, channel], color=colour_of(_NAMES[name]), label=name)
        axis.axhline(0.0, color="grey", linewidth=0.8)
        axis.set_ylabel(channels[channel])
        axis.set_ylim(-1.05, 1.05)
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("lag (s); white noise has no correlation beyond 0")
    axes[0].legend(fontsize="small")
    save_figure(figure, path)


def parameter_intervals(
    path: Path,
    names: Sequence[str],
    values: Float[np.ndarray, " parameters"],
    robust: Float[np.ndarray, " parameters"],
    white: Float[np.ndarray, " parameters"],
) -> None:
    """Draw the differences of identified and nominal values with 95 % intervals, in units of the prior's standard
    deviation.

    Thin intervals are from robust standard errors (`robust`), thick ones from those for white noise (`white`).
    """
    figure = Figure(figsize=(7.0, 1.2 + 0.35 * len(names)), layout="constrained")
    axis, place, colour = figure.subplots(), np.arange(len(names))[::-1], colour_of("vanilla+sysid")
    axis.errorbar(values, place, xerr=1.96 * robust, fmt="o", color=colour, capsize=3, label="robust")
    thick: dict[str, Any] = {"fmt": "none", "elinewidth": 4, "alpha": 0.4, "label": "white noise"}
    axis.errorbar(values, place, xerr=1.96 * white, color=colour, **thick)
    axis.axvline(0.0, color=colour_of("vanilla"), linestyle="--", label="nominal")
    axis.set_yticks(place, names)
    axis.set_ylim(-0.6, len(names) - 0.4)
    axis.set_xlabel("identified minus nominal, in standard deviations among robots")
    axis.grid(alpha=0.3)
    axis.legend(fontsize="small")
    save_figure(figure, path)
