"""A residual whose loads are the output of a neural network."""

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
    """EnvMimic's kind of residual (see `residual.Residual`): a policy's action is what pushes the robot.

    **Fields**

    - `config`: what the policy sees, and what its actions mean.
    - `robot`: which it pushes.
    - `infer`: (parameters, observation) to the most likely action.
    - `sample`: (parameters, observation, key) to a drawn one; None: there is none to be had.
    - `network`: the network's options; None: unknown, and the residual cannot be exported.
    """

    config: ForceNetworkConfig
    robot: RobotDescription
    infer: Callable[[Any, Float[Array, " inputs"]], Float[Array, " loads"]]
    sample: Callable[[Any, Float[Array, " inputs"], Array], Float[Array, " loads"]] | None = None
    name: str = "envmimic"
    network: PPOConfig | None = None

    def inputs(self, history: History, commands: Commands) -> Float[Array, " inputs"]:
        """Return what the policy sees."""
        return network_input(history, commands, self.config, self.robot)

    def act(self, params: Any, history: History, commands: Commands, key: Array | None = None) -> Action:
        """Return the policy's loads, where they act."""
        seen, yaw = self.inputs(history, commands), history[-1, ObservationLayout.yaw]
        if key is None or self.sample is None:
            loads = self.loads(params, seen, yaw)
        else:
            loads = world_loads(self.sample(params, seen, key), yaw, self.config, self.robot)
        return FORCE_SETS[self.config.forces].act(loads, self.robot)

    def loads(self, params: Any, seen: Float[Array, " inputs"], yaw: Float[Array, ""]) -> Float[Array, " loads"]:
        """The most likely loads (N, N m, commands' units; world) for what the policy sees, at a heading."""
        return world_loads(self.infer(params, seen), yaw, self.config, self.robot)
