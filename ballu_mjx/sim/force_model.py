"""What a residual is: model fields and commands that it changes, and wrenches on the robot's bodies, held over a
control step.

Everything that simulates takes residuals by this one interface, whatever they were learned by.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.robots.description import RobotDescription

Fields = dict[str, Array]
"""Fields of `mjx.Model` by name."""
ForceSet = Literal["force", "wrench", "multi", "joints", "commands"]
"""What a network acts with: a force on the tracked body (the paper's), a force and a torque on it, forces on it and at
every measured point, forces and torques along joints, or changes of the commands. `FORCE_SETS` says all of each."""


class Action(NamedTuple):
    """What a residual does over a control step."""

    wrench: Float[Array, "loaded 6"]
    """Force (N) and torque (N m), world frame; see `ForceModel.wrench`."""
    joint_force: Float[Array, " nv"] | None = None
    """N m or N, along `mjx.Data.qvel`; None: none."""
    command_change: Float[Array, " commands"] | None = None
    """In the actuators' own units; None: none."""

    def scaled(self, share: Float[Array, ""] | float) -> Action:
        """Return a share of it."""
        joint, change = (None if part is None else share * part for part in self[1:])
        return Action(share * self.wrench, joint, change)


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


def _act_at_joints(loads: Float[Array, " loads"], robot: RobotDescription) -> Action:
    places = np.array([joint.place for joint in robot.force_joints.values()], int)
    return Action(_nothing(), jnp.zeros(robot.directions, loads.dtype).at[places].set(loads))


def _nothing() -> Float[Array, "1 6"]:
    return jnp.zeros((1, 6))


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
        lambda loads, robot: Action(_nothing(), None, loads),
    ),
}
"""By name. All methods that learn a network take all of them."""


def _forces_alone(loads: Float[Array, " loads"]) -> Float[Array, "loaded 6"]:
    return jnp.pad(loads.reshape(-1, 3), [(0, 0), (0, 3)])


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


def add_parts(one: Array | None, other: Array | None) -> Array | None:
    """Return the sum of what may be missing."""
    if one is None or other is None:
        return other if one is None else one
    return one + other


def add_wrenches(one: Float[Array, "loaded 6"], other: Float[Array, "others 6"]) -> Float[Array, "bodies 6"]:
    """Wrenches of two residuals, on as many bodies as the one that acts on more."""
    most = max(len(one), len(other))
    one, other = (jnp.pad(wrench, [(0, most - len(wrench)), (0, 0)]) for wrench in (one, other))
    return one + other


@runtime_checkable
class ForceModel(Protocol):
    """A kind of residual. All methods are pure: they may be jitted, vmapped and differentiated.

    `history` holds `observation.observe_features` of the last three control steps, the current one last; `commands`
    those of the last two control steps and the coming one.
    """

    @property
    def name(self) -> str:
        """What a simulator improved by it is called."""
        ...

    def inputs(
        self, history: Float[Array, "steps features"], commands: Float[Array, "steps commands"]
    ) -> Float[Array, " inputs"]:
        """What it sees, independent of place and heading."""
        ...

    def fields(self, params: Any) -> Fields:
        """Model fields to simulate with instead of the model's own."""
        ...

    def command(self, params: Any, commands: Float[Array, "steps commands"]) -> Float[Array, "parts commands"]:
        """What the actuators get over equal parts of the coming control step; a number of them that divides its physics
        steps."""
        ...

    def wrench(
        self,
        params: Any,
        history: Float[Array, "steps features"],
        commands: Float[Array, "steps commands"],
        key: Array | None = None,
    ) -> Float[Array, "loaded 6"]:
        """Force (N) and torque (N m), world frame, over the coming control step: at the tracked body's centre of mass,
        and, if on more bodies than that, at the robot's points, in order.

        With `key`, drawn from the model's distribution, where it has one; without, the most likely.
        """
        ...

    def joint_force(
        self,
        params: Any,
        history: Float[Array, "steps features"],
        commands: Float[Array, "steps commands"],
        key: Array | None = None,
    ) -> Float[Array, " nv"] | None:
        """Generalized forces (N m, N, along `mjx.Data.qvel`) over the coming control step; None: there are none."""
        del params, history, commands, key

    def command_change(
        self,
        params: Any,
        history: Float[Array, "steps features"],
        commands: Float[Array, "steps commands"],
        key: Array | None = None,
    ) -> Float[Array, " commands"] | None:
        """What is added to the coming command (the actuators' own units); None: nothing. The sum stays within the
        commands' ranges."""
        del params, history, commands, key


