"""The MJX robot between control steps."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from mujoco import mjx

from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import with_fields
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.observation import observe_features
from ballu_mjx.sim.step import PhysicsState, control_step, count_substeps, load_state, make_data, put_model, state_at
from ballu_mjx.sim.vmap_last import vmap_with_trailing_batch


class Simulator:
    """The MJX robot between control steps: states in, states and features out."""

    def __init__(self, model: mujoco.MjModel, robot: RobotDescription | None = None) -> None:
        """`robot` says what is what in `model`; None: it is BALLU."""
        robot = robot or load_robot()
        self.robot = robot
        self.nv = model.nv
        self.model = put_model(model)
        self._template = make_data(model)
        self._count = count_substeps(model)
        sites = [model.site(name).id for name in (robot.tracked, *robot.points)]
        self._root = int(model.body_rootid[model.site_bodyid[sites[0]]])
        self._sites = tuple(zip(sites, model.site_bodyid[sites].tolist(), strict=True))
        self._masses = jnp.asarray(model.body_mass / model.body_mass.sum())

    def altered(self, fields: Mapping[str, Array]) -> Simulator:
        """The same with other model fields, which may be traced. The centre of mass stays that of the model's own
        masses: air that the robot drags along is no part of it."""
        return self.of(with_fields(self.model, dict(fields)))

    def of(self, model: mjx.Model) -> Simulator:
        """The same of another model of this structure, which may be traced."""
        other = copy.copy(self)
        other.model = model
        return other

    def strained(self, generalized: Float[Array, " nv"]) -> Simulator:
        """The same under generalized forces (N, N m, along `mjx.Data.qvel`), which may be traced."""
        other = copy.copy(self)
        other._template = self._template.replace(qfrc_applied=generalized)  # pyright: ignore
        return other

    def observe(self, state: PhysicsState) -> tuple[Float[Array, " features"], Float[Array, " 3"]]:
        """Features and centre of mass (m, world) of a state."""
        return _observe(self.model, self._template, state, self._masses, self._sites, self._root)

    def observe_all(
        self, qpos: Float[Array, "... nq"], qvel: Float[Array, "... nv"]
    ) -> tuple[Float[Array, "... features"], Float[Array, "... 3"]]:
        """`observe`, of any number of states; one compiled program serves them all."""
        shape, count = qpos.shape[:-1], math.prod(qpos.shape[:-1])
        filled = np.arange(-(-count // _CHUNK) * _CHUNK) % count
        flat = state_at(qpos.reshape(count, -1), qvel.reshape(count, -1))
        chunks = [PhysicsState(*(x[part] for x in flat)) for part in filled.reshape(-1, _CHUNK)]
        fixed = self._masses, self._sites, self._root
        pieces = [_observe_chunk(self.model, self._template, chunk, *fixed) for chunk in chunks]
        features, com = (jnp.concatenate(parts)[:count] for parts in zip(*pieces, strict=True))
        return features.reshape(*shape, -1), com.reshape(*shape, -1)

    def step(
        self, state: PhysicsState, command: Float[Array, "*parts commands"], wrench: Float[Array, "loaded 6"]
    ) -> PhysicsState:
        """One control step under a command, or one for each of equal parts of it; wrenches are on the tracked body
        and, if more, at the robot's points. See `step.control_step`."""
        parts = command.reshape(-1, command.shape[-1])
        commands = jnp.repeat(parts, self._count // len(parts), axis=0)
        sites, bodies = zip(*self._sites[: len(wrench)], strict=True)
        return control_step(
            self.model, self._template, state, commands, wrench, bodies=bodies, points=sites[1:], count=self._count
        )


@functools.partial(jax.jit, static_argnames=("sites", "root"))
def _observe(
    model: mjx.Model,
    template: mjx.Data,
    state: PhysicsState,
    masses: Float[Array, " bodies"],
    sites: tuple[tuple[int, int], ...],
    root: int,
) -> tuple[Float[Array, " features"], Float[Array, " 3"]]:
    """`Simulator.observe`; `masses` are shares of the whole, `sites` ids of sites and of their bodies."""
    site, body = np.array(sites).T

    def seen(model: mjx.Model, template: mjx.Data, state: PhysicsState, masses: Array) -> tuple[Array, Array]:
        data = load_state(template, state)
        data = mjx.com_vel(model, mjx.com_pos(model, mjx.kinematics(model, data)))
        return observe_features(data, site, body, root), masses @ data.xipos

    return vmap_with_trailing_batch(seen)(model, template, state, masses)


_CHUNK = 1024
"""States that `Simulator.observe_all` looks at in one go."""


@functools.partial(jax.jit, static_argnames=("sites", "root"))
def _observe_chunk(
    model: mjx.Model,
    template: mjx.Data,
    states: PhysicsState,
    masses: Float[Array, " bodies"],
    sites: tuple[tuple[int, int], ...],
    root: int,
) -> tuple[Float[Array, "states features"], Float[Array, "states 3"]]:
    return jax.vmap(lambda state: _observe(model, template, state, masses, sites, root))(states)
