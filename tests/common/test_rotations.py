"""Rotations of NumPy and JAX arrays, compared with SciPy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from ballu_mjx.common.rotations import (
    matrix_to_quaternion,
    matrix_to_rotation_vector,
    quaternion_conjugate,
    quaternion_integrate,
    quaternion_product,
    quaternion_to_matrix,
    rotation_about,
)

ROTATIONS = Rotation.from_rotvec(np.random.default_rng(0).normal(0, 2, (20, 3)))
OTHERS = Rotation.from_rotvec([[0.0, 0.0, 0.0], [np.pi, 0.0, 0.0], *np.random.default_rng(1).normal(0, 1, (18, 3))])


def test_rotations_match_scipy():
    a, b = (each.as_quat(scalar_first=True) for each in (ROTATIONS, OTHERS))
    np.testing.assert_allclose(quaternion_to_matrix(a), ROTATIONS.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(
        quaternion_to_matrix(quaternion_product(a, b)), (ROTATIONS * OTHERS).as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(quaternion_to_matrix(quaternion_conjugate(a)), ROTATIONS.inv().as_matrix(), atol=1e-12)
    rotated = quaternion_integrate(a, OTHERS.as_rotvec())
    np.testing.assert_allclose(quaternion_to_matrix(rotated), (ROTATIONS * OTHERS).as_matrix(), atol=1e-12)
    found = Rotation.from_rotvec(matrix_to_rotation_vector(OTHERS.as_matrix()))
    np.testing.assert_allclose((found * OTHERS.inv()).magnitude(), 0.0, atol=1e-9)
    axis, angles = np.array([0.6, 0.0, -0.8]), np.array([-2.0, 0.0, 3.0])
    expected = Rotation.from_rotvec(axis * angles[:, None]).as_matrix()
    np.testing.assert_allclose(rotation_about(axis, angles), expected, atol=1e-12)


def test_jax_arrays_give_the_same_rotations():
    for rotation in [*ROTATIONS[:3], *OTHERS[:2]]:
        quaternion, matrix = jnp.asarray(rotation.as_quat(scalar_first=True)), jnp.asarray(rotation.as_matrix())
        np.testing.assert_allclose(quaternion_to_matrix(quaternion), matrix, atol=1e-6)
        np.testing.assert_allclose(quaternion_to_matrix(matrix_to_quaternion(matrix)), matrix, atol=1e-6)


def test_quaternion_integration_is_differentiable_at_zero_rotation():
    identity, zero = jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3)
    jacobian = jax.jacfwd(lambda vector: quaternion_integrate(identity, vector))(zero)
    np.testing.assert_allclose(jacobian, np.eye(4)[:, 1:] / 2, atol=1e-7)
