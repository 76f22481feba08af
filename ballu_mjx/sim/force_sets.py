"""Force sets: the meaning of a network's outputs, and their effect on a robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.residual import Action

ForceSet = Literal["force", "wrench", "multi", "joints", "commands"]
"""Loads that a network outputs. `FORCE_SETS` has the details.

`force`: a force on the tracked body (as in the paper). `wrench`: a force and a torque on it. `multi`: forces on it and
at every measured point. `joints`: forces and torques along joints. `commands`: changes of the commands.
"""


class ForceSetKind(NamedTuple):
    """Definition of a force set."""

    names: Callable[[RobotDescription], list[str]]
    """Names of its loads, each with its unit."""
    turns: bool
    """Whether the loads are vectors, three numbers each, that rotate with the robot's heading."""
    act: Callable[[Float[Array, " loads"], RobotDescription], Action]
    """Function that returns the action of loads on a robot. Vectors are in the world frame."""


def _vectors(*heads: str) -> list[str]:
    return [f"{head.partition(',')[0]} {axis},{head.partition(',')[2]}" for head in heads for axis in "xyz"]


def _joint_names(robot: RobotDescription) -> list[str]:
    return [
        f"{'force' if joint.unit == 'N' else 'torque'} along {name}, {joint.unit}"
        for name, joint in robot.force_joints.items()
    ]


def _forces_alone(loads: Float[Array, " loads"]) -> Float[Array, "loaded 6"]:
    return jnp.pad(loads.reshape(-1, 3), [(0, 0), (0, 3)])


def _act_at_joints(loads: Float[Array, " loads"], robot: RobotDescription) -> Action:
    places = np.array([joint.place for joint in robot.force_joints.values()], int)
    force = jnp.zeros(robot.directions, loads.dtype).at[places].set(loads)
    return Action.none()._replace(joint_force=force)


FORCE_SETS: Mapping[ForceSet, ForceSetKind] = {
    "force": ForceSetKind(
        lambda robot: _vectors(f"force on {robot.tracked}, N"),
        True,
        lambda loads, robot: Action(_forces_alone(loads)),
    ),
    "wrench": ForceSetKind(
        lambda robot: _vectors(f"force on {robot.tracked}, N", f"torque on {robot.tracked}, N m"),
        True,
        lambda loads, robot: Action(loads[None]),
    ),
    "multi": ForceSetKind(
        lambda robot: _vectors(f"force on {robot.tracked}, N", *(f"force at {point}, N" for point in robot.points)),
        True,
        lambda loads, robot: Action(_forces_alone(loads)),
    ),
    "joints": ForceSetKind(_joint_names, False, _act_at_joints),
    "commands": ForceSetKind(
        lambda robot: [f"change of command {command}, its units" for command in robot.commands],
        False,
        lambda loads, robot: Action.none()._replace(command_change=loads),
    ),
}
"""Force sets by name. Every method that learns a network supports all of them."""


def num_loads(forces: ForceSet, robot: RobotDescription) -> int:
    """Return the number of loads that a force set has on a robot."""
    return len(FORCE_SETS[forces].names(robot))


def check_force_set(forces: ForceSet, robot: RobotDescription) -> None:
    """Check that a robot has something on which a force set acts.

    **Raises** `InputError` if it does not.
    """
    if not num_loads(forces, robot):
        raise InputError(
            f"--forces {forces}: {robot.name} has no hinge or slide joint that forces may act along; list joints "
            f'under "force_joints" in {robot.file}, or give another force set.'
        )
