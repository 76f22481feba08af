"""Offset between two clocks: that of a log of commands and that of a recorded motion, with its confidence.

This module needs only NumPy and SciPy.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float
from scipy.signal import correlate, find_peaks

TIMESTEP = 0.01
"""Step (s) of the grid on which signals are compared. Offsets are interpolated between grid points."""
_PEAK_DISTANCE = 0.2
"""Distance (s) below which two offsets count as the same."""
_FILLED_GAP = 0.1
"""Longest gap (s) that is interpolated. Longer gaps of the motion are left out of the comparison."""
_RESTING = 0.2
"""Smallest standard deviation by which a signal is divided, relative to that of the signal that varies most. It keeps
signals at rest small."""


@dataclasses.dataclass(frozen=True)
class Match:
    """An offset between the clocks, and its correlation."""

    offset: float
    """Time (s) to add to the log's times to get the capture's times."""
    correlation: float
    """Correlation over all signals, in [-1, 1]. Negative if they move against the prediction."""


@dataclasses.dataclass(frozen=True)
class Alignment:
    """The best offset, and the next best offset that differs from it."""

    best: Match
    second: Match | None
    """Next best offset, with a correlation of the same sign. None if no other offset has a peak."""
    overlap: float
    """Duration (s) of the overlap at the best offset."""

    @property
    def confidence(self) -> float:
        """Return the confidence in the best offset, from 0 (the second fits as well) to 1 (there is no second).

        It is 1 - q(second) / q(best), where q = r^2 / (1 - r^2) is the ratio of explained to unexplained variance.
        """
        if self.second is None:
            return 1.0
        return 1.0 - min(_odds(self.second.correlation) / max(_odds(self.best.correlation), 1e-12), 1.0)


def align(
    time: Float[np.ndarray, " T"],
    motion: Float[np.ndarray, "T signals"],
    log_time: Float[np.ndarray, " N"],
    predicted: Float[np.ndarray, "N signals"],
    *,
    within: tuple[float, float] | None = None,
    overlap: float = 0.7,
) -> Alignment | None:
    """Return the offset of the log's clock at which `predicted` correlates best with `motion`.

    The criterion is the normalized cross-correlation. Signals are scaled to the same variance, and their covariances
    and variances are summed. The correlation may have either sign. A parabola interpolates the peak.

    **Arguments**

    - `time`, `motion`: times (s) and recorded signals (any unit) that respond to commands, NaN where not seen.
    - `log_time`, `predicted`: times (s, log's clock) and the same signals as a model predicts them from the commands.
    - `within`: smallest and largest offset (s) of the search. None for all offsets with enough overlap.
    - `overlap`: smallest overlap, as a fraction of the shorter of the two.

    **Returns** None if nothing moves, or if no offset of the search leaves enough overlap.
    """
    x, seen = _on_grid(time, motion)
    y, known = _on_grid(log_time, predicted)
    x, y = _scaled(x, seen), _scaled(y, known)
    lags = (np.arange(len(x) + len(y) - 1) - (len(y) - 1)) * TIMESTEP + time[0] - log_time[0]
    samples, covariance, variance_x, variance_y = (np.zeros(len(lags)) for _ in range(4))
    for signal in range(x.shape[1]):
        a, b, m, n = x[:, signal], y[:, signal], seen[:, signal].astype(float), known[:, signal].astype(float)
        count = np.maximum(_correlate(m, n), 1e-9)
        mean_a, mean_b = _correlate(a, n) / count, _correlate(m, b) / count
        covariance += _correlate(a, b) - count * mean_a * mean_b
        variance_x += np.maximum(_correlate(a * a, n) - count * mean_a**2, 0.0)
        variance_y += np.maximum(_correlate(m, b * b) - count * mean_b**2, 0.0)
        samples += count
    samples = samples / x.shape[1] * TIMESTEP
    scale = np.sqrt(variance_x * variance_y)
    allowed = samples >= overlap * min(len(x), len(y)) * TIMESTEP * 0.98
    if within is not None:
        allowed &= (lags >= within[0] - TIMESTEP / 2) & (lags <= within[1] + TIMESTEP / 2)
    moving = scale > 1e-6 * np.max(scale, initial=0.0)
    if not (allowed & moving).any() or np.max(scale) < 1e-12:
        return None
    correlation = np.where(moving, covariance / np.maximum(scale, 1e-300), 0.0)
    allowed_correlation = np.where(allowed, np.abs(correlation), 0.0)
    best = int(allowed_correlation.argmax())
    sign = math.copysign(1.0, float(correlation[best]))
    signed = np.where(allowed, sign * correlation, -1.0)
    peaks = find_peaks(signed, distance=max(1, round(_PEAK_DISTANCE / TIMESTEP)))[0]
    others = [p for p in peaks if abs(p - best) * TIMESTEP > _PEAK_DISTANCE and signed[p] > 0]
    second = max(others, key=lambda p: signed[p], default=None)
    return Alignment(
        _match(lags, correlation, best),
        None if second is None else _match(lags, correlation, int(second)),
        float(samples[best]),
    )


def _match(lags: Float[np.ndarray, " L"], correlation: Float[np.ndarray, " L"], peak: int) -> Match:
    """Return the offset and correlation of a peak, with the offset interpolated between grid points."""
    shift = 0.0
    if 0 < peak < len(lags) - 1:
        before, here, after = correlation[peak - 1 : peak + 2]
        curvature = before - 2 * here + after
        if abs(curvature) > 1e-12:
            shift = float(np.clip((before - after) / (2 * curvature), -0.5, 0.5))
    return Match(float(lags[peak] + shift * TIMESTEP), float(np.clip(correlation[peak], -1.0, 1.0)))


def _odds(correlation: float) -> float:
    """Return the ratio of explained to unexplained variance."""
    return correlation**2 / max(1.0 - correlation**2, 1e-9)


def _correlate(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " m"]) -> Float[np.ndarray, " L"]:
    return correlate(a, b, mode="full", method="fft")


def _on_grid(
    time: Float[np.ndarray, " T"], values: Float[np.ndarray, "T signals"]
) -> tuple[Float[np.ndarray, "n signals"], Float[np.ndarray, "n signals"]]:
    """Return values every `TIMESTEP` from the first time on, and a mask: 1 where they are known, else 0."""
    grid = time[0] + TIMESTEP * np.arange(int((time[-1] - time[0]) / TIMESTEP + 1e-6) + 1)
    columns, known = np.zeros((len(grid), values.shape[1])), np.zeros((len(grid), values.shape[1]))
    for signal, column in enumerate(values.T):
        seen = ~np.isnan(column)
        if seen.sum() < 2:
            continue
        columns[:, signal] = np.interp(grid, time[seen], column[seen])
        after = np.clip(np.searchsorted(time[seen], grid), 1, int(seen.sum()) - 1)
        step = time[seen][after] - time[seen][after - 1]
        inside = (grid >= time[seen][0] - 1e-9) & (grid <= time[seen][-1] + 1e-9)
        known[:, signal] = inside & (step <= max(_FILLED_GAP, 1.5 * float(np.median(np.diff(time)))))
    return columns, known


def _scaled(
    values: Float[np.ndarray, "n signals"], known: Float[np.ndarray, "n signals"]
) -> Float[np.ndarray, "n signals"]:
    """Return values with mean 0 and variance 1 where they are known, else 0. Signals at rest stay small."""
    count = np.maximum(known.sum(axis=0), 1.0)
    centred = (values - (values * known).sum(axis=0) / count) * known
    deviation = np.sqrt((centred**2).sum(axis=0) / count)
    return centred / np.maximum(deviation, max(_RESTING * float(deviation.max()), 1e-12))
