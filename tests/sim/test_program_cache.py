"""Programs stored on disk: which function they belong to, and what happens to files that cannot be used."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.program_cache import cached_program
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.sim.step import state_at
from ballu_mjx.sim.vmap_last import vmap_with_trailing_batch


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """An empty compilation cache."""
    before = jax.config.jax_compilation_cache_dir  # pyright: ignore
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


class Traced:
    """`x -> factor * x + y`, and the number of times that it was traced."""

    def __init__(self, factor: float) -> None:
        self.factor, self.times = factor, 0

    def __call__(self, x: Any, y: Any) -> tuple[Any, Any]:
        self.times += 1
        return self.factor * x + y, y

    def kept(self, key: tuple[Any, ...] = ("function",)) -> Any:
        return vmap_with_trailing_batch(self, key=key)


X, Y = jnp.arange(12.0).reshape(4, 3), jnp.ones(3)


def test_a_stored_program_is_not_traced_again(folder: Path):
    first, second = Traced(2.0), Traced(2.0)
    for function, traced in ((first, True), (second, False)):
        found = jax.jit(jax.vmap(function.kept(), in_axes=(0, None)))(X, Y)
        assert (function.times > 0) == traced
        np.testing.assert_array_equal(found[0], 2 * X + Y)
        np.testing.assert_array_equal(function.kept()(X[0], Y)[0], 2 * X[0] + Y)
        assert (function.times > 0) == traced


@pytest.mark.parametrize("key", [("other",), ("function", 3), ("function", np.arange(2))])
def test_another_key_is_another_program(folder: Path, key: tuple[Any, ...]):
    for function, chosen in ((Traced(2.0), ("function",)), (Traced(3.0), key)):
        found = jax.jit(jax.vmap(function.kept(chosen), in_axes=(0, None)))(X, Y)
        np.testing.assert_array_equal(found[0], function.factor * X + Y)


def test_other_shapes_types_and_batches_are_other_programs(folder: Path):
    function = Traced(2.0)
    each = jax.vmap(function.kept(), in_axes=(0, None))
    np.testing.assert_array_equal(each(X, Y)[0], 2 * X + Y)
    np.testing.assert_array_equal(each(X[:2], Y)[0], 2 * X[:2] + Y)
    np.testing.assert_array_equal(each(X[:, :1], Y[:1])[0], 2 * X[:, :1] + 1)
    np.testing.assert_array_equal(each(X, jnp.ones(3, int))[0], 2 * X + 1)
    together = jax.vmap(function.kept())(X, jnp.tile(2 * Y, (4, 1)))
    np.testing.assert_array_equal(together[0], 2 * X + 2)


def test_results_without_a_batch_stay_so(folder: Path):
    for _ in range(2):
        each = jax.vmap(Traced(2.0).kept(), in_axes=(0, None), out_axes=(0, None))
        np.testing.assert_array_equal(each(X, Y)[1], Y)


def test_a_batch_of_batches_agrees_with_vmap(folder: Path):
    function, stack = Traced(2.0), jnp.stack([X, -X])
    axes = (0, None)
    for _ in range(2):
        found = jax.jit(jax.vmap(jax.vmap(function.kept(), in_axes=axes), in_axes=axes))(stack, Y)
        np.testing.assert_array_equal(found[0], 2 * stack + Y)
        np.testing.assert_array_equal(found[1], jnp.broadcast_to(Y, stack.shape))


def test_derivatives_of_a_stored_program(folder: Path):
    for _ in range(2):
        each = jax.vmap(Traced(2.0).kept(), in_axes=(0, None))
        value, change = jax.jvp(lambda x, each=each: each(x, Y)[0], (X,), (jnp.ones_like(X),))
        np.testing.assert_array_equal(value, 2 * X + Y)
        np.testing.assert_array_equal(change, 2 * jnp.ones_like(X))


@pytest.mark.parametrize("damage", [lambda content: content[:-40], lambda content: b"", lambda content: content[::-1]])
def test_a_damaged_file_is_replaced(folder: Path, damage: Any):
    arguments = (X, Y)
    cached_program(("function",), Traced(2.0), arguments)
    (path,) = folder.rglob("*.jax")
    content = path.read_bytes()
    path.write_bytes(damage(content))
    function = Traced(2.0)
    for _ in range(2):
        np.testing.assert_array_equal(cached_program(("function",), function, arguments)(X, Y)[0], 2 * X + Y)
        assert function.times == 1


def test_what_cannot_be_stored_is_computed(folder: Path):
    (folder / "traced").write_text("a file where the folder should be")
    np.testing.assert_array_equal(cached_program(("function",), Traced(2.0), (X, Y))(X, Y)[0], 2 * X + Y)
    unknown = ("function", object())
    np.testing.assert_array_equal(cached_program(unknown, Traced(2.0), (X, Y))(X, Y)[0], 2 * X + Y)


@pytest.mark.parametrize(
    ("option", "value"), [("jax_compilation_cache_dir", "gs://bucket/cache"), ("jax_enable_compilation_cache", False)]
)
def test_nothing_is_stored_without_a_local_cache(
    folder: Path, option: str, value: Any, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(folder)
    before = getattr(jax.config, option)
    jax.config.update(option, value)
    try:
        np.testing.assert_array_equal(cached_program(("function",), Traced(2.0), (X, Y))(X, Y)[0], 2 * X + Y)
    finally:
        jax.config.update(option, before)
    assert not list(folder.iterdir())


def test_what_has_no_portable_form_is_computed(folder: Path):
    def function(x: Any) -> Any:
        return jax.pure_callback(lambda x: 2 * np.asarray(x), jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    np.testing.assert_array_equal(cached_program(("function",), function, (X,))(X), 2 * X)
    assert not list(folder.rglob("*.jax"))


@pytest.mark.slow
def test_a_robot_s_step_and_observation_are_stored(folder: Path):
    """All static fields of a model can be hashed. Otherwise nothing would be stored, without a word."""
    jax.clear_caches()  # other tests may have traced the same programs
    simulator = Simulator(load_robot())
    state = state_at(jnp.zeros((3, simulator.mj_model.nq)), jnp.zeros((3, simulator.nv)))
    for count, function in (
        (2, jax.vmap(simulator.observe)),
        (4, jax.vmap(lambda state: simulator.step(state, jnp.zeros(2), jnp.zeros((1, 6))))),
    ):
        jax.eval_shape(function, state)
        assert len(list(folder.rglob("*.jax"))) == count


_SOLVE = """
import sys

import jax
import jax.numpy as jnp

from ballu_mjx.sim.program_cache import cached_program

jax.config.update("jax_compilation_cache_dir", sys.argv[1])
matrix = jnp.array([[4.0, 1.0], [1.0, 3.0]])
program = cached_program(("solve",), lambda m: jax.scipy.linalg.cho_solve((m, True), jnp.ones(2)), (matrix,))
print(program(matrix).tolist())
"""


def test_a_new_process_runs_a_stored_program_that_calls_lapack(tmp_path: Path):
    command = [sys.executable, "-c", _SOLVE, str(tmp_path)]
    first, second = (subprocess.run(command, capture_output=True, text=True) for _ in range(2))
    assert first.returncode == second.returncode == 0, second.stderr
    assert first.stdout == second.stdout
