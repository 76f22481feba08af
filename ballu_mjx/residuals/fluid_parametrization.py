"""Parametrizations of the fluid residual: the search vector of a fit, and the coefficients that it stands for.

Free coefficients may have any value. Passive coefficients are those of a still fluid: at every velocity, the wrench,
without its gravity part, does no positive work on the body. With the motion x = (v, w) of the tracked site, and the
wrench about that site,

    wrench = -(A + |v| B) x + Q(x, x) + gravity part

- A and B have positive semidefinite symmetric parts, which are drag and damping. Their skew parts are the lift of a
  cambered body, and couplings that do no work.
- Q satisfies x . Q(x, x) = 0. It contains lift and moments as functions of angle of attack and sideslip.
- The gravity part corrects a wrong weight and a wrong centre of mass.

Simulations with passive coefficients stay bounded, even far from the recordings. Residuals apply the wrench at the
centre of mass, so the coefficients are transformed to that point.

Added masses and inertias are exponentials, so that they are never negative.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ballu_mjx.residuals.fluid import TERM_SETS, FluidParameters, Term, TermSet, symmetric_mask, terms_of

PASSIVE_SETS: tuple[TermSet, ...] = ("linear", "drag", "quadratic")
"""Sets of terms for which passive coefficients exist."""
_GRAVITY, _MOTION = 3, 6
"""Numbers of the linear terms of gravity, which come first, and of the velocities."""
_START = 0.3
"""Starting value of the diagonal of the damping's square root, in units of its prior. At 0, the damping would have no
derivative with respect to its root."""


class Parametrization(Protocol):
    """Parametrization of the coefficients of a set of terms by a vector whose entries have standard normal priors."""

    start: Float[np.ndarray, " size"]
    """Starting vector of a search."""

    def table(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "terms 6"]:
        """Return the coefficients of all terms of the largest set (SI units)."""
        ...

    def directions(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "size terms 6"]:
        """Return the derivatives of the coefficients with respect to the entries of the vector."""
        ...


class AddedMass(NamedTuple):
    """Medians of the log-normal priors of added mass and inertia. The standard deviation of the logarithms is
    `ADDED_SPREAD`."""

    mass: float
    """Added mass (kg)."""
    inertia: Float[np.ndarray, " 3"]
    """Added moments of inertia (kg m^2)."""


ADDED_SPREAD = 0.7
"""Standard deviation of the logarithms of added mass and inertia: a factor of two."""


class FluidParametrization:
    """Parametrization of all parameters by a vector: logarithms of added mass and inertia, then coefficients."""

    def __init__(self, coefficients: Parametrization, added: AddedMass | None) -> None:
        """Combine the coefficients with an added mass. If `added` is None, there is no added mass."""
        self._coefficients, self._added = coefficients, added
        self._logarithms = 0 if added is None else 4
        self.start = np.concatenate([np.zeros(self._logarithms), coefficients.start])

    def parameters(self, vector: Float[np.ndarray, " size"]) -> FluidParameters:
        """Return the parameters, with the coefficients of all terms of the largest set."""
        table = self._coefficients.table(vector[self._logarithms :])
        if self._added is None:
            return FluidParameters.without_added_mass(table)
        factors = np.exp(ADDED_SPREAD * vector[: self._logarithms])
        return FluidParameters(table, np.asarray(self._added.mass * factors[0]), self._added.inertia * factors[1:])

    def directions(self, vector: Float[np.ndarray, " size"]) -> FluidParameters:
        """Return the derivatives of the parameters with respect to the entries of the vector, the leading axis."""
        table = self._coefficients.directions(vector[self._logarithms :])
        coefficients = np.concatenate([np.zeros((self._logarithms, *table.shape[1:])), table])
        mass, inertia = np.zeros(len(vector)), np.zeros((len(vector), 3))
        if self._added is not None:
            now = self.parameters(vector)
            mass[0] = ADDED_SPREAD * now.added_mass
            inertia[1:4] = np.diag(ADDED_SPREAD * now.added_inertia)
        return FluidParameters(coefficients, mass, inertia)


class TrimParametrization:
    """Parametrization of a trim in addition to known parameters, by a vector with standard normal priors.

    The trim is a force and a torque that are constant in the body frame while the body is upright: coefficients of the
    vertical component of the direction of gravity. A known symmetry does not limit it.
    """

    def __init__(self, known: FluidParameters, prior: Float[np.ndarray, "terms 6"]) -> None:
        """Prepare the parametrization.

        **Arguments**

        - `known`: the known parameters, with the coefficients of all terms of the largest set.
        - `prior`: standard deviation of each coefficient's prior (SI units).
        """
        vertical = terms_of(TERM_SETS[-1]).index(Term(("gz",), 0))
        axes = np.arange(prior.shape[1])
        self._known, self._directions = known, np.zeros((len(axes), *prior.shape))
        self._directions[axes, vertical, axes] = prior[vertical]
        self.start = np.zeros(len(axes))

    def parameters(self, vector: Float[np.ndarray, " size"]) -> FluidParameters:
        """Return the parameters, with the coefficients of all terms of the largest set."""
        table = self._known.coefficients + np.tensordot(vector, self._directions, 1)
        return dataclasses.replace(self._known, coefficients=table)

    def directions(self, vector: Float[np.ndarray, " size"]) -> FluidParameters:
        """Return the derivatives of the parameters with respect to the entries of the vector, the leading axis."""
        return FluidParameters(self._directions, np.zeros(len(vector)), np.zeros((len(vector), 3)))


class FreeCoefficients:
    """Parametrization of coefficients that may have any value. Coefficients are linear in the vector."""

    def __init__(self, name: TermSet, prior: Float[np.ndarray, "terms 6"], *, symmetric: bool) -> None:
        """Prepare the parametrization of a set of terms.

        **Arguments**

        - `name`: set of terms.
        - `prior`: standard deviation of each coefficient's prior (SI units).
        - `symmetric`: whether the body is symmetric about the xz plane, so that some coefficients are 0.
        """
        terms = terms_of(TERM_SETS[-1])
        free = symmetric_mask(terms) if symmetric else np.ones(prior.shape, bool)
        free[len(terms_of(name)) :] = False
        self._directions = np.zeros((int(free.sum()), *prior.shape))
        self._directions[np.arange(len(self._directions)), *np.argwhere(free).T] = prior[free]
        self.start = np.zeros(len(self._directions))

    def table(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "terms 6"]:
        """Return the coefficients of all terms of the largest set (SI units)."""
        return np.tensordot(vector, self._directions, 1)

    def directions(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "size terms 6"]:
        """Return the derivatives of the coefficients, which are the same for all vectors."""
        del vector
        return self._directions


class PassiveCoefficients:
    """Parametrization of coefficients whose wrench, without its gravity part, does no positive work on the body."""

    def __init__(
        self,
        name: TermSet,
        prior: Float[np.ndarray, "terms 6"],
        centre: Float[np.ndarray, " 3"],
        *,
        symmetric: bool,
    ) -> None:
        """Prepare the parametrization of a set of terms.

        **Arguments**

        - `name`: set of terms.
        - `prior`: standard deviation of each coefficient's prior (SI units).
        - `centre`: position of the body's centre of mass relative to the tracked site (m, body frame).
        - `symmetric`: whether the body is symmetric about the xz plane, so that some coefficients are 0.
        """
        terms = terms_of(TERM_SETS[-1])
        allowed = symmetric_mask(terms) if symmetric else np.ones(prior.shape, bool)
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
            # The torque about the centre of mass is the torque about the site plus force x centre.
            return jnp.concatenate([force, torque + force @ lever], axis=1)

        self._table, self._jacobian = jax.jit(table), jax.jit(jax.jacfwd(table))
        self.start = np.concatenate([part.start for part in parts])

    def table(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "terms 6"]:
        """Return the coefficients of all terms of the largest set (SI units)."""
        with jax.enable_x64(True):
            return np.asarray(self._table(jnp.asarray(vector)))

    def directions(self, vector: Float[np.ndarray, " size"]) -> Float[np.ndarray, "size terms 6"]:
        """Return the derivatives of the coefficients with respect to the entries of the vector."""
        with jax.enable_x64(True):
            return np.moveaxis(np.asarray(self._jacobian(jnp.asarray(vector))), -1, 0)


class _Part(NamedTuple):
    """Parametrization of some terms, with the wrench about the tracked site."""

    rows: slice
    """Indices of the terms."""
    start: Float[np.ndarray, " size"]
    """Starting values of the part's entries of the vector."""
    table: Callable[[Float[Array, " size"]], Float[Array, "rows 6"]]
    """Function from these entries to the coefficients."""


