"""Simulators of a robot in MJX that advance by control steps, without and with a residual."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float
from mujoco import mjx

from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.kinematic_trees import mass_shares
from ballu_mjx.robots.model import ModelParameters, bare_parameters, has_simple_bodies, with_fields
from ballu_mjx.sim.derived_constants import ReferencePose, with_derived_constants
from ballu_mjx.sim.drivetrain import (
    DrivetrainParameters,
    DrivetrainState,
    count_slots,
    drivetrain_of,
    init_drivetrain,
    scan_drivetrain,
)
from ballu_mjx.sim.observation import observe_features
from ballu_mjx.sim.residual import Action, BoundResidual, Commands, HasResidual, History
from ballu_mjx.sim.sharding import chunks
from ballu_mjx.sim.step import PhysicsState, control_step, count_substeps, load_state, make_data, put_model, state_at
from ballu_mjx.sim.vmap_last import vmap_with_trailing_batch


class Simulator:
    """A robot in MJX, simulated in control steps.

    The methods map states to states and features. Commands are in the actuators' own units. `model` is the MJX model,
    and `mj_model` is the C model from which it was made. `drivetrain` holds the parameters of the drivetrain (delay,
    lag, backlash) between command and actuator. It is None if there is no drivetrain.
    """

    def __init__(
        self,
        robot: RobotDescription,
        actuators: ModelParameters | None = None,
        *,
        model: mujoco.MjModel | None = None,
    ) -> None:
        """Create the simulator on this process's first device.

        **Arguments**

        - `actuators`: identified actuators, with a drivetrain (`drivetrain.HasDrivetrain`) or without. None for the
          nominal actuators.
        - `model`: model of this robot to simulate instead of `robot.load_model(actuators)`.

        **Raises** `ValueError` if the model's time step does not divide the robot's control step.
        """
        self.robot, self.actuators = robot, bare_parameters(actuators)
        self.mj_model = robot.load_model(actuators) if model is None else model
        self.control_timestep = robot.control_timestep
        """Duration of a control step (s)."""
        self.nv = self.mj_model.nv
        self.substeps = count_substeps(self.mj_model, robot.control_timestep)
        """Number of physics steps in a control step."""
        self.drivetrain = drivetrain_of(self.actuators)
        self._slots = 0 if self.drivetrain is None else self._count_slots(self.drivetrain)
        self.model = put_model(self.mj_model)
        self._template = make_data(self.mj_model)
        self._reference_pose = ReferencePose.of(self.mj_model)
        sites = [self.mj_model.site(name).id for name in (robot.tracked, *robot.points)]
        bodies = self.mj_model.site_bodyid[sites]
        roots = self.mj_model.body_rootid[bodies]
        self._sites = tuple(zip(sites, bodies.tolist(), roots.tolist(), strict=True))
        self._mass_shares = jnp.asarray(mass_shares(self.mj_model, robot.tracked))

    def with_fields(self, fields: Mapping[str, Array]) -> Simulator:
        """Return a copy of the simulator with other model fields, and with the constants that MuJoCo derives from them.

        The fields may be traced. The centre of mass is still computed with the masses of `mj_model`: the added mass of
        the surrounding air is not part of it.

        **Raises** `ValueError` if a body's centre of mass or principal axes change, and the model is not from
        `robots.model.load_model` and stores only the diagonal of a body's inertia matrix.
        """
        if fields.keys() & {"body_ipos", "body_iquat"} and has_simple_bodies(self.mj_model):
            raise ValueError(
                "The model has bodies that MuJoCo compiled as simple, whose inertial frame cannot be changed; load it "
                "by `ballu_mjx.robots.model.load_model`, or set `simple = 0` for its bodies in an MjSpec."
            )
        return self.with_model(
            with_fields(self.model, with_derived_constants(self._reference_pose, self.model, fields))
        )

    def with_model(self, model: mjx.Model) -> Simulator:
        """Return a copy of the simulator with another MJX model of the same structure, which may be traced."""
        other = copy.copy(self)
        other.model = model
        return other

    def with_drivetrain(self, drivetrain: DrivetrainParameters | None) -> Simulator:
        """Return a copy of the simulator with another drivetrain, which may be traced.

        Delays are limited to the longest delay of the drivetrain given to the constructor, rounded up to whole control
        steps. A simulator without a drivetrain accepts only None.

        **Raises** `ValueError` if exactly one of the present and the new drivetrain is None.
        """
        if (drivetrain is None) != (self.drivetrain is None):
            raise ValueError(
                "Exactly one of the present and the new drivetrain is None; use actuators of the same kind for both."
            )
        other = copy.copy(self)
        other.drivetrain = drivetrain
        return other

    def with_generalized_force(self, force: Float[Array, " nv"]) -> Simulator:
        """Return a copy of the simulator with generalized forces (N, N m, along `qvel`), which may be traced."""
        other = copy.copy(self)
        other._template = self._template.replace(qfrc_applied=force)  # pyright: ignore
        return other

    def observe(self, state: PhysicsState) -> tuple[Float[Array, " features"], Float[Array, " 3"]]:
        """Return the features and the centre of mass (m, world frame) of a state."""
        return _observe(self.model, self._template, state, self._mass_shares, self._sites)

    def observe_all(
        self, qpos: Float[Array, "... nq"], qvel: Float[Array, "... nv"]
    ) -> tuple[Float[Array, "... features"], Float[Array, "... 3"]]:
        """Return the features and centres of mass (m, world frame) of any number of states; see `observe`.

        One compiled program serves all numbers of states.
        """
        shape, count = qpos.shape[:-1], math.prod(qpos.shape[:-1])
        # In NumPy: JAX would compile a program for each slice and size.
        positions, velocities = (np.asarray(x).reshape(count, -1) for x in (qpos, qvel))
        states = [
            state_at(jnp.asarray(positions[rows]), jnp.asarray(velocities[rows])) for rows, _ in chunks(count, _CHUNK)
        ]
        fixed = self._mass_shares, self._sites
        pieces = [_observe_chunk(self.model, self._template, state, *fixed) for state in states]
        features, com = (np.concatenate(parts)[:count] for parts in zip(*pieces, strict=True))
        return jnp.asarray(features.reshape(*shape, -1)), jnp.asarray(com.reshape(*shape, -1))

    def drivetrain_at_rest(self, command: Float[Array, " commands"]) -> DrivetrainState | None:
        """Return the drivetrain's state after a long time under a constant command. None if there is no drivetrain."""
        return None if self.drivetrain is None else init_drivetrain(self.drivetrain, command, self._slots)

    def drivetrain_along(self, commands: Float[Array, "steps commands"]) -> DrivetrainState | None:
        """Return the drivetrain's state before each control step under `commands`.

        The first state is at rest under the first command. All arrays have a leading axis of control steps. None if
        there is no drivetrain.
        """

        def step(state: DrivetrainState, command: Array) -> tuple[Any, DrivetrainState]:
            return self.drive(state, command)[0], state

        start = self.drivetrain_at_rest(commands[0])
        return None if start is None else jax.lax.scan(step, start, commands)[1]

    def drive(
        self, state: DrivetrainState | None, command: Float[Array, "*parts commands"]
    ) -> tuple[DrivetrainState | None, Float[Array, "*substeps commands"]]:
        """Return the drivetrain's state after a control step, and the actuators' `ctrl` in each physics step.

        `command` is held over the control step, or has one row for each of equal parts of it. Without a drivetrain,
        return None and `command` itself.

        **Raises** `ValueError` if only one of simulator and state has a drivetrain.
        """
        if (state is None) != (self.drivetrain is None):
            raise ValueError(
                "The simulator has a drivetrain and the state has none, or the reverse; make the state with "
                "`drivetrain_at_rest` of this simulator."
            )
        if state is None or self.drivetrain is None:
            return None, command
        return scan_drivetrain(self.drivetrain, state, self._in_substeps(command), self._timestep)

    def step(
        self,
        state: PhysicsState,
        ctrl: Float[Array, "*parts commands"],
        wrench: Float[Array, "loaded 6"],
        joint_force: Float[Array, " nv"] | None = None,
    ) -> PhysicsState:
        """Advance by one control step; see `step.control_step`.

        **Arguments**

        - `ctrl`: the actuators' `ctrl`, held over the control step, or one row for each of equal parts of it.
        - `wrench`: force (N) and torque (N m), world frame, on the tracked body and, in further rows, at the robot's
          points.
        - `joint_force`: generalized forces (N, N m, along `mjx.Data.qvel`). None if there are none.

        **Raises** `ValueError` if the last axis of an argument has another size.
        """
        sizes = [("ctrl", ctrl, self.mj_model.nu), ("wrench", wrench, 6), ("joint_force", joint_force, self.nv)]
        for name, value, size in sizes:
            if value is not None and value.shape[-1] != size:
                raise ValueError(
                    f"{name} has {value.shape[-1]} entries along its last axis; {self.robot.name} has {size}."
                )
        commands = self._in_substeps(ctrl)
        sites, bodies, _ = zip(*self._sites[: len(wrench)], strict=True)
        template = self._template
        if joint_force is not None:
            template = template.replace(qfrc_applied=template.qfrc_applied + joint_force)  # pyright: ignore
        return control_step(
            self.model, template, state, commands, wrench, bodies=bodies, points=sites[1:], count=self.substeps
        )

    @property
    def _timestep(self) -> float:
        return float(self.mj_model.opt.timestep)

    def _count_slots(self, drivetrain: DrivetrainParameters) -> int:
        # Round up to whole control steps, so that robots with similar delays share a compiled program.
        steps = math.ceil(float(np.max(drivetrain.delay)) / self.control_timestep - 1e-6)
        return count_slots(steps * self.control_timestep, self._timestep)

    def _in_substeps(self, command: Float[Array, "*parts commands"]) -> Float[Array, "substeps commands"]:
        parts = command.reshape(-1, command.shape[-1])
        return jnp.repeat(parts, self.substeps // len(parts), axis=0)

    def with_residual(
        self, residual: HasResidual | None, scale: Float[Array, ""] | float | None = None
    ) -> AugmentedSimulator:
        """Return the simulator with a residual and with the residual's model fields.

        `scale` is the fraction of the residual that is applied: 0 for nothing, None for all of it. If `residual` is
        None, return a simulator with the same interface and without a residual.
        """
        if residual is None:
            return AugmentedSimulator(self)
        bound = residual.bound
        fields = bound.fields
        if scale is not None:
            own = {name: getattr(self.model, name) for name in fields}
            fields = {name: (1 - scale) * own[name] + scale * value for name, value in fields.items()}
        return AugmentedSimulator(self.with_fields(fields), bound, scale, self)


class RolloutState(NamedTuple):
    """State of a simulation between two control steps: physics, inputs of the residual, and drivetrain.

    Leading axes of the arrays, if any, are batch axes.
    """

    physics: PhysicsState
    history: Float[Array, "steps features"]
    """Features (`observe_features`) of the last `HISTORY` control steps, the current one last."""
    commands: Float[Array, "earlier commands"]
    """Commands of the last `HISTORY` - 1 control steps, the most recent one last."""
    drivetrain: DrivetrainState | None = None
    """State of the drivetrain. None if the simulator has no drivetrain."""

    @property
    def features(self) -> Float[Array, "*batch features"]:
        """Features (`observe_features`) of the current state."""
        return self.history[..., -1, :]

    def with_command(self, command: Float[Array, " commands"]) -> Float[Array, "steps commands"]:
        """Return the commands that residuals observe: the earlier ones and the upcoming `command`."""
        return jnp.concatenate([self.commands, command[None]])

    def keep_finite(
        self, before: RolloutState, features: Float[Array, " features"]
    ) -> tuple[RolloutState, Bool[Array, ""]]:
        """Return a finite version of this state, the successor of `before`, and whether this state is finite.

        A state is finite if its current features and its velocities are. Otherwise the returned state has the physics
        and the drivetrain of `before`, and `features` as its current observation.
        """
        finite = jnp.all(jnp.isfinite(self.features)) & jnp.all(jnp.isfinite(self.physics.qvel))
        seen = jnp.where(finite, self.features, features)
        own, earlier = ((state.physics, state.drivetrain) for state in (self, before))
        physics, drivetrain = jax.tree.map(lambda new, old: jnp.where(finite, new, old), own, earlier)
        history = jnp.concatenate([self.history[:-1], seen[None]])
        return RolloutState(physics, history, self.commands, drivetrain), finite


class RolloutStep(NamedTuple):
    """Result of one control step."""

    state: RolloutState
    """State after the step."""
    com: Float[Array, " 3"]
    """Centre of mass (m, world) after the step."""
    action: Action
    """Action over the step: the sum of the residual's action and the further action."""


@dataclasses.dataclass(frozen=True)
class AugmentedSimulator:
    """A simulator with a residual: the paper's improved simulator. All methods are pure.

    **Fields**

    - `simulator`: the robot's simulator, with the residual's model fields.
    - `residual`: the residual with its parameters, which may be traced. None if there is no residual.
    - `scale`: the fraction of the residual that is applied. None for all of it.
    - `plain`: the simulator without the residual and its model fields. None if there is no residual.

    `Simulator.with_residual` creates an instance. The constructor does not apply the residual's model fields.
    """

    simulator: Simulator
    residual: BoundResidual | None = None
    scale: Float[Array, ""] | float | None = None
    plain: Simulator | None = None

    @property
    def robot(self) -> RobotDescription:
        """Description of the simulated robot."""
        return self.simulator.robot

    @property
    def actuators(self) -> ModelParameters | None:
        """Identified actuators of the simulator. None for the nominal actuators."""
        return self.simulator.actuators

    @property
    def control_timestep(self) -> float:
        """Duration of a control step (s)."""
        return self.simulator.control_timestep

    def without_residual(self) -> Simulator:
        """Return the simulator without the residual and without its model fields."""
        return self.simulator if self.plain is None else self.plain

    def with_residual(self, residual: HasResidual | None) -> AugmentedSimulator:
        """Return the simulator with a further residual, which acts together with the present one (`SumOfResiduals`).

        If `residual` is None, return the simulator itself.

        **Raises** `ValueError` if the present residual has a scale.
        """
        if residual is None:
            return self
        if self.scale is not None:
            raise ValueError("A residual with a scale takes no further one; add it to the simulator without the scale.")
        both = residual.bound if self.residual is None else self.residual.plus(residual.bound)
        return AugmentedSimulator(self.simulator.with_fields(both.fields), both, plain=self.without_residual())

    def with_fields(self, fields: Mapping[str, Array]) -> AugmentedSimulator:
        """Return a copy with other model fields; see `Simulator.with_fields`."""
        plain = None if self.plain is None else self.plain.with_fields(fields)
        return dataclasses.replace(self, simulator=self.simulator.with_fields(fields), plain=plain)

    def with_model(self, model: mjx.Model, params: Any) -> AugmentedSimulator:
        """Return a copy with another MJX model, and with other parameters of the residual; both may be traced.

        `model` must already contain the residual's fields. `params` is ignored if there is no residual.
        """
        residual = None if self.residual is None else self.residual._replace(params=params)
        return dataclasses.replace(self, simulator=self.simulator.with_model(model), residual=residual)

    def with_drivetrain(self, drivetrain: DrivetrainParameters | None) -> AugmentedSimulator:
        """Return a copy with another drivetrain; see `Simulator.with_drivetrain`."""
        plain = None if self.plain is None else self.plain.with_drivetrain(drivetrain)
        return dataclasses.replace(self, simulator=self.simulator.with_drivetrain(drivetrain), plain=plain)

    def with_generalized_force(self, force: Float[Array, " nv"]) -> AugmentedSimulator:
        """Return a copy with generalized forces; see `Simulator.with_generalized_force`."""
        return dataclasses.replace(self, simulator=self.simulator.with_generalized_force(force))

    def step(
        self,
        state: RolloutState,
        command: Float[Array, " commands"],
        further: Action | None = None,
        *,
        key: Array | None = None,
    ) -> RolloutStep:
        """Advance by one control step.

        The residual is evaluated first. Then drivetrain and physics advance, and the new state is observed and appended
        to the history. The drivetrain receives the commands that the residual returns.

        **Arguments**

        - `state`: current state. The residual observes its history and commands.
        - `command`: command of the upcoming control step, in the actuators' own units.
        - `further`: action in addition to that of the residual. None if there is none.
        - `key`: random key to sample the residual's action. None for the mode of its distribution.
        """
        commands = state.with_command(command)
        if self.residual is None:
            sent, action = command, Action.none() if further is None else further
        else:
            sent, action = self._evaluate_residual(state.history, commands, key)
            action = action if further is None else further.plus(action)
        if action.command_change is not None:
            low, high = np.array(self.robot.command_ranges, np.float32).T
            sent = jnp.clip(sent + action.command_change, low, high)
        drivetrain, ctrl = self.simulator.drive(state.drivetrain, sent)
        physics = self.simulator.step(state.physics, ctrl, action.wrench, action.joint_force)
        features, com = self.simulator.observe(physics)
        history = jnp.concatenate([state.history[1:], features[None]])
        return RolloutStep(RolloutState(physics, history, commands[1:], drivetrain), com, action)

    def _evaluate_residual(
        self, history: History, commands: Commands, key: Array | None
    ) -> tuple[Float[Array, "*parts commands"], Action]:
        """Return the residual's commands before its command change is added, and its action."""
        assert self.residual is not None
        action = self.residual.act(history, commands, key)
        sent = self.residual.model.command(self.residual.params, commands)
        if self.scale is None:
            return sent, action
        return (1 - self.scale) * commands[-1] + self.scale * sent, action.scaled(self.scale)


@functools.partial(jax.jit, static_argnames="sites")
def _observe(
    model: mjx.Model,
    template: mjx.Data,
    state: PhysicsState,
    shares: Float[Array, " bodies"],
    sites: tuple[tuple[int, int, int], ...],
) -> tuple[Float[Array, " features"], Float[Array, " 3"]]:
    """Implement `Simulator.observe`.

    `shares` are those of `mass_shares`. `sites` are the ids of each site, its body, and the root of the body's tree.
    """
    ids = np.array(sites).T

    def seen(model: mjx.Model, template: mjx.Data, state: PhysicsState, shares: Array) -> tuple[Array, Array]:
        data = load_state(template, state)
        data = mjx.com_vel(model, mjx.com_pos(model, mjx.kinematics(model, data)))
        return observe_features(data, *ids), shares @ data.xipos

    return vmap_with_trailing_batch(seen, key=("observe", sites))(model, template, state, shares)


_CHUNK = 1024
"""Number of states that `Simulator.observe_all` processes at a time."""


@functools.partial(jax.jit, static_argnames="sites")
def _observe_chunk(
    model: mjx.Model,
    template: mjx.Data,
    states: PhysicsState,
    shares: Float[Array, " bodies"],
    sites: tuple[tuple[int, int, int], ...],
) -> tuple[Float[Array, "states features"], Float[Array, "states 3"]]:
    return jax.vmap(lambda state: _observe(model, template, state, shares, sites))(states)
