"""Training range of a residual's inputs, and residuals whose action fades outside of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.rl.mirror import Mirror
from ballu_mjx.runs.record import TrainingRecord
from ballu_mjx.sim.residual import Action, Commands, Fields, History, Residual

MARGIN = 0.1
"""Margin around the training range, as a fraction of its width. Inputs within the margin count as inside, because the
range is that of a finite sample."""
NARROWEST = 1e-3
"""Smallest width of the training range of an input, in the input's unit."""
_FILE = "observed.json"
_UNBOUNDED = 1e30
"""Bound of an input whose training range is unknown."""


class TrainingRange(NamedTuple):
    """Smallest and largest value of each input over the training recordings."""

    low: Float[np.ndarray | Array, ...]
    high: Float[np.ndarray | Array, ...]

    @staticmethod
    def of(inputs: Float[Array | np.ndarray, "states inputs"], mirror: Mirror | None = None) -> TrainingRange:
        """Return the range of inputs.

        With `mirror`, the range includes the mirror images of the inputs, because a symmetric network learns their
        loads, too.
        """
        seen = np.asarray(inputs, np.float32)
        if mirror is not None:
            seen = np.concatenate([seen, np.asarray(mirror.observation(seen))])
        return TrainingRange(seen.min(axis=0), seen.max(axis=0))

    @staticmethod
    def unbounded() -> TrainingRange:
        """Return a range that contains all inputs."""
        return TrainingRange(np.array(-_UNBOUNDED, np.float32), np.array(_UNBOUNDED, np.float32))

    @staticmethod
    def read(folder: Path, size: int) -> TrainingRange:
        """Read the range of `size` inputs from a run.

        **Raises** `InputError` if the file is damaged.
        """
        path, fix = folder / _FILE, "train the residual again"
        content = files.read_json(path, fix)
        bounds = [content.get(name) for name in ("low", "high")]
        if all(isinstance(bound, list) and len(bound) == size and all(map(is_number, bound)) for bound in bounds):
            low, high = (np.asarray(bound, np.float32) for bound in bounds)
            if np.all(low <= high):
                return TrainingRange(low, high)
        raise InputError(f"{path}: low and high must have {size} numbers each, with low at most high; {fix}.")

    def write(self, run: TrainingRecord) -> None:
        """Write the range to a run."""
        content = {name: np.asarray(bound).tolist() for name, bound in self._asdict().items()}
        run.write(_FILE, json.dumps(content) + "\n")

    def excess(self, inputs: Float[Array, " inputs"]) -> Float[Array, ""]:
        """Return the distance of an input from the range. It is 0 in the range.

        The distance along an axis is in widths of the range, less `MARGIN`. The result is the largest one.
        """
        low, high = jnp.asarray(self.low), jnp.asarray(self.high)
        beyond = jnp.maximum(low - inputs, inputs - high) / jnp.maximum(high - low, NARROWEST)
        return jnp.maximum(jnp.max(beyond) - MARGIN, 0.0)

    def fade(self, inputs: Float[Array, " inputs"], width: float) -> Float[Array, ""]:
        """Return the factor exp(-(excess / width)^4): 1 in the range, 0.94 at half of `width`, and 0 far away."""
        return jnp.exp(-((self.excess(inputs) / width) ** 4))


class FadingResidual(Residual):
    """Residual whose action fades outside of its training range. `params` is the pair of its parameters and the range.

    Fields and delays of the residual do not fade.
    """

    def __init__(self, inner: Residual, width: float) -> None:
        """`width`: see `TrainingRange.fade`."""
        self.inner, self.width = inner, width

    @property
    def name(self) -> str:
        return self.inner.name

    def inputs(self, history: History, commands: Commands) -> Float[Array, " inputs"]:
        return self.inner.inputs(history, commands)

    def fields(self, params: tuple[Any, TrainingRange]) -> Fields:
        return self.inner.fields(params[0])

    def command(self, params: tuple[Any, TrainingRange], commands: Commands) -> Float[Array, "parts commands"]:
        return self.inner.command(params[0], commands)

    def act(
        self, params: tuple[Any, TrainingRange], history: History, commands: Commands, key: Array | None = None
    ) -> Action:
        own, observed = params
        share = observed.fade(self.inputs(history, commands), self.width)
        return self.inner.act(own, history, commands, key).scaled(share)


def with_fading(
    residual: Residual, width: float | None, observed: TrainingRange
) -> tuple[Residual, Callable[[Any], Any]]:
    """Return the residual with fading, and a function from its parameters to those with fading.

    Without a `width`, return the residual itself and the identity.
    """
    if width is None:
        return residual, lambda params: params
    return FadingResidual(residual, width), lambda params: (params, observed)
