"""What a residual is: model fields and commands that it changes, and a wrench on the tracked body (the balloon), held
over a control step.

Everything that simulates takes residuals by this one interface, whatever they were learned by.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

Fields = dict[str, Array]
"""Fields of `mjx.Model` by name."""


@runtime_checkable
class ForceModel(Protocol):
    """A kind of residual. All methods are pure: they may be jitted, vmapped and differentiated.

    `history` holds `envmimic.features` of the last three control steps, the current one last; `commands` those of the
    last two control steps and the coming one.
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
    ) -> Float[Array, " 6"]:
        """Force (N) and torque (N m), world frame, at the tracked body's centre of mass over the coming control step.

        With `key`, drawn from the model's distribution, where it has one; without, the most likely.
        """
        ...


class Applied(NamedTuple):
    """A kind of residual with its parameters."""

    model: ForceModel
    params: Any


class Sum:
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
    ) -> Float[Array, " 6"]:
        both = [part.wrench(own, history, commands, key) for part, own in zip(self.parts, params, strict=True)]
        return jnp.sum(jnp.stack(both), axis=0)
