"""Recorded motions as padded arrays: what episodes start from and are compared with."""

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
    """Recorded motions, stacked and padded to the longest: what an episode starts from and is compared with."""

    qpos: Float[Array, "recordings states nq"]
    qvel: Float[Array, "recordings states nv"]
    features: Float[Array, "recordings states features"]
    command: Float[Array, "recordings steps commands"]
    steps: Int[Array, " recordings"]
    """Control steps of each recording."""
    drivetrain: DrivetrainState | None = None
    """Of the simulator's drivetrain before each control step, axes of recordings and control steps in front; None where
    it has none."""

    def drivetrain_at(
        self, recording: Int[Array, "*batch"] | np.ndarray, step: Int[Array, "*batch"] | np.ndarray
    ) -> DrivetrainState | None:
        """Return the drivetrain's state before control steps of recordings; None where there is no drivetrain."""
        return jax.tree.map(lambda x: x[recording, step], self.drivetrain)


def stack_motions(
    simulator: Simulator, motions: Sequence[Motion]
) -> tuple[ReferenceMotions, Float[Array, "recordings states 3"]]:
    """Motions as one `Reference`, and their centres of mass (m, world)."""
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
    """`reference` with room for more: recordings of no steps, and states behind the last ones, up to the next powers of
    two. Programs are compiled for sizes, and recordings made anew are seldom just as many and as long."""
    recordings, states = reference.qpos.shape[:2]
    more = (
        max(1 << (recordings - 1).bit_length(), _ROOM[0]) - recordings,
        max(1 << (states - 1).bit_length(), _ROOM[1]) - states,
    )

    def filled(x: Array) -> Array:
        return jnp.pad(x, [(0, more[0]), (0, more[1]), *[(0, 0)] * (x.ndim - 2)], mode="edge")

    steps = jnp.pad(reference.steps, (0, more[0]))
    return jax.tree.map(filled, reference._replace(steps=None))._replace(steps=steps)


_ROOM = (16, 512)
"""Recordings and states (25 s) that there is always room for."""
