"""What a fit of fluid forces searches: vectors, and the tables of coefficients that they stand for.

Free coefficients may take any value. Passive ones are those of a still fluid: the wrench takes energy from the body, or
leaves it as it is, at every velocity. With the motion x = (v, w) of the tracked site, and the wrench about that site,

    wrench = -(A + |v| B) x + Q(x, x) + gravity's part

where A and B have positive semidefinite symmetric parts: drag and damping. Their skew parts are the lift of a cambered
body, and couplings that do no work. Q has x . Q(x, x) = 0: lift and moments over angle of attack and sideslip. The
part of gravity is a wrong weight and a wrong centre of mass. Simulations under such forces stay bounded far from the
recordings. The wrench acts at the centre of mass: coefficients are shifted there.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ballu_mjx.residuals.fluid import TERM_SETS, TermSet, mirrored, terms_of

PASSIVE_SETS: tuple[TermSet, ...] = ("linear", "drag", "quadratic")
"""Sets of terms that passive coefficients have."""
_GRAVITY, _MOTION = 3, 6
"""Numbers of linear terms: gravity's direction first, then velocities."""
_START = 0.3
"""Of the damping's root, in units of its prior: at 0 it has no derivative."""


class Parametrization(Protocol):
    """A set of terms as a vector whose entries have standard normal priors."""

    start: Float[np.ndarray, " size"]
    """Where a search starts."""

    def table(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "terms 6"]:
        """Return coefficients of all terms of the largest set (SI units)."""
        ...

    def directions(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "size terms 6"]:
        """Return the table's derivatives."""
        ...


class FreeCoefficients:
    """Coefficients that may take any value: the table is linear in the vector."""

    def __init__(self, name: TermSet, prior: Float[np.ndarray, "terms 6"], *, symmetric: bool) -> None:
        """`prior`: each coefficient's standard deviation. `symmetric`: about the xz plane."""
        terms = terms_of(TERM_SETS[-1])
        free = mirrored(terms) if symmetric else np.ones(prior.shape, bool)
        free[len(terms_of(name)) :] = False
        self._directions = np.zeros((int(free.sum()), *prior.shape))
        self._directions[np.arange(len(self._directions)), *np.argwhere(free).T] = prior[free]
        self.start = np.zeros(len(self._directions))

    def table(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "terms 6"]:
        """Return coefficients of all terms of the largest set (SI units)."""
        return np.tensordot(vector, self._directions, 1)

    def directions(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "size terms 6"]:
        """Return the table's derivatives, the same everywhere."""
        del vector
        return self._directions


class PassiveCoefficients:
    """Coefficients of a wrench that takes energy from the body, or leaves it as it is."""

    def __init__(
        self,
        name: TermSet,
        prior: Float[np.ndarray, "terms 6"],
        centre: Float[np.ndarray, " 3"],
        *,
        symmetric: bool,
    ) -> None:
        """`prior`: each coefficient's standard deviation. `centre`: the body's centre of mass from the tracked site, in
        the body's axes (m). `symmetric`: about the xz plane."""
        terms = terms_of(TERM_SETS[-1])
        allowed = mirrored(terms) if symmetric else np.ones(prior.shape, bool)
        linear, drag, quadratic = (len(terms_of(each)) for each in PASSIVE_SETS)
        parts = [_gravity_part(prior, allowed), _damping_part(prior, allowed, _GRAVITY)]
        if drag <= len(terms_of(name)):
            parts.append(_damping_part(prior, allowed, linear))
        if quadratic <= len(terms_of(name)):
            parts.append(_workless_part(prior, allowed, slice(drag, quadratic)))
        places = np.cumsum([0, *(len(part.start) for part in parts)])
        lever = np.cross(np.eye(3), centre)

        def table(vector: Float[Array, " size"]) -> Float[Array, "terms 6"]:
            about_site = jnp.zeros(prior.shape)
            for part, first, last in zip(parts, places[:-1], places[1:], strict=True):
                about_site = about_site.at[part.rows].set(part.table(vector[first:last]))
            force, torque = about_site[:, :3], about_site[:, 3:]
            # About the centre of mass: plus force x centre.
            return jnp.concatenate([force, torque + force @ lever], axis=1)

        self._table, self._slopes = jax.jit(table), jax.jit(jax.jacfwd(table))
        self.start = np.concatenate([part.start for part in parts])

    def table(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "terms 6"]:
        """Return coefficients of all terms of the largest set (SI units)."""
        with jax.enable_x64(True):
            return np.asarray(self._table(jnp.asarray(vector)))

    def directions(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "size terms 6"]:
        """Return the table's derivatives."""
        with jax.enable_x64(True):
            return np.moveaxis(np.asarray(self._slopes(jnp.asarray(vector))), -1, 0)


