"""Style of figures: one colour and one label for each simulator."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from ballu_mjx.policies.simulator_variants import SimulatorVariant
from ballu_mjx.residuals.registry import GRADIENT_STEPS

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
    "fluid": "#661100",
    "aerodynamic+envmimic": "#332288",
    "aerodynamic+analytic": "#aa4499",
    "envmimic-shared": "#117733",
    "envmimic-near": "#88ccee",
    "envmimic-wrench": "#44aa99",
    "envmimic-paper": "#ddcc77",
}
"""Colours of simulators in all figures. They are from the palettes of Okabe and Ito and (seven of them) of Tol, for
colour-blind readers. Read them by `colour_of`, which has a colour for every name."""

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
    "fluid": "fluid forces",
    "aerodynamic+envmimic": "aerodynamic+EnvMimic",
    "aerodynamic+analytic": "aerodynamic+analytic",
    "envmimic-shared": "EnvMimic, one for all tasks",
    "envmimic-near": "EnvMimic, near its data",
    "envmimic-wrench": "EnvMimic, wrench",
    "envmimic-paper": "EnvMimic, the paper's preset",
}


def colour_of(simulator: str) -> tuple[float, float, float]:
    """Return the colour of a simulator (red, green, blue; 0 to 1). The same name always has the same colour.

    A sum of residuals (`aerodynamic+supervised`) without an entry in `COLOURS` has a dark mixture of its parts'
    colours, mostly of the last. A later round (`envmimic-2`) is paler than the previous one. Other names have one of
    `_OTHERS`.
    """
    variant = SimulatorVariant.parse(simulator)
    red, green, blue = 1 - (1 - _first_round(variant.residual or variant.name)) * _PALER ** (variant.round - 1)
    return float(red), float(green), float(blue)


def label_of(simulator: str) -> str:
    """Return the label of a simulator in figures.

    For a sum of residuals that is not in `LABELS`, join the labels of its parts. For another name, return the name.
    """
    variant = SimulatorVariant.parse(simulator)
    name = variant.residual or variant.name
    label = LABELS.get(name) or "+".join(LABELS.get(part, part) for part in name.split("+"))
    return label + (f", round {variant.round}" if variant.round > 1 else "")


def _first_round(name: str) -> Float[np.ndarray, " 3"]:
    if name in COLOURS:
        return np.array(to_rgb(COLOURS[name]))
    *before, last = name.split("+")
    if before and all(part in COLOURS for part in (*before, last)):
        mixed = _first_round("+".join(before)) * (1 - _SHARE_OF_LAST) + _first_round(last) * _SHARE_OF_LAST
        return mixed * _DARKER
    return np.array(to_rgb(_OTHERS[zlib.crc32(name.encode()) % len(_OTHERS)]))


_PALER = 0.55
_DARKER = 0.75
_SHARE_OF_LAST = 0.65
_OTHERS = ("#8c564b", "#7f7f7f", "#bcbd22", "#17becf", "#e377c2", "#6b6ecf", "#b5cf6b", "#ad494a")
"""Colours of names that are not in `COLOURS`."""
_DOTS_PER_INCH = 120
COMMAND_COLOURS = ("#1f77b4", "#d64d1f", "#2ca02c", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf")
"""Colours of a robot's commands, in order. They repeat if there are more commands."""


def unwrapped(runs: Float[np.ndarray, "runs T 3"], start: float) -> Float[np.ndarray, "runs T 3"]:
    """Return runs (x, y, yaw) with unwrapped yaw in degrees instead of yaw in radians.

    The first yaw of each run is within 180 deg of `start` (rad), the recording's first yaw.
    """
    yaw = np.unwrap(runs[..., 2], axis=-1)
    yaw = yaw - 2 * np.pi * np.round((yaw[:, :1] - start) / (2 * np.pi))
    return np.concatenate([runs[..., :2], np.rad2deg(yaw)[..., None]], axis=-1)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, without a display."""
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=_DOTS_PER_INCH)


def step_axis(steps: str) -> tuple[str, float]:
    """Return the label of a learning curve's x axis, and the number of steps that is 1 on it.

    `steps` is the unit of the run's metrics (`registry.steps_of`). Control steps are counted in millions.
    """
    return (steps, 1.0) if steps == GRADIENT_STEPS else (f"{steps} (millions)", 1e6)