def _gravity_part(prior: Float[np.ndarray, "terms 6"], allowed: Bool[np.ndarray, "terms 6"]) -> _Part:
    """Return the gravity part: force c g and torque p x g, where g is the direction of gravity.

    The scalar c corrects the weight, and the vector p the centre of mass.
    """
    entries = np.zeros((1 + 3, _GRAVITY, 6))
    entries[0, :, :3] = np.eye(3)
    entries[1:, :, 3:] = np.cross(np.eye(3)[:, None], np.eye(3)[None])
    entries = entries[(~(entries != 0) | allowed[:_GRAVITY]).all(axis=(1, 2))]
    scales = [prior[:_GRAVITY][entry != 0].min() for entry in entries]
    scaled = entries * np.array(scales)[:, None, None]
    return _Part(slice(0, _GRAVITY), np.zeros(len(scaled)), lambda vector: jnp.tensordot(vector, scaled, 1))


def _damping_part(prior: Float[np.ndarray, "terms 6"], allowed: Bool[np.ndarray, "terms 6"], first: int) -> _Part:
    """Return a damping part, -A x or -|v| B x, for the terms from the index `first` on.

    The matrix has a positive semidefinite symmetric part, which is parametrized by its lower triangular root.
    """
    rows = slice(first, first + _MOTION)
    scale = np.sqrt(np.diag(prior[rows]))
    root = np.argwhere(np.tril(allowed[rows]))
    skew = np.argwhere(np.tril(allowed[rows], -1))

    def table(vector: Array) -> Array:
        lower = jnp.zeros((_MOTION, _MOTION)).at[*root.T].set(vector[: len(root)])
        strict = jnp.zeros((_MOTION, _MOTION)).at[*skew.T].set(vector[len(root) :])
        return -(lower @ lower.T + strict - strict.T) * scale * scale[:, None]

    start = np.concatenate([_START * (root[:, 0] == root[:, 1]), np.zeros(len(skew))])
    return _Part(rows, start, table)


def _workless_part(prior: Float[np.ndarray, "terms 6"], allowed: Bool[np.ndarray, "terms 6"], rows: slice) -> _Part:
    """Return the part Q of products of two velocities that do no work: x . Q(x, x) = 0 for every motion x.

    Its entries are coordinates in the null space of the power x . Q(x, x), which is linear in the coefficients.
    """
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
"""Singular values below this fraction of the largest one count as 0."""