class _Part(NamedTuple):
    """Some rows of the table, about the tracked site."""

    rows: slice
    start: Float[np.ndarray, " size"]
    table: Callable[[Float[Array, " size"]], Float[Array, "rows 6"]]


def _gravity_part(prior: Float[np.ndarray, "terms 6"], allowed: Bool[np.ndarray, "terms 6"]) -> _Part:
    """Return a wrong weight, and a wrong centre of mass: force c g, torque p x g, by the direction of gravity g."""
    entries = np.zeros((1 + 3, _GRAVITY, 6))
    entries[0, :, :3] = np.eye(3)
    entries[1:, :, 3:] = np.cross(np.eye(3)[:, None], np.eye(3)[None])
    entries = entries[(~(entries != 0) | allowed[:_GRAVITY]).all(axis=(1, 2))]
    scales = [prior[:_GRAVITY][entry != 0].min() for entry in entries]
    scaled = entries * np.array(scales)[:, None, None]
    return _Part(slice(0, _GRAVITY), np.zeros(len(scaled)), lambda vector: jnp.tensordot(vector, scaled, 1))


def _damping_part(prior: Float[np.ndarray, "terms 6"], allowed: Bool[np.ndarray, "terms 6"], first: int) -> _Part:
    """Return minus a matrix with a positive semidefinite symmetric part, of the terms from `first` on."""
    rows = slice(first, first + _MOTION)
    scale = np.sqrt(np.diag(prior[rows]))
    root = np.argwhere(np.tril(allowed[rows]))
    skew = np.argwhere(np.tril(allowed[rows], -1))

    def table(vector: Array) -> Array:
        lower = jnp.zeros((_MOTION, _MOTION)).at[*root.T].set(vector[: len(root)])
        turning = jnp.zeros((_MOTION, _MOTION)).at[*skew.T].set(vector[len(root) :])
        return -(lower @ lower.T + turning - turning.T) * scale * scale[:, None]

    start = np.concatenate([_START * (root[:, 0] == root[:, 1]), np.zeros(len(skew))])
    return _Part(rows, start, table)


def _workless_part(prior: Float[np.ndarray, "terms 6"], allowed: Bool[np.ndarray, "terms 6"], rows: slice) -> _Part:
    """Return products of two velocities that do no work: the sum of motion times wrench is 0 at every motion."""
    pairs = list(itertools.combinations_with_replacement(range(_MOTION), 2))
    free = np.argwhere(allowed[rows])
    triples = [tuple(sorted((*pairs[row], axis))) for row, axis in free]
    names = sorted(set(triples))
    power = np.zeros((len(names), len(free)))
    scale = prior[rows][*free.T]
    power[[names.index(triple) for triple in triples], np.arange(len(free))] = scale
    _, singular, right = np.linalg.svd(power / scale.max())
    basis = right[np.count_nonzero(singular > _NO_WORK * singular.max()) :]
    entries = np.zeros((len(basis), len(pairs), 6))
    entries[:, *free.T] = basis * scale
    return _Part(rows, np.zeros(len(basis)), lambda vector: jnp.tensordot(vector, entries, 1))


_NO_WORK = 1e-10
"""Of the largest singular value."""
