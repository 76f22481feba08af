"""The contact solver of a physics step, with derivatives: of its iterations, or of the minimum that they reach."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from mujoco import mjx
from mujoco.mjx._src.solver import Context

from ballu_mjx.sim.custom_jvp import DirectionalDerivative, with_custom_jvp


class _Solution(NamedTuple):
    qacc: Float[Array, " nv"]
    force: Float[Array, " nv"]
    """Generalized, of the constraints."""


def _solve(model: mjx.Model, data: mjx.Data) -> _Solution:
    if not data._impl.efc_J.size:  # nothing constrains this model  # pyright: ignore
        return _Solution(data.qacc_smooth, jnp.zeros_like(data.qacc_smooth))
    data = mjx.solve(model, data)
    return _Solution(data.qacc, data.qfrc_constraint)


def _derivative(along: DirectionalDerivative, found: _Solution) -> _Solution:
    """That of the solver's iterations while they are on their way; once they have arrived, that of the place.

    A line search with nothing left to find divides rounding errors by rounding errors. At a robot at rest the solver
    stops where it starts, and would have the derivative of the step before.
    """
    (_, step), (at_place, _) = along(functools.partial(_newton_step, found))
    arrived = jnp.linalg.norm(step) < _ARRIVED
    on_the_way = along(_solve)[1]
    return jax.tree.map(lambda x, y: jnp.where(arrived, x, y), at_place, on_the_way)


_ARRIVED = 0.025
"""Length of a Newton step (m/s^2 and rad/s^2) that counts as none: a quarter of a mm/s or mrad/s over a physics step.

Rounding leaves up to 0.01 at rest; one in twenty steps of a walking robot is farther off, by up to 20."""


def _newton_step(found: _Solution, model: mjx.Model, data: mjx.Data) -> tuple[_Solution, Float[Array, " nv"]]:
    """Return where a Newton step leads from where the solver ended; and the step. The cost's Hessian is held: what
    multiplies its derivative is zero."""
    data = data.replace(qacc=found.qacc)  # pyright: ignore
    here = Context.create(model, data, grad=False)
    slope = here.Ma - data.qfrc_smooth - here.qfrc_constraint
    held_model, held = jax.lax.stop_gradient((model, data))
    moved = slope - jax.lax.stop_gradient(slope)  # zero, but for its derivative
    step = Context.create(held_model, held.replace(qfrc_smooth=held.qfrc_smooth - moved)).search
    qacc = found.qacc + step
    # Where the cost is least, forces are in balance.
    return _Solution(qacc, mjx.mul_m(model, data, qacc) - data.qfrc_smooth), step


solve_constraints = with_custom_jvp(_solve, _derivative)
"""Accelerations, and generalized forces of the constraints, by model and data: `mjx.solve`."""
