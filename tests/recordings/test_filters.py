"""Savitzky-Golay filters."""

from __future__ import annotations

import numpy as np
import pytest

from ballu_mjx.recordings.filters import noise_gain, odd_window, savitzky_golay

STEP = 0.01


@pytest.mark.parametrize("derivative", [0, 1])
def test_noise_gain_is_the_spread_of_filtered_white_noise(derivative: int):
    noise = np.random.default_rng(0).standard_normal(200_000)
    filtered = savitzky_golay(noise, 0.11, STEP, 3, derivative)
    gain = noise_gain(odd_window(0.11, STEP, 3, len(noise)), 3, STEP, derivative)
    assert np.std(filtered[100:-100]) == pytest.approx(gain, rel=0.02)
