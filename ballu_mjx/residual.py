"""A learned residual, of whatever kind, for whoever simulates next."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx import aerodynamics, ppo, robot, runs
from ballu_mjx.aerodynamics import Aerodynamics
from ballu_mjx.envmimic import EnvMimicConfig, ForcePolicy
from ballu_mjx.errors import InputError
from ballu_mjx.forces import Applied, Fields, ForceModel, Sum
from ballu_mjx.ppo import PPOConfig
from ballu_mjx.robot import ActuatorParameters

ACTIONS = 3
"""Force along three axes."""
TASKS = ("envmimic", "aerodynamic")
"""Runs that leave a residual."""
MARGIN = 0.1
"""How far beyond the recorded range, in its widths, an observation still counts as inside: the range is that of a
finite sample."""
_OBSERVED = "observed.json"
_NARROW = 1e-3


@dataclasses.dataclass(frozen=True)
class Residual:
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
    actuators: ActuatorParameters | None

    @staticmethod
    def load(folder: Path | str, which: Literal["best", "last"] = "best") -> Residual:
        """The residual of a run; of EnvMimic's the policy in the best (by validation error) or last checkpoint.

        **Raises** `InputError` where `folder` is no such run or has no such checkpoint.
        """
        folder = Path(folder)
        stored = runs.read_config(folder, *TASKS)
        identified = runs.actuators(stored, folder)
        if stored["task"] == "aerodynamic":
            step, model = 0, Aerodynamics(robot.load_model(identified))
            params = aerodynamics.read(folder / aerodynamics.FILE)
            inputs = _INPUTS
        else:
            step, tree = runs.restore(folder, which)
            params = ppo.from_tree(tree)
            inputs = params.normalizer.mean["state"].shape[0]
            sizes = inputs, ACTIONS, runs.typed(PPOConfig, stored["ppo"], folder)
            config = runs.typed(EnvMimicConfig, stored["env"], folder)
            model = ForcePolicy(config, ppo.make_inference(*sizes), ppo.make_sampler(*sizes))
            if stored.get("residual") is not None:
                beside = Residual.load(stored["residual"])
                model, params = Sum(beside.model, model), (beside.params, params)
        return Residual(model, params, _read_observed(folder / _OBSERVED, inputs), step, identified)

    @property
    def applied(self) -> Applied:
        """Model and parameters."""
        return Applied(self.model, self.params)

    @property
    def fields(self) -> Fields:
        """Model fields to simulate with; see `forces.ForceModel.fields`."""
        return self.model.fields(self.params)

    def command(self, commands: Float[Array, "steps 2"]) -> Float[Array, "parts 2"]:
        """What the servos get; see `forces.ForceModel.command`."""
        return self.model.command(self.params, commands)

    def wrench(
        self, history: Float[Array, "steps features"], commands: Float[Array, "steps 2"], key: Array | None = None
    ) -> Float[Array, " 6"]:
        """Force and torque on the balloon over the coming control step; see `forces.ForceModel.wrench`."""
        return self.model.wrench(self.params, history, commands, key)

    def excess(self, history: Float[Array, "steps features"], commands: Float[Array, "steps 2"]) -> Float[Array, ""]:
        """How far an observation lies outside of what the recordings showed: by the worst of its entries, in widths of
        that entry's range, `MARGIN` taken off; 0 inside."""
        seen = self.model.inputs(history, commands)
        low, high = (jnp.asarray(bound) for bound in self.observed)
        beyond = jnp.maximum(low - seen, seen - high) / jnp.maximum(high - low, _NARROW)
        return jnp.maximum(jnp.max(beyond) - MARGIN, 0.0)


_INPUTS = 87
"""Of `envmimic.policy_input` with its defaults."""


def write_observed(run: runs.Run, inputs: Float[Array, "states inputs"]) -> None:
    """Leave in the run's folder the range of what its policy saw in the recordings."""
    low, high = np.min(inputs, axis=0), np.max(inputs, axis=0)
    run.write(_OBSERVED, json.dumps({"low": low.tolist(), "high": high.tolist()}) + "\n")


def _read_observed(path: Path, size: int) -> tuple[np.ndarray, np.ndarray]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        low, high = (np.asarray(content[name], np.float32) for name in ("low", "high"))
        if low.shape == high.shape == (size,) and np.all(low <= high):
            return low, high
        problem = f"low and high must be {size} numbers each, low at most high"
    except (OSError, ValueError, KeyError, TypeError) as error:
        problem = str(error)
    raise InputError(f"{path}: the range of the observations cannot be read ({problem}); train the residual again.")
