"""Deformation of a body's mass distribution by ten numbers, which always gives an inertia that a rigid body can have.

The distribution is scaled in mass, shifted, stretched and sheared along the nominal principal axes (a log-Cholesky
factor relative to nominal; Rucker and Wensing, RA-L 7(2), 2022). Mass and stretches must be above 0.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ballu_mjx.common.rotations import matrix_to_quaternion, quaternion_to_matrix

BODY_QUANTITIES = (
    "mass",
    "com_x",
    "com_y",
    "com_z",
    "stretch_x",
    "stretch_y",
    "stretch_z",
    "shear_xy",
    "shear_xz",
    "shear_yz",
)
"""The ten numbers: mass relative to nominal, shift of the centre of mass along the nominal principal axes (m), and
stretches and shears along them."""
UNDEFORMED = (1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
"""Values of the nominal body, in the order of `BODY_QUANTITIES`."""


def deform_body(
    mass: Float[Array, ""],
    ipos: Float[Array, " 3"],
    iquat: Float[Array, " 4"],
    inertia: Float[Array, " 3"],
    numbers: Float[Array, " 10"],
    *,
    turned: bool = True,
) -> tuple[Float[Array, ""], Float[Array, " 3"], Float[Array, " 4"], Float[Array, " 3"]]:
    """Return mass, centre of mass, principal axes and principal inertia of a body with a deformed mass distribution.

    **Arguments**

    - `mass`, `ipos`, `iquat`, `inertia`: MuJoCo's `body_*` fields of the nominal body.
    - `numbers`: the ten numbers, in the order of `BODY_QUANTITIES`.
    - `turned`: whether stretches and shears may differ from nominal, so that the principal axes must be recomputed.
    """
    axes = quaternion_to_matrix(iquat)
    ratio, shift, stretch, shear = numbers[0], numbers[1:4], numbers[4:7], numbers[7:]
    centre = ipos + axes @ shift
    if not turned:
        return ratio * mass, centre, iquat, ratio * inertia
    # Second moments of mass along the principal axes, from the moments of inertia about them.
    moments = jnp.sum(inertia) / 2 - inertia
    factor = jnp.diag(stretch).at[jnp.array([0, 0, 1]), jnp.array([1, 2, 2])].set(shear)
    spread = factor @ jnp.diag(moments) @ factor.T
    # The axes of equal principal moments have no derivative. This offset separates them, without loss of precision.
    split = jnp.diag(jnp.array([0.0, 1.0, 2.0]) * _SPLIT * jnp.trace(spread))
    own = jnp.trace(spread) * jnp.eye(3) - spread + split
    principal, vectors = jnp.linalg.eigh(own)
    vectors = vectors * jnp.where(jnp.linalg.det(vectors) < 0, -1.0, 1.0)
    return ratio * mass, centre, matrix_to_quaternion(axes @ vectors), ratio * principal


_SPLIT = 1e-6
"""Offset between the principal moments, relative to the trace of the second moments of mass."""
