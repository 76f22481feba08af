"""Locomotion tasks in a simulator that is vanilla, identified, randomized, or improved by a residual.

They are those of the paper's section "Improved Sim-to-real Transfer". The parameters that differ between simulators
(actuators, friction, starting states) are data in the environment's state, so that all settings share one compiled
program. A residual adds a network and needs another program, which serves all residuals of its kind.
"""

from __future__ import annotations

import copy
import dataclasses
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from jaxtyping import Array, Float, Int

from ballu_mjx.policies.domain_randomization import (
    SimulatorSetting,
    Start,
    draw_start,
    make_simulator_setting,
)
from ballu_mjx.policies.locomotion_config import LocomotionConfig, check_task
from ballu_mjx.policies.simulator_variants import SimulatorVariant
from ballu_mjx.policies.tasks import Step, Task
from ballu_mjx.policies.tasks.base import mean_velocity
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.rl.training_env import initial_state
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters, colliding_geoms
from ballu_mjx.sim.observation import HISTORY, ObservationLayout, heading_observation
from ballu_mjx.sim.residual import Action
from ballu_mjx.sim.simulator import RolloutState, Simulator
from ballu_mjx.sim.step import state_at


class EnvironmentParameters(NamedTuple):
    """Parameters that differ between environments of the same task, configuration and kind of residual, as arrays."""

    model: Any
    """The MJX model."""
    setting: SimulatorSetting
    residual: Any
    """Parameters of the residual, and the range of its training data. None if there is no residual."""


class LocomotionState(NamedTuple):
    """State of one episode, with the parameters of its simulator."""

    setting: SimulatorSetting
    friction: Float[Array, " colliding"]
    """Sliding friction coefficients of the geoms that collide."""
    push: Float[Array, " 6"]
    """Constant force (N) and torque (N m) on the tracked body, world frame."""
    rollout: RolloutState
    com: Float[Array, " 3"]
    """Centre of mass (m, world)."""
    remaining: Int[Array, ""]
    """Number of control steps until the episode ends."""
    key: Array


_METRICS = ("velocity_x", "velocity_y", "force", "outside", "excess", "diverged")


def locomotion_state(state: State) -> LocomotionState:
    """Return the `LocomotionState` in `state`. Brax's type for this field is that of its own physics."""
    return cast(LocomotionState, state.pipeline_state)


def num_observations(robot: RobotDescription) -> int:
    """Return the size of `locomotion_observation`."""
    return robot.features + 1


def locomotion_observation(
    features: Float[Array, " features"], anchored: bool = False
) -> Float[Array, " observations"]:
    """Return the observation of a locomotion policy: the paper's state, of the current control step only.

    For a free robot, horizontal positions are relative to the tracked body's. Positions and velocities are rotated into
    its heading, because a gait is the same everywhere. The heading itself comes last, as cosine and sine, because the
    task's direction is fixed in the world.
    """
    yaw = features[ObservationLayout.yaw]
    relative = heading_observation(features[None], anchored)  # its last entry is the yaw
    return jnp.concatenate([relative[:-1], jnp.cos(yaw)[None], jnp.sin(yaw)[None]])


def command_of(action: Float[Array, " commands"], robot: RobotDescription) -> Float[Array, " commands"]:
    """Return the commands (in the actuators' units) for a policy's output. -1 to 1 covers the range of each command."""
    low, high = (jnp.asarray(bound, jnp.float32) for bound in np.array(robot.command_ranges).T)
    return low + jnp.clip((action + 1) / 2, 0.0, 1.0) * (high - low)


