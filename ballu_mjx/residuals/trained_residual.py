"""Residual of any kind with its learned parameters, and its training range."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.residuals.aerodynamics import AirParameters
from ballu_mjx.residuals.registry import KINDS, RESIDUAL_TASKS, StoredRun
from ballu_mjx.residuals.run_config import (
    ResidualReference,
    check_compatible_robot,
    run_actuators,
    run_residual,
    run_robot,
)
from ballu_mjx.residuals.training_range import TrainingRange, with_fading
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters
from ballu_mjx.runs.folder import read_config
from ballu_mjx.runs.layout import CONFIG_FILE, Which
from ballu_mjx.sim.residual import BoundResidual, Commands, History, Residual, SumOfResiduals
from ballu_mjx.sim.simulator import AugmentedSimulator


@dataclasses.dataclass(frozen=True)
class TrainedResidual:
    """A residual with its learned parameters. All methods are pure: they may be jitted and vmapped.

    **Fields**

    - `model`: the residual without parameters.
    - `params`: the learned parameters.
    - `observed`: training range of the inputs.
    - `step`: control steps or gradient steps of training. 0 for kinds without checkpoints.
    - `actuators`: identified actuators of the simulator that the residual corrects. None if they are nominal.
    - `report`: report of the training for the user. Empty if there is none.
    """

    model: Residual
    params: Any
    observed: TrainingRange
    step: int
    actuators: ModelParameters | None
    report: str = ""

    @staticmethod
    def of(simulator: AugmentedSimulator) -> TrainedResidual | None:
        """Return the residual of a simulator. None if the simulator has no residual."""
        bound = simulator.residual
        if bound is None:
            return None
        observed = TrainingRange.unbounded() if bound.observed is None else TrainingRange(*bound.observed)
        return TrainedResidual(bound.model, bound.params, observed, 0, simulator.actuators)

    @staticmethod
    def load(
        folder: Path | str,
        robot: RobotDescription,
        which: Which = "best",
        *,
        other_model: bool = False,
        loading: frozenset[Path] = frozenset(),
    ) -> TrainedResidual:
        """Load the residual of a run, including its base residual.

        **Arguments**

        - `folder`: folder of the run.
        - `robot`: robot of the run.
        - `which`: checkpoint of a network: the best one (by validation error), the last one, or that of a step.
        - `other_model`: allow a `robot` whose model differs from the run's in its numbers, for example by a payload.
        - `loading`: folders of the runs that have this run as base residual.

        **Raises** `InputError` if `folder` is no run of a residual, is of another robot, or lacks the checkpoint.
        """
        folder = Path(folder)
        loading |= {folder.resolve()}
        stored = read_config(folder, *RESIDUAL_TASKS)
        own = run_robot(stored, folder)
        if other_model:
            check_compatible_robot(robot, own, stored, folder)
        elif own.sha256 != robot.sha256:
            raise InputError(f"{folder}: is of the robot {own.name}, not of {robot.name}; give one of the same robot.")
        identified = run_actuators(stored, folder, robot)
        model, own_params, inputs, step, fade_width = KINDS[stored["task"]].load(
            StoredRun(folder, stored, robot, identified, which)
        )
        observed = TrainingRange.read(folder, inputs)
        model, with_range = with_fading(model, fade_width, observed)
        params = with_range(own_params)
        reference = run_residual(stored, folder) if KINDS[stored["task"]].network else None
        if reference is not None:
            if reference.folder.resolve() in loading:
                raise InputError(f"{folder}: is its own base residual; restore its config.json.")
            base = TrainedResidual.load_reference(reference, robot, other_model=other_model, loading=loading)
            both = base.bound.plus(BoundResidual(model, params))
            model, params = both.model, both.params
        return TrainedResidual(model, params, observed, step, identified)

    @staticmethod
    def load_reference(
        reference: ResidualReference,
        robot: RobotDescription,
        *,
        other_model: bool = False,
        loading: frozenset[Path] = frozenset(),
    ) -> TrainedResidual:
        """Load the residual that another run's simulator contains, as it was when that run was trained.

        The arguments are those of `load`.

        **Raises** `InputError` from `load`, or if the residual has changed since.
        """
        from ballu_mjx.runs.checkpoints import list_checkpoints  # orbax takes long to import

        folder, step, sha256, user = reference
        if user is not None and not folder.is_dir():
            raise InputError(
                f"{user / CONFIG_FILE}: names the run {folder}, which is missing; move it back there, or change "
                '"residual" to its new place.'
            )
        steps = list_checkpoints(folder)
        fix = f"restore {folder}, or repeat the training of {user}"
        if steps and step is not None and step not in steps:
            raise InputError(f"{folder}: has no checkpoint of step {step:,} any more, which {user} contains; {fix}.")
        which = "best" if step is None or not steps else step
        found = TrainedResidual.load(folder, robot, which, other_model=other_model, loading=loading)
        if sha256 not in (None, found.sha256):
            raise InputError(f"{folder}: its residual has changed since {user} was trained with it; {fix}.")
        return found

    @functools.cached_property
    def sha256(self) -> str:
        """SHA-256 of the parameters."""
        digest = hashlib.sha256()
        for leaf in map(np.asarray, jax.tree.leaves(self.params)):
            digest.update(f"{leaf.shape} {leaf.dtype} ".encode() + leaf.tobytes())
        return digest.hexdigest()

    @property
    def bound(self) -> BoundResidual:
        """Return the residual with its parameters bound, as simulators take it."""
        return BoundResidual(self.model, self.params, self.observed)

    @property
    def latency(self) -> float:
        """Return the delay between commands and actuators that the residual adds (s)."""
        return _latency(self.model, self.params)

    def out_of_range(self, history: History, commands: Commands) -> Float[Array, ""]:
        """Return the distance of the residual's input from its training range; see `TrainingRange.excess`."""
        return self.observed.excess(self.model.inputs(history, commands))


def describe_residual(residual: TrainedResidual | None, folder: Path | None) -> dict[str, Any]:
    """Return the entries of a run's `config.json` about the residual in its simulator, which is that of a run.

    Both are None if the simulator has no residual. `run_residual` reads the entries.
    """
    if residual is None or folder is None:
        return {"residual": None}
    return {"residual": str(folder.resolve()), "residual_step": residual.step, "residual_sha256": residual.sha256}


def _latency(model: Residual, params: Any) -> float:
    if isinstance(model, SumOfResiduals):
        return sum(_latency(part, own) for part, own in zip(model.parts, params, strict=True))
    return float(params.delay) if isinstance(params, AirParameters) else 0.0
