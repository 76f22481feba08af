"""Choice between models of the legs."""

from __future__ import annotations

import numpy as np

from ballu_mjx.ballu.leg_model_selection import select_model


def test_models_with_equally_many_parameters_are_compared():
    """So they are where the richer model holds the springs."""
    poor, good = np.full((2, 400), 3.0), np.full((2, 400), 1.0)
    for before, after, richer in ((poor, good, True), (good, poor, False), (good, good, False)):
        found = select_model(before, after, np.ones((2, 400)), 10, 0)
        assert found.richer == richer and np.isfinite(found.statistic)
