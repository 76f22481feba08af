"""Number of independent samples in errors that are correlated in time."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float


def integrated_autocorrelation_time(
    errors: Float[np.ndarray, "samples channels"], begins: Bool[np.ndarray, " samples"]
) -> Float[np.ndarray, " channels"]:
    """Return the integrated autocorrelation time tau of each channel, in samples.

    n samples count as n / tau independent ones. tau is 1 + 2 sum(rho_k), with Geyer's initial monotone sequence (Geyer,
    "Practical Markov chain Monte Carlo", Statistical Science 7, 1992). Autocorrelations are added in pairs of lags
    while the pairs are positive, and no pair counts more than the previous one. The mean of the errors is not
    subtracted, so that a constant error is fully correlated. tau is at least 1: alternating errors do not count as
    more samples than there are.

    - `begins`: true at the first sample of each recording. Errors of different recordings are uncorrelated.
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
