"""Custom forward derivatives of functions of trees of arrays, only few of which vary."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, PyTree


def nonzero_tangents(changes: Sequence[Any]) -> list[int]:
    """Return the indices of the tangents that are not known to be zero.

    `changes` are the tangents that a `custom_jvp` with `symbolic_zeros=True` receives.
    """
    return [place for place, change in enumerate(changes) if not isinstance(change, SymbolicZero)]


def directional_derivative(
    function: Callable[[Sequence[Array]], PyTree],
    leaves: Sequence[Array],
    places: Sequence[int],
    changes: Sequence[Array],
) -> tuple[PyTree, PyTree]:
    """Return `function(leaves)` and its directional derivative.

    Only the leaves at `places` vary, along the tangents `changes`.
    """

    def of(*moved: Array) -> PyTree:
        new = dict(zip(places, moved, strict=True))
        return function([new.get(place, leaf) for place, leaf in enumerate(leaves)])

    return jax.jvp(of, [leaves[place] for place in places], list(changes))


DirectionalDerivative = Callable[[Callable[..., PyTree]], tuple[PyTree, PyTree]]
"""Function that maps a function of the given arguments to its value and its derivative along their tangents."""


def with_custom_jvp(
    function: Callable[..., PyTree], rule: Callable[[DirectionalDerivative, PyTree], PyTree]
) -> Callable[..., PyTree]:
    """Return `function` with the derivative `rule(along, result)`.

    `result` is the result of `function`. `along` differentiates another function of the same arguments.
    """

    def whole(*arguments: PyTree) -> PyTree:
        leaves, tree = jax.tree.flatten(arguments)

        @jax.custom_jvp
        def apply(*leaves: Array) -> PyTree:
            return function(*jax.tree.unflatten(tree, leaves))

        @functools.partial(apply.defjvp, symbolic_zeros=True)
        def _(leaves: Sequence[Array], changes: Sequence[Any]) -> tuple[PyTree, PyTree]:
            result, places = apply(*leaves), nonzero_tangents(changes)

            def along_changes(another: Callable[..., PyTree]) -> tuple[PyTree, PyTree]:
                def flat(leaves: Sequence[Array]) -> PyTree:
                    return another(*jax.tree.unflatten(tree, leaves))

                return directional_derivative(flat, leaves, places, [changes[place] for place in places])

            return result, rule(along_changes, result)

        return apply(*leaves)

    return whole
