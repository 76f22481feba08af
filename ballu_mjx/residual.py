"""A trained residual: the force that EnvMimic's policy adds to a simulator."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx import envmimic, ppo, runs
from ballu_mjx.envmimic import EnvMimicConfig
from ballu_mjx.errors import InputError
from ballu_mjx.ppo import Inference, Params, PPOConfig, Sampler
from ballu_mjx.robot import ActuatorParameters

ACTIONS = 3
"""Force along three axes."""
MARGIN = 0.1
"""How far beyond the recorded range, in its widths, an observation still counts as inside: the range is that of a
finite sample."""
_OBSERVED = "observed.json"
_NARROW = 1e-3
_YAW = 8  # the balloon's, among the features


@dataclasses.dataclass(frozen=True)
class Residual:
    """The force policy of a run. `force` and `excess` are pure: they may be jitted and vmapped.

    **Fields**

    - `config`: what the policy sees, and what its actions mean.
    - `params`: what `learner.params` gave.
    - `infer`: (parameters, observation) to the most likely action.
    - `sample`: (parameters, observation, key) to a drawn one.
    - `observed`: smallest and largest of each input over the recordings it was trained on.
    - `step`: control steps of training behind it.
    - `actuators`: of the simulator that the force belongs to; None for the nominal ones.
    """

    config: EnvMimicConfig
    params: Params
    infer: Inference
    sample: Sampler
    observed: tuple[Float[np.ndarray, " inputs"], Float[np.ndarray, " inputs"]]
    step: int
    actuators: ActuatorParameters | None

    @staticmethod
    def load(folder: Path | str, which: Literal["best", "last"] = "best") -> Residual:
        """The policy in a run's best (by validation error) or last checkpoint.

        **Raises** `InputError` where `folder` is no EnvMimic run or has no such checkpoint.
        """
        folder = Path(folder)
        stored = runs.read_config(folder, "envmimic")
        step, tree = runs.restore(folder, which)
        params = ppo.from_tree(tree)
        sizes = params.normalizer.mean["state"].shape[0], ACTIONS, runs.typed(PPOConfig, stored["ppo"], folder)
        return Residual(
            config=runs.typed(EnvMimicConfig, stored["env"], folder),
            params=params,
            infer=ppo.make_inference(*sizes),
            sample=ppo.make_sampler(*sizes),
            observed=_read_observed(folder / _OBSERVED, sizes[0]),
            step=step,
            actuators=runs.actuators(stored, folder),
        )

    def force(
        self, history: Float[Array, "steps features"], commands: Float[Array, "steps 2"], key: Array | None = None
    ) -> Float[Array, " 3"]:
        """Force (N, world) on the balloon's centre of mass over the coming control step.

        **Arguments**

        - `history`: `envmimic.features` of the last three control steps, the current one last.
        - `commands`: of the last two control steps and the coming one; see `envmimic.commands_seen`.
        - `key`: draws from the policy's distribution; without it, the most likely force.
        """
        seen = envmimic.policy_input(history, commands, self.config)
        action = self.infer(self.params, seen) if key is None else self.sample(self.params, seen, key)
        return envmimic.world_force(action, history[-1, _YAW], self.config)

    def excess(self, history: Float[Array, "steps features"], commands: Float[Array, "steps 2"]) -> Float[Array, ""]:
        """How far an observation lies outside of what the recordings showed: by the worst of its entries, in widths of
        that entry's range, `MARGIN` taken off; 0 inside."""
        seen = envmimic.policy_input(history, commands, self.config)
        low, high = (jnp.asarray(bound) for bound in self.observed)
        beyond = jnp.maximum(low - seen, seen - high) / jnp.maximum(high - low, _NARROW)
        return jnp.maximum(jnp.max(beyond) - MARGIN, 0.0)


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
