"""`vmap` with the batch along the last axis, for CPUs.

A robot's arrays are small, for example 13 velocities or a 3x3 rotation. `jax.vmap` puts the batch axis first. XLA's
loops on a CPU then run over the short axes, three or thirteen numbers at a time. With the batch axis last, every loop
runs over hundreds of robots that are adjacent in memory, and vector instructions process several robots at once. The
function itself does not change. JAX's record of it (the jaxpr) is evaluated again, operation by operation, on arrays
with one more axis.

Operations without a rule (`vmap_last_rules`) are left to `jax.vmap`, which is equally correct and slower.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.interpreters.partial_eval import dce_jaxpr
from jaxtyping import Array, PyTree

from ballu_mjx.sim.custom_jvp import directional_derivative, nonzero_tangents
from ballu_mjx.sim.program_cache import cached_program, shapes_of
from ballu_mjx.sim.vmap_last_rules import Batch, Batched, depends_on_batch, evaluate, unwrap


def vmap(
    function: Callable[..., Any],
    in_batched: Sequence[PyTree[bool]],
    size: int,
    widest: int | None = None,
    store_operands: bool = False,
) -> Callable[..., Any]:
    """Return a batched version of `function`, like `jax.vmap(function)`, for functions of arrays and trees of arrays.

    **Arguments**

    - `in_batched`: for each argument, a tree of the same structure. It says which leaves have a batch along their first
      axis.
    - `size`: batch size.
    - `widest`: largest batch that is evaluated at once. Larger batches are split into parts that run one after another.
      None for 512.
    - `store_operands`: see `vmap_last_rules.Batch`.

    **Returns** a function that returns the results, and a tree that says which results have a batch along their first
    axis. These are the results that depend on a batched argument.
    """
    flags, widest = jax.tree.leaves(list(in_batched)), widest or _WIDEST

    def batched(*arguments: Any) -> Any:
        leaves, tree = jax.tree.flatten(list(arguments))
        arrays = [jnp.asarray(leaf) for leaf in leaves]
        single = [
            jax.ShapeDtypeStruct(x.shape[1:] if f else x.shape, x.dtype, weak_type=x.weak_type)
            for x, f in zip(arrays, flags, strict=True)
        ]
        recorded, shape = jax.make_jaxpr(function, return_shape=True)(*jax.tree.unflatten(tree, single))
        depends = depends_on_batch(recorded, flags)

        def part(width: int, own: Sequence[Array]) -> list[Array]:
            rows = iter(own)
            values = [Batched(jnp.moveaxis(next(rows), 0, -1)) if f else x for x, f in zip(arrays, flags, strict=True)]
            batch = Batch(width, store_operands)
            found = unwrap(evaluate(recorded, values, batch), depends, batch)
            return [jnp.moveaxis(x, -1, 0) if d else jnp.asarray(x) for x, d in zip(found, depends, strict=True)]

        own = [x for x, f in zip(arrays, flags, strict=True) if f]
        if size <= widest:
            found = part(size, own)
        else:
            parts = -(-size // widest)
            width = -(-size // parts)
            rows = np.arange(parts * width).reshape(parts, width) % size
            found = lax.map(functools.partial(part, width), [x[rows] for x in own])
            found = [x.reshape(-1, *x.shape[2:])[:size] if d else x[0] for x, d in zip(found, depends, strict=True)]
        tree = jax.tree.structure(shape)
        return jax.tree.unflatten(tree, found), jax.tree.unflatten(tree, depends)

    return batched


_WIDEST = 512
"""Largest batch whose working data in a robot's step stay in a core's cache (`benchmarks/step_profile.py`)."""


def nested_vmap(function: Callable[..., PyTree], inner: int = 1, store_operands: bool = False) -> Callable[..., PyTree]:
    """Return `jax.vmap(function)`; on the CPU, a version with the batch along the last axis.

    Operations that `function` itself batches have the new batch axis last as well. Their batch size is about `inner`,
    and the largest batch that is evaluated at once is smaller by this factor. `store_operands`: see
    `vmap_last_rules.Batch`.
    """
    if jax.default_backend() != "cpu":
        return jax.vmap(function)

    def whole(*arguments: PyTree) -> PyTree:
        size = len(jax.tree.leaves(arguments)[0])
        everything = jax.tree.map(lambda _: True, arguments)
        found, depends = vmap(function, everything, size, max(_WIDEST // inner, 1), store_operands)(*arguments)
        return jax.tree.map(lambda x, d: x if d else jnp.broadcast_to(x, (size, *x.shape)), found, depends)

    return whole


def vmap_with_trailing_batch(
    function: Callable[..., PyTree], store_operands: bool = False, key: tuple[Any, ...] | None = None
) -> Callable[..., PyTree]:
    """Return `function` with a rule that makes `jax.vmap` put the batch along the last axis.

    The rule applies to forward derivatives too. It exists on the CPU only: on other devices, the result calls
    `function` unchanged. Reverse mode is not supported.

    **Arguments**

    - `store_operands`: see `vmap_last_rules.Batch`; true for models with dry friction (`step.has_dry_friction`).
    - `key`: name and static values that determine `function`. Its traced programs are then stored on disk, except those
      of derivatives (`program_cache`). It must return arrays in tuples or lists. If None, nothing is stored.
    """

    def whole(*arguments: PyTree) -> PyTree:
        if jax.default_backend() != "cpu":
            return function(*arguments)
        leaves, tree = jax.tree.flatten(arguments)
        stored = None if key is None else (*key, tree, store_operands)
        flat = _recorded(lambda leaves: function(*jax.tree.unflatten(tree, leaves)), leaves)

        @jax.custom_jvp
        def apply(*leaves: Array) -> PyTree:
            return _with_batch_last(flat, store_operands, stored)(list(leaves))

        @functools.partial(apply.defjvp, symbolic_zeros=True)
        def _(leaves: Sequence[Array], changes: Sequence[Any]) -> tuple[PyTree, PyTree]:
            # Most fields of a model are constant and need no derivatives.
            places = nonzero_tangents(changes)

            def along(leaves: list[Array], changes: list[Array]) -> tuple[PyTree, PyTree]:
                return directional_derivative(flat, leaves, places, changes)

            moving = list(leaves), [changes[i] for i in places]
            return _with_batch_last(_recorded(along, *moving), store_operands)(*moving)

        return apply(*leaves)

    return whole


def _recorded(function: Callable[..., PyTree], *arguments: PyTree) -> Callable[..., PyTree]:
    """Return a function that runs JAX's record of `function` for arguments of these shapes.

    The record is made at the first call. Tracing MJX takes long, and it would be traced several times here. Operations
    that the results do not need, a third of a physics step, are left out.
    """
    shapes = shapes_of(arguments)

    @functools.cache
    def recorded() -> tuple[Callable[..., list[Array]], Any]:
        record, shape = jax.make_jaxpr(function, return_shape=True)(*shapes)
        needed, _ = dce_jaxpr(record.jaxpr, [True] * len(record.jaxpr.outvars), instantiate=True)
        return jaxpr_as_fun(ClosedJaxpr(needed, record.consts)), jax.tree.structure(shape)

    def run(*arguments: PyTree) -> PyTree:
        flat, tree = recorded()
        return jax.tree.unflatten(tree, flat(*jax.tree.leaves(arguments)))

    return run


def _with_batch_last(
    function: Callable[..., PyTree], store_operands: bool, key: tuple[Any, ...] | None = None
) -> Callable[..., PyTree]:
    """Return `function` with the rule of `vmap_with_trailing_batch`."""

    def run(*arguments: PyTree) -> PyTree:
        whole = custom_vmap(function if key is None else cached_program(key, function, arguments))

        @whole.def_vmap
        def _(size: int, in_batched: Sequence[PyTree[bool]], *arguments: PyTree) -> tuple[PyTree, PyTree[bool]]:
            batched = vmap(function, in_batched, size, store_operands=store_operands)
            if key is None:
                return batched(*arguments)
            which = size, tuple(jax.tree.leaves(in_batched))
            return _unmarked(_stored(batched, size, store_operands, (*key, *which), arguments)(*arguments))

        return whole(*arguments)

    return run


def _stored(
    batched: Callable[..., tuple[PyTree, PyTree[bool]]],
    size: int,
    store_operands: bool,
    key: tuple[Any, ...],
    arguments: Sequence[PyTree],
) -> Callable[..., PyTree]:
    """Return the stored program of a batched function. Its results are marked as with a batch or without.

    A further `jax.vmap` cannot batch a stored program. It batches the function.
    """

    def marked(*arguments: PyTree) -> PyTree:
        return jax.tree.map(lambda x, d: {_BATCHED if d else _SHARED: x}, *batched(*arguments))

    program = custom_vmap(cached_program(key, marked, arguments))

    @program.def_vmap
    def _(outer: int, in_batched: Sequence[PyTree[bool]], *arguments: PyTree) -> tuple[PyTree, PyTree[bool]]:
        return vmap(marked, in_batched, outer, max(_WIDEST // size, 1), store_operands)(*arguments)

    return program


_BATCHED, _SHARED = "batched", "shared"


def _unmarked(found: PyTree) -> tuple[PyTree, PyTree[bool]]:
    def is_mark(x: Any) -> bool:
        return isinstance(x, dict)

    results = jax.tree.map(lambda x: next(iter(x.values())), found, is_leaf=is_mark)
    return results, jax.tree.map(lambda x: _BATCHED in x, found, is_leaf=is_mark)
