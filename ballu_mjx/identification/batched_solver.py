"""Several Optimistix searches in parallel, in one compiled program."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float


def directional_derivatives(
    function: Callable[..., Array],
    points: tuple[Float[Array, "n _"] | Float[Array, " n"], ...],
    directions: tuple[Float[Array, "n k _"] | Float[Array, "n k"], ...],
    held: tuple[Float[Array, "n ..."], ...],
) -> tuple[Float[Array, "n ..."], Float[Array, "n ... k"]]:
    """Return the values of `function(*point, *held)` at n points, and its derivatives along k directions at each point.

    All n k derivatives form one batch. Nested batches would be traced once more each, and would run in shorter loops.
    """
    n, k = directions[0].shape[:2]
    points, held = (tuple(jnp.repeat(x, k, axis=0) for x in group) for group in (points, held))
    directions = tuple(x.reshape(n * k, *x.shape[2:]) for x in directions)

    def one(point: tuple[Array, ...], direction: tuple[Array, ...], held: tuple[Array, ...]) -> tuple[Array, Array]:
        return jax.jvp(lambda *point: function(*point, *held), point, direction)

    values, changes = jax.vmap(one)(points, directions, held)
    return values[::k], jnp.moveaxis(changes.reshape(n, k, *changes.shape[1:]), 1, -1)


Evaluate = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function from coordinates (batch, size) to values (batch, n) and Jacobians (batch, n, size)."""


class BatchedSolver:
    """An Optimistix solver that runs several searches in parallel, one iteration at a time.

    The compiled solver contains no physics. The caller computes values and Jacobians at the points that the solver
    tries next. MJX takes by far the longest to compile. It is thus compiled only once for all solvers and stages.
    """

    def __init__(self, solver: Any, least_gain: float = 1e-4) -> None:
        """`least_gain`: relative decrease of the loss below which an iteration counts as idle."""
        self._least_gain = least_gain
        least_squares = isinstance(solver, optx.AbstractLeastSquaresSolver)

        @jax.custom_jvp
        def known(y: Array, value: Array, jacobian: Array) -> Array:
            return value

        @known.defjvp
        def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
            return primals[1], primals[2] @ tangents[0]

        def function(y: Array, evaluated: tuple[Array, Array]) -> tuple[Array, Array]:
            value = known(y, *evaluated)
            return (value, jnp.sum(value**2)) if least_squares else (value[0], value[0])

        def init(y: Array, evaluated: tuple[Array, Array]) -> Any:
            return solver.init(function, y, evaluated, {}, *jax.eval_shape(function, y, evaluated), frozenset())

        def step(y: Array, evaluated: tuple[Array, Array], state: Any) -> tuple[Array, Any, Array, Array]:
            y, state, loss = solver.step(function, y, evaluated, {}, state, frozenset())
            done, _ = solver.terminate(function, y, evaluated, {}, state, frozenset())
            return y, state, loss, done

        self._init = eqx.filter_jit(eqx.filter_vmap(init))
        self._step = eqx.filter_jit(eqx.filter_vmap(step))

    def __call__(
        self,
        evaluate: Evaluate,
        start: np.ndarray,
        steps: int,
        report: Callable[[int, int, float], None],
        patience: int | None = None,
        small_gain: float = 0.0,
    ) -> tuple[Float[np.ndarray, "batch size"], Float[np.ndarray, " batch"]]:
        """Return coordinates and losses at the end of each search.

        Losses are sums of squares, or the minimized function itself. The searches end after `steps` iterations, when
        all have converged, after `patience` idle iterations in a row (None: no limit), or after an iteration that
        decreases losses, but none by more than the fraction `small_gain`.

        **Arguments**

        - `evaluate`: values and Jacobians at given coordinates.
        - `start`: coordinates at which the searches start.
        - `report`: called with (iteration, `steps`, lowest loss) after every iteration.
        """
        evaluated = tuple(map(jnp.asarray, evaluate(start)))
        y, state, loss = jnp.asarray(start), self._init(jnp.asarray(start), evaluated), np.zeros(len(start))
        lowest, idle = np.full(len(start), np.inf), 0
        for iteration in range(steps):
            y, state, loss, done = self._step(y, evaluated, state)
            report(iteration + 1, steps, float(jnp.min(loss)))
            gained, enough = (bool(np.any(loss < (1 - gain) * lowest)) for gain in (0.0, small_gain))
            idle = 0 if bool(np.any(loss < (1 - self._least_gain) * lowest)) else idle + 1
            lowest = np.minimum(lowest, loss)
            if bool(jnp.all(done)) or idle == patience or (gained and not enough):
                break
            evaluated = tuple(map(jnp.asarray, evaluate(np.asarray(state.y_eval))))
        return np.asarray(y), np.asarray(loss)
