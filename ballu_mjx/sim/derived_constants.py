"""Constants that MuJoCo's compiler derives from masses and inertias, for models whose masses are altered in MJX.

Contacts, joint limits and friction losses are as soft as the inverse weights `body_invweight0`, `dof_invweight0` and
`tendon_invweight0` say. In C, `mj_setConst` derives these from the inertia matrix at the reference pose. A model whose
masses alone are replaced keeps the constants of the old ones.

Source: MuJoCo, `engine_setconst.c`, `mj_setConst`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from mujoco import mjx

INERTIAL_FIELDS = ("body_mass", "body_inertia", "body_ipos", "dof_armature")
"""Fields that the constants are derived from, and that residuals or identified parameters alter."""


_TRIPLES = {int(mujoco.mjtJoint.mjJNT_FREE): (0, 3), int(mujoco.mjtJoint.mjJNT_BALL): (0,)}
"""Where a joint has three axes whose weights are averaged, from its first on."""


class ReferencePose(NamedTuple):
    """What of a model at its reference pose does not depend on masses; world frame."""

    translation: Float[np.ndarray, "bodies 3 nv"]
    """Jacobian of each body's origin (m)."""
    rotation: Float[np.ndarray, "bodies 3 nv"]
    """Jacobian of each body's orientation (rad)."""
    frame: Float[np.ndarray, "bodies 3 3"]
    """Orientation of each body."""
    inertial_frame: Float[np.ndarray, "bodies 3 3"]
    """Orientation of each body's principal axes of inertia."""
    tendons: Float[np.ndarray, "tendons nv"]
    """Jacobian of the tendons' lengths (m)."""
    below: Float[np.ndarray, "bodies bodies"]
    """1 where the second body is the first or below it."""
    averages: Float[np.ndarray, "nv nv"]
    """Averages over the translations, and over the rotations, of each free joint; over the axes of each ball joint."""

    @staticmethod
    def of(model: mujoco.MjModel) -> ReferencePose:
        """Return the reference pose of `model`."""
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        bodies, nv = model.nbody, model.nv
        translation, rotation = np.zeros((bodies, 3, nv)), np.zeros((bodies, 3, nv))
        for body in range(bodies):
            mujoco.mj_jacBody(model, data, translation[body], rotation[body], body)
        tendons = np.zeros((model.ntendon, nv))
        if model.ntendon:
            mujoco.mju_sparse2dense(tendons, data.ten_J, model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind)
        below = np.eye(bodies)
        for body in range(bodies - 1, 0, -1):
            below[model.body_parentid[body]] += below[body]
        averages = np.eye(nv)
        for kind, first in zip(model.jnt_type, model.jnt_dofadr, strict=True):
            for start in _TRIPLES.get(int(kind), ()):
                block = slice(first + start, first + start + 3)
                averages[block, block] = 1 / 3
        frame, inertial_frame = (x.reshape(bodies, 3, 3).copy() for x in (data.xmat, data.ximat))
        return ReferencePose(translation, rotation, frame, inertial_frame, tendons, below, averages)


def with_derived_constants(pose: ReferencePose, model: mjx.Model, fields: Mapping[str, Array]) -> dict[str, Array]:
    """Return `fields` with the constants that follow from them; `fields` itself where it alters no mass.

    Constants are the model's own, times what the altered masses make of them over what the model's masses do: rounding
    errors cancel, and equal masses leave equal constants. Differentiable by `fields`, which may be traced.

    **Arguments**

    - `pose`: of the model.
    - `model`: with the constants of its own masses.
    - `fields`: fields of `mjx.Model` by name, altered.
    """
    if not set(INERTIAL_FIELDS).intersection(fields):
        return dict(fields)
    old = _constants(pose, model, {})
    new = _constants(pose, model, fields)
    derived: dict[str, Array] = {}
    for name, value in new.items():
        there = old[name] > 0
        derived[name] = jnp.asarray(getattr(model, name)) * jnp.where(
            there, value / jnp.where(there, old[name], 1.0), 1.0
        )
    return {**fields, **derived}


def _constants(pose: ReferencePose, model: mjx.Model, fields: Mapping[str, Array]) -> dict[str, Array]:
    """Return the constants by their definition, in the precision of `model`."""
    mass, inertia, centre, armature = (jnp.asarray(fields.get(name, getattr(model, name))) for name in INERTIAL_FIELDS)
    with jax.default_matmul_precision("highest"):
        arm = jnp.einsum("bij,bj->bi", pose.frame, centre)
        moved = pose.translation + jnp.cross(pose.rotation, arm[:, :, None], axis=1)
        turned = jnp.einsum("bji,bjk->bik", pose.inertial_frame, pose.rotation)
        matrix = jnp.einsum("b,bij,bik->jk", mass, moved, moved)
        matrix += jnp.einsum("bi,bij,bik->jk", inertia, turned, turned)
        matrix += jnp.einsum("t,ti,tj->ij", model.tendon_armature, pose.tendons, pose.tendons)
        matrix += jnp.diag(armature)
        # A chain's inertia matrix is badly scaled: metres beside radians, the heaviest body beside the lightest.
        scale = 1 / jnp.sqrt(jnp.diag(matrix))
        factor = jax.scipy.linalg.cho_factor(scale[:, None] * matrix * scale)
        inverse = scale[:, None] * jax.scipy.linalg.cho_solve(factor, jnp.eye(len(scale), dtype=scale.dtype)) * scale
        weights = (jnp.einsum("bij,jk,bik->b", jacobian, inverse, jacobian) / 3 for jacobian in (moved, pose.rotation))
        return {
            "body_invweight0": jnp.stack(list(weights), axis=1),
            "body_subtreemass": jnp.asarray(pose.below) @ mass,
            "dof_invweight0": jnp.asarray(pose.averages) @ jnp.diag(inverse),
            "tendon_invweight0": jnp.einsum("ti,ij,tj->t", pose.tendons, inverse, pose.tendons),
        }
