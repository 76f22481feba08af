"""What a residual is: model fields and commands that it changes, and wrenches on the robot's bodies, held over a
control step.

Everything that simulates takes residuals by this one interface, whatever they were learned by.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

Fields = dict[str, Array]
"""Fields of `mjx.Model` by name."""
History = Float[Array, "steps features"]
"""`observation.observe_features` of the last `HISTORY` control steps, the current one last."""
Commands = Float[Array, "steps commands"]
"""Commands (the actuators' own units) of the last control steps and the coming one, `HISTORY` in all."""


class Action(NamedTuple):
    """What a residual does over a control step."""

    wrench: Float[Array, "loaded 6"]
    """Force (N) and torque (N m), world frame: at the tracked body's centre of mass, and, if on more bodies than that,
    at the robot's points, in order."""
    joint_force: Float[Array, " nv"] | None = None
    """Generalized forces (N m or N, along `mjx.Data.qvel`); None: none."""
    command_change: Float[Array, " commands"] | None = None
    """What is added to the coming command (the actuators' own units), whose sum stays within the commands' ranges;
    None: nothing."""

    @staticmethod
    def none() -> Action:
        """Return the action that does nothing."""
        return Action(jnp.zeros((1, 6)))

    def scaled(self, share: Float[Array, ""] | float) -> Action:
        """Return a share of it."""
        joint, change = (None if part is None else share * part for part in self[1:])
        return Action(share * self.wrench, joint, change)

    def plus(self, other: Action) -> Action:
        """Return the sum of both, on as many bodies as the one that acts on more."""
        most = max(len(self.wrench), len(other.wrench))
        one, two = (jnp.pad(wrench, [(0, most - len(wrench)), (0, 0)]) for wrench in (self.wrench, other.wrench))
        joint, change = (
            b if a is None else a if b is None else a + b for a, b in zip(self[1:], other[1:], strict=True)
        )
        return Action(one + two, joint, change)


@runtime_checkable
class Residual(Protocol):
    """A kind of residual. All methods are pure: they may be jitted, vmapped and differentiated.

    A kind inherits from this class, and writes `name`, `inputs`, and what else it changes.
    """

    @property
    def name(self) -> str:
        """Return what a simulator improved by it is called."""
        ...

    def inputs(self, history: History, commands: Commands) -> Float[Array, " inputs"]:
        """Return what it sees, independent of place and heading."""
        ...

    def fields(self, params: Any) -> Fields:
        """Return model fields to simulate with instead of the model's own. Default: none."""
        del params
        return {}

    def command(self, params: Any, commands: Commands) -> Float[Array, "parts commands"]:
        """Return what the actuators get over equal parts of the coming control step; a number of them that divides its
        physics steps. Default: the coming command."""
        del params
        return commands[-1:]

    def act(self, params: Any, history: History, commands: Commands, key: Array | None = None) -> Action:
        """Return what it does over the coming control step. Default: nothing.

        With `key`, drawn from the model's distribution, where it has one; without, the most likely.
        """
        del params, history, commands, key
        return Action.none()


class BoundResidual(NamedTuple):
    """A kind of residual with its parameters."""

    model: Residual
    params: Any
    observed: Any = None
    """Smallest and largest of each of its inputs in what it was learned from; None: unknown."""

    @property
    def bound(self) -> BoundResidual:
        """Itself: what has parameters bound may be given for it (`HasResidual`)."""
        return self

    @property
    def fields(self) -> Fields:
        """Model fields to simulate with; see `Residual.fields`."""
        return self.model.fields(self.params)

    def act(self, history: History, commands: Commands, key: Array | None = None) -> Action:
        """Return what it does over the coming control step; see `Residual.act`."""
        return self.model.act(self.params, history, commands, key)

    def plus(self, further: BoundResidual) -> BoundResidual:
        """Return both residuals, acting together."""
        both = SumOfResiduals(self.model, further.model)
        return BoundResidual(both, (self.params, further.params), further.observed)


@runtime_checkable
class HasResidual(Protocol):
    """A residual with its parameters, or what holds one, such as what a training returns."""

    @property
    def bound(self) -> BoundResidual: ...


def add_to_base(base: BoundResidual | None, further: Residual) -> tuple[Residual, Callable[[Any], Any]]:
    """Return `further` on top of a base residual, and what turns parameters of `further` into those of the sum.

    Without base residual: `further` itself, and the identity.
    """
    if base is None:
        return further, lambda params: params
    return SumOfResiduals(base.model, further), lambda params: (base.params, params)


class SumOfResiduals(Residual):
    """Two residuals, acting together: `params` of both, in order. It sees what the second sees."""

    def __init__(self, first: Residual, second: Residual) -> None:
        self.parts = first, second

    @property
    def name(self) -> str:
        return "+".join(part.name for part in self.parts)

    def inputs(self, history: History, commands: Commands) -> Float[Array, " inputs"]:
        return self.parts[1].inputs(history, commands)

    def fields(self, params: Any) -> Fields:
        first, second = (part.fields(own) for part, own in zip(self.parts, params, strict=True))
        shared = sorted(first.keys() & second.keys())
        if shared:
            raise ValueError(f"Both residuals change {', '.join(shared)}.")
        return first | second

    def command(self, params: Any, commands: Commands) -> Float[Array, "parts commands"]:
        changes = [part.command(own, commands) - commands[-1] for part, own in zip(self.parts, params, strict=True)]
        return commands[-1] + sum(changes)

    def act(self, params: Any, history: History, commands: Commands, key: Array | None = None) -> Action:
        first, second = (part.act(own, history, commands, key) for part, own in zip(self.parts, params, strict=True))
        return first.plus(second)
