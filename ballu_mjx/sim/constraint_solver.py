"""The constraint solver of a physics step, with derivatives of its iterations or of the minimum that they reach.

Like MuJoCo, the solver minimizes Gauss's cost of the accelerations plus a cost for each row of the constraints (Todorov
2014, "Convex and analytically-invertible dynamics with contacts and constraints"). The cost of a row is quadratic where
the row's force is within its bounds, and linear beyond. Equality constraints have no bounds, dry friction has two, and
joint limits and pyramidal contacts only push. Steps are Newton's.

MJX solves the same problem. Its line search evaluates three points in each iteration, and always makes all iterations
for a batch. Here, a row's force is one clipped product, and the search evaluates one point (benchmarks/README.md).
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from mujoco import mjx
from mujoco.mjx._src import support
from mujoco.mjx._src.solver import Context

from ballu_mjx.sim.custom_jvp import DirectionalDerivative, with_custom_jvp


class _Solution(NamedTuple):
    qacc: Float[Array, " nv"]
    force: Float[Array, " nv"]
    """Generalized forces of the constraints (N, N m)."""


class _Problem(NamedTuple):
    """Minimization over accelerations. Rows are those of the constraints."""

    inertia: Float[Array, "nv nv"]
    smooth_force: Float[Array, " nv"]
    """Generalized forces without those of the constraints (N, N m)."""
    smooth_qacc: Float[Array, " nv"]
    """Accelerations without constraints."""
    jacobian: Float[Array, "rows nv"]
    reference: Float[Array, " rows"]
    """Acceleration of each row without force."""
    gain: Float[Array, " rows"]
    """Force of a row for each unit of acceleration below the reference, within the bounds."""
    lower: Float[Array, " rows"]
    """Smallest force of each row."""
    upper: Float[Array, " rows"]
    """Largest force of each row."""

    def forces(self, excess: Float[Array, " rows"]) -> tuple[Float[Array, " rows"], Float[Array, " rows"]]:
        """Return the rows' forces and gains at accelerations that exceed the references by `excess`.

        The gain is 0 beyond the bounds.
        """
        unbounded = -self.gain * excess
        within = (unbounded > self.lower) & (unbounded < self.upper)
        return jnp.clip(unbounded, self.lower, self.upper), jnp.where(within, self.gain, 0.0)

    def cost(self, qacc: Float[Array, " nv"]) -> Float[Array, ""]:
        """Return the cost of accelerations."""
        excess = self.jacobian @ qacc - self.reference
        force, _ = self.forces(excess)
        rows = -force * excess - 0.5 * force * force / jnp.where(self.gain > 0, self.gain, 1.0)
        gauss = jnp.dot(self.inertia @ qacc - self.smooth_force, qacc - self.smooth_qacc)
        return jnp.sum(rows) + 0.5 * gauss


def _problem(model: mjx.Model, data: mjx.Data) -> _Problem:
    inner: Any = data._impl  # pyright: ignore
    friction: Array = inner.efc_frictionloss
    row = np.arange(len(friction))
    equality = row < inner.ne
    has_friction = jnp.asarray(~equality & (row < inner.ne + inner.nf))
    free = jnp.full_like(friction, jnp.inf)
    return _Problem(
        support.full_m(model, data),
        data.qfrc_smooth,
        data.qacc_smooth,
        inner.efc_J,
        inner.efc_aref,
        inner.efc_D,
        jnp.where(has_friction, -friction, jnp.where(jnp.asarray(equality), -free, 0 * friction)),
        jnp.where(has_friction, friction, free),
    )


class _Iterate(NamedTuple):
    qacc: Float[Array, " nv"]
    inertial_force: Float[Array, " nv"]
    excess: Float[Array, " rows"]
    """Acceleration of each row beyond its reference."""
    converged: Bool[Array, ""]
    count: Int[Array, ""]


def _solve(model: mjx.Model, data: mjx.Data) -> _Solution:
    if not data._impl.efc_J.size:  # the model has no constraints  # pyright: ignore
        return _Solution(data.qacc_smooth, jnp.zeros_like(data.qacc_smooth))
    if not _is_supported(model):
        data = mjx.solve(model, data)
        return _Solution(data.qacc, data.qfrc_constraint)
    problem = _problem(model, data)
    qacc = data.qacc_smooth
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART:
        qacc = jnp.where(problem.cost(data.qacc_warmstart) < problem.cost(qacc), data.qacc_warmstart, qacc)
    scale = jnp.maximum(jnp.trace(problem.inertia), mujoco.mjMINVAL)

    def goes_on(at: _Iterate) -> Bool[Array, ""]:
        return ~at.converged & (at.count < model.opt.iterations)

    def improved(at: _Iterate) -> _Iterate:
        force, gain = problem.forces(at.excess)
        gradient = at.inertial_force - problem.smooth_force - problem.jacobian.T @ force
        hessian = problem.inertia + (problem.jacobian.T * gain) @ problem.jacobian
        # Rounding leaves the Hessian slightly unsymmetric.
        factor = jax.scipy.linalg.cho_factor(0.5 * (hessian + hessian.T))
        step = -jax.scipy.linalg.cho_solve(factor, gradient)
        slope = jnp.dot(step, gradient)
        inertial, rows = problem.inertia @ step, problem.jacobian @ step
        linear = jnp.dot(step, at.inertial_force - problem.smooth_force)
        line = _Line(at.excess, rows, linear, jnp.dot(step, inertial))
        length = _line_search(problem, line, slope, model.opt.ls_iterations)
        return _Iterate(
            at.qacc + length * step,
            at.inertial_force + length * inertial,
            at.excess + length * rows,
            -slope < model.opt.tolerance * scale,
            at.count + 1,
        )

    start = _Iterate(
        qacc,
        problem.inertia @ qacc,
        problem.jacobian @ qacc - problem.reference,
        jnp.asarray(False),
        jnp.asarray(0),
    )
    found = lax.while_loop(goes_on, improved, start)
    return _Solution(found.qacc, problem.jacobian.T @ problem.forces(found.excess)[0])


class _Line(NamedTuple):
    """Cost along a step."""

    excess: Float[Array, " rows"]
    """Acceleration of each row beyond its reference, at the start."""
    rows: Float[Array, " rows"]
    """Change of the rows' accelerations over the step."""
    linear: Float[Array, ""]
    """Slope of Gauss's cost at the start."""
    quadratic: Float[Array, ""]
    """Change of the slope of Gauss's cost over the step."""

    def slopes(self, problem: _Problem, length: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return first and second derivative of the cost, by the share of the step."""
        force, gain = problem.forces(self.excess + length * self.rows)
        first = self.linear + length * self.quadratic - jnp.dot(self.rows, force)
        return first, jnp.maximum(self.quadratic + jnp.dot(gain, self.rows * self.rows), mujoco.mjMINVAL)


class _Search(NamedTuple):
    """Share of the step, with bounds of the minimum, and derivatives of the cost."""

    length: Float[Array, ""]
    low: Float[Array, ""]
    high: Float[Array, ""]
    first: Float[Array, ""]
    second: Float[Array, ""]

    def bounds(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the bounds of the minimum. The cost is convex, so that the slope's sign tells the side."""
        below = self.first < 0
        return jnp.where(below, self.length, self.low), jnp.where(below, self.high, self.length)

    def better_length(self) -> Float[Array, ""]:
        """Return the share after a step of Newton's method, or the middle of the bounds if that step is too long.

        Where the second derivative jumps, Newton's method could alternate between two shares for ever.
        """
        low, high = self.bounds()
        change = -self.first / self.second
        bisect = jnp.abs(change) > _LONGEST * (high - low)
        return jnp.where(bisect, 0.5 * (low + high), self.length + change)


_LONGEST = 0.9
"""Longest step of a line search, as a share of the distance between the bounds."""


def _line_search(problem: _Problem, line: _Line, slope: Float[Array, ""], most: int) -> Float[Array, ""]:
    """Return the share of a step at which the cost is smallest. It is 0 if the step does not decrease the cost.

    Newton's method finds the share at which the slope of the cost is 0, with at most `most` evaluations. `slope` is the
    slope at the start.
    """
    held_problem, held_line = lax.stop_gradient((problem, line))

    def improved(_: Int[Array, ""], at: _Search) -> _Search:
        length = at.better_length()
        return _Search(length, *at.bounds(), *held_line.slopes(held_problem, length))

    whole = lax.stop_gradient(jnp.ones_like(slope))
    start = _Search(whole, 0 * whole, jnp.inf * whole, *held_line.slopes(held_problem, whole))
    found = lax.fori_loop(0, min(most, _EVALUATIONS) - 1, improved, start)
    # The derivative of the share is that of the minimum along the line.
    first, _ = line.slopes(problem, found.length)
    moved = first - lax.stop_gradient(first)  # zero, but with the derivative of the slope
    length = found.better_length() - moved / found.second
    return jnp.where(slope < 0, length, 0 * length)


_EVALUATIONS = 5
"""Largest number of evaluations in a line search."""


def _is_supported(model: mjx.Model) -> bool:
    """Return whether `_Problem` describes the model's constraints, and its solver makes Newton's steps."""
    return model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL and model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON


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
    # MJX's other solver would leave the constraints out of the Hessian.
    model = model.replace(opt=model.opt.replace(solver=mjx.SolverType.NEWTON))  # pyright: ignore
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

    If the solver converges, the derivative is that of the minimum alone, which takes half the time. This is so for
    Newton's method with enough iterations. Without contacts the cost is piecewise quadratic in a few rows, and few
    iterations suffice in double precision.
    """
    few_rows = data.qpos.dtype == jnp.float64 and not data._impl.ncon  # pyright: ignore
    newton = model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    converges = newton and (few_rows or model.opt.iterations >= _ENOUGH_ITERATIONS)
    return (_solve_to_minimum if converges else _solve_with_check)(model, data)


_ENOUGH_ITERATIONS = 4
"""Number of Newton's iterations after which the derivative of the minimum is that of the simulation.

With 3 iterations, derivatives of BALLU's control steps by a force differ by 9 % or more in one of twenty steps (from
finite differences). With 4, they differ by 0.1 % or more in one of fifty."""
