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
from ballu_mjx.residuals.aerodynamics import AERODYNAMICS_FILE, Aerodynamics, read_air_parameters
from ballu_mjx.residuals.envmimic import EnvMimicConfig, check_envmimic_config
from ballu_mjx.residuals.network import NetworkForces, num_inputs, num_loads
from ballu_mjx.residuals.run_config import run_actuators, run_residual, run_robot
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs.checkpoints import restore_checkpoint
from ballu_mjx.runs.folder import Run, read_config, typed_config
from ballu_mjx.sim.force_model import BoundForces, Fields, ForceModel, SumOfForces

NETWORK_TASKS = ("envmimic", "supervised", "analytic")
"""Runs that leave a network of forces."""
RESIDUAL_TASKS = (*NETWORK_TASKS, "aerodynamic")
"""Runs that leave a residual."""
MARGIN = 0.1
"""How far beyond the recorded range, in its widths, an observation still counts as inside: the range is that of a
finite sample."""
_OBSERVED = "observed.json"
_NARROW = 1e-3


@dataclasses.dataclass(frozen=True)
class TrainedResidual:
    """The residual of a run. All methods are pure: they may be jitted and vmapped.

    **Fields**

    - `model`: its kind.
    - `params`: what was learned.
    - `observed`: smallest and largest of each of the model's inputs over the recordings it was learned from.
    - `step`: control steps of training behind it.
    - `actuators`: of the simulator that it belongs to; None for the nominal ones.
    """

    model: ForceModel
    params: Any
    observed: tuple[Float[np.ndarray, " inputs"], Float[np.ndarray, " inputs"]]
    step: int
    actuators: ModelParameters | None

    @staticmethod
    def load(
        folder: Path | str,
        which: Literal["best", "last"] = "best",
        *,
        beside: frozenset[Path] = frozenset(),
        description: RobotDescription | None = None,
    ) -> TrainedResidual:
        """The residual of a run; of a network that in the best (by validation error) or last checkpoint.
        `beside`: runs of which it is a part; `description`: the robot that it has to be of (None: BALLU).

        **Raises** `InputError` where `folder` is no such run, is of another robot or has no such checkpoint.
        """
        description = description or load_robot()
        folder = Path(folder)
        beside |= {folder.resolve()}
        stored = read_config(folder, *RESIDUAL_TASKS)
        own = run_robot(stored, folder)
        if own.sha256 != description.sha256:
            raise InputError(
                f"{folder}: is of the robot {own.name}, not of {description.name}; give one of the same robot."
            )
        identified = run_actuators(stored, folder, own)
        if stored["task"] == "aerodynamic":
            step, model = 0, Aerodynamics(description.load_model(identified))
            params = read_air_parameters(folder / AERODYNAMICS_FILE)
            inputs = num_inputs(EnvMimicConfig(), description)
        else:
            step, tree = restore_checkpoint(folder, which)
            params = ppo.from_tree(tree)
            inputs = params.normalizer.mean["state"].shape[0]
            config = typed_config(EnvMimicConfig, stored, "env", folder, check_envmimic_config)
            network = typed_config(PPOConfig, stored, "ppo", folder, ppo.check_values)
            sizes = inputs, num_loads(config, description), network
            infer = ppo.make_inference(*sizes)
            if not (inputs == num_inputs(config, description) and ppo.fits(infer, params, inputs)):
                raise InputError(
                    f"{folder}: the stored parameters do not fit the networks in its config.json; restore one of them."
                )
            sample = ppo.make_sampler(*sizes) if stored["task"] == "envmimic" else None
            model = NetworkForces(config, infer, sample, stored["task"], description.anchored)
            if (where := run_residual(stored, folder)) is not None:
                if where.resolve() in beside:
                    raise InputError(f"{folder}: its residual stands beside itself; restore its config.json.")
                other = TrainedResidual.load(where, beside=beside, description=description)
                model, params = SumOfForces(other.model, model), (other.params, params)
        return TrainedResidual(model, params, _read_observed(folder / _OBSERVED, inputs), step, identified)

    @property
    def applied(self) -> BoundForces:
        """Model and parameters."""
        return BoundForces(self.model, self.params)

    @property
    def fields(self) -> Fields:
        """Model fields to simulate with; see `force_model.ForceModel.fields`."""
        return self.model.fields(self.params)

    def command(self, commands: Float[Array, "steps commands"]) -> Float[Array, "parts commands"]:
        """What the actuators get; see `force_model.ForceModel.command`."""
        return self.model.command(self.params, commands)

    def wrench(
        self,
        history: Float[Array, "steps features"],
        commands: Float[Array, "steps commands"],
        key: Array | None = None,
    ) -> Float[Array, "loaded 6"]:
        """Forces and torques over the coming control step; see `force_model.ForceModel.wrench`."""
        return self.model.wrench(self.params, history, commands, key)

    def excess(
        self, history: Float[Array, "steps features"], commands: Float[Array, "steps commands"]
    ) -> Float[Array, ""]:
        """How far an observation lies outside of what the recordings showed: by the worst of its entries, in widths of
        that entry's range, `MARGIN` taken off; 0 inside."""
        seen = self.model.inputs(history, commands)
        low, high = (jnp.asarray(bound) for bound in self.observed)
        beyond = jnp.maximum(low - seen, seen - high) / jnp.maximum(high - low, _NARROW)
        return jnp.maximum(jnp.max(beyond) - MARGIN, 0.0)


def write_observed(run: Run, inputs: Float[Array | np.ndarray, "states inputs"]) -> None:
    """Leave in the run's folder the range of what its policy saw in the recordings."""
    low, high = np.min(inputs, axis=0), np.max(inputs, axis=0)
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
