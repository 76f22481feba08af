"""What the output of a residual network stands for: loads, their units, limit, frame and cost."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim import force_sets
from ballu_mjx.sim.force_sets import FORCE_SETS
from ballu_mjx.sim.observation import world_rotation


def load_names(config: ForceNetworkConfig, robot: RobotDescription) -> list[str]:
    """Return the names of a network's loads, each with its unit."""
    return FORCE_SETS[config.forces].names(robot)


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
