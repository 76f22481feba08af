"""Constants that MuJoCo's compiler derives from masses and inertias, for models whose masses change in MJX.

The inverse weights `body_invweight0`, `dof_invweight0` and `tendon_invweight0` determine the softness of contacts,
joint limits and friction losses. In C, `mj_setConst` derives them from the inertia matrix at the reference pose. A
model in which only the masses are replaced keeps the constants of the old masses.

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

from ballu_mjx.common.rotations import quaternion_to_matrix

INERTIAL_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_armature", "tendon_armature")
"""Fields from which the constants are derived, and which residuals or identified parameters change."""


_TRIPLES = {int(mujoco.mjtJoint.mjJNT_FREE): (0, 3), int(mujoco.mjtJoint.mjJNT_BALL): (0,)}
"""Offsets from a joint's first degree of freedom at which three axes start whose weights are averaged."""


class ReferencePose(NamedTuple):
    """Quantities of a model at its reference pose that do not depend on masses; world frame."""

    translation: Float[np.ndarray, "bodies 3 nv"]
    """Jacobian of the position of each body's origin (m)."""
    rotation: Float[np.ndarray, "bodies 3 nv"]
    """Jacobian of each body's orientation (rad)."""
    frame: Float[np.ndarray, "bodies 3 3"]
    """Orientation of each body."""
    tendons: Float[np.ndarray, "tendons nv"]
    """Jacobian of the lengths of tendons (m)."""
    below: Float[np.ndarray, "bodies bodies"]
    """1 if the second body is the first body or one of its descendants, else 0."""
    averages: Float[np.ndarray, "nv nv"]
    """Matrix that averages over translations and rotations of each free joint, and over axes of each ball joint."""

    @staticmethod
    def of(model: mujoco.MjModel) -> ReferencePose:
        """Compute the quantities of `model`."""
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
        return ReferencePose(translation, rotation, data.xmat.reshape(bodies, 3, 3).copy(), tendons, below, averages)


def with_derived_constants(pose: ReferencePose, model: mjx.Model, fields: Mapping[str, Array]) -> dict[str, Array]:
    """Return `fields` with the constants that follow from them, or only `fields` if it changes no mass or inertia.

    Each constant is the model's own, multiplied by a ratio: its computed value for the changed masses over that for the
    model's masses. Rounding errors cancel in the ratio, and equal masses give equal constants. The result is
    differentiable with respect to `fields`, which may be traced.

    **Arguments**

    - `pose`: quantities of the model at its reference pose.
    - `model`: model with the constants of its own masses.
    - `fields`: changed fields of `mjx.Model` by name.
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
    """Compute the constants from their definition, in the precision of `model`."""
    values = (jnp.asarray(fields.get(name, getattr(model, name))) for name in INERTIAL_FIELDS)
    mass, inertia, centre, axes, armature, wound = values
    with jax.default_matmul_precision("highest"):
        arm = jnp.einsum("bij,bj->bi", pose.frame, centre)
        moved = pose.translation + jnp.cross(pose.rotation, arm[:, :, None], axis=1)
        turned = jnp.einsum("bji,bjk->bik", pose.frame @ quaternion_to_matrix(axes), pose.rotation)
        matrix = jnp.einsum("b,bij,bik->jk", mass, moved, moved)
        matrix += jnp.einsum("bi,bij,bik->jk", inertia, turned, turned)
        matrix += jnp.einsum("t,ti,tj->ij", wound, pose.tendons, pose.tendons)
        matrix += jnp.diag(armature)
        # The inertia matrix of a chain is badly scaled: it mixes metres and radians, and heavy and light bodies.
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
