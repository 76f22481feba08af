"""Operations on constants have JAX's results, and they and repeated operations disappear from programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from ballu_mjx.sim.constant_folding import fold
from ballu_mjx.sim.vmap_last import nested_vmap, vmap

INTEGERS = np.array([[-7, 3, 0], [5, -2, 9]], np.int32)
OTHERS = np.array([[3, -3, 4], [-5, 5, 7]], np.int32)
CASES: dict[str, Callable[..., Any]] = {
    "add": lax.add,
    "and": lax.bitwise_and,
    "and, truth values": lambda x, y: (x > 0) & (y > 0),
    "broadcast": lambda x, y: lax.broadcast_in_dim(x, (2, 4, 3), (0, 2)),
    "broadcast, one row": lambda x, y: lax.broadcast_in_dim(x[:1], (2, 3), (0, 1)),
    "concatenate": lambda x, y: lax.concatenate([x, y, x], 1),
    "convert to float": lambda x, y: lax.convert_element_type(x, np.float32),
    "convert to truth values": lambda x, y: lax.convert_element_type(x, bool),
    "comparisons": lambda x, y: [x == y, x != y, x < y, x <= y, x > y, x >= y],
    "iota": lambda x, y: [lax.broadcasted_iota(np.int32, (2, 3, 4), axis) for axis in range(3)],
    "largest": lax.max,
    "smallest": lax.min,
    "multiply": lax.mul,
    "negate": lambda x, y: -x,
    "not": lambda x, y: [~x, ~(x > 0)],
    "or": lax.bitwise_or,
    "remainder": lax.rem,
    "remainder of jnp": lambda x, y: x % y,
    "reshape": lambda x, y: x.reshape(3, 1, 2),
    "select": lambda x, y: lax.select_n(x > y, x, y),
    "select by a scalar": lambda x, y: lax.select_n(x[0, 1] > 0, x, y),
    "slice": lambda x, y: lax.slice(x, (0, 1), (2, 3), (1, 2)),
    "squeeze": lambda x, y: lax.squeeze(x[:1], (0,)),
    "subtract": lax.sub,
    "transpose": lambda x, y: lax.transpose(x, (1, 0)),
}


def operations(jaxpr: Any) -> list[str]:
    """Return the names of all operations of a record, with those of loops and calls."""
    inner = [x for e in jaxpr.eqns for x in e.params.values() if hasattr(x, "jaxpr")]
    return [e.primitive.name for e in jaxpr.eqns] + [name for x in inner for name in operations(x.jaxpr)]


@pytest.mark.parametrize("name", CASES)
def test_constants_have_the_result_of_jax(name: str):
    def function(x: Any) -> Any:
        return CASES[name](jnp.array(INTEGERS), jnp.array(OTHERS))

    def batched(x: Any) -> Any:
        return vmap(function, [True], len(x))(x)[0]

    x = jnp.arange(4.0)
    assert not operations(jax.make_jaxpr(batched)(x).jaxpr)
    jax.tree.map(np.testing.assert_array_equal, batched(x), function(x))
    assert [y.dtype for y in jax.tree.leaves(batched(x))] == [y.dtype for y in jax.tree.leaves(function(x))]


def test_only_constants_are_folded():
    record = jax.make_jaxpr(lambda x, y: x + y)(1, 2)
    assert fold(record.eqns[0], [3, 4]) == 7
    folded = []
    jax.make_jaxpr(lambda x: folded.append(fold(record.eqns[0], [x, 4])) or x)(1)
    assert folded == [None]


def test_constants_stay_so_inside_loops():
    table, rows = jnp.arange(12.0).reshape(4, 3), np.array([1, -1])

    def function(x: Any) -> Any:
        return lax.fori_loop(0, 3, lambda number, y: y + table[rows].sum() * y, x)

    batched = nested_vmap(function)
    used = operations(jax.make_jaxpr(batched)(jnp.arange(4.0)).jaxpr)
    assert "select_n" not in used and "select_n" in operations(jax.make_jaxpr(function)(1.0).jaxpr)
    np.testing.assert_allclose(batched(jnp.arange(4.0)), jax.vmap(function)(jnp.arange(4.0)))


def test_repeated_operations_are_evaluated_once():
    def function(x: Any, y: Any) -> Any:
        return jnp.sin(x) * jnp.sin(x) + jnp.sin(y) + jax.jit(jnp.sin)(x)

    x, y = jnp.arange(4.0), jnp.arange(4.0) / 3
    batched = nested_vmap(function)
    assert operations(jax.make_jaxpr(batched)(x, y).jaxpr).count("sin") == 2
    np.testing.assert_allclose(batched(x, y), jax.vmap(function)(x, y), rtol=1e-6)


def test_equal_operations_with_other_options_are_not_repeated():
    def function(x: Any) -> Any:
        return x.sum(0), x.sum(1), x[0] + 1.0, x[0] + 2.0, lax.slice(x, (0, 0), (1, 2)), lax.slice(x, (1, 0), (2, 2))

    x = jax.random.normal(jax.random.key(0), (5, 2, 2))
    jax.tree.map(np.testing.assert_array_equal, nested_vmap(function)(x), jax.vmap(function)(x))
