"""Regression and gradients by the functions of the package's root. Their residuals can be simulated and evaluated."""

from __future__ import annotations

import numpy as np
import pytest

import ballu_mjx as bm
from ballu_mjx.recordings.recording import cut

pytestmark = pytest.mark.optimized


@pytest.fixture(scope="module")
def simulator() -> bm.Simulator:
    return bm.Simulator(bm.load_robot("ballu"))


@pytest.fixture(scope="module")
def motions(simulator: bm.Simulator) -> list[bm.Motion]:
    robot = simulator.robot
    short = [cut(each, slice(0, 6 * 60)) for each in bm.load_recordings("training", robot)[1:3]]
    return [bm.reconstruct(each, robot) for each in short]


def test_regression_returns_a_residual(simulator: bm.Simulator, motions: list[bm.Motion]):
    learned = bm.fit_supervised(simulator, motions, bm.SupervisedConfig(updates=20, force_scales=(1.0,)))
    found = bm.evaluate(simulator.with_residual(learned), motions)
    assert np.isfinite(found.score) and found.residual != found.vanilla
    assert "Labels, training" in learned.report


def test_gradients_return_a_residual(simulator: bm.Simulator, motions: list[bm.Motion]):
    config = bm.AnalyticConfig(window_seconds=0.5, relinearizations=1, updates=2, validate_every=2)
    learned = bm.fit_analytic(simulator, motions, config)
    assert np.isfinite(bm.evaluate(simulator.with_residual(learned), motions).score)
