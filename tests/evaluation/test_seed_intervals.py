"""Confidence intervals over seeds: their coverage, and paired differences of settings."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ballu_mjx.evaluation.seed_intervals import paired_difference, seed_means, t_interval

DATASETS = 4000


@pytest.mark.parametrize("trial_noise", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("seeds", [3, 5])
def test_intervals_contain_the_mean_over_all_trainings_in_95_percent(seeds: int, trial_noise: float) -> None:
    """Standard deviations are 1 between seeds, and `trial_noise` between the five trials of a seed."""
    rng = np.random.default_rng(seeds)
    data = 2.0 + rng.normal(size=(DATASETS, seeds, 1)) + trial_noise * rng.normal(size=(DATASETS, seeds, 5))
    found = [t_interval(seed_means(each)) for each in data.tolist()]
    coverage = np.mean([each.half is not None and abs(each.mean - 2.0) <= each.half for each in found])
    assert 0.93 <= coverage <= 0.97


@pytest.mark.parametrize("seeds", [3, 5])
def test_equal_settings_seldom_differ_significantly(seeds: int) -> None:
    """Both values of a pair have the same robot. Robots differ more than the values of a pair."""
    rng = np.random.default_rng(seeds)
    shared = 5.0 * rng.normal(size=(DATASETS, seeds))
    one, other = (shared + rng.normal(size=(DATASETS, seeds)) for _ in range(2))
    significant = [paired_difference(a, b).excludes_zero for a, b in zip(one.tolist(), other.tolist(), strict=True)]
    assert np.mean(significant) <= 0.07


def test_paired_difference_removes_the_effect_that_pairs_share() -> None:
    robots = np.array([1.0, 4.0, 9.0, 2.0])
    found = paired_difference((robots + [0.5, 0.6, 0.4, 0.5]).tolist(), robots.tolist())
    assert found.excludes_zero and found.mean == pytest.approx(0.5)
    expected = stats.t.interval(0.95, 3, loc=0.5, scale=stats.sem([0.5, 0.6, 0.4, 0.5]))
    assert (found.low, found.high) == pytest.approx(expected)


def test_one_seed_has_no_interval_and_no_significant_difference() -> None:
    found = t_interval(seed_means([[1.0, 2.0, 3.0]]))
    assert found.mean == 2.0 and found.half is found.low is found.high is None
    assert not paired_difference([5.0], [1.0]).excludes_zero


def test_seeds_have_equal_weights_for_any_number_of_trials() -> None:
    assert t_interval(seed_means([[1.0], [3.0] * 9])).mean == 2.0


@pytest.mark.parametrize("values", [[], [1.0, float("nan")], [float("inf"), 2.0]])
def test_empty_and_non_finite_values_are_refused(values: list[float]) -> None:
    with pytest.raises(ValueError, match="finite values, one or more"):
        t_interval(values)


def test_seeds_without_trials_and_unequal_pairs_are_refused() -> None:
    for nothing in ([], [[1.0], []]):
        with pytest.raises(ValueError, match="a trial or more"):
            seed_means(nothing)
    with pytest.raises(ValueError, match="equal numbers, not 1 and 2"):
        paired_difference([1.0], [1.0, 2.0])
