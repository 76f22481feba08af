"""Objective of a fit of parameters to windows of recordings, for any robot.

The starting state of each window is a further unknown. It is eliminated window by window (variable projection). The
parameters are then the only unknowns of a search, however many windows there are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ballu_mjx.identification.window_simulator import DIVERGED, Simulated, WindowSimulator


@dataclasses.dataclass(frozen=True)
class WindowConfig:
    """Windows that recordings are cut into, and weights of their errors."""

    window_seconds: float = 1.0
    """Length of a window (s)."""
    interval_seconds: float | None = None
    """Time between the starts of two windows (s). Without this option: the length of a window."""
    outlying: float = 3.0
    """Differences above this multiple of their scatter count less (pseudo-Huber loss)."""
    start_spread: float = 4.0
    """Standard deviation of starting states, in units of the measurements' noise. 0 takes them as measured. The default
    is well above 1, because filters compute starting states from samples with which the window is compared too."""


class ReducedResiduals(NamedTuple):
    """Residuals of the fit and their Jacobian, for starting states that follow the parameters to their optimum."""

    values: Float[np.ndarray, "windows rows"]
    slopes: Float[np.ndarray, "windows rows parameters"]
    """Jacobian in the parameters' units, orthogonal to all changes by starting states."""
    start: Float[np.ndarray, "windows start"]
    """Optimal shifts of the starting states, to first order, in units of the measurements' noise."""
    start_jacobian: Float[np.ndarray, "windows start parameters"]
    """Derivatives of these shifts with respect to the parameters."""

    @property
    def loss(self) -> float:
        """Return the sum of squares of the residuals."""
        return float(np.sum(self.values**2))


class WindowObjective:
    """Objective of a fit: pseudo-Huber residuals of the positions in all windows.

    Velocities have no residuals, because they are filtered positions. They would count the same noise twice, and would
    smooth away the effect of damping.
    """

    def __init__(self, simulator: WindowSimulator, config: WindowConfig) -> None:
        self.simulator, self.config = simulator, config
        self.parameters = simulator.parameters
        self.scale = np.ones(simulator.nv)
        """Scatter of the positions, in units of their noise."""

    def rescale(self, differences: Float[np.ndarray, "windows samples channels"]) -> None:
        """Set the positions' scatter to the robust scatter of `differences`, but not below their noise."""
        self.scale = robust_scatter(differences[..., : self.simulator.nv])

    def measured_start(self) -> Float[np.ndarray, "windows start"]:
        """Return zero shifts of the starting states. There are no columns if starting states are taken as measured."""
        return np.zeros((self.simulator.count, self.simulator.channels if self.config.start_spread else 0))

    def __call__(
        self, values: Float[np.ndarray, " parameters"], start: Float[np.ndarray, "windows start"]
    ) -> tuple[ReducedResiduals, Simulated]:
        """Return the residuals at parameter values and starting states, and the simulated windows."""
        simulated, positions = self.simulator.linearize(values, start), slice(self.simulator.nv)
        soft, steepness = soften(simulated.values[..., positions] / self.scale, self.config.outlying)
        weight = (steepness / self.scale)[..., None]
        windows, moving = start.shape
        flat = lambda x: x.reshape(windows, -1, *x.shape[3:])  # noqa: E731
        slopes, residuals = flat(weight * simulated.by_parameters[:, :, positions]), flat(soft)
        if not moving:
            none = np.zeros((windows, 0, slopes.shape[-1]))
            return ReducedResiduals(values=residuals, slopes=slopes, start=start, start_jacobian=none), simulated
        own = np.tile(np.eye(moving) / self.config.start_spread, (windows, 1, 1))
        by_start = np.concatenate([flat(weight * simulated.by_start[:, :, positions]), own], axis=1)
        slopes = np.concatenate([slopes, np.zeros((windows, moving, slopes.shape[-1]))], axis=1)
        residuals = np.concatenate([residuals, start / self.config.start_spread], axis=1)
        q, r = np.linalg.qr(by_start)
        turned = np.swapaxes(q, 1, 2)
        along, along_slopes = turned @ residuals[..., None], turned @ slopes
        reduced = ReducedResiduals(
            values=residuals,
            slopes=slopes - q @ along_slopes,
            start=start - np.linalg.solve(r, along)[..., 0],
            start_jacobian=-np.linalg.solve(r, along_slopes),
        )
        return reduced, simulated


def robust_scatter(differences: Float[np.ndarray, "windows samples channels"]) -> Float[np.ndarray, " channels"]:
    """Return each channel's robust standard deviation, in units of its noise, and at least 1."""
    differences = np.nan_to_num(differences, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED)
    return np.maximum(1.0, _NORMAL * np.median(np.abs(differences), axis=(0, 1)))


_NORMAL = 1.4826
"""Ratio of standard deviation to median absolute deviation of a normal distribution."""


def soften(values: Float[np.ndarray, "*shape"], outlying: float) -> tuple[np.ndarray, np.ndarray]:
    """Return signed residuals whose squares are the pseudo-Huber loss of `values`, and their derivatives."""
    root = np.sqrt(1 + (values / outlying) ** 2)
    soft = values * np.sqrt(2 / (root + 1))
    return soft, np.sqrt((root + 1) / 2) / root


class WindowSearch:
    """Function that the solver evaluates: residuals and their Jacobian with respect to the parameters' shares.

    A QR decomposition compresses them to one row more than there are parameters, which keeps all sums of squares. The
    search stores the starting states at the best point so far, and extrapolates them as the parameters change.
    """

    def __init__(
        self,
        objective: WindowObjective,
        start: Float[np.ndarray, "windows start"],
        on_evaluation: Callable[[Float[np.ndarray, " parameters"]], None] | None,
    ) -> None:
        self.objective, self.start, self.on_evaluation = objective, start, on_evaluation
        self.residuals = np.zeros((0, 0, 0))
        """Differences at the best point so far, in units of noise."""
        self._best: tuple[float, np.ndarray, ReducedResiduals] | None = None
        self._refused = 0

    def __call__(self, shares: Float[np.ndarray, " parameters"]) -> tuple[np.ndarray, np.ndarray]:
        parameters = self.objective.parameters
        values, start = parameters.at_shares(shares), self.start
        if self._best is not None:
            _, at, reduced = self._best
            step = reduced.start + reduced.start_jacobian @ (values - at) - start
            start = start + np.clip(step / 2.0**self._refused, -_FAR, _FAR)
        reduced, simulated = self.objective(values, start)
        if self.on_evaluation is not None:
            self.on_evaluation(values)
        prior = (values - parameters.expected) / parameters.prior
        loss = reduced.loss + float(prior @ prior)
        if self._best is None or loss < self._best[0]:
            self._best, self._refused = (loss, values, reduced), 0
            self.start, self.residuals = start, simulated.values
        else:  # the starting states may have moved too far
            self._refused += 1
        # Window by window first: LAPACK splits one tall table between many threads, and takes a hundred times as long.
        table = np.concatenate([reduced.slopes, reduced.values[..., None]], axis=2)
        windows = np.asarray(np.linalg.qr(table, mode="r")).reshape(-1, len(values) + 1)
        own = np.concatenate([np.diag(1 / parameters.prior), prior[:, None]], axis=1)
        triangle = np.asarray(np.linalg.qr(np.concatenate([windows, own]), mode="r"))
        triangle[:, :-1] *= parameters.with_respect_to_shares(values)
        return triangle[:, -1], triangle[:, :-1]


_FAR = 3.0
"""Largest step of a starting state, in units of the measurements' noise. The linearization is not valid beyond it."""
