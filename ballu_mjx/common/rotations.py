"""Quaternions (w, x, y, z), rotation matrices and rotation vectors, as NumPy or JAX arrays.

The package calls `scipy.spatial.transform.Rotation` where one line of it suffices. This module has the operations that
JAX needs too, and those that inverse kinematics applies to hundreds of thousands of rotations.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

_TINY = 1e-30


def quaternion_product(a: Float[Any, "*n 4"], b: Float[Any, "*n 4"]) -> Float[Any, "*n 4"]:
    """Return the quaternion products a b: the rotation `b` about axes that the rotation `a` has turned."""
    w, x, y, z = _components(a)
    p, q, r, s = _components(b)
    return _namespace(a).stack(
        [
            w * p - x * q - y * r - z * s,
            w * q + x * p + y * s - z * r,
            w * r - x * s + y * p + z * q,
            w * s + x * r - y * q + z * p,
        ],
        axis=-1,
    )


def quaternion_conjugate(quaternion: Float[Any, "*n 4"]) -> Float[Any, "*n 4"]:
    """Return the conjugates of quaternions, which are the inverses of unit quaternions."""
    return quaternion * np.array([1.0, -1.0, -1.0, -1.0], np.float32)


def quaternion_integrate(quaternion: Float[Any, "*n 4"], vector: Float[Any, "*n 3"]) -> Float[Any, "*n 4"]:
    """Return unit quaternions turned by rotation vectors (rad, body frame), as `mju_quatIntegrate` does.

    The result is differentiable at the zero vector.
    """
    xp = _namespace(quaternion)
    angle = xp.sqrt(xp.maximum(xp.sum(vector**2, axis=-1, keepdims=True), _TINY))
    turned = quaternion_product(
        quaternion, xp.concat([xp.cos(angle / 2), vector * (xp.sin(angle / 2) / angle)], axis=-1)
    )
    return _normalized(turned)


def quaternion_to_matrix(quaternion: Float[Any, "*n 4"]) -> Float[Any, "*n 3 3"]:
    """Return the rotation matrices of unit quaternions."""
    xp = _namespace(quaternion)
    w, x, y, z = _components(quaternion)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return xp.moveaxis(xp.stack([xp.stack(row) for row in rows]), (0, 1), (-2, -1))


def matrix_to_quaternion(rotation: Float[Any, "3 3"]) -> Float[Any, " 4"]:
    """Return the unit quaternion of one rotation matrix, differentiably.

    For accuracy it is computed from its component of largest magnitude.
    """
    xp, r = _namespace(rotation), rotation
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    # Row i is the quaternion times four times its component i.
    rows = xp.asarray(
        [
            [1 + r[0, 0] + r[1, 1] + r[2, 2], x, y, z],
            [x, 1 + r[0, 0] - r[1, 1] - r[2, 2], xy, xz],
            [y, xy, 1 - r[0, 0] + r[1, 1] - r[2, 2], yz],
            [z, xz, yz, 1 - r[0, 0] - r[1, 1] + r[2, 2]],
        ]
    )
    return _normalized(rows[xp.argmax(xp.linalg.diagonal(rows))])


def rotation_about(axis: Float[Any, " 3"], angle: Float[Any, "*n"]) -> Float[Any, "*n 3 3"]:
    """Return the rotation matrices of angles (rad) about one unit axis, by Rodrigues' formula."""
    xp = _namespace(angle)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, versine = xp.sin(angle)[..., None, None], 1 - xp.cos(angle)[..., None, None]
    return np.eye(3) + sine * cross + versine * (cross @ cross)


def matrix_to_rotation_vector(matrices: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 3"]:
    """Return the rotation vectors (rad) of rotation matrices."""
    from scipy.spatial.transform import Rotation

    sine = np.stack(
        [
            matrices[:, 2, 1] - matrices[:, 1, 2],
            matrices[:, 0, 2] - matrices[:, 2, 0],
            matrices[:, 1, 0] - matrices[:, 0, 1],
        ],
        axis=1,
    )
    length = np.linalg.norm(sine, axis=1)
    cosine = np.trace(matrices, axis1=1, axis2=2) - 1
    vectors = sine * (np.arctan2(length, cosine) / np.maximum(length, 1e-300))[:, None]
    vectors[length < 1e-12] = 0.0
    far = cosine < -1.9  # near a half turn the sine is too small to give the axis
    if far.any():
        vectors[far] = Rotation.from_matrix(matrices[far]).as_rotvec()
    return vectors


def _namespace(array: Any) -> Any:
    """Return the module of an array: `numpy` or `jax.numpy`."""
    return array.__array_namespace__()


def _components(quaternion: Float[Any, "*n 4"]) -> tuple[Any, Any, Any, Any]:
    return quaternion[..., 0], quaternion[..., 1], quaternion[..., 2], quaternion[..., 3]


def _normalized(quaternion: Float[Any, "*n 4"]) -> Float[Any, "*n 4"]:
    return quaternion / _namespace(quaternion).linalg.norm(quaternion, axis=-1, keepdims=True)
