"""Residual whose loads are the output of a neural network."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Float

from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_input import network_input
from ballu_mjx.residuals.network_loads import world_loads
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.force_sets import FORCE_SETS
from ballu_mjx.sim.observation import ObservationLayout
from ballu_mjx.sim.residual import Action, Commands, History, Residual


@dataclasses.dataclass(frozen=True)
class NetworkResidual(Residual):
    """Residual (`sim.residual.Residual`) whose loads are the output of a neural network, as in EnvMimic.

    **Fields**

    - `config`: options of the network's input and output.
    - `robot`: the robot on which the loads act.
    - `infer`: function of parameters and input that returns the mode of the output's distribution.
    - `sample`: function of parameters, input and key that returns a sample of this distribution. None if the network
      cannot be sampled.
    - `name`: name of a simulator with this residual.
    - `network`: options of the network. None if unknown; the residual then cannot be exported.
    """

    config: ForceNetworkConfig
    robot: RobotDescription
    infer: Callable[[Any, Float[Array, " inputs"]], Float[Array, " loads"]]
    sample: Callable[[Any, Float[Array, " inputs"], Array], Float[Array, " loads"]] | None = None
    name: str = "envmimic"
    network: PPOConfig | None = None

    def inputs(self, history: History, commands: Commands) -> Float[Array, " inputs"]:
        """Return the input of the network."""
        return network_input(history, commands, self.config, self.robot)

    def act(self, params: Any, history: History, commands: Commands, key: Array | None = None) -> Action:
        """Return the network's loads over the coming control step.

        With `key`, they are sampled from the network's distribution, if it can be sampled. Without `key`, they are the
        distribution's mode.
        """
        seen, yaw = self.inputs(history, commands), history[-1, ObservationLayout.yaw]
        if key is None or self.sample is None:
            loads = self.loads(params, seen, yaw)
        else:
            loads = world_loads(self.sample(params, seen, key), yaw, self.config, self.robot)
        return FORCE_SETS[self.config.forces].act(loads, self.robot)

    def loads(self, params: Any, seen: Float[Array, " inputs"], yaw: Float[Array, ""]) -> Float[Array, " loads"]:
        """Return the mode of the loads (N, N m, commands' units; world frame) for an input `seen` and a yaw (rad)."""
        return world_loads(self.infer(params, seen), yaw, self.config, self.robot)
