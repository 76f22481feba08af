"""Residual forces by a neural network: what it sees, and what its output means."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.recordings.reference import ReferenceMotions
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim import force_sets
from ballu_mjx.sim.force_model import Action, Commands, ForceModel, History
from ballu_mjx.sim.force_sets import FORCE_SETS, ForceSet
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
    """What the policy acts with: a force on the tracked body (the paper's), a force and a torque there (wrench), forces
    there and at all measured points (multi), forces and torques along joints (joints), or changes of the commands
    (commands)."""
    force_limit: float | None = None
    """Largest force along each axis, N (paper: 1). Other loads may be as many units. Without this option: the robot's
    own, or 20 units."""
    force_scale: float | None = None
    """Force, N, that one unit of the policy's output stands for. Without this option: the robot's own, or the size of
    what the model leaves unexplained in the training recordings. Joints and commands have `scales`: for limit and cost
    one of their units counts as this force."""
    torque_scale: float | None = None
    """Torque, N m, that one unit of the policy's output stands for, where it pushes with one. Without this option:
    likewise. Limit and cost are, unit for unit, those of a force."""
    scales: tuple[float, ...] = ()
    """What one unit of each output stands for, with `--forces joints` (N m, of slides N) and `commands` (their units),
    in their order. Without this option: from the training recordings."""
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
    return FORCE_SETS[config.forces].names(robot)


def num_inputs(config: ForceNetworkConfig, robot: RobotDescription) -> int:
    """Return the size of `network_input`."""
    return HISTORY * (ObservationLayout.of(robot).size + len(robot.commands) * config.observe_command)


def num_loads(config: ForceNetworkConfig, robot: RobotDescription) -> int:
    """Return the size of an action."""
    return force_sets.num_loads(config.forces, robot)


class LoadScales(NamedTuple):
    """What a network's outputs stand for."""

    units: Float[np.ndarray, " loads"]
    """One unit of each output (N, N m, commands' units)."""
    newtons: float
    """Force (N) that a unit counts as, for limit and cost."""
    limit: float
    """Largest output, in units."""


def load_scales(config: ForceNetworkConfig, robot: RobotDescription) -> LoadScales:
    """Return what the outputs of a network stand for; what the configuration leaves open is the robot's own.

    **Raises** `ValueError` where nothing tells (`scales.settle_scales` asks the recordings).
    """
    own, size = robot.adapter.residual_scales(), num_loads(config, robot)
    names = ("force_scale", "torque_scale", "force_limit")
    force, torque, limit = (
        getattr(own, name, None) if getattr(config, name) is None else getattr(config, name) for name in names
    )
    if FORCE_SETS[config.forces].turns:
        scales = None if force is None else [force] * size
        if scales is not None and config.forces == "wrench":
            scales[3:] = [torque] * 3
    else:
        scales = list(config.scales) if len(config.scales) == size else None
    if force is None or limit is None or scales is None or None in scales:
        raise ValueError("The scales of the forces are open; give them, or let settle_scales find them.")
    return LoadScales(np.array(scales, float), float(force), float(limit / force))


def load_units(config: ForceNetworkConfig, robot: RobotDescription) -> Float[np.ndarray, " loads"]:
    """What one unit of each number of an action stands for (N, N m, commands' units)."""
    return load_scales(config, robot).units


def square_newtons(
    loads: Float[Array, "*batch loads"], config: ForceNetworkConfig, robot: RobotDescription
) -> Float[Array, "*batch"]:
    """What loads cost force for (N^2): their squares, another load counted as the force that takes as many units."""
    scales = load_scales(config, robot)
    in_newtons = loads / scales.units * scales.newtons
    return jnp.sum(in_newtons**2, axis=-1)


def world_loads(
    action: Float[Array, " loads"], yaw: Float[Array, ""], config: ForceNetworkConfig, robot: RobotDescription
) -> Float[Array, " loads"]:
    """Return the loads (N, N m, commands' units; world) that an action stands for, within the limit on each.

    Vectors of actions are in the tracked body's heading frame, like the observation: the same situation met in another
    direction calls for the same force, turned. Those on an anchored robot, or without `heading_frame`, are in the
    world's.
    """
    scales = load_scales(config, robot)
    loads = jnp.asarray(scales.units) * jnp.clip(action, -scales.limit, scales.limit)
    if not FORCE_SETS[config.forces].turns:
        return loads
    return (loads.reshape(-1, 3) @ force_frame(yaw, config, robot).T).ravel()


def force_frame(yaw: Float[Array, ""], config: ForceNetworkConfig, robot: RobotDescription) -> Float[Array, "3 3"]:
    """Return the rotation that takes vectors in the frame of a network's actions to the world."""
    return world_rotation(yaw, robot.anchored or not config.heading_frame)


@dataclasses.dataclass(frozen=True)
class NetworkForces(ForceModel):
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
