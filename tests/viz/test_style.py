"""Colours and labels of simulators: each simulator has its own, and every figure uses them."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from ballu_mjx.ballu import plots as ballu_plots
from ballu_mjx.policies.simulator_variants import SimulatorVariant
from ballu_mjx.viz import plots
from ballu_mjx.viz.style import COLOURS, colour_of, label_of

RESIDUALS = ("envmimic", "supervised", "analytic", "aerodynamic")
SUMS = ["+".join(pair) for pair in itertools.product(RESIDUALS, RESIDUALS)]


def test_every_simulator_has_its_own_colour():
    names = [*RESIDUALS, *SUMS, "vanilla", "vanilla+sysid", "vanilla+dr", "vanilla+sysid+dr", "envmimic-2", "recording"]
    for one, other in itertools.combinations(names, 2):
        assert np.linalg.norm(np.subtract(colour_of(one), colour_of(other))) > 0.1, (one, other)
    assert len({label_of(name) for name in names}) == len(names)
    assert colour_of("aerodynamic+envmimic") == pytest.approx(to_rgb(COLOURS["aerodynamic+envmimic"]))


@pytest.mark.parametrize("name", ["", "+", "vanilla+", "nobody", "envmimic-0", "a+b+c", "supervised-7"])
def test_unknown_names_have_a_constant_colour(name: str):
    assert colour_of(name) == colour_of(name) and all(0 <= part <= 1 for part in colour_of(name))
    assert label_of(name) == name


def test_later_rounds_have_paler_colours():
    first, second, third = (colour_of(name) for name in ("envmimic", "envmimic-2", "envmimic-3"))
    assert all(a <= b <= c for a, b, c in zip(first, second, third, strict=True)) and sum(first) < sum(third)
    assert label_of("envmimic-3") == "EnvMimic, round 3"


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SUMS, "aerodynamic+envmimic+analytic", "nobody"])
def test_every_figure_draws_every_combination(name: str, tmp_path: Path):
    """A residual learned on top of another one once caused a KeyError after training."""
    time, steps = np.arange(30) * 0.05, np.arange(1.0, 5.0)
    path = np.column_stack([time, 0.1 * time, 0.0 * time])
    panel = plots.TrackingPanel("near-1", time, path, {"vanilla+sysid": 0.9 * path, name: 1.1 * path})
    plots.tracking(tmp_path / "tracking.png", [panel])
    plots.reward_curve(tmp_path / "reward.png", steps, steps, steps, steps, name)
    plots.fit_curve(tmp_path / "fit.png", {"training": (steps, steps)}, (steps, steps), "error", name, 2)
    ballu_plots.draw_trajectories(tmp_path / "trajectories.png", [path], [1.2 * path], name)
    expected = np.round(255 * np.array(colour_of(name)))
    for picture in ("tracking", "reward", "fit", "trajectories"):
        pixels = np.asarray(Image.open(tmp_path / f"{picture}.png").convert("RGB")).reshape(-1, 3).astype(float)
        assert np.sum(np.abs(pixels - expected).max(axis=1) < 3) > 50, picture


def test_names_of_simulator_variants_are_parsed():
    variants = [
        SimulatorVariant(),
        SimulatorVariant(identified=True),
        SimulatorVariant(randomized=True),
        SimulatorVariant(identified=True, randomized=True),
        SimulatorVariant("envmimic"),
        SimulatorVariant("envmimic", round=3),
        SimulatorVariant("aerodynamic+envmimic"),
        SimulatorVariant("envmimic-shared"),
    ]
    names = [variant.name for variant in variants]
    assert names == [
        "vanilla",
        "vanilla+sysid",
        "vanilla+dr",
        "vanilla+sysid+dr",
        "envmimic",
        "envmimic-3",
        "aerodynamic+envmimic",
        "envmimic-shared",
    ]
    assert [SimulatorVariant.parse(name) for name in names] == variants
