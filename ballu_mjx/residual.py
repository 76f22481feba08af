"""A trained residual: the force that EnvMimic's policy adds to a simulator."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

from jaxtyping import Array, Float

from ballu_mjx import envmimic, ppo, runs
from ballu_mjx.envmimic import EnvMimicConfig
from ballu_mjx.ppo import Inference, Params, PPOConfig
from ballu_mjx.robot import ActuatorParameters


@dataclasses.dataclass(frozen=True)
class Residual:
    """The deterministic force policy of a run. `force` is pure: it may be jitted and vmapped.

    **Fields**

    - `config`: what the policy sees, and what its actions mean.
    - `params`: as `ppo.train` returned them.
    - `infer`: (parameters, observation) to action.
    - `step`: control steps of training behind it.
    - `actuators`: of the simulator that the force belongs to; None for the nominal ones.
    """

    config: EnvMimicConfig
    params: Params
    infer: Inference
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
        infer = ppo.make_inference(
            params.normalizer.mean["state"].shape[0], ACTIONS, runs.typed(PPOConfig, stored["ppo"], folder)
        )
        config = runs.typed(EnvMimicConfig, stored["env"], folder)
        return Residual(config, params, infer, step, runs.actuators(stored, folder))

    def force(self, history: Float[Array, "steps features"], commands: Float[Array, "steps 2"]) -> Float[Array, " 3"]:
        """Force (N, world) on the balloon's centre of mass over the coming control step.

        **Arguments**

        - `history`: `envmimic.features` of the last three control steps, the current one last.
        - `commands`: of the last two control steps and the coming one; see `envmimic.commands_seen`.
        """
        action = self.infer(self.params, envmimic.policy_input(history, commands, self.config))
        return envmimic.world_force(action, history[-1, _YAW], self.config)


ACTIONS = 3
"""Force along three axes."""
_YAW = 8  # the balloon's, among the features
