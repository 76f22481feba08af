"""Integrated autocorrelation times of processes for which they are known."""

import numpy as np
import pytest

from ballu_mjx.identification.effective_samples import integrated_autocorrelation_time

COUNT = 20000


def begins(*starts: int, count: int = COUNT) -> np.ndarray:
    return np.isin(np.arange(count), starts)


def test_autoregressive_errors_have_their_theoretical_autocorrelation_time() -> None:
    """For a first-order process with coefficient a, the time is (1 + a) / (1 - a). White noise has a = 0."""
    rng = np.random.default_rng(0)
    coefficients = np.array([0.0, 0.5, 0.9])
    errors, now = np.zeros((COUNT, 3)), np.zeros(3)
    for sample in range(COUNT):
        now = coefficients * now + rng.normal(size=3)
        errors[sample] = now
    found = integrated_autocorrelation_time(errors, begins(0))
    assert found == pytest.approx((1 + coefficients) / (1 - coefficients), rel=0.15, abs=0.15)


def test_a_constant_error_is_one_sample_and_alternating_errors_are_independent() -> None:
    errors = np.stack([np.ones(100), (-1.0) ** np.arange(100)], axis=1)
    assert integrated_autocorrelation_time(errors, begins(0, count=100)) == pytest.approx([100, 1], rel=0.02)


def test_errors_of_different_recordings_do_not_correlate() -> None:
    errors = np.ones((100, 1))
    assert integrated_autocorrelation_time(errors, begins(0, 50, count=100)) == pytest.approx([50], rel=0.04)


def test_errors_of_zero_are_uncorrelated() -> None:
    assert integrated_autocorrelation_time(np.zeros((10, 2)), begins(0, count=10)) == pytest.approx([1, 1])
