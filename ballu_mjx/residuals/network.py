"""Residual forces by a neural network: what it sees, and what its output means."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.recordings.reference import ReferenceMotions
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.force_model import Fields, ForceSet, num_vectors, to_wrenches
from ballu_mjx.sim.observation import (
    HISTORY,
    ObservationLayout,
    commands_seen,
    heading_observation,
    heading_observation_names,
    world_rotation,
)


@dataclasses.dataclass(frozen=True)
class ForceNetworkConfig:
    """What a force network sees, and what its output means."""

    forces: ForceSet = "force"
    """What the policy pushes with: a force on the tracked body (the paper's), a force and a torque there (wrench), or
    forces there and at all measured points (multi)."""
    force_limit: float = 1.0
    """Largest force along each axis, N (paper: 1)."""
    force_scale: float = 0.05
    """Force, N, that one unit of the policy's output stands for. The forces that close the gap are hundredths of a
    newton: with 1 N a unit, PPO's first steps throw the robot over, with a constant learning rate for good."""
    torque_scale: float = 0.005
    """Torque, N m, that one unit of the policy's output stands for, where it pushes with one. Limit and cost are, unit
    for unit, those of a force."""
    observe_command: bool = True
    """Let the policy see the commands (now and the last two), which the paper's state leaves out."""
    relative_observation: bool = True
    """Horizontal positions that the policy sees are from the tracked body, so that forces do not depend on the place in
    the room. The paper's are the room's. Those of an anchored robot always are."""
    heading_frame: bool = True
    """Directions that the policy sees, yaw and forces are in the tracked body's heading frame. The paper's are the
    world's. Those of an anchored robot always are."""


def network_input(
    history: Float[Array, "3 features"],
    commands: Float[Array, "3 commands"],
    config: ForceNetworkConfig,
    robot: RobotDescription,
) -> Float[Array, " inputs"]:
    """Return `heading_observation`, with the commands (the coming one last) where the configuration asks for them.

    Commands come as fractions of their ranges, 0 to 1, whatever their units.
    """
    seen = heading_observation(
        history, robot.anchored, relative=config.relative_observation, turned=config.heading_frame
    )
    if not config.observe_command:
        return seen
    low, high = np.array(robot.command_ranges, np.float32).T
    return jnp.concatenate([seen, ((commands - low) / (high - low)).ravel()])


def network_input_names(config: ForceNetworkConfig, robot: RobotDescription) -> list[str]:
    """Return the names of `network_input`, each with its unit and control step."""
    steps = ["now", "one control step ago", "two control steps ago"][:HISTORY][::-1]
    seen = heading_observation_names((robot.tracked, *robot.points))
    names = [f"{name}, {step}" for step in steps for name in seen]
    if config.observe_command:
        steps = ["coming", "last", "last but one"][:HISTORY][::-1]
        names += [f"command {command}, share of its range, {step}" for step in steps for command in robot.commands]
    return names


def load_names(config: ForceNetworkConfig, robot: RobotDescription) -> list[str]:
    """Return the names of a network's loads, each with its unit."""
    tracked = f"force on {robot.tracked}, N"
    vectors = {
        "force": [tracked],
        "wrench": [tracked, f"torque on {robot.tracked}, N m"],
        "multi": [tracked, *(f"force at {point}, N" for point in robot.points)],
    }[config.forces]
    return [f"{vector.partition(',')[0]} {axis},{vector.partition(',')[2]}" for vector in vectors for axis in "xyz"]


def num_inputs(config: ForceNetworkConfig, robot: RobotDescription) -> int:
    """Return the size of `network_input`."""
    return HISTORY * (ObservationLayout.of(robot).size + len(robot.commands) * config.observe_command)


def num_loads(config: ForceNetworkConfig, robot: RobotDescription) -> int:
    """Return the size of an action."""
    return 3 * num_vectors(config.forces, len(robot.points))


def load_units(config: ForceNetworkConfig, size: int) -> Float[np.ndarray, " loads"]:
    """What one unit of each number of an action stands for, N or N m."""
    scale = np.full(size, config.force_scale)
    if config.forces == "wrench":
        scale[3:] = config.torque_scale
    return scale


def square_newtons(loads: Float[Array, "*batch loads"], config: ForceNetworkConfig) -> Float[Array, "*batch"]:
    """What loads cost force for (N^2): their squares, a torque counted as the force that takes as many units."""
    in_newtons = loads / load_units(config, loads.shape[-1]) * config.force_scale
    return jnp.sum(in_newtons**2, axis=-1)


def world_loads(
    action: Float[Array, " loads"], yaw: Float[Array, ""], config: ForceNetworkConfig, robot: RobotDescription
) -> Float[Array, " loads"]:
    """Return the loads (N, N m; world; see `to_wrenches`) that an action stands for, within the limit along each axis.

    Actions are in the tracked body's heading frame, like the observation: the same situation met in another direction
    calls for the same force, turned. Those on an anchored robot, or without `heading_frame`, are in the world's.
    """
    most = config.force_limit / config.force_scale
    loads = jnp.asarray(load_units(config, len(action))) * jnp.clip(action, -most, most)
    return (loads.reshape(-1, 3) @ force_frame(yaw, config, robot).T).ravel()


def force_frame(yaw: Float[Array, ""], config: ForceNetworkConfig, robot: RobotDescription) -> Float[Array, "3 3"]:
    """Return the rotation that takes vectors in the frame of a network's actions to the world."""
    return world_rotation(yaw, robot.anchored or not config.heading_frame)


@dataclasses.dataclass(frozen=True)
class NetworkForces:
    """EnvMimic's kind of residual (see `force_model.ForceModel`): a policy's action is what pushes the robot.

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

    def inputs(
        self, history: Float[Array, "steps features"], commands: Float[Array, "steps commands"]
    ) -> Float[Array, " inputs"]:
        """What the policy sees."""
        return network_input(history, commands, self.config, self.robot)

    def fields(self, params: Any) -> Fields:
        """None: forces are all there is."""
        return {}

    def command(self, params: Any, commands: Float[Array, "steps commands"]) -> Float[Array, "1 commands"]:
        """The command as it is."""
        return commands[-1:]

    def wrench(
        self,
        params: Any,
        history: Float[Array, "steps features"],
        commands: Float[Array, "steps commands"],
        key: Array | None = None,
    ) -> Float[Array, "loaded 6"]:
        """The policy's loads, where they act."""
        seen, yaw = self.inputs(history, commands), history[-1, ObservationLayout.yaw]
        if key is None or self.sample is None:
            loads = self.loads(params, seen, yaw)
        else:
            loads = world_loads(self.sample(params, seen, key), yaw, self.config, self.robot)
        return to_wrenches(loads, self.config.forces)

    def loads(self, params: Any, seen: Float[Array, " inputs"], yaw: Float[Array, ""]) -> Float[Array, " loads"]:
        """The most likely loads (N, N m; world) for what the policy sees, at a heading."""
        return world_loads(self.infer(params, seen), yaw, self.config, self.robot)


def recorded_inputs(
    reference: ReferenceMotions, config: ForceNetworkConfig, robot: RobotDescription
) -> Float[Array, "states inputs"]:
    """What the policy would see of every recorded state."""

    def inputs(recording: Array, time: Array) -> Array:
        history = jax.lax.dynamic_slice_in_dim(reference.features[recording], time - HISTORY + 1, HISTORY)
        return network_input(history, commands_seen(reference.command[recording], time), config, robot)

    steps = np.asarray(reference.steps)
    pairs = np.array([(r, k) for r, count in enumerate(steps) for k in range(HISTORY - 1, count)])
    return jax.jit(jax.vmap(inputs))(*jnp.array(pairs).T)
