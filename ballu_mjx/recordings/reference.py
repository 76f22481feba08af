"""Recorded motions as padded arrays. Episodes start from them and are compared with them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ballu_mjx.recordings.motion import Motion
from ballu_mjx.sim.drivetrain import DrivetrainState
from ballu_mjx.sim.simulator import Simulator


class ReferenceMotions(NamedTuple):
    """Recorded motions, stacked and padded to the longest one. Episodes start from them and are compared with them."""

    qpos: Float[Array, "recordings states nq"]
    """MuJoCo's generalized positions."""
    qvel: Float[Array, "recordings states nv"]
    """MuJoCo's generalized velocities."""
    features: Float[Array, "recordings states features"]
    """`observation.observe_features` of each state."""
    command: Float[Array, "recordings steps commands"]
    """Command of each control step, in the actuators' units."""
    steps: Int[Array, " recordings"]
    """Number of control steps of each recording."""
    drivetrain: DrivetrainState | None = None
    """State of the simulator's drivetrain before each control step, with leading axes (recordings, control steps). None
    if the simulator has no drivetrain."""

    def drivetrain_at(
        self, recording: Int[Array, "*batch"] | np.ndarray, step: Int[Array, "*batch"] | np.ndarray
    ) -> DrivetrainState | None:
        """Return the drivetrain's state before the given control steps, or None without a drivetrain."""
        return jax.tree.map(lambda x: x[recording, step], self.drivetrain)


def stack_motions(
    simulator: Simulator, motions: Sequence[Motion]
) -> tuple[ReferenceMotions, Float[Array, "recordings states 3"]]:
    """Return the motions as `ReferenceMotions`, and their centres of mass (m, world frame).

    Shorter motions are padded with copies of their last state and command.
    """
    longest = max(len(motion.qpos) for motion in motions)

    def pad(arrays: list[np.ndarray], length: int) -> Array:
        return jnp.asarray(
            np.stack([np.pad(a, [(0, length - len(a)), (0, 0)], mode="edge") for a in arrays]), jnp.float32
        )

    qpos = pad([motion.qpos for motion in motions], longest)
    qvel = pad([motion.qvel for motion in motions], longest)
    command = pad([motion.command for motion in motions], longest - 1)
    steps = jnp.array([len(motion.command) for motion in motions])

    feature, com = simulator.observe_all(qpos, qvel)
    drivetrain = None if simulator.drivetrain is None else jax.jit(jax.vmap(simulator.drivetrain_along))(command)
    return ReferenceMotions(qpos, qvel, feature, command, steps, drivetrain), com


def pad_to_bucket(reference: ReferenceMotions) -> ReferenceMotions:
    """Return `reference`, padded to powers of two in recordings and in states.

    The sizes are at least 16 recordings and 512 states. Added recordings have no control steps, and added states repeat
    the last one. JAX compiles a program for each array size, and new recordings seldom have the same number and length.
    """
    recordings, states = reference.qpos.shape[:2]
    more = (
        max(1 << (recordings - 1).bit_length(), _MIN_SIZES[0]) - recordings,
        max(1 << (states - 1).bit_length(), _MIN_SIZES[1]) - states,
    )

    def filled(x: Array) -> Array:
        # In NumPy: JAX would compile a program for each size.
        return jnp.asarray(np.pad(x, [(0, more[0]), (0, more[1]), *[(0, 0)] * (x.ndim - 2)], mode="edge"))

    steps = jnp.asarray(np.pad(reference.steps, (0, more[0])))
    return jax.tree.map(filled, reference._replace(steps=None))._replace(steps=steps)


_MIN_SIZES = (16, 512)
"""Smallest padded numbers of recordings and of states. 512 states are 25 s at a control step of 0.05 s."""
