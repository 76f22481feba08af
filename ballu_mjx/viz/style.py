"""One colour and one label for each simulator, in all figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

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
_DOTS_PER_INCH = 120
SIDE_COLOURS = ("#1f77b4", "#d64d1f")
"""Left and right, as in the model."""


def unwrapped(runs: Float[np.ndarray, "runs T 3"], start: float) -> Float[np.ndarray, "runs T 3"]:
    """Yaw in degrees without jumps, starting on the same turn as the recording's."""
    yaw = np.unwrap(runs[..., 2], axis=-1)
    yaw = yaw - 2 * np.pi * np.round((yaw[:, :1] - start) / (2 * np.pi))
    return np.concatenate([runs[..., :2], np.rad2deg(yaw)[..., None]], axis=-1)


def save_figure(figure: Figure, path: Path) -> None:
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=_DOTS_PER_INCH)
