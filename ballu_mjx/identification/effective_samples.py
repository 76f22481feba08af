"""How many independent samples errors that go together in time are worth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float


def integrated_autocorrelation_time(
    errors: Float[np.ndarray, "samples channels"], begins: Bool[np.ndarray, " samples"]
) -> Float[np.ndarray, " channels"]:
    """Return the integrated autocorrelation time of each channel, in samples: n samples are worth n over it.

    It is 1 + 2 sum(rho_k), with Geyer's initial monotone sequence: correlations are added in pairs of lags as long as
    the pairs are positive, and no pair counts for more than the one before (Geyer, "Practical Markov chain Monte
    Carlo", Statistical Science 7, 1992). The errors' mean is not taken off, so that a constant error correlates fully.
    Never below 1: errors that alternate are not credited.

    - `begins`: where a recording begins; errors of different recordings do not correlate.
    """
    count = len(errors)
    covariance = np.zeros((count, errors.shape[1]))
    for part in np.split(errors, np.flatnonzero(begins)[1:]):
        spectrum = np.fft.rfft(part, 2 * len(part), axis=0)
        covariance[: len(part)] += np.fft.irfft(np.abs(spectrum) ** 2, axis=0)[: len(part)]
    even = count - count % 2
    pairs = covariance[:even:2] + covariance[1:even:2]
    monotone = np.minimum.accumulate(np.maximum(pairs, 0.0), axis=0)
    correlated = np.sum(monotone, axis=0) / np.maximum(covariance[0], np.finfo(float).tiny)
    return np.maximum(2 * correlated - 1, 1.0)