class BoundForces(NamedTuple):
    """A kind of residual with its parameters."""

    model: ForceModel
    params: Any
    observed: Any = None
    """Smallest and largest of each of its inputs in what it was learned from; None: unknown."""

    @property
    def bound(self) -> BoundForces:
        """Itself: what has parameters bound may be given for it (`HasForces`)."""
        return self

    @property
    def fields(self) -> Fields:
        """Model fields to simulate with; see `ForceModel.fields`."""
        return self.model.fields(self.params)

    def plus(self, further: BoundForces) -> BoundForces:
        """Return both residuals, acting together."""
        both = SumOfForces(self.model, further.model)
        return BoundForces(both, (self.params, further.params), further.observed)


@runtime_checkable
class HasForces(Protocol):
    """A residual with its parameters, or what holds one, such as what a training returns."""

    @property
    def bound(self) -> BoundForces: ...


def add_to_base(base: BoundForces | None, further: ForceModel) -> tuple[ForceModel, Callable[[Any], Any]]:
    """Return `further` on top of a base residual, and what turns parameters of `further` into those of the sum.

    Without base residual: `further` itself, and the identity.
    """
    if base is None:
        return further, lambda params: params
    return SumOfForces(base.model, further), lambda params: (base.params, params)


class SumOfForces(ForceModel):
    """Two residuals, acting together: `params` of both, in order. It sees what the second sees."""

    def __init__(self, first: ForceModel, second: ForceModel) -> None:
        self.parts = first, second

    @property
    def name(self) -> str:
        return "+".join(part.name for part in self.parts)

    def inputs(
        self, history: Float[Array, "steps features"], commands: Float[Array, "steps commands"]
    ) -> Float[Array, " inputs"]:
        return self.parts[1].inputs(history, commands)

    def fields(self, params: Any) -> Fields:
        first, second = (part.fields(own) for part, own in zip(self.parts, params, strict=True))
        shared = sorted(first.keys() & second.keys())
        if shared:
            raise ValueError(f"Both residuals change {', '.join(shared)}.")
        return first | second

    def command(self, params: Any, commands: Float[Array, "steps commands"]) -> Float[Array, "parts commands"]:
        changes = [part.command(own, commands) - commands[-1] for part, own in zip(self.parts, params, strict=True)]
        return commands[-1] + sum(changes)

    def wrench(
        self,
        params: Any,
        history: Float[Array, "steps features"],
        commands: Float[Array, "steps commands"],
        key: Array | None = None,
    ) -> Float[Array, "loaded 6"]:
        return add_wrenches(
            *(part.wrench(own, history, commands, key) for part, own in zip(self.parts, params, strict=True))
        )

    def joint_force(
        self,
        params: Any,
        history: Float[Array, "steps features"],
        commands: Float[Array, "steps commands"],
        key: Array | None = None,
    ) -> Float[Array, " nv"] | None:
        return add_parts(
            *(part.joint_force(own, history, commands, key) for part, own in zip(self.parts, params, strict=True))
        )

    def command_change(
        self,
        params: Any,
        history: Float[Array, "steps features"],
        commands: Float[Array, "steps commands"],
        key: Array | None = None,
    ) -> Float[Array, " commands"] | None:
        return add_parts(
            *(part.command_change(own, history, commands, key) for part, own in zip(self.parts, params, strict=True))
        )
