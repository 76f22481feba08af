"""What a fit of parameters to windows of recordings minimizes, for any robot.

Each window's starting state is an unknown of its own. It is eliminated window by window (variable projection), so that
a search sees the parameters alone, however many windows there are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ballu_mjx.identification.window_simulator import Simulated, WindowSimulator


@dataclasses.dataclass(frozen=True)
class WindowConfig:
    """What recordings are cut into, and how they count."""

    window_seconds: float = 1.0
    """Length of a window, s."""
    interval_seconds: float | None = None
    """Time between the starts of two windows, s. Without this option: a window's length."""
    outlying: float = 3.0
    """Differences beyond so many times their scatter count less (pseudo-Huber loss)."""
    start_spread: float = 4.0
    """How uncertain starting states are, in units of the measurements' noise; 0: they are as measured. Well above 1,
    because filters make them from samples that the window compares too."""


class ReducedResiduals(NamedTuple):
    """Residuals, and how they change by the parameters while starting states move along to their best."""

    values: Float[np.ndarray, "windows rows"]
    slopes: Float[np.ndarray, "windows rows parameters"]
    """In the parameters' units; at right angles to all that starting states can change."""
    start: Float[np.ndarray, "windows start"]
    """The best starting states, to first order."""
    start_slopes: Float[np.ndarray, "windows start parameters"]

    @property
    def loss(self) -> float:
        return float(np.sum(self.values**2))


class WindowObjective:
    """Softened residuals of all windows: of positions alone. Velocities are filtered positions. Beside these they would
    count the same noise twice, and smooth away what damping does."""

    def __init__(self, simulator: WindowSimulator, config: WindowConfig) -> None:
        self.simulator, self.config = simulator, config
        self.parameters = simulator.parameters
        self.scale = np.ones(simulator.nv)
        """Of the positions' scatter, in units of their noise."""

    def rescale(self, differences: Float[np.ndarray, "windows samples channels"]) -> None:
        """Weigh positions by their robust scatter, and none by less than its noise."""
        self.scale = robust_scatter(differences[..., : self.simulator.nv])

    def measured_start(self) -> Float[np.ndarray, "windows start"]:
        """Return starting states that are not moved; without columns where they are known."""
        return np.zeros((self.simulator.count, self.simulator.channels if self.config.start_spread else 0))

    def __call__(
        self, values: Float[np.ndarray, " parameters"], start: Float[np.ndarray, "windows start"]
    ) -> tuple[ReducedResiduals, Simulated]:
        simulated, positions = self.simulator.linearize(values, start), slice(self.simulator.nv)
        soft, steepness = soften(simulated.values[..., positions] / self.scale, self.config.outlying)
        weight = (steepness / self.scale)[..., None]
        windows, moving = start.shape
        flat = lambda x: x.reshape(windows, -1, *x.shape[3:])  # noqa: E731
        slopes, residuals = flat(weight * simulated.by_parameters[:, :, positions]), flat(soft)
        if not moving:
            none = np.zeros((windows, 0, slopes.shape[-1]))
            return ReducedResiduals(values=residuals, slopes=slopes, start=start, start_slopes=none), simulated
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
            start_slopes=-np.linalg.solve(r, along_slopes),
        )
        return reduced, simulated


def robust_scatter(differences: Float[np.ndarray, "windows samples channels"]) -> Float[np.ndarray, " channels"]:
    """Return each channel's robust standard deviation, in units of its noise; none is below it."""
    return np.maximum(1.0, _NORMAL * np.median(np.abs(differences), axis=(0, 1)))


_NORMAL = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution."""


def soften(values: Float[np.ndarray, "*shape"], outlying: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what has the pseudo-Huber loss of `values` for its square, with their signs; and its slopes."""
    root = np.sqrt(1 + (values / outlying) ** 2)
    soft = values * np.sqrt(2 / (root + 1))
    return soft, np.sqrt((root + 1) / 2) / root


class WindowSearch:
    """What the solver evaluates: residuals and their Jacobian by the parameters' shares, compressed to as many rows as
    there are parameters (and one), which keep all sums of squares. Starting states are remembered from the best point
    so far, and moved along with the parameters."""

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
            step = reduced.start + reduced.start_slopes @ (values - at) - start
            start = start + np.clip(step / 2.0**self._refused, -_FAR, _FAR)
        reduced, simulated = self.objective(values, start)
        if self.on_evaluation is not None:
            self.on_evaluation(values)
        prior = (values - parameters.nominal) / parameters.prior
        loss = reduced.loss + float(prior @ prior)
        if self._best is None or loss < self._best[0]:
            self._best, self._refused = (loss, values, reduced), 0
            self.start, self.residuals = start, simulated.values
        else:  # starting states may be what went too far
            self._refused += 1
        # Window by window first: one tall table is left to many threads of LAPACK, and takes a hundred times as long.
        table = np.concatenate([reduced.slopes, reduced.values[..., None]], axis=2)
        windows = np.asarray(np.linalg.qr(table, mode="r")).reshape(-1, len(values) + 1)
        own = np.concatenate([np.diag(1 / parameters.prior), prior[:, None]], axis=1)
        triangle = np.asarray(np.linalg.qr(np.concatenate([windows, own]), mode="r"))
        triangle[:, :-1] *= parameters.by_shares(values)
        return triangle[:, -1], triangle[:, :-1]


_FAR = 3.0
"""Longest step of a starting state, in units of its uncertainty: the linearization holds no farther."""
