"""Evaluation of JAX's records of functions (jaxprs) with the batch along the last axis: one rule for each operation.

`vmap_last` gives the reason. Operations without a rule are left to `jax.vmap`.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from jaxtyping import Array

from ballu_mjx.sim.constant_folding import fold, is_constant


@dataclasses.dataclass(frozen=True)
class Batch:
    """How a function is evaluated for a batch."""

    size: int
    """Batch size."""
    store_operands: bool = False
    """Whether factors of matrix products are computed before the product, and sums over rows are written out.

    By default, XLA merges the computation of a factor into the product, and repeats it for each of its elements. This
    saves memory traffic if the computation is short. In MJX's solver it is long if joints have dry friction: their
    constraints have three cases. The step then takes seven times as long.
    """


@dataclasses.dataclass(frozen=True)
class Batched:
    """A value that has a batch."""

    array: Array
    """Array whose last axis is the batch."""


def _bare(value: Any) -> Any:
    return value.array if isinstance(value, Batched) else value


def _is_batched(value: Any) -> bool:
    return isinstance(value, Batched)


def _full(value: Any, batch: Batch) -> Array:
    """Return the array of a value, repeated over the batch if the value has none."""
    if isinstance(value, Batched):
        return value.array
    array = jnp.asarray(value)
    return lax.broadcast_in_dim(array, (*array.shape, batch.size), tuple(range(array.ndim)))


def _ranked(array: Array, like: Array) -> Array:
    """Return `array`, repeated over the axes of `like` if it has only one number for each element of the batch.

    JAX's operations accept scalars in place of arrays of any shape.
    """
    return array if array.ndim == like.ndim else lax.broadcast_in_dim(array, like.shape, (like.ndim - 1,))


Operations = dict[Any, tuple[list[Any], list[Any]]]
"""Inputs and results of the operations so far. Inputs are kept because a key contains their identities."""


def evaluate(
    closed: ClosedJaxpr, arguments: Iterable[Any], batch: Batch, operations: Operations | None = None
) -> list[Any]:
    """Return the results of a recorded function. Repeated operations are evaluated once.

    `operations` are those of the function that calls this one.
    """
    operations = {} if operations is None else operations
    known: dict[Any, Any] = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    known.update(zip(closed.jaxpr.invars, arguments, strict=True))

    def read(variable: Any) -> Any:
        return variable.val if isinstance(variable, Literal) else known[variable]

    for equation in closed.jaxpr.eqns:
        inputs, call = [read(v) for v in equation.invars], _CALLS.get(equation.primitive.name)
        if call is not None:
            results = evaluate(equation.params[call], inputs, batch, operations)
        else:
            key = _operation(equation, inputs)
            if key not in operations:
                operations[key] = inputs, _apply(equation, inputs, batch)
            results = operations[key][1]
        known.update(zip(equation.outvars, results, strict=True))
    return [read(v) for v in closed.jaxpr.outvars]


def _operation(equation: JaxprEqn, inputs: list[Any]) -> Any:
    """Return a key that is equal for equal operations on the same inputs, or on constants of equal content."""
    places = tuple(_content(x) if is_constant(x) else id(x) for x in inputs)
    try:
        params = tuple(sorted(equation.params.items()))
        hash(params)
    except TypeError:
        params = id(equation)
    return equation.primitive, places, params


def _content(value: Any) -> Any:
    array = np.asarray(value)
    return array.tobytes(), array.shape, array.dtype


def _apply(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any]:
    """Return the results of one operation."""
    name, bind, params = equation.primitive.name, equation.primitive.bind, equation.params
    if not any(map(_is_batched, inputs)):
        constant = fold(equation, inputs)
        return _as_list(bind(*inputs, **params), equation) if constant is None else [constant]
    if name in _ELEMENTWISE:
        full = [_full(x, batch) for x in inputs]
        widest = max(full, key=jnp.ndim)
        return [Batched(bind(*(_ranked(x, widest) for x in full), **params))]
    if name in _REDUCTIONS:
        array = _bare(inputs[0])
        if batch.store_operands and name == "reduce_sum" and params["axes"] == (0,) and array.ndim > 2 and len(array):
            return [Batched(functools.reduce(operator.add, array))]
        return [Batched(bind(array, **params))]
    if name in _RULES:
        found = _RULES[name](equation, inputs, batch)
        if found is not None:
            return found
    axes = [-1 if _is_batched(x) else None for x in inputs]
    found = jax.vmap(lambda *values: bind(*values, **params), in_axes=axes, out_axes=-1)(*map(_bare, inputs))
    return [Batched(x) for x in _as_list(found, equation)]


def _stored(array: Array) -> Array:
    """Return `array` in a form that XLA computes only once.

    XLA does not repeat divisions. The divisor is 1, which XLA does not know, and no number changes.
    """
    if not array.size or not jnp.issubdtype(array.dtype, jnp.floating):
        return array
    return array / (1 + 0 * array[(0,) * (array.ndim - 1)])


def _as_list(found: Any, equation: JaxprEqn) -> list[Any]:
    return list(found) if equation.primitive.multiple_results else [found]


def _result(equation: JaxprEqn) -> ShapedArray:
    """Return shape and type of an operation's result for one element of the batch."""
    aval = equation.outvars[0].aval
    assert isinstance(aval, ShapedArray)
    return aval


