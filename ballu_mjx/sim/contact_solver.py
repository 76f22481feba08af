"""The contact solver of a physics step, with derivatives of its iterations or of the minimum that they reach."""

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
    """Generalized forces of the constraints (N, N m)."""


def _solve(model: mjx.Model, data: mjx.Data) -> _Solution:
    if not data._impl.efc_J.size:  # the model has no constraints  # pyright: ignore
        return _Solution(data.qacc_smooth, jnp.zeros_like(data.qacc_smooth))
    data = mjx.solve(model, data)
    return _Solution(data.qacc, data.qfrc_constraint)


def _derivative(along: DirectionalDerivative, found: _Solution) -> _Solution:
    """Return the derivative of the solver's iterations or, once they have converged, the derivative of the minimum.

    A line search that has converged divides rounding errors by rounding errors. For a robot at rest, the solver stops
    at its initial guess. The derivative of its iterations would be that of the previous step.
    """
    (_, step), (of_minimum, _) = along(functools.partial(_newton_step, found))
    converged = jnp.linalg.norm(step) < _CONVERGED
    of_iterations = along(_solve)[1]
    return jax.tree.map(lambda x, y: jnp.where(converged, x, y), of_minimum, of_iterations)


_CONVERGED = 0.025
"""Length of a Newton step (m/s^2 and rad/s^2) below which the solver counts as converged.

It changes velocities by a quarter of a mm/s or mrad/s in a physics step. Rounding leaves up to 0.01 at rest. In one of
twenty steps of a walking robot the length is greater, up to 20.
"""


def _newton_step(found: _Solution, model: mjx.Model, data: mjx.Data) -> tuple[_Solution, Float[Array, " nv"]]:
    """Return the solution after a Newton step from the solver's result `found`, and the Newton step.

    The Hessian of the cost is held constant, because the factor of its derivative is zero at the minimum.
    """
    data = data.replace(qacc=found.qacc)  # pyright: ignore
    here = Context.create(model, data, grad=False)
    gradient = here.Ma - data.qfrc_smooth - here.qfrc_constraint
    held_model, held = jax.lax.stop_gradient((model, data))
    moved = gradient - jax.lax.stop_gradient(gradient)  # zero, but with the gradient's derivative
    step = Context.create(held_model, held.replace(qfrc_smooth=held.qfrc_smooth - moved)).search
    qacc = found.qacc + step
    # Forces are in balance at the minimum of the cost.
    return _Solution(qacc, mjx.mul_m(model, data, qacc) - data.qfrc_smooth), step


def _derivative_of_minimum(along: DirectionalDerivative, found: _Solution) -> _Solution:
    """Return the derivative of the minimum, also if the iterations have not converged."""
    return along(functools.partial(_newton_step, found))[1][0]


_solve_with_check = with_custom_jvp(_solve, _derivative)
_solve_to_minimum = with_custom_jvp(_solve, _derivative_of_minimum)


def solve_constraints(model: mjx.Model, data: mjx.Data) -> _Solution:
    """Return accelerations and generalized forces of the constraints, like `mjx.solve`.

    Without contacts the cost is piecewise quadratic in a few rows, and Newton's method finds its minimum in few
    iterations. In double precision the derivative is then that of the minimum alone, which takes half the time.
    """
    converges = data.qpos.dtype == jnp.float64 and not data._impl.ncon  # pyright: ignore
    return (_solve_to_minimum if converges else _solve_with_check)(model, data)
