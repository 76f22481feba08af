"""Generalized coordinates of a robot: at most one free joint, at the root, then hinges and slides.

Directions are those of `mjx.Data.qvel`. A free joint has translations along the world's axes and rotations about the
body's own axes. The other joints follow.
"""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from ballu_mjx.common.rotations import quaternion_conjugate, quaternion_product

_KINDS = mujoco.mjtJoint
_TRANSLATIONS = {
    int(_KINDS.mjJNT_FREE): [True] * 3 + [False] * 3,
    int(_KINDS.mjJNT_SLIDE): [True],
    int(_KINDS.mjJNT_HINGE): [False],
}


def translations(model: mujoco.MjModel) -> Bool[np.ndarray, " nv"]:
    """Return which directions are translations (m) and not rotations (rad)."""
    return np.concatenate([_TRANSLATIONS[int(kind)] for kind in model.jnt_type])


def has_free_joint(model: mujoco.MjModel) -> bool:
    """Return whether the root has a free joint."""
    return bool(model.jnt_type[0] == _KINDS.mjJNT_FREE)


def expand(qpos: Float[Array, " nq"], change: Float[Array, " nv"], free: bool) -> Float[Array, " nq"]:
    """Return the rates of generalized positions for the generalized velocities `change`.

    The rate of a quaternion q is q (0, omega) / 2. `free` says whether the first joint is free.
    """
    if not free:
        return change
    turn = quaternion_product(qpos[3:7], jnp.concatenate([jnp.zeros(1), change[3:6]])) / 2
    return jnp.concatenate([change[:3], turn, change[6:]])


def compress(qpos: Float[Array, " nq"], change: Float[Array, " nq"], free: bool) -> Float[Array, " nv"]:
    """Return the generalized velocities for the rates of generalized positions `change`: the inverse of `expand`."""
    if not free:
        return change
    return jnp.concatenate(
        [change[:3], 2 * quaternion_product(quaternion_conjugate(qpos[3:7]), change[3:7])[1:], change[7:]]
    )