_CALLS = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "custom_jvp_call": "call_jaxpr"}
"""Operations that call another recorded function, and the name of the parameter that holds it."""
_ELEMENTWISE = frozenset(
    "abs acos add add_any and asin atan atan2 cbrt ceil clamp convert_element_type copy cos div eq erf exp exp2 floor "
    "ge gt integer_pow is_finite le log log1p logistic lt max min mul ne neg nextafter not or pow rem round rsqrt sign "
    "sin sqrt square sub tan tanh xor".split()
)
_REDUCTIONS = frozenset("argmax argmin reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum".split())

Rule = Callable[[JaxprEqn, list[Any], Batch], list[Any] | None]
"""Function of an operation, its inputs and the batch. It returns the results, or None if `jax.vmap` has to do it."""
_RULES: dict[str, Rule] = {}


def _rule(*names: str) -> Callable[[Rule], Rule]:
    def keep(rule: Rule) -> Rule:
        _RULES.update(dict.fromkeys(names, rule))
        return rule

    return keep


# 1. Shapes


@_rule("select_n")
def _select(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any]:
    which, *cases = (_full(x, batch) for x in inputs)
    return [Batched(lax.select_n(_ranked(which, cases[0]), *cases))]


@_rule("broadcast_in_dim")
def _broadcast(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any]:
    shape, axes = equation.params["shape"], equation.params["broadcast_dimensions"]
    return [Batched(lax.broadcast_in_dim(_bare(inputs[0]), (*shape, batch.size), (*axes, len(shape))))]


@_rule("reshape")
def _reshape(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any] | None:
    if equation.params["dimensions"] is not None:
        return None
    return [Batched(lax.reshape(_bare(inputs[0]), (*equation.params["new_sizes"], batch.size)))]


@_rule("squeeze", "expand_dims", "rev")
def _same_axes(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any]:
    return [Batched(equation.primitive.bind(_bare(inputs[0]), **equation.params))]


@_rule("transpose")
def _transpose(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any]:
    axes = equation.params["permutation"]
    return [Batched(lax.transpose(_bare(inputs[0]), (*axes, len(axes))))]


@_rule("slice")
def _slice(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any]:
    start, limit, strides = (equation.params[name] for name in ("start_indices", "limit_indices", "strides"))
    strides = None if strides is None else (*strides, 1)
    return [Batched(lax.slice(_bare(inputs[0]), (*start, 0), (*limit, batch.size), strides))]


@_rule("concatenate")
def _concatenate(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any]:
    return [Batched(lax.concatenate([_full(x, batch) for x in inputs], equation.params["dimension"]))]


@_rule("tile")
def _tile(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any]:
    return [Batched(lax.tile(_bare(inputs[0]), (*equation.params["reps"], 1)))]


