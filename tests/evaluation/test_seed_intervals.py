"""Intervals over seeds: do they hold the mean as often as they say, and who is told apart?"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ballu_mjx.evaluation.seed_intervals import paired_difference, seed_means, t_interval

DATASETS = 4000


@pytest.mark.parametrize("trial_noise", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("seeds", [3, 5])
def test_intervals_hold_the_mean_over_all_trainings(seeds: int, trial_noise: float) -> None:
    """Seeds differ by 1, trials of a seed by `trial_noise`; 95 % intervals of five trials a seed."""
    rng = np.random.default_rng(seeds)
    data = 2.0 + rng.normal(size=(DATASETS, seeds, 1)) + trial_noise * rng.normal(size=(DATASETS, seeds, 5))
    found = [t_interval(seed_means(each)) for each in data.tolist()]
    held = np.mean([each.half is not None and abs(each.mean - 2.0) <= each.half for each in found])
    assert 0.93 <= held <= 0.97


@pytest.mark.parametrize("seeds", [3, 5])
def test_equal_settings_are_seldom_told_apart(seeds: int) -> None:
    """Pairs share a robot each, which matters more than the setting."""
    rng = np.random.default_rng(seeds)
    shared = 5.0 * rng.normal(size=(DATASETS, seeds))
    one, other = (shared + rng.normal(size=(DATASETS, seeds)) for _ in range(2))
    apart = [paired_difference(a, b).excludes_zero for a, b in zip(one.tolist(), other.tolist(), strict=True)]
    assert np.mean(apart) <= 0.07


def test_a_paired_difference_sees_what_the_pairs_share_hides() -> None:
    robots = np.array([1.0, 4.0, 9.0, 2.0])
    found = paired_difference((robots + [0.5, 0.6, 0.4, 0.5]).tolist(), robots.tolist())
    assert found.excludes_zero and found.mean == pytest.approx(0.5)
    expected = stats.t.interval(0.95, 3, loc=0.5, scale=stats.sem([0.5, 0.6, 0.4, 0.5]))
    assert (found.low, found.high) == pytest.approx(expected)


def test_one_seed_has_no_interval_and_is_told_apart_from_none() -> None:
    found = t_interval(seed_means([[1.0, 2.0, 3.0]]))
    assert found.mean == 2.0 and found.half is found.low is found.high is None
    assert not paired_difference([5.0], [1.0]).excludes_zero


def test_seeds_weigh_alike_whatever_their_trials() -> None:
    assert t_interval(seed_means([[1.0], [3.0] * 9])).mean == 2.0


@pytest.mark.parametrize("values", [[], [1.0, float("nan")], [float("inf"), 2.0]])
def test_what_has_no_mean_is_refused(values: list[float]) -> None:
    with pytest.raises(ValueError, match="finite values, one or more"):
        t_interval(values)


def test_seeds_without_trials_and_unequal_pairs_are_refused() -> None:
    for nothing in ([], [[1.0], []]):
        with pytest.raises(ValueError, match="a trial or more"):
            seed_means(nothing)
    with pytest.raises(ValueError, match="equal numbers, not 1 and 2"):
        paired_difference([1.0], [1.0, 2.0])
