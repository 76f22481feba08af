"""Operations on constants, computed with NumPy while a function is traced.

Many of MJX's operations compute indices into tables. Without them, a step's program has fewer operations to lower and
to compile.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import JaxprEqn
from jaxtyping import Shaped

Constant = Shaped[np.ndarray, "..."]
_LARGEST = 4096
"""Largest number of elements of a result. Larger constants would make programs larger, not smaller."""
_KINDS = np.ndarray | np.generic | jax.Array | int | float
"""Types of constants. A `Tracer` is a `jax.Array`, too."""


def is_constant(value: Any) -> bool:
    """Return whether the content of a value is known while a function is traced."""
    return isinstance(value, _KINDS) and not isinstance(value, Tracer)


def fold(equation: JaxprEqn, inputs: Sequence[Any]) -> Constant | None:
    """Return the result of an operation on `inputs`. None if they are not constants, or if no rule exists."""
    rule, aval = _RULES.get(equation.primitive.name), equation.outvars[0].aval
    if rule is None or not isinstance(aval, ShapedArray) or aval.size > _LARGEST or not all(map(is_constant, inputs)):
        return None
    dtype: Any = aval.dtype
    with np.errstate(all="ignore"):
        return np.asarray(rule(equation.params, *map(np.asarray, inputs))).astype(dtype).reshape(aval.shape)


Rule = Callable[..., Any]
"""Function of an operation's parameters and of its constant inputs."""


def _elementwise(function: Callable[..., Any]) -> Rule:
    return lambda params, *inputs: function(*inputs)


def _broadcast(params: dict[str, Any], array: Constant) -> Constant:
    shape, axes = params["shape"], params["broadcast_dimensions"]
    aligned = [1] * len(shape)
    for axis, size in zip(axes, array.shape, strict=True):
        aligned[axis] = size
    return np.broadcast_to(array.reshape(aligned), shape)


def _slice(params: dict[str, Any], array: Constant) -> Constant:
    strides = params["strides"] or (1,) * array.ndim
    return array[tuple(map(slice, params["start_indices"], params["limit_indices"], strides))]


def _iota(params: dict[str, Any]) -> Constant:
    shape, axis = params["shape"], params["dimension"]
    return np.broadcast_to(np.expand_dims(np.arange(shape[axis]), tuple(range(1, len(shape) - axis))), shape)


_RULES: dict[str, Rule] = {
    "add": _elementwise(np.add),
    "and": _elementwise(np.bitwise_and),
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda params, *inputs: np.concatenate(inputs, params["dimension"]),
    "convert_element_type": lambda params, array: array,
    "eq": _elementwise(np.equal),
    "ge": _elementwise(np.greater_equal),
    "gt": _elementwise(np.greater),
    "iota": _iota,
    "le": _elementwise(np.less_equal),
    "lt": _elementwise(np.less),
    "max": _elementwise(np.maximum),
    "min": _elementwise(np.minimum),
    "mul": _elementwise(np.multiply),
    "ne": _elementwise(np.not_equal),
    "neg": _elementwise(np.negative),
    "not": _elementwise(np.invert),
    "or": _elementwise(np.bitwise_or),
    "rem": _elementwise(np.fmod),
    "reshape": lambda params, array: array.reshape(params["new_sizes"]),
    "select_n": lambda params, which, *cases: np.choose(which.astype(int), cases),
    "slice": _slice,
    "squeeze": lambda params, array: np.squeeze(array, params["dimensions"]),
    "sub": _elementwise(np.subtract),
    "transpose": lambda params, array: np.transpose(array, params["permutation"]),
}