@_rule("pad")
def _pad(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any] | None:
    if _is_batched(inputs[1]):
        return None
    return [Batched(lax.pad(_full(inputs[0], batch), inputs[1], (*equation.params["padding_config"], (0, 0, 0))))]


@_rule("dynamic_slice")
def _dynamic_slice(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any]:
    """Select among all possible start positions if they differ over the batch.

    There are few positions, and the selection needs no loop over the batch.
    """
    array, sizes = _full(inputs[0], batch), equation.params["slice_sizes"]
    for axis, (start, width) in enumerate(zip(inputs[1:], sizes, strict=True)):
        places = array.shape[axis] - width + 1
        if not _is_batched(start):
            array = lax.dynamic_slice_in_dim(array, start, width, axis)
            continue
        place = jnp.clip(_bare(start), 0, places - 1)
        found = lax.slice_in_dim(array, 0, width, axis=axis)
        for number in range(1, places):
            here = lax.slice_in_dim(array, number, number + width, axis=axis)
            found = jnp.where(place == number, here, found)
        array = found
    return [Batched(array)]


@_rule("dynamic_update_slice")
def _dynamic_update_slice(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any] | None:
    array, update, *starts = inputs
    if any(map(_is_batched, starts)):
        return None
    return [Batched(lax.dynamic_update_slice(_full(array, batch), _full(update, batch), (*starts, 0)))]


@_rule("gather")
def _gather(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any] | None:
    array, indices = inputs
    if _is_batched(indices):
        return None
    numbers = equation.params["dimension_numbers"]
    numbers = numbers._replace(offset_dims=(*numbers.offset_dims, _result(equation).ndim))
    sizes = (*equation.params["slice_sizes"], batch.size)
    params = {**equation.params, "dimension_numbers": numbers, "slice_sizes": sizes}
    return [Batched(equation.primitive.bind(_bare(array), indices, **params))]


@_rule("scatter", "scatter-add", "scatter-mul", "scatter-min", "scatter-max")
def _scatter(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any] | None:
    array, indices, updates = inputs
    if _is_batched(indices):
        return None
    numbers, updates = equation.params["dimension_numbers"], _full(updates, batch)
    numbers = numbers._replace(update_window_dims=(*numbers.update_window_dims, updates.ndim - 1))
    params = {**equation.params, "dimension_numbers": numbers}
    return [Batched(equation.primitive.bind(_full(array, batch), indices, updates, **params))]


# 2. Linear algebra: matrices with about a dozen rows, processed column by column for the whole batch


@_rule("dot_general")
def _dot(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any]:
    contracted, together = equation.params["dimension_numbers"]
    dtype = _result(equation).dtype

    def arranged(value: Any, contracted: Sequence[int], together: Sequence[int]) -> tuple[Array, int]:
        """Return the operand with axes contracted (merged into one), `together`, others, batch; and the count of
        others."""
        array = _bare(value) if _is_batched(value) else jnp.asarray(value)[..., None]
        others = [axis for axis in range(array.ndim - 1) if axis not in (*contracted, *together)]
        array = lax.transpose(array, (*contracted, *together, *others, array.ndim - 1))
        terms = math.prod(array.shape[: len(contracted)])
        return array.reshape(terms, *array.shape[len(contracted) :]), len(others)

    left, left_others = arranged(inputs[0], contracted[0], together[0])
    right, right_others = arranged(inputs[1], contracted[1], together[1])
    if batch.store_operands:
        left, right = _stored(left) if right_others else left, _stored(right) if left_others else right
    first = 1 + len(together[0])
    left = jnp.expand_dims(left, tuple(range(first + left_others, first + left_others + right_others)))
    right = jnp.expand_dims(right, tuple(range(first, first + left_others)))
    return [Batched(jnp.sum(left * right, axis=0, dtype=dtype))]  # pyright: ignore[reportArgumentType]


# Explicit sums over the rows solved so far keep XLA from recomputing every earlier row in each later row.


