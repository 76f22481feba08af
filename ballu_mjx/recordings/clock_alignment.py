"""Two clocks: at which offset a log of commands fits a recorded motion, and how sure that is. NumPy and SciPy alone."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float
from scipy.signal import correlate, find_peaks

TIMESTEP = 0.01
"""s, of the grid on which signals are compared; offsets are interpolated between its points."""
_PEAK_DISTANCE = 0.2
"""s; two offsets closer than that are one."""
_FILLED_GAP = 0.1
"""s; longer gaps of the motion are left out of the comparison."""
_RESTING = 0.2
"""A signal that moves by less of what the other does is not scaled up any further."""


@dataclasses.dataclass(frozen=True)
class Match:
    """One offset, and how well it fits."""

    offset: float
    """s, to add to the log's times for the capture's."""
    correlation: float
    """Over all signals, in [-1, 1]; negative where they move against the prediction."""


@dataclasses.dataclass(frozen=True)
class Alignment:
    """The best offset, and the next best one that is another."""

    best: Match
    second: Match | None
    """With the same sign; None where no other offset has a peak."""
    overlap: float
    """Seconds that the best is judged by."""

    @property
    def confidence(self) -> float:
        """From 0, where the second fits as well as the best, to 1, where there is none: one less the ratio of their
        unexplained to explained parts (r^2 / (1 - r^2))."""
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
    """The offset of the log's clock at which `predicted` correlates best with `motion`.

    Normalized cross-correlation, over all offsets at which the two overlap by `overlap` of the shorter one at least;
    covariances and variances are summed over signals, each scaled to the same variance. The sign is free. The peak is
    interpolated by a parabola.

    **Arguments**

    - `time`, `motion`: s and any unit; what moved on commands, NaN where not seen.
    - `log_time`, `predicted`: s, on the log's clock; what should have.
    - `within`: the offsets (s) to search. None: all with enough overlap.

    **Returns** None where nothing moves, or no offset in question leaves enough overlap.
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
    """The peak between grid points."""
    shift = 0.0
    if 0 < peak < len(lags) - 1:
        before, here, after = correlation[peak - 1 : peak + 2]
        curvature = before - 2 * here + after
        if abs(curvature) > 1e-12:
            shift = float(np.clip((before - after) / (2 * curvature), -0.5, 0.5))
    return Match(float(lags[peak] + shift * TIMESTEP), float(np.clip(correlation[peak], -1.0, 1.0)))


def _odds(correlation: float) -> float:
    return correlation**2 / max(1.0 - correlation**2, 1e-9)


def _correlate(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " m"]) -> Float[np.ndarray, " L"]:
    return correlate(a, b, mode="full", method="fft")


def _on_grid(
    time: Float[np.ndarray, " T"], values: Float[np.ndarray, "T signals"]
) -> tuple[Float[np.ndarray, "n signals"], Float[np.ndarray, "n signals"]]:
    """Values every `TIMESTEP` from the first time on, and 1 where they are known, else 0."""
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
    """Values with mean 0 and variance 1 where they are known, else 0; one that rests beside another stays small."""
    count = np.maximum(known.sum(axis=0), 1.0)
    centred = (values - (values * known).sum(axis=0) / count) * known
    deviation = np.sqrt((centred**2).sum(axis=0) / count)
    return centred / np.maximum(deviation, max(_RESTING * float(deviation.max()), 1e-12))
