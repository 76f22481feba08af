"""The interface of residuals: changes of model fields and commands, and wrenches that are held over a control step.

All simulations use residuals through this interface, regardless of the method that learned them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

Fields = dict[str, Array]
"""Fields of `mjx.Model` by name."""
History = Float[Array, "steps features"]
"""Features (`observation.observe_features`) of the last `HISTORY` control steps, the current one last."""
Commands = Float[Array, "steps commands"]
"""Commands (the actuators' own units) of the last control steps and of the upcoming one, `HISTORY` in all."""


class Action(NamedTuple):
    """Action of a residual over a control step."""

    wrench: Float[Array, "loaded 6"]
    """Force (N) and torque (N m), world frame. The first row acts at the tracked body's centre of mass. Further rows,
    if any, act at the robot's points, in order."""
    joint_force: Float[Array, " nv"] | None = None
    """Generalized forces (N m or N, along `mjx.Data.qvel`). None if there are none."""
    command_change: Float[Array, " commands"] | None = None
    """Change that is added to the upcoming command (the actuators' own units). The sum is clipped to the commands'
    ranges. None if there is no change."""

    @staticmethod
    def none() -> Action:
        """Return the action that has no effect."""
        return Action(jnp.zeros((1, 6)))

    def scaled(self, share: Float[Array, ""] | float) -> Action:
        """Return the action multiplied by `share`."""
        joint, change = (None if part is None else share * part for part in self[1:])
        return Action(share * self.wrench, joint, change)

    def plus(self, other: Action) -> Action:
        """Return the sum of both actions. The wrench with fewer rows is filled up with zeros."""
        most = max(len(self.wrench), len(other.wrench))
        one, two = (jnp.pad(wrench, [(0, most - len(wrench)), (0, 0)]) for wrench in (self.wrench, other.wrench))
        joint, change = (
            b if a is None else a if b is None else a + b for a, b in zip(self[1:], other[1:], strict=True)
        )
        return Action(one + two, joint, change)


@runtime_checkable
class Residual(Protocol):
    """A kind of residual. All methods are pure: they may be jitted, vmapped and differentiated.

    A kind inherits from this class. It implements `name` and `inputs`, and overrides the methods for its effects.
    """

    @property
    def name(self) -> str:
        """Name of a simulator that has this residual."""
        ...

    def inputs(self, history: History, commands: Commands) -> Float[Array, " inputs"]:
        """Return the residual's input, which does not depend on horizontal position or heading."""
        ...

    def fields(self, params: Any) -> Fields:
        """Return the model fields that replace the model's own. Default: none."""
        del params
        return {}

    def command(self, params: Any, commands: Commands) -> Float[Array, "parts commands"]:
        """Return the commands to the drivetrain, or to the actuators, over equal parts of the upcoming control step.

        The number of parts must divide the number of physics steps. Default: the upcoming command.
        """
        del params
        return commands[-1:]

    def act(self, params: Any, history: History, commands: Commands, key: Array | None = None) -> Action:
        """Return the action over the upcoming control step. Default: no effect.

        With `key`, the action is a sample of the residual's distribution, if there is one. Without `key`, it is the
        mode.
        """
        del params, history, commands, key
        return Action.none()


class BoundResidual(NamedTuple):
    """A kind of residual with its parameters."""

    model: Residual
    params: Any
    observed: Any = None
    """Smallest and largest value of each input in the training data. None if unknown."""

    @property
    def bound(self) -> BoundResidual:
        """The residual itself, so that it can be used as a `HasResidual`."""
        return self

    @property
    def fields(self) -> Fields:
        """Model fields that replace the model's own; see `Residual.fields`."""
        return self.model.fields(self.params)

    def act(self, history: History, commands: Commands, key: Array | None = None) -> Action:
        """Return the action over the upcoming control step; see `Residual.act`."""
        return self.model.act(self.params, history, commands, key)

    def plus(self, further: BoundResidual) -> BoundResidual:
        """Return the sum of both residuals."""
        both = SumOfResiduals(self.model, further.model)
        return BoundResidual(both, (self.params, further.params), further.observed)


@runtime_checkable
class HasResidual(Protocol):
    """A residual with its parameters, or an object that holds one, such as the result of a training."""

    @property
    def bound(self) -> BoundResidual: ...


def add_to_base(base: BoundResidual | None, further: Residual) -> tuple[Residual, Callable[[Any], Any]]:
    """Return the sum of a base residual and `further`, and a function from parameters of `further` to those of the sum.

    Without a base residual, return `further` itself and the identity.
    """
    if base is None:
        return further, lambda params: params
    return SumOfResiduals(base.model, further), lambda params: (base.params, params)


class SumOfResiduals(Residual):
    """The sum of two residuals, which act together. `params` is the pair of their parameters.

    Its input is that of the second residual.
    """

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
            raise ValueError(f"Both residuals change {', '.join(shared)}; at most one of them may change a field.")
        return first | second

    def command(self, params: Any, commands: Commands) -> Float[Array, "parts commands"]:
        changes = [part.command(own, commands) - commands[-1] for part, own in zip(self.parts, params, strict=True)]
        return commands[-1] + sum(changes)

    def act(self, params: Any, history: History, commands: Commands, key: Array | None = None) -> Action:
        first, second = (part.act(own, history, commands, key) for part, own in zip(self.parts, params, strict=True))
        return first.plus(second)
