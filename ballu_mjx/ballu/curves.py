"""The paper's curves of angle over command, and the directed Hausdorff distance between them."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.ballu.actuators import SERVO_RANGE

CURVE_SAMPLES = 200
"""Number of points at which the curves are compared (paper)."""


def polynomial_curve(
    command: Float[Array | np.ndarray, " holds"], angles: Float[Array | np.ndarray, " holds"], degree: int
) -> Float[Array, "200 2"]:
    """Return a polynomial that is fitted to angles (rad) over commands, at `CURVE_SAMPLES` commands in [0, 1].

    Points are (command, angle / 90 deg), the plane in which the paper compares curves. They are linear in the angles.
    """
    samples = np.linspace(0.0, 1.0, CURVE_SAMPLES)
    # Chebyshev polynomials, because powers of the command would be nearly linearly dependent.
    basis = lambda x: jnp.cos(jnp.arange(degree + 1) * jnp.arccos(jnp.clip(2 * x - 1, -1.0, 1.0))[:, None])  # noqa: E731
    coefficients = jnp.linalg.lstsq(basis(jnp.asarray(command)), jnp.asarray(angles))[0]
    return jnp.stack([jnp.asarray(samples), basis(jnp.asarray(samples)) @ coefficients / SERVO_RANGE], axis=1)


def directed_hausdorff(from_points: Float[Array, "n d"], to_points: Float[Array, "m d"]) -> Float[Array, ""]:
    """Return the largest distance from a point in `from_points` to its nearest point in `to_points`.

    The distance is not smooth. Its gradient is that of the pair of points that attains it: a subgradient if several
    pairs do, and 0 if the two points coincide.
    """
    squared = jnp.sum((from_points[:, None] - to_points[None]) ** 2, axis=-1)
    decisive = jnp.max(jnp.min(squared, axis=1))
    return jnp.where(decisive > 0, jnp.sqrt(jnp.where(decisive > 0, decisive, 1.0)), 0.0)


def curve_distances(
    command: Float[np.ndarray | Array, " holds"],
    simulated: Float[Array | np.ndarray, "holds 2"],
    measured: Float[Array | np.ndarray, "holds 2"],
    degree: int,
) -> Float[Array, "2 2"]:
    """Return the directed Hausdorff distances between a leg's simulated and measured curves.

    Rows are (simulated to measured, measured to simulated) and columns are (motor, knee). The paper's objective is the
    sum of the first row over both legs.
    """
    pairs = [
        [polynomial_curve(command, angles[:, joint], degree) for angles in (simulated, measured)] for joint in range(2)
    ]
    return jnp.stack([jnp.stack([directed_hausdorff(*pair[::way]) for pair in pairs]) for way in (1, -1)])
