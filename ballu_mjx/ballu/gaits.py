"""Hand-designed command sequences: gaits, and sequences that are unlike any gait."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.model import CONTROL_TIMESTEP


@dataclasses.dataclass(frozen=True)
class Gait:
    """Bang-bang commands of a gait: `high` for a fraction `duty` of every period, and 0 otherwise."""

    period: float
    """Period (s)."""
    phase: float
    """Phase by which the right leg is ahead of the left, as a fraction of the period."""
    duty: tuple[float, float]
    """Fraction of the period with a high command (left, right)."""
    high: tuple[float, float]
    """High command (left, right)."""

    def commands(self, seconds: float) -> Float[np.ndarray, "steps 2"]:
        """Return commands (left, right) of `seconds` (s), with one row for each control step."""
        time = np.arange(round(seconds / CONTROL_TIMESTEP)) * CONTROL_TIMESTEP
        phases = time[:, None] / self.period + np.array([0.0, self.phase])
        return np.where(phases % 1.0 < np.array(self.duty) - 1e-9, np.array(self.high), 0.0)


# The notes of the bundled recordings quote the docstrings of the four functions below.


def hopping(seconds: float) -> Float[np.ndarray, "steps 2"]:
    """Both legs together, a period of 1.4 s."""
    return Gait(1.4, 0.0, (0.4, 0.4), (0.9, 0.9)).commands(seconds)


def one_legged(seconds: float) -> Float[np.ndarray, "steps 2"]:
    """Two strides on one leg, then two on the other."""
    time = np.arange(round(seconds / CONTROL_TIMESTEP)) * CONTROL_TIMESTEP
    left = Gait(1.0, 0.0, (0.45, 0.45), (1.0, 1.0)).commands(seconds)
    return np.where(np.stack([time % 4.0 < 2.0, time % 4.0 >= 2.0], axis=1), left, 0.0)


def telegraph(seconds: float, seed: int = 11) -> Float[np.ndarray, "steps 2"]:
    """Each leg jumps to another random level after another random wait."""
    rng = np.random.default_rng(seed)
    commands = np.zeros((round(seconds / CONTROL_TIMESTEP), 2))
    for leg in range(2):
        step = 0
        while step < len(commands):
            wait = rng.integers(5, 20)
            commands[step : step + wait, leg] = rng.uniform(0.0, 1.0)
            step += wait
    return np.round(commands, 3)


def waves(seconds: float) -> Float[np.ndarray, "steps 2"]:
    """Smooth waves whose period drifts from 0.8 to 1.8 s."""
    time = np.arange(round(seconds / CONTROL_TIMESTEP)) * CONTROL_TIMESTEP
    phase = 2 * np.pi * np.cumsum(CONTROL_TIMESTEP / np.linspace(0.8, 1.8, len(time)))
    return np.round(0.5 - 0.5 * np.cos(np.stack([phase, phase + np.pi], axis=1)), 3)


GAITS: Mapping[str, Callable[[float], Float[np.ndarray, "steps 2"]]] = {
    "walking": Gait(1.2, 0.5, (0.4, 0.4), (0.9, 0.9)).commands,
    "turning": Gait(1.0, 0.4, (0.4, 0.6), (1.0, 0.5)).commands,
    "hopping": hopping,
    "one-legged": one_legged,
    "telegraph": telegraph,
    "waves": waves,
}
"""Functions by name from a length (s) to a command sequence with one row for each control step."""
