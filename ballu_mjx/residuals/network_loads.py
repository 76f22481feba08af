"""Output of a residual network as loads: their names, units, limit, frame and cost."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim import force_sets
from ballu_mjx.sim.force_sets import FORCE_SETS, check_force_set
from ballu_mjx.sim.observation import world_rotation


def load_names(config: ForceNetworkConfig, robot: RobotDescription) -> list[str]:
    """Return the names of a network's loads, each with its unit."""
    return FORCE_SETS[config.forces].names(robot)


def num_loads(config: ForceNetworkConfig, robot: RobotDescription) -> int:
    """Return the number of a network's loads."""
    return force_sets.num_loads(config.forces, robot)


class LoadScales(NamedTuple):
    """Scales of a network's outputs. An output of 1 is called one unit."""

    units: Float[np.ndarray, " loads"]
    """Load for one unit of each output (N, N m, commands' units)."""
    newtons: float
    """Force that counts as one unit, for limit and cost (N)."""
    limit: float
    """Largest magnitude of an output (units)."""


def load_scales(config: ForceNetworkConfig, robot: RobotDescription) -> LoadScales:
    """Return the scales of a network's outputs.

    **Raises** `ValueError` if `config` lacks a value. `scales.resolve_scales` estimates it from recordings.
    """
    force, torque, limit = config.force_scale, config.torque_scale, config.force_limit
    size = num_loads(config, robot)
    scales: list[float | None] = list(config.scales)
    if FORCE_SETS[config.forces].turns:
        scales = [force] * 3 + [torque] * 3 if config.forces == "wrench" else [force] * size
    if force is None or limit is None or len(scales) != size or None in scales:
        raise ValueError("The scales of the forces are open; set them, or call resolve_scales.")
    return LoadScales(np.array(scales, float), float(force), float(limit / force))


def check_load_options(config: ForceNetworkConfig, robot: RobotDescription) -> None:
    """Check that the force set of a network, its scales and its expected loads fit the robot.

    **Raises** `InputError` if they do not.
    """
    check_force_set(config.forces, robot)
    size, count = num_loads(config, robot), len(config.scales)
    if count and FORCE_SETS[config.forces].turns:
        raise InputError(
            f"--scales is for --forces joints and --forces commands: with --forces {config.forces}, give --force-scale."
        )
    if config.torque_scale is not None and config.forces != "wrench":
        raise InputError(f"--torque-scale is for --forces wrench: leave it out with --forces {config.forces}.")
    if count not in (0, size):
        raise InputError(
            f"--scales has {count} values: give {size} with --forces {config.forces}, or leave it out for the default."
        )
    expected = len(config.expected_loads)
    if expected not in (0, 1, size):
        raise InputError(
            f"--expected-loads has {expected} values: give {size} with --forces {config.forces}, or one for all, or "
            "leave it out for the default."
        )


def load_units(config: ForceNetworkConfig, robot: RobotDescription) -> Float[np.ndarray, " loads"]:
    """Return the load for one unit of each output (N, N m, commands' units)."""
    return load_scales(config, robot).units


def expected_units(config: ForceNetworkConfig, robot: RobotDescription) -> Float[np.ndarray, " loads"]:
    """Return the loads at which an untrained network starts, as its outputs."""
    units = load_units(config, robot)
    return np.broadcast_to(np.asarray(config.expected_loads or (0.0,), float), units.shape) / units


def square_newtons(
    loads: Float[Array, "*batch loads"], config: ForceNetworkConfig, robot: RobotDescription
) -> Float[Array, "*batch"]:
    """Return the sum of the squared loads, as squared force (N^2), for the force cost.

    A load that is no force counts as a force with the same number of units.
    """
    scales = load_scales(config, robot)
    in_newtons = loads / scales.units * scales.newtons
    return jnp.sum(in_newtons**2, axis=-1)


def world_loads(
    action: Float[Array, " loads"], yaw: Float[Array, ""], config: ForceNetworkConfig, robot: RobotDescription
) -> Float[Array, " loads"]:
    """Return the loads (N, N m, commands' units; world frame) of a network's output, each clipped to the limit.

    Vectors of the output are in the tracked body's heading frame, as in the network's input. The same situation with
    another heading therefore has the same force, rotated by the heading. For an anchored robot, or without
    `config.heading_frame`, vectors of the output are in the world frame.
    """
    scales = load_scales(config, robot)
    loads = jnp.asarray(scales.units) * jnp.clip(action, -scales.limit, scales.limit)
    if not FORCE_SETS[config.forces].turns:
        return loads
    return (loads.reshape(-1, 3) @ force_frame(yaw, config, robot).T).ravel()


def force_frame(yaw: Float[Array, ""], config: ForceNetworkConfig, robot: RobotDescription) -> Float[Array, "3 3"]:
    """Return the rotation matrix, frame of a network's output to world frame, for a yaw (rad)."""
    return world_rotation(yaw, robot.anchored or not config.heading_frame)
