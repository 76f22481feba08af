"""A learned residual, of whatever kind, for whoever simulates next."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.residuals.aerodynamics import AirParameters
from ballu_mjx.residuals.registry import KINDS, RESIDUAL_TASKS, StoredRun
from ballu_mjx.residuals.run_config import check_stands_in, run_actuators, run_residual, run_robot
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters
from ballu_mjx.runs.folder import read_config
from ballu_mjx.runs.record import TrainingRecord
from ballu_mjx.sim.residual import BoundResidual, Commands, History, Residual, SumOfResiduals
from ballu_mjx.sim.simulator import AugmentedSimulator

MARGIN = 0.1
"""How far beyond the recorded range, in its widths, an observation still counts as inside: the range is that of a
finite sample."""
_OBSERVED = "observed.json"
_NARROW = 1e-3
_ANYTHING = 1e30


@dataclasses.dataclass(frozen=True)
class TrainedResidual:
    """The residual of a run. All methods are pure: they may be jitted and vmapped.

    **Fields**

    - `model`: its kind.
    - `params`: what was learned.
    - `observed`: smallest and largest of each of the model's inputs over the recordings it was learned from.
    - `step`: control steps of training behind it.
    - `actuators`: of the simulator that it belongs to; None for the nominal ones.
    - `report`: what the training says of it, for the user; empty where that is nothing.
    """

    model: Residual
    params: Any
    observed: tuple[Float[np.ndarray, ...], Float[np.ndarray, ...]]
    step: int
    actuators: ModelParameters | None
    report: str = ""

    @staticmethod
    def of(simulator: AugmentedSimulator) -> TrainedResidual | None:
        """Return the residual in a simulator; None where it has none."""
        bound = simulator.residual
        if bound is None:
            return None
        observed = bound.observed
        if observed is None:
            observed = np.array(-_ANYTHING, np.float32), np.array(_ANYTHING, np.float32)
        return TrainedResidual(bound.model, bound.params, observed, 0, simulator.actuators)

    @staticmethod
    def load(
        folder: Path | str,
        robot: RobotDescription,
        which: Literal["best", "last"] = "best",
        *,
        other_model: bool = False,
        loading: frozenset[Path] = frozenset(),
    ) -> TrainedResidual:
        """Load the residual of a run; of a network that in the best (by validation error) or last checkpoint.

        `robot` is the one that it has to be of; with `other_model` one whose model may differ in its numbers, such as a
        load. `loading` are the runs whose base residual it is.

        **Raises** `InputError` where `folder` is no such run, is of another robot or has no such checkpoint.
        """
        folder = Path(folder)
        loading |= {folder.resolve()}
        stored = read_config(folder, *RESIDUAL_TASKS)
        own = run_robot(stored, folder)
        if other_model:
            check_stands_in(robot, own, folder)
        elif own.sha256 != robot.sha256:
            raise InputError(f"{folder}: is of the robot {own.name}, not of {robot.name}; give one of the same robot.")
        identified = run_actuators(stored, folder, robot)
        model, params, inputs, step = KINDS[stored["task"]].load(StoredRun(folder, stored, robot, identified, which))
        where = run_residual(stored, folder) if KINDS[stored["task"]].network else None
        if where is not None:
            if where.resolve() in loading:
                raise InputError(f"{folder}: is its own base residual; restore its config.json.")
            base = TrainedResidual.load(where, robot, other_model=other_model, loading=loading)
            both = base.bound.plus(BoundResidual(model, params))
            model, params = both.model, both.params
        return TrainedResidual(model, params, _read_observed(folder / _OBSERVED, inputs), step, identified)

    @property
    def bound(self) -> BoundResidual:
        """Return the model with its parameters."""
        return BoundResidual(self.model, self.params, self.observed)

    @property
    def latency(self) -> float:
        """Seconds by which commands are delayed on their way to the actuators."""
        return _latency(self.model, self.params)

    def out_of_range(self, history: History, commands: Commands) -> Float[Array, ""]:
        """Return how far an observation lies outside of what the recordings showed.

        It is that of the worst entry, in widths of the entry's range, `MARGIN` taken off; 0 inside.
        """
        seen = self.model.inputs(history, commands)
        low, high = (jnp.asarray(bound) for bound in self.observed)
        beyond = jnp.maximum(low - seen, seen - high) / jnp.maximum(high - low, _NARROW)
        return jnp.maximum(jnp.max(beyond) - MARGIN, 0.0)


def _latency(model: Residual, params: Any) -> float:
    if isinstance(model, SumOfResiduals):
        return sum(_latency(part, own) for part, own in zip(model.parts, params, strict=True))
    return float(params.delay) if isinstance(params, AirParameters) else 0.0


def observed_range(
    inputs: Float[Array | np.ndarray, "states inputs"],
) -> tuple[Float[np.ndarray, " inputs"], Float[np.ndarray, " inputs"]]:
    """Return the smallest and the largest of each input."""
    seen = np.asarray(inputs, np.float32)
    return seen.min(axis=0), seen.max(axis=0)


def write_observed(run: TrainingRecord, inputs: Float[Array | np.ndarray, "states inputs"]) -> None:
    """Leave in the run's folder the range of what its policy saw in the recordings."""
    low, high = observed_range(inputs)
    run.write(_OBSERVED, json.dumps({"low": low.tolist(), "high": high.tolist()}) + "\n")


def _read_observed(path: Path, size: int) -> tuple[np.ndarray, np.ndarray]:
    mend = "train the residual again"
    content = files.read_json(path, mend)
    bounds = [content.get(name) for name in ("low", "high")]
    if all(isinstance(bound, list) and len(bound) == size and all(map(is_number, bound)) for bound in bounds):
        low, high = (np.asarray(bound, np.float32) for bound in bounds)
        if np.all(low <= high):
            return low, high
    raise InputError(f"{path}: low and high are not {size} numbers each, low at most high; {mend}.")
