"""Linearization of control steps: derivatives of the next state by the state before, the loads, and torques of joints.

Derivatives are computed forwards, direction by direction, through the same accurate physics as in every simulation. The
solver's loop has no reverse mode, and a separate implementation of it would differentiate a different model. A control
step has about thirty directions. These are few, because the result then gives thousands of gradients without
simulation.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.sim.coordinates import compress, expand, has_free_joint
from ballu_mjx.sim.force_sets import FORCE_SETS, ForceSet, num_loads
from ballu_mjx.sim.sharding import chunks, shard_over_devices
from ballu_mjx.sim.simulator import AugmentedSimulator, RolloutState, Simulator
from ballu_mjx.sim.step import PhysicsState, has_dry_friction
from ballu_mjx.sim.vmap_last import nested_vmap

_CHUNK = 64
"""Number of control steps that are linearized at a time."""


class ControlSteps(NamedTuple):
    """Control steps to linearize about: the states before them, the commands and the loads."""

    state: RolloutState
    """State before the step. A base residual observes its history and commands."""
    command: Float[Array | np.ndarray, "steps commands"]
    """Command of the upcoming control step (the actuators' own units)."""
    loads: Float[Array | np.ndarray, "steps loads"]
    """Loads on the robot of the linearizer's force set (N, N m, command units; world frame)."""


class Linearized(NamedTuple):
    """Linearization of control steps.

    The directions of the state are those of `mjx.Data.qvel`, first for the positions (a free body rotates about its own
    axes), then for the velocities. The inputs are the loads (N, N m, command units), then the torques of joints (N m).
    """

    qpos: Float[Array | np.ndarray, "steps nq"]
    """Generalized positions after the step."""
    qvel: Float[Array | np.ndarray, "steps nv"]
    """Generalized velocities after the step."""
    features: Float[Array | np.ndarray, "steps features"]
    """Features (`observation.observe_features`) after the step."""
    state: Float[Array | np.ndarray, "steps 2nv 2nv+inputs"]
    """Derivative of the state after the step with respect to the state before it and the inputs."""
    seen: Float[Array | np.ndarray, "steps features 2nv+inputs"]
    """Derivative of the features after the step with respect to the state before it and the inputs."""


class Linearizer:
    """Linearizer of a robot's control steps. It compiles once."""

    def __init__(
        self,
        simulator: Simulator | AugmentedSimulator,
        joints: Sequence[str] = (),
        forces: ForceSet = "force",
    ) -> None:
        """Prepare to linearize control steps of `simulator`. Torques of the joints named in `joints` (forces of slides)
        are inputs too."""
        self.simulator = simulator.with_residual(None)
        plain = self.simulator.simulator
        self._nv, self._free = plain.nv, has_free_joint(plain.mj_model)
        self._forces: ForceSet = forces
        self.joint_directions = np.array([plain.mj_model.joint(name).dofadr[0] for name in joints], int)
        """Index in the velocities of each joint whose torque is an input."""
        self.loads = num_loads(forces, plain.robot)
        over = functools.partial(nested_vmap, inner=self.directions, store_operands=has_dry_friction(plain.model))
        self._each = shard_over_devices(self._one, shared=0, over=over)

    @property
    def directions(self) -> int:
        """Number of directions of the state before a step and of the inputs."""
        return 2 * self._nv + self.loads + len(self.joint_directions)

    def __call__(self, steps: ControlSteps) -> Linearized:
        """Return the linearization of control steps. Derivatives of a step become 0 if any of them is not finite."""
        count = len(steps.loads)
        found = []
        for rows, _ in chunks(count, _CHUNK):
            found.append(self._each(jax.tree.map(lambda x, rows=rows: np.asarray(x, np.float32)[rows], steps)))
        qpos, qvel, features, state, seen = (np.concatenate(parts)[:count] for parts in zip(*found, strict=True))
        good = np.isfinite(state).all(axis=(1, 2)) & np.isfinite(seen).all(axis=(1, 2))
        state, seen = (np.where(good.reshape(-1, 1, 1), x, 0.0).transpose(0, 2, 1) for x in (state, seen))
        return Linearized(qpos, qvel, features, state, seen)

    def _one(self, step: ControlSteps) -> tuple[Array, ...]:
        """Return the result of a control step and its derivatives, one row for each direction."""
        nv, physics = self._nv, step.state.physics
        units = jnp.eye(self.directions)
        rates = jax.vmap(lambda change: expand(physics.qpos, change, self._free))(units[:, :nv])
        start = PhysicsState(*map(jnp.asarray, physics)), jnp.zeros(self.directions - 2 * nv)
        moves = PhysicsState(rates, units[:, nv : 2 * nv], jnp.zeros_like(units[:, :nv])), units[:, 2 * nv :]

        def after(moved: PhysicsState, inputs: Float[Array, " inputs"]) -> tuple[PhysicsState, Array]:
            loads = jnp.asarray(step.loads) + inputs[: self.loads]
            does = FORCE_SETS[self._forces].act(loads, self.simulator.robot)
            torques = jnp.zeros(nv).at[self.joint_directions].set(inputs[self.loads :])
            history = jnp.asarray(step.state.history)
            if self.simulator.residual is not None:  # the residual observes the perturbed state
                history = history.at[-1].set(self.simulator.simulator.observe(moved)[0])
            state = jax.tree.map(jnp.asarray, step.state._replace(physics=moved, history=history))
            simulator = self.simulator.with_generalized_force(torques)
            done = simulator.step(state, jnp.asarray(step.command), does).state
            return done.physics, done.features

        # The step itself does not depend on the direction, so that it is simulated once for all directions.
        (state, features), (change, seen) = jax.vmap(lambda *move: jax.jvp(after, start, move))(*moves)
        positions = jax.vmap(lambda qpos, rate: compress(qpos, rate, self._free))(state.qpos, change.qpos)
        moved = jnp.concatenate([positions, change.qvel], axis=1)
        return state.qpos[0], state.qvel[0], features[0], moved, seen


def step_defects(
    model: mujoco.MjModel,
    steps: Linearized,
    qpos: Float[np.ndarray, "steps nq"],
    qvel: Float[np.ndarray, "steps nv"],
) -> Float[np.ndarray, "steps 2*nv"]:
    """Return the state after each control step minus the motion's state after it, along the directions of the state.

    `qpos` and `qvel` are the motion's states after the control steps.
    """
    defect = np.zeros((len(qpos), 2 * model.nv))
    for own, recorded, after in zip(defect, qpos, np.asarray(steps.qpos, np.float64), strict=True):
        mujoco.mj_differentiatePos(model, own[: model.nv], 1.0, recorded, after)
    defect[:, model.nv :] = steps.qvel - qvel
    return defect
