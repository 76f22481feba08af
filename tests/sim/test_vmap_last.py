"""`vmap` with the batch along the last axis agrees with `jax.vmap`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
import pytest
from mujoco import mjx

from ballu_mjx.ballu.model import load_model, standing_qpos
from ballu_mjx.sim import vmap_last
from ballu_mjx.sim.step import PhysicsState, control_step, make_data, put_model, state_at
from ballu_mjx.sim.vmap_last import nested_vmap, vmap, vmap_with_trailing_batch

SIZE = 5


def symmetric(x: Any) -> Any:
    return x.T @ x + 0.5 * jnp.eye(x.shape[1])


def countdown(x: Any) -> Any:
    """Run a loop whose number of steps differs within the batch."""
    return jax.lax.while_loop(lambda c: c[0] > 0.3, lambda c: (c[0] - 0.2, c[1] + c[0] ** 2), (x[0, 0], 0.0))


def halving(x: Any) -> Any:
    def step(carry: Any, row: Any) -> Any:
        larger = jax.lax.cond(row[0] > 0, lambda c: 2 * c, lambda c: c - row[1], carry)
        return larger, larger.sum()

    return jax.lax.scan(step, x[0], x)


def chosen(x: Any) -> Any:
    place = jnp.argmin(x[:, 0])
    return x[place], jax.lax.dynamic_slice(x, (place, 0), (2, 2)), jax.lax.switch(place, [jnp.sin, jnp.cos, jnp.exp], x)


def scattered(x: Any) -> Any:
    rows = jnp.array([2, 0])
    return x.at[rows].set(1.0).at[:, 1].add(x[:, 2]).at[rows, rows].mul(3.0), x[rows], x[::-1, jnp.array([1, 1])]


FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "elementwise": lambda x: jnp.where(x > 0, jnp.sqrt(jnp.abs(x)), jnp.clip(x, -0.5, 0.1) ** 3) + jnp.arctan2(x, 2.0),
    "scalars": lambda x: jnp.where(x[0, 0] > 0, x, -x) * x[1, 2] + jnp.arange(3.0),
    "shapes": lambda x: (jnp.concatenate([x, x.T]), jnp.tile(x[0], 2), jnp.pad(x, 1), x.ravel()[::-1], x[:, None, 1:]),
    "reductions": lambda x: (
        x.sum(0),
        x.sum(),
        x.max(),
        jnp.argmax(x, axis=1),
        (x > 0).all(1),
        jnp.linalg.norm(x),
        jnp.sort(x),
    ),
    "empty": lambda x: (x[:, :0] @ x[:0], x[:0].sum(0), jnp.stack([x, x])[:0].sum(0), x[:0] @ x),
    "products": lambda x: (x @ x, x.T @ x[0], jnp.einsum("ij,kj->ik", x, x), jnp.outer(x[0], x[1]), x @ jnp.ones(3)),
    "batched product": lambda x: jnp.einsum("bij,bjk->bik", jnp.stack([x, 2 * x]), jnp.stack([x.T, x])),
    "cholesky": lambda x: jnp.linalg.cholesky(symmetric(x)),
    "solve": lambda x: jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(symmetric(x)), x[0]),
    "solve, upper": lambda x: jax.scipy.linalg.solve_triangular(symmetric(x), x, lower=False),
    "solve, on the right": lambda x: jax.lax.linalg.triangular_solve(symmetric(x), x, left_side=False, lower=True),
    "solve, on the right, transposed": lambda x: jax.lax.linalg.triangular_solve(
        symmetric(x), x, left_side=False, lower=False, transpose_a=True
    ),
    "solve, transposed": lambda x: jax.scipy.linalg.solve_triangular(symmetric(x), x, lower=True, trans=1),
    "inverse": lambda x: jnp.linalg.inv(symmetric(x)),
    "custom derivative": jax.nn.relu,
    "while": countdown,
    "fori": lambda x: jax.lax.fori_loop(0, 3, lambda i, y: y + x[i], x[0]),
    "scan": halving,
    "places": chosen,
    "gather and scatter": scattered,
    "nothing batched": lambda x: (jnp.ones(2), x),
}


def assert_same(found: Any, expected: Any, tolerance: float = 1e-5) -> None:
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance), found, expected)


@pytest.mark.parametrize("store_operands", [False, True])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_results_agree_with_vmap(name: str, store_operands: bool):
    function = FUNCTIONS[name]
    x = jax.random.normal(jax.random.key(1), (SIZE, 3, 3))
    assert_same(jax.jit(nested_vmap(function, store_operands=store_operands))(x), jax.vmap(function)(x))


@pytest.mark.parametrize("size", [4, 7, 13])
def test_large_batches_run_in_parts(size: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(vmap_last, "_WIDEST", 4)
    x, shared = jax.random.normal(jax.random.key(5), (size, 3, 3)), jnp.arange(3.0)
    together = vmap(lambda x, y: (x @ y, countdown(x)), [True, False], size)
    found = jax.jit(lambda x, y: together(x, y)[0])(x, shared)
    assert_same(found, jax.vmap(lambda x: (x @ shared, countdown(x)))(x))


@pytest.mark.parametrize("name", ["products", "solve", "scan", "gather and scatter"])
def test_derivatives_agree_with_vmap(name: str):
    function = FUNCTIONS[name]
    x, change = jax.random.normal(jax.random.key(2), (2, SIZE, 3, 3))
    ours, theirs = (jax.jvp(f, (x,), (change,)) for f in (nested_vmap(function), jax.vmap(function)))
    assert_same(ours, theirs, 1e-4)


@pytest.mark.parametrize("name", ["products", "solve", "scan", "gather and scatter"])
def test_nested_batches_agree_with_vmap(name: str, monkeypatch: pytest.MonkeyPatch):
    """The inner batch has derivatives along several directions. The outer batch runs in parts."""
    monkeypatch.setattr(vmap_last, "_WIDEST", 8)
    x, changes = jax.random.normal(jax.random.key(7), (SIZE, 3, 3)), jax.random.normal(jax.random.key(8), (4, 3, 3))

    def function(x: Any) -> Any:
        return jax.vmap(lambda change: jax.jvp(FUNCTIONS[name], (x,), (change,)))(changes)

    assert_same(jax.jit(nested_vmap(function, inner=4))(x), jax.vmap(function)(x), 1e-4)


def test_arguments_without_a_batch_are_shared():
    def function(shared: Any, own: Any) -> Any:
        return {"sum": shared["a"] + own, "product": shared["m"] @ own, "shared": shared["m"].T}

    shared = {"a": jnp.arange(3.0), "m": jax.random.normal(jax.random.key(3), (3, 3))}
    own = jax.random.normal(jax.random.key(4), (SIZE, 3))
    found, batched = vmap(function, [{"a": False, "m": False}, True], SIZE)(shared, own)
    assert batched == {"sum": True, "product": True, "shared": False}
    assert_same(found["shared"], shared["m"].T)
    expected = jax.vmap(function, in_axes=(None, 0))(shared, own)
    assert_same((found["sum"], found["product"]), (expected["sum"], expected["product"]))


def test_loop_variables_independent_of_the_batch_get_no_batch():
    def function(own: Any, shared: Any) -> Any:
        def step(number: Any, carry: Any) -> Any:
            return carry[0] + own * number, 2 * carry[1]

        return jax.lax.fori_loop(0, 3, step, (own, shared))

    (summed, doubled), batched = vmap(function, [True, False], SIZE)(jnp.ones((SIZE, 2)), jnp.ones(2))
    assert batched == (True, False)
    assert summed.shape == (SIZE, 2) and doubled.tolist() == [8.0, 8.0]


def test_values_beside_a_jacobian_get_no_batch():
    """`jax.jacfwd` batches directions of derivatives. Values must not get this batch."""
    x = jax.random.normal(jax.random.key(6), (3, 3))
    jacobian, value = jax.jacfwd(lambda x: (vmap_with_trailing_batch(halving)(x)[0],) * 2, has_aux=True)(x)
    assert_same(value, halving(x)[0])
    assert_same(jacobian, jax.jacfwd(lambda x: halving(x)[0])(x))


@pytest.fixture(scope="module", params=[0.0, 1e-3], ids=["no friction", "dry friction"])
def robots(request: pytest.FixtureRequest) -> tuple[mjx.Model, mjx.Data, PhysicsState, Any, int]:
    """Eight robots on and slightly above the floor, with their commands."""
    model = load_model()
    model.dof_frictionloss[6:] = request.param
    rng = np.random.default_rng(0)
    qpos = np.tile(standing_qpos(model), (8, 1))
    qpos[:, 2] += rng.uniform(-0.002, 0.01, 8)
    state = state_at(jnp.asarray(qpos), jnp.asarray(0.3 * rng.normal(size=(8, model.nv))))
    command = jnp.asarray(rng.uniform(size=(8, 2)))
    return put_model(model), make_data(model), state, command, model.body("balloon").id


@pytest.mark.slow
def test_robots_in_a_batch_move_as_single_robots(robots: tuple[mjx.Model, mjx.Data, PhysicsState, Any, int]):
    model, template, state, command, balloon = robots

    def step(model: mjx.Model, state: PhysicsState, command: Any, lift: Any) -> PhysicsState:
        push = jnp.zeros((1, 6)).at[0, 2].set(lift)
        return control_step(model, template, state, command, push, bodies=(balloon,), count=1)

    lift = jnp.linspace(-0.05, 0.05, 8)
    together = jax.jit(jax.vmap(step, in_axes=(None, 0, 0, 0)))(model, state, command, lift)
    step_one = jax.jit(step)
    for number in range(8):
        alone = step_one(model, *jax.tree.map(lambda x, n=number: x[n], (state, command, lift)))
        moved = jax.tree.map(lambda x, n=number: x[n], together)
        np.testing.assert_allclose(moved.qpos, alone.qpos, atol=2e-5)
        np.testing.assert_allclose(moved.qvel, alone.qvel, atol=2e-3)