@_rule("cholesky")
def _cholesky(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any] | None:
    matrix = _bare(inputs[0])
    if matrix.ndim != 3:
        return None
    lower = jnp.zeros_like(matrix)  # transposed: its rows are the columns found so far
    for number in range(len(matrix)):
        found = lower[:number, number:]
        column = matrix[number:, number] - jnp.sum(found * found[:, :1], axis=0)
        lower = lower.at[number, number:].set(column / jnp.sqrt(column[0]))
    return [Batched(jnp.swapaxes(lower, 0, 1))]


@_rule("triangular_solve")
def _triangular_solve(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any] | None:
    matrix, right = (_full(x, batch) for x in inputs)
    params = equation.params
    if matrix.ndim != 3 or params["unit_diagonal"]:
        return None
    lower, on_left = params["lower"], params["left_side"]
    if params["transpose_a"] == on_left:  # transposing the equation moves the matrix to its other side
        matrix, lower = jnp.swapaxes(matrix, 0, 1), not lower
    if not on_left:
        right = jnp.swapaxes(right, 0, 1)
    count = len(matrix)
    solved = jnp.zeros_like(right)
    for row in range(count) if lower else reversed(range(count)):
        known = slice(None, row) if lower else slice(row + 1, None)
        rest = right[row] - jnp.sum(matrix[row, known][:, None] * solved[known], axis=0)
        solved = solved.at[row].set(rest / matrix[row, row])
    return [Batched(solved if on_left else jnp.swapaxes(solved, 0, 1))]


# 3. Control flow: elements of the batch that have finished a loop keep their values while others continue


def depends_on_batch(closed: ClosedJaxpr, batched: Iterable[bool]) -> list[bool]:
    """Return which results have a batch, given which arguments have one."""
    jaxpr: Jaxpr = closed.jaxpr
    known = dict(zip(jaxpr.invars, batched, strict=True))

    def has(variable: Any) -> bool:
        return not isinstance(variable, Literal) and known.get(variable, False)

    for equation in jaxpr.eqns:
        inputs, name, params = [has(v) for v in equation.invars], equation.primitive.name, equation.params
        if not any(inputs):
            continue
        if name in _CALLS:
            results = depends_on_batch(params[_CALLS[name]], inputs)
        elif name == "while":
            results = _while_depends(equation, inputs)[0]
        elif name == "scan":
            results = _scan_depends(equation, inputs)
        elif name == "cond" and not inputs[0]:
            results = [
                any(each) for each in zip(*(depends_on_batch(b, inputs[1:]) for b in params["branches"]), strict=True)
            ]
        else:
            results = [True] * len(equation.outvars)
        known.update(zip(equation.outvars, results, strict=True))
    return [has(v) for v in jaxpr.outvars]


def _while_depends(equation: JaxprEqn, inputs: Sequence[bool]) -> tuple[list[bool], bool]:
    """Return which of the loop's values have a batch, and whether the number of iterations differs over the batch.

    A value has a batch if it has one at the start or receives one during the loop.
    """
    of_cond, of_body, batched = _parts(inputs, equation.params["cond_nconsts"], equation.params["body_nconsts"])
    while True:
        each = depends_on_batch(equation.params["cond_jaxpr"], [*of_cond, *batched])[0]
        after = depends_on_batch(equation.params["body_jaxpr"], [*of_body, *batched])
        grown = [b or a or each for b, a in zip(batched, after, strict=True)]
        if grown == batched:
            return batched, each
        batched = grown


def _scan_depends(equation: JaxprEqn, inputs: Sequence[bool]) -> list[bool]:
    """Return which values of the final carry, and which results of all steps, have a batch."""
    constants, carried = _scan_sizes(equation)
    fixed, batched, rows = _parts(inputs, constants, carried)
    while True:
        after = depends_on_batch(equation.params["jaxpr"], [*fixed, *batched, *rows])
        grown = [b or a for b, a in zip(batched, after[:carried], strict=True)]
        if grown == batched:
            return [*batched, *after[carried:]]
        batched = grown


