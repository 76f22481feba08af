"""What a residual is: model fields and commands that it changes, and wrenches on the robot's bodies, held over a
control step.

Everything that simulates takes residuals by this one interface, whatever they were learned by.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

Fields = dict[str, Array]
"""Fields of `mjx.Model` by name."""
ForceSet = Literal["force", "wrench", "multi"]
"""What a network pushes with: a force on the tracked body (the paper's), a force and a torque on it, or forces on it
and at every measured point."""


def num_vectors(forces: ForceSet, points: int) -> int:
    """Vectors in the loads of a robot with so many points."""
    return {"force": 1, "wrench": 2, "multi": 1 + points}[forces]


def to_wrenches(loads: Float[Array, " loads"], forces: ForceSet) -> Float[Array, "loaded 6"]:
    """Loads, vector after vector (N, N m; world), as wrenches on the bodies that they act on; the tracked one first,
    then those of the points."""
    if forces == "wrench":
        return loads[None]
    return jnp.pad(loads.reshape(-1, 3), [(0, 0), (0, 3)])


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


class SumOfForces:
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
