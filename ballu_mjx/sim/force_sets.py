"""Force sets: what the outputs of a network stand for, and what they do on a robot."""

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
"""What a network acts with: a force on the tracked body (the paper's), a force and a torque on it, forces on it and at
every measured point, forces and torques along joints, or changes of the commands. `FORCE_SETS` says all of each."""


class ForceSetKind(NamedTuple):
    """A force set."""

    names: Callable[[RobotDescription], list[str]]
    """Its loads, each with its unit."""
    turns: bool
    """Whether loads are vectors, three numbers each, that turn with the robot's heading."""
    act: Callable[[Float[Array, " loads"], RobotDescription], Action]
    """Loads, vectors in the world frame, as what they do."""


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
"""By name. All methods that learn a network take all of them."""


def num_loads(forces: ForceSet, robot: RobotDescription) -> int:
    """Return the number of a force set's loads on a robot."""
    return len(FORCE_SETS[forces].names(robot))


def check_force_set(forces: ForceSet, robot: RobotDescription) -> None:
    """**Raises** `InputError` where the robot has nothing that the force set acts on."""
    if not num_loads(forces, robot):
        raise InputError(
            f'--forces {forces}: {robot.name} has no hinge or slide to act along; name some under "force_joints" in '
            f"{robot.file}, or give another force set."
        )
