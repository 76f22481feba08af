"""A residual that only applies a constant force."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from ballu_mjx.sim.residual import Action, Residual


class PlainPush(Residual):
    """A residual whose parameter is a force along x (N) on the tracked body."""

    @property
    def name(self) -> str:
        return "push"

    def inputs(self, history: Array, commands: Array) -> Array:
        return commands.ravel()

    def act(self, params: Any, history: Array, commands: Array, key: Array | None = None) -> Action:
        return Action(params * jnp.eye(1, 6))