def _scan_sizes(equation: JaxprEqn) -> tuple[int, int]:
    """Return how many inputs of the loop are constants, and how many are carried."""
    params = equation.params
    if "num_carry" in params:
        return params["num_consts"], params["num_carry"]
    constants, carried, _ = params["ft_in"].unpack()  # since JAX 0.11
    return len(constants), len(carried)


def _parts(values: Sequence[Any], first: int, second: int) -> tuple[list[Any], list[Any], list[Any]]:
    """Return the first `first` values, the next `second` values, and the rest."""
    return list(values[:first]), list(values[first : first + second]), list(values[first + second :])


def _wrapped(values: Iterable[Any], batched: Iterable[bool]) -> list[Any]:
    return [Batched(x) if b else x for x, b in zip(values, batched, strict=True)]


def unwrap(values: Iterable[Any], batched: Iterable[bool], batch: Batch) -> list[Any]:
    """Return bare arrays. Those that are `batched` have a batch, even if the value had none."""
    return [_full(x, batch) if b else x for x, b in zip(values, batched, strict=True)]


@_rule("cond")
def _cond(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any]:
    which, *operands = inputs
    branches = equation.params["branches"]
    if _is_batched(which):
        cases = [unwrap(evaluate(b, operands, batch), [True] * len(equation.outvars), batch) for b in branches]
        chosen = _bare(which) if len(branches) > 2 else _bare(which) != 0
        return [Batched(lax.select_n(_ranked(chosen, case[0]), *case)) for case in zip(*cases, strict=True)]
    batched = list(map(_is_batched, operands))
    after = [any(each) for each in zip(*(depends_on_batch(b, batched) for b in branches), strict=True)]

    def branch(closed: ClosedJaxpr) -> Callable[..., list[Array]]:
        return lambda *values: unwrap(evaluate(closed, _wrapped(values, batched), batch), after, batch)

    return _wrapped(lax.switch(which, [branch(b) for b in branches], *map(_bare, operands)), after)


@_rule("while")
def _while(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any]:
    cond, body = equation.params["cond_jaxpr"], equation.params["body_jaxpr"]
    of_cond, of_body, start = _parts(inputs, equation.params["cond_nconsts"], equation.params["body_nconsts"])
    batched, each = _while_depends(equation, list(map(_is_batched, inputs)))

    def goes_on(carry: list[Any]) -> Any:
        return _bare(evaluate(cond, [*of_cond, *_wrapped(carry, batched)], batch)[0])

    def step(carry: list[Any]) -> list[Any]:
        return unwrap(evaluate(body, [*of_body, *_wrapped(carry, batched)], batch), batched, batch)

    def step_each(carry: tuple[Array, list[Any]]) -> tuple[Array, list[Any]]:
        going, values = carry
        values = [lax.select(_ranked(going, old), new, old) for new, old in zip(step(values), values, strict=True)]
        return going & goes_on(values), values

    first = unwrap(start, batched, batch)
    if each:
        last = lax.while_loop(lambda carry: jnp.any(carry[0]), step_each, (goes_on(first), first))[1]
    else:
        last = lax.while_loop(goes_on, step, first)
    return _wrapped(last, batched)


@_rule("scan")
def _scan(equation: JaxprEqn, inputs: list[Any], batch: Batch) -> list[Any]:
    closed, (constants, carried) = equation.params["jaxpr"], _scan_sizes(equation)
    fixed, start, rows = _parts(inputs, constants, carried)
    of_rows, all_batched = list(map(_is_batched, rows)), _scan_depends(equation, list(map(_is_batched, inputs)))
    batched = all_batched[:carried]

    def step(carry: list[Any], row: list[Any]) -> tuple[list[Any], list[Any]]:
        found = evaluate(closed, [*fixed, *_wrapped(carry, batched), *_wrapped(row, of_rows)], batch)
        found = unwrap(found, all_batched, batch)
        return found[:carried], found[carried:]

    same = {name: equation.params[name] for name in ("length", "reverse", "unroll")}
    last, seen = lax.scan(step, unwrap(start, batched, batch), list(map(_bare, rows)), **same)
    return _wrapped([*last, *seen], all_batched)