class LocomotionEnv(Env):
    """A task in one of the simulators, with Brax's interface of environments: one robot, not batched."""

    def __init__(
        self,
        robot: RobotDescription,
        task: Task,
        config: LocomotionConfig,
        *,
        actuators: ModelParameters | None = None,
        residual: TrainedResidual | None = None,
    ) -> None:
        """Make the environment. The simulator has `actuators` (None: nominal ones) and `residual` (None: none).

        **Raises** `InputError` if the robot cannot perform the task.
        """
        check_task(task, robot)
        self.robot, self.task, self.config, self.residual = robot, task, config, residual
        simulator = Simulator(robot, actuators)
        self.simulator = simulator.with_residual(None if residual is None else residual.bound)
        model = simulator.mj_model
        setting = make_simulator_setting(robot, robot.load_model(), config, actuators)
        # The residual's fields contain the identified values already, for example the mass without the dragged fluid.
        changed = {} if residual is None else residual.bound.fields
        fields = {name: value for name, value in setting.fields.items() if name not in changed}
        self._colliding = colliding_geoms(model)
        friction = setting.friction
        if "geom_friction" in changed:  # The residual's friction scales the model's, and so the range of the draws.
            own = model.geom_friction[self._colliding, 0]
            ratio = changed["geom_friction"][self._colliding, 0] / np.where(own > 0, own, 1.0)
            friction = friction * jnp.where(own > 0, ratio, 1.0)[:, None]
        self.setting = setting._replace(fields=fields, friction=friction)
        self._rest = jnp.asarray(robot.adapter.rest_command(robot, model), jnp.float32)

    @property
    def parameters(self) -> EnvironmentParameters:
        """The MJX model, the setting, and the parameters and training range of the residual.

        A program that takes them as an argument serves all environments that differ in nothing else. In a batch,
        settings may differ between robots.
        """
        residual = None if self.residual is None else (self.residual.params, self.residual.observed)
        return EnvironmentParameters(self.simulator.simulator.model, self.setting, residual)

    @property
    def _model_friction(self) -> Float[Array, "geoms 3"]:
        """Friction of all geoms, with the residual's model fields."""
        return self.simulator.simulator.model.geom_friction

    def with_parameters(self, parameters: EnvironmentParameters) -> LocomotionEnv:
        """Return the same environment with other parameters, which may be traced."""
        other = copy.copy(self)
        params, observed = (None, None) if self.residual is None else parameters.residual
        other.simulator, other.setting = self.simulator.with_model(parameters.model, params), parameters.setting
        if self.residual is not None:
            other.residual = dataclasses.replace(self.residual, params=params, observed=observed)
        return other

    def reset(self, rng: Array) -> State:
        """Start an episode from the initial pose, at the origin, facing x.

        With domain randomization, the state varies around this pose.
        """
        return self._start(self.setting, rng)

    def renew(self, state: State, rng: Array) -> State:
        """Start an episode like `reset`, with the setting of `state`."""
        return self._start(locomotion_state(state).setting, rng)

    def at(self, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], rng: Array) -> State:
        """Start from a given state, with the model's friction and no push. The episode has no time limit."""
        friction = self._model_friction[self._colliding, 0]
        state = self._begin(self.setting, Start(qpos, qvel, friction, jnp.zeros(6), rng))
        endless = locomotion_state(state)._replace(remaining=jnp.asarray(2**30, jnp.int32))
        return dataclasses.replace(state, pipeline_state=cast(Any, endless))

    def step(self, state: State, action: Array) -> State:
        """Advance by one control step under the policy's commands and the residual."""
        before = locomotion_state(state)
        command = self.command_of(action)
        key, key_force = jax.random.split(before.key)
        excess = self._excess(before.rollout, command)

        friction = {"geom_friction": self._model_friction.at[self._colliding, 0].set(before.friction)}
        drawn = key_force if self.config.sampled_residual else None
        simulator = self.simulator.with_fields(before.setting.fields | friction)
        simulator = simulator.with_drivetrain(before.setting.drivetrain)
        push = Action(before.push[None])
        after = simulator.step(before.rollout, command, push, key=drawn)

        rollout, finite = after.state.keep_finite(before.rollout, before.rollout.features)
        com = jnp.where(finite, after.com, before.com)
        velocity = mean_velocity(before.com, com, self.robot.control_timestep)
        earned = self.task.reward(Step(velocity, rollout.features, command)) - self.config.outside_cost * excess
        reward = jnp.where(finite, earned, 0.0)
        remaining = before.remaining - 1
        now = before._replace(rollout=rollout, com=com, remaining=remaining, key=key)
        metrics = {
            "velocity_x": velocity[0],
            "velocity_y": velocity[1],
            "force": jnp.linalg.norm(after.action.wrench[0, :3] - before.push[:3]),
            "outside": jnp.asarray(excess > 0.0, jnp.float32),
            "excess": excess,
            "diverged": jnp.asarray(~finite, jnp.float32),
        }
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=now,
            obs=self._observe(rollout),
            reward=reward,
            done=jnp.asarray((remaining <= 0) | ~finite, jnp.float32),
            metrics=state.metrics | metrics,
            info=state.info | {"truncation": jnp.asarray((remaining <= 0) & finite, jnp.float32)},
        )

    def command_of(self, action: Float[Array, " commands"]) -> Float[Array, " commands"]:
        """Return the commands for a policy's output; see the function of the same name."""
        return command_of(action, self.robot)

    @property
    def observation_size(self) -> int:
        return num_observations(self.robot)

    @property
    def action_size(self) -> int:
        return len(self.robot.commands)

    @property
    def backend(self) -> str:
        return "mjx"

    def _observe(self, rollout: RolloutState) -> Float[Array, " observations"]:
        return locomotion_observation(rollout.features, self.robot.anchored)

    def _start(self, setting: SimulatorSetting, rng: Array) -> State:
        return self._begin(setting, draw_start(setting, self.robot, rng))

    def _begin(self, setting: SimulatorSetting, start: Start) -> State:
        key, key_length = jax.random.split(start.rng)
        mean = max(round(self.config.episode_seconds / self.robot.control_timestep), 2)
        physics = state_at(start.qpos, start.qvel)
        features, com = self.simulator.simulator.observe(physics)
        drivetrain = self.simulator.simulator.with_drivetrain(setting.drivetrain).drivetrain_at_rest(self._rest)
        history, commands = jnp.tile(features, (HISTORY, 1)), jnp.tile(self._rest, (HISTORY - 1, 1))
        rollout = RolloutState(physics, history, commands, drivetrain)
        remaining = jax.random.randint(key_length, (), mean // 2, mean + mean // 2 + 1)
        now = LocomotionState(setting, start.friction, start.push, rollout, com, remaining, key)
        return initial_state(now, self._observe(rollout), _METRICS)

    def _excess(self, rollout: RolloutState, command: Float[Array, " commands"]) -> Float[Array, ""]:
        """Return the distance of the residual's observation from its training range, in widths of the range."""
        if self.residual is None:
            return jnp.zeros(())
        return self.residual.out_of_range(rollout.history, rollout.with_command(command))


def variant_of(
    config: LocomotionConfig, actuators: ModelParameters | None, residual: TrainedResidual | None
) -> SimulatorVariant:
    """Return the variant of the simulator."""
    if residual is not None:
        return SimulatorVariant(residual.model.name)
    return SimulatorVariant(identified=actuators is not None, randomized=config.domain_randomization)
