"""The MJX robot between control steps, alone and improved by a residual."""

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
from ballu_mjx.robots.model import ModelParameters, bare_parameters, with_fields
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
    """The MJX robot between control steps: states in, states and features out.

    Commands are in the actuators' own units. `model` is the MJX model, `mj_model` the C model that it was made from,
    `drivetrain` what commands meet on their way to the actuators; None: nothing.
    """

    def __init__(
        self,
        robot: RobotDescription,
        actuators: ModelParameters | None = None,
        *,
        model: mujoco.MjModel | None = None,
    ) -> None:
        """Put the robot on this process's first device.

        **Arguments**

        - `actuators`: identified actuators, with a drivetrain (`drivetrain.HasDrivetrain`) or without; None: the
          nominal ones.
        - `model`: a model of this robot to simulate instead of `robot.load_model(actuators)`.

        **Raises** `ValueError` where the model's time step does not divide the robot's control time step.
        """
        self.robot, self.actuators = robot, bare_parameters(actuators)
        self.mj_model = robot.load_model(actuators) if model is None else model
        self.control_timestep = robot.control_timestep
        """Seconds between two commands."""
        self.nv = self.mj_model.nv
        self.substeps = count_substeps(self.mj_model, robot.control_timestep)
        """Physics steps in a control step."""
        self.drivetrain = drivetrain_of(self.actuators)
        self._slots = 0 if self.drivetrain is None else self._count_slots(self.drivetrain)
        self.model = put_model(self.mj_model)
        self._template = make_data(self.mj_model)
        self._reference_pose = ReferencePose.of(self.mj_model)
        sites = [self.mj_model.site(name).id for name in (robot.tracked, *robot.points)]
        bodies = self.mj_model.site_bodyid[sites]
        self._root = int(self.mj_model.body_rootid[bodies[0]])
        self._sites = tuple(zip(sites, bodies.tolist(), strict=True))
        self._masses = jnp.asarray(self.mj_model.body_mass / self.mj_model.body_mass.sum())

    def with_fields(self, fields: Mapping[str, Array]) -> Simulator:
        """Return the same simulator with other model fields, which may be traced, and the constants that follow.

        The centre of mass stays that of the model's own masses: air that the robot drags along is no part of it.
        """
        return self.with_model(
            with_fields(self.model, with_derived_constants(self._reference_pose, self.model, fields))
        )

    def with_model(self, model: mjx.Model) -> Simulator:
        """Return the same simulator of another MJX model of this structure, which may be traced."""
        other = copy.copy(self)
        other.model = model
        return other

    def with_drivetrain(self, drivetrain: DrivetrainParameters | None) -> Simulator:
        """Return the same simulator with another drivetrain, which may be traced.

        Its delays may be as long as those of the drivetrain that it takes the place of, rounded up to whole control
        steps; a simulator without a drivetrain takes none.
        """
        if (drivetrain is None) != (self.drivetrain is None):
            raise ValueError("One simulator has a drivetrain, the other has none; make both with actuators alike.")
        other = copy.copy(self)
        other.drivetrain = drivetrain
        return other

    def with_generalized_force(self, force: Float[Array, " nv"]) -> Simulator:
        """Return the same simulator under generalized forces (N, N m, along `mjx.Data.qvel`), which may be traced."""
        other = copy.copy(self)
        other._template = self._template.replace(qfrc_applied=force)  # pyright: ignore
        return other

    def observe(self, state: PhysicsState) -> tuple[Float[Array, " features"], Float[Array, " 3"]]:
        """Features and centre of mass (m, world) of a state."""
        return _observe(self.model, self._template, state, self._masses, self._sites, self._root)

    def observe_all(
        self, qpos: Float[Array, "... nq"], qvel: Float[Array, "... nv"]
    ) -> tuple[Float[Array, "... features"], Float[Array, "... 3"]]:
        """`observe`, of any number of states; one compiled program serves them all."""
        shape, count = qpos.shape[:-1], math.prod(qpos.shape[:-1])
        flat = state_at(qpos.reshape(count, -1), qvel.reshape(count, -1))
        parts = [PhysicsState(*(x[rows] for x in flat)) for rows, _ in chunks(count, _CHUNK)]
        fixed = self._masses, self._sites, self._root
        pieces = [_observe_chunk(self.model, self._template, part, *fixed) for part in parts]
        features, com = (jnp.concatenate(parts)[:count] for parts in zip(*pieces, strict=True))
        return features.reshape(*shape, -1), com.reshape(*shape, -1)

    def drivetrain_at_rest(self, command: Float[Array, " commands"]) -> DrivetrainState | None:
        """Return the drivetrain's state long after the same command; None where there is no drivetrain."""
        return None if self.drivetrain is None else init_drivetrain(self.drivetrain, command, self._slots)

    def drivetrain_along(self, commands: Float[Array, "steps commands"]) -> DrivetrainState | None:
        """Return the drivetrain's state before each of the control steps under `commands`, from rest under the first;
        all arrays have an axis of control steps in front. None where there is no drivetrain."""

        def step(state: DrivetrainState, command: Array) -> tuple[Any, DrivetrainState]:
            return self.drive(state, command)[0], state

        start = self.drivetrain_at_rest(commands[0])
        return None if start is None else jax.lax.scan(step, start, commands)[1]

    def drive(
        self, state: DrivetrainState | None, command: Float[Array, "*parts commands"]
    ) -> tuple[DrivetrainState | None, Float[Array, "*substeps commands"]]:
        """Return the drivetrain's state after a control step under a command, or one for each of equal parts of it; and
        the actuators' `ctrl` in each physics step. Without a drivetrain: None, and the command itself.

        **Raises** `ValueError` where one of drivetrain and state is there without the other.
        """
        if (state is None) != (self.drivetrain is None):
            raise ValueError("The simulator has a drivetrain and the state has none, or the other way round.")
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
        """One control step under the actuators' `ctrl`, or one for each of equal parts of it; wrenches are on the
        tracked body and, if more, at the robot's points. See `step.control_step`."""
        commands = self._in_substeps(ctrl)
        sites, bodies = zip(*self._sites[: len(wrench)], strict=True)
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
        # Whole control steps: robots of nearly the same delay share a compiled program.
        steps = math.ceil(float(np.max(drivetrain.delay)) / self.control_timestep - 1e-6)
        return count_slots(steps * self.control_timestep, self._timestep)

    def _in_substeps(self, command: Float[Array, "*parts commands"]) -> Float[Array, "substeps commands"]:
        parts = command.reshape(-1, command.shape[-1])
        return jnp.repeat(parts, self.substeps // len(parts), axis=0)

    def with_residual(
        self, residual: HasResidual | None, scale: Float[Array, ""] | float | None = None
    ) -> AugmentedSimulator:
        """Return the simulator that the residual improves, its model fields included.

        `scale` is the fraction of the residual that acts (0: nothing); None: all of it. `residual` None: a simulator
        with the same interface that nothing improves.
        """
        if residual is None:
            return AugmentedSimulator(self)
        bound = residual.bound
        fields = bound.fields
        if scale is not None:
            own = {name: getattr(self.model, name) for name in fields}
            fields = {name: (1 - scale) * own[name] + scale * value for name, value in fields.items()}
        return AugmentedSimulator(self.with_fields(fields), bound, scale)


class RolloutState(NamedTuple):
    """A simulation between two control steps: the physics, and what a residual and the drivetrain remember.

    With B leading batch axes it is a batch of simulations.
    """

    physics: PhysicsState
    history: Float[Array, "steps features"]
    """`observe_features` of the last `HISTORY` control steps, the current one last."""
    commands: Float[Array, "earlier commands"]
    """Commands of the `HISTORY` - 1 control steps before the coming one, the latest last."""
    drivetrain: DrivetrainState | None = None
    """Of the simulator's drivetrain; None where it has none."""

    @property
    def features(self) -> Float[Array, "*batch features"]:
        """`observe_features` of the current state."""
        return self.history[..., -1, :]

    def with_command(self, command: Float[Array, " commands"]) -> Float[Array, "steps commands"]:
        """Return the commands that residuals see: the earlier ones and the coming one."""
        return jnp.concatenate([self.commands, command[None]])

    def keep_finite(
        self, before: RolloutState, features: Float[Array, " features"]
    ) -> tuple[RolloutState, Bool[Array, ""]]:
        """Return this state, the successor of `before`, and whether all its numbers are finite.

        Where they are not, physics and drivetrain are those of `before`, and `features` stand for the current
        observation.
        """
        finite = jnp.all(jnp.isfinite(self.features)) & jnp.all(jnp.isfinite(self.physics.qvel))
        seen = jnp.where(finite, self.features, features)
        own, earlier = ((state.physics, state.drivetrain) for state in (self, before))
        physics, drivetrain = jax.tree.map(lambda new, old: jnp.where(finite, new, old), own, earlier)
        history = jnp.concatenate([self.history[:-1], seen[None]])
        return RolloutState(physics, history, self.commands, drivetrain), finite


class RolloutStep(NamedTuple):
    """What one control step gives."""

    state: RolloutState
    """After the step."""
    com: Float[Array, " 3"]
    """Centre of mass (m, world) after the step."""
    action: Action
    """What acted over the step: the residual, and what was beside it."""


@dataclasses.dataclass(frozen=True)
class AugmentedSimulator:
    """A simulator with a residual: the paper's improved simulator. All methods are pure.

    **Fields**

    - `simulator`: the robot, with the residual's model fields.
    - `residual`: the residual with its parameters, which may be traced; None: none.
    - `scale`: the fraction of the residual that acts; None: all of it.

    `Simulator.with_residual` makes one. The constructor takes the simulator as it is.
    """

    simulator: Simulator
    residual: BoundResidual | None = None
    scale: Float[Array, ""] | float | None = None

    @property
    def robot(self) -> RobotDescription:
        """Whose simulator it is."""
        return self.simulator.robot

    @property
    def actuators(self) -> ModelParameters | None:
        """The simulator's actuators; None: the nominal ones."""
        return self.simulator.actuators

    @property
    def control_timestep(self) -> float:
        """Seconds between two commands."""
        return self.simulator.control_timestep

    def without_residual(self) -> Simulator:
        """Return the simulator that the residual improves."""
        return Simulator(self.robot, self.actuators, model=self.simulator.mj_model)

    def with_residual(self, residual: HasResidual | None) -> AugmentedSimulator:
        """Return the simulator with a further residual, which acts together with its own (`SumOfResiduals`)."""
        if residual is None:
            return self
        assert self.scale is None, "A scaled residual takes no further one."
        both = residual.bound if self.residual is None else self.residual.plus(residual.bound)
        return AugmentedSimulator(self.simulator.with_fields(both.fields), both)

    def with_fields(self, fields: Mapping[str, Array]) -> AugmentedSimulator:
        """Return the same with other model fields; see `Simulator.with_fields`."""
        return dataclasses.replace(self, simulator=self.simulator.with_fields(fields))

    def with_model(self, model: mjx.Model, params: Any) -> AugmentedSimulator:
        """Return the same of another MJX model, and with other parameters of the residual; both may be traced.

        `model` has the residual's fields already. Without a residual, `params` are of no influence.
        """
        residual = None if self.residual is None else self.residual._replace(params=params)
        return dataclasses.replace(self, simulator=self.simulator.with_model(model), residual=residual)

    def with_drivetrain(self, drivetrain: DrivetrainParameters | None) -> AugmentedSimulator:
        """Return the same with another drivetrain; see `Simulator.with_drivetrain`."""
        return dataclasses.replace(self, simulator=self.simulator.with_drivetrain(drivetrain))

    def with_generalized_force(self, force: Float[Array, " nv"]) -> AugmentedSimulator:
        """Return the same under generalized forces; see `Simulator.with_generalized_force`."""
        return dataclasses.replace(self, simulator=self.simulator.with_generalized_force(force))

    def step(
        self,
        state: RolloutState,
        command: Float[Array, " commands"],
        further: Action | None = None,
        *,
        action_scale: Float[Array, ""] | float | None = None,
        key: Array | None = None,
    ) -> RolloutStep:
        """Advance by one control step: ask the residual, step drivetrain and physics, observe, shift the history.

        The residual's commands are what the drivetrain takes.

        **Arguments**

        - `state`: where the simulation stands; the residual sees its history and commands.
        - `command`: of the coming control step, in the actuators' own units.
        - `further`: what acts beside the residual.
        - `action_scale`: multiplies what the residual does (`Residual.act`), not its delays and model fields.
        - `key`: to draw what the residual does; None: the most likely.
        """
        commands = state.with_command(command)
        if self.residual is None:
            sent, action = command, Action.none() if further is None else further
        else:
            sent, action = self._ask(state.history, commands, key)
            if action_scale is not None:
                action = action.scaled(action_scale)
            action = action if further is None else further.plus(action)
        if action.command_change is not None:
            low, high = np.array(self.robot.command_ranges, np.float32).T
            sent = jnp.clip(sent + action.command_change, low, high)
        drivetrain, ctrl = self.simulator.drive(state.drivetrain, sent)
        physics = self.simulator.step(state.physics, ctrl, action.wrench, action.joint_force)
        features, com = self.simulator.observe(physics)
        history = jnp.concatenate([state.history[1:], features[None]])
        return RolloutStep(RolloutState(physics, history, commands[1:], drivetrain), com, action)

    def _ask(
        self, history: History, commands: Commands, key: Array | None
    ) -> tuple[Float[Array, "*parts commands"], Action]:
        """Return the residual's commands before it changes them, and what it does."""
        assert self.residual is not None
        action = self.residual.act(history, commands, key)
        sent = self.residual.model.command(self.residual.params, commands)
        if self.scale is None:
            return sent, action
        return (1 - self.scale) * commands[-1] + self.scale * sent, action.scaled(self.scale)


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
