"""Control steps to first order: what a small change of the state before, of the forces on the robot, or of joints'
torques changes after.

Derivatives are taken forward, direction by direction, through the same accurate physics that everything else is
simulated with: the solver's loop has no reverse mode, and a reverse mode of its own would be that of another model.
Some thirty directions a control step are few beside the thousands of gradients that can then be had without simulating.
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

from ballu_mjx.sim.force_model import BoundForces, ForceSet, add_wrenches, num_vectors, to_wrenches
from ballu_mjx.sim.sharding import shard_over_devices
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.sim.step import PhysicsState
from ballu_mjx.sim.vmap_last import nested_vmap

_CHUNK = 64
"""Control steps that are linearized in one go."""


class ControlSteps(NamedTuple):
    """Control steps to linearize about: states before, and what acts over them."""

    physics: PhysicsState
    history: Float[Array | np.ndarray, "steps 3 27"]
    """`observe_features` of the last three control steps, the state's own last: what a base residual sees."""
    commands: Float[Array | np.ndarray, "steps 3 2"]
    """Commands of the last two control steps and the coming one."""
    loads: Float[Array | np.ndarray, "steps loads"]
    """What pushes the robot (N, N m; world), of the linearizer's force set."""


class Linearized(NamedTuple):
    """Control steps to first order. The state's directions are those of `mjx.Data.qvel` for positions (the base turns
    about its own axes), then the velocities'; the inputs are the loads (N, N m) and then the joints' torques (N m)."""

    qpos: Float[Array | np.ndarray, "steps nq"]
    """After the step."""
    qvel: Float[Array | np.ndarray, "steps nv"]
    """After the step."""
    features: Float[Array | np.ndarray, "steps 27"]
    """After the step."""
    state: Float[Array | np.ndarray, "steps 2nv 2nv+inputs"]
    """Derivative of the state after by the state before and the inputs."""
    seen: Float[Array | np.ndarray, "steps 27 2nv+inputs"]
    """Derivative of the features after, likewise."""


class Linearizer:
    """The robot's control steps, to first order; compiles once."""

    def __init__(
        self,
        model: mujoco.MjModel,
        beside: BoundForces | None = None,
        joints: Sequence[str] = (),
        forces: ForceSet = "force",
    ) -> None:
        """`beside` is a residual that the simulator has already; `joints` are those whose torques are inputs too."""
        self._nv, self.beside = model.nv, beside
        self._forces: ForceSet = forces
        self._joints = np.array([model.joint(name).dofadr[0] for name in joints], int)
        self._simulator = Simulator(model)
        self.loads = 3 * num_vectors(forces, len(self._simulator.robot.points))
        if beside is not None:
            self._simulator = self._simulator.altered(beside.model.fields(beside.params))
        over = functools.partial(nested_vmap, inner=self.directions)
        self._each = shard_over_devices(self._one, shared=0, over=over)

    @property
    def directions(self) -> int:
        """Of the state before and the inputs."""
        return 2 * self._nv + self.loads + len(self._joints)

    def __call__(self, steps: ControlSteps) -> Linearized:
        """Linearize; a step whose derivatives are no numbers comes back with zeros."""
        count = len(steps.loads)
        found = []
        for first in range(0, count, _CHUNK):
            place = np.arange(first, first + _CHUNK) % count
            found.append(self._each(jax.tree.map(lambda x, place=place: np.asarray(x, np.float32)[place], steps)))
        qpos, qvel, features, state, seen = (np.concatenate(parts)[:count] for parts in zip(*found, strict=True))
        good = np.isfinite(state).all(axis=(1, 2)) & np.isfinite(seen).all(axis=(1, 2))
        state, seen = (np.where(good.reshape(-1, 1, 1), x, 0.0).transpose(0, 2, 1) for x in (state, seen))
        return Linearized(qpos, qvel, features, state, seen)

    def _one(self, step: ControlSteps) -> tuple[Array, ...]:
        """A control step and its derivatives, those along one direction in a row."""
        nv, physics = self._nv, step.physics
        units = jnp.eye(self.directions)
        turned = jax.vmap(lambda change: _expand(physics.qpos, change))(units[:, :nv])
        start = PhysicsState(*map(jnp.asarray, physics)), jnp.zeros(self.directions - 2 * nv)
        moves = PhysicsState(turned, units[:, nv : 2 * nv], jnp.zeros_like(turned[:, :nv])), units[:, 2 * nv :]

        def after(moved: PhysicsState, inputs: Float[Array, " inputs"]) -> tuple[PhysicsState, Array]:
            commands = jnp.asarray(step.commands)
            command, wrench = commands[-1], to_wrenches(jnp.asarray(step.loads) + inputs[: self.loads], self._forces)
            simulator = self._simulator.strained(jnp.zeros(nv).at[self._joints].set(inputs[self.loads :]))
            if self.beside is not None:
                model, params = self.beside
                seen, _ = simulator.observe(moved)
                history = jnp.concatenate([step.history[:-1], seen[None]])
                command = model.command(params, commands)
                wrench = add_wrenches(wrench, model.wrench(params, history, commands))
            state = simulator.step(moved, command, wrench)
            return state, simulator.observe(state)[0]

        # The step itself is the same for all directions, and simulated once for all.
        (state, features), (change, seen) = jax.vmap(lambda *move: jax.jvp(after, start, move))(*moves)
        moved = jnp.concatenate([jax.vmap(_compress)(state.qpos, change.qpos), change.qvel], axis=1)
        return state.qpos[0], state.qvel[0], features[0], moved, seen


def _expand(qpos: Float[Array, " nq"], change: Float[Array, " nv"]) -> Float[Array, " nq"]:
    """Rates of generalized positions of the velocities `change`, in MuJoCo's conventions: q' = q (0, omega) / 2."""
    turn = _product(qpos[3:7], jnp.concatenate([jnp.zeros(1), change[3:6]])) / 2
    return jnp.concatenate([change[:3], turn, change[6:]])


def _compress(qpos: Float[Array, " nq"], change: Float[Array, " nq"]) -> Float[Array, " nv"]:
    """The inverse of `_expand`."""
    conjugate = qpos[3:7] * jnp.array([1.0, -1.0, -1.0, -1.0])
    return jnp.concatenate([change[:3], 2 * _product(conjugate, change[3:7])[1:], change[7:]])


def _product(a: Float[Array, " 4"], b: Float[Array, " 4"]) -> Float[Array, " 4"]:
    """Of quaternions (w, x, y, z)."""
    v, w = a[1:], b[1:]
    return jnp.concatenate([(a[0] * b[0] - v @ w)[None], a[0] * w + b[0] * v + jnp.cross(v, w)])
