"""Learning to move: tasks in a simulator that is vanilla, identified, randomized, or improved by EnvMimic's forces
(paper, section "Improved Sim-to-real Transfer").

What tells one simulator from another (actuators, friction, starting states) travels in the environment's state, as
data: settings share a compiled program. A residual adds a network, and so makes another one, but one for all residuals
of its kind.
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

from ballu_mjx.policies.domain_randomization import Setting, colliding_geoms, draw_start, make_setting
from ballu_mjx.policies.locomotion_config import LocomotionConfig, check_task
from ballu_mjx.policies.tasks import Step, Task
from ballu_mjx.policies.variants import SimulatorVariant
from ballu_mjx.residuals.trained import TrainedResidual
from ballu_mjx.rl.training_env import initial_state
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters
from ballu_mjx.sim.observation import HISTORY, ObservationLayout, heading_observation
from ballu_mjx.sim.simulator import RolloutState, Simulator
from ballu_mjx.sim.step import state_at


class Contents(NamedTuple):
    """What tells one environment from another of the same task, configuration and kind of residual, as arrays."""

    model: Any
    """The MJX model."""
    setting: Setting
    residual: Any
    """Parameters of the residual, and the range of what it has seen; None: there is no residual."""


class LocomotionState(NamedTuple):
    """Where an episode stands, and in which simulator."""

    setting: Setting
    friction: Float[Array, " colliding"]
    """Sliding friction of the geoms that collide."""
    rollout: RolloutState
    com: Float[Array, " 3"]
    """Centre of mass (m, world)."""
    remaining: Int[Array, ""]
    """Control steps until the episode ends."""
    key: Array


_METRICS = ("velocity_x", "velocity_y", "force", "outside", "excess", "diverged")


def locomotion_state(state: State) -> LocomotionState:
    """Return what `LocomotionEnv` keeps in `state`: Brax types it as its own physics' state."""
    return cast(LocomotionState, state.pipeline_state)


def num_observations(robot: RobotDescription) -> int:
    """Return the size of `locomotion_observation`."""
    return robot.features + 1


def locomotion_observation(
    features: Float[Array, " features"], anchored: bool = False
) -> Float[Array, " observations"]:
    """Return what a locomotion policy sees of `observe_features`: the paper's state, of the current control step only.

    Of a free robot, horizontal positions are relative to the tracked body's and turned into its heading, like
    velocities, for a gait is the same one wherever it goes. The heading itself stands at the end, as cosine and sine:
    the task's direction is fixed in the world.
    """
    yaw = features[ObservationLayout.yaw]
    relative = heading_observation(features[None], anchored)  # its last entry is the yaw
    return jnp.concatenate([relative[:-1], jnp.cos(yaw)[None], jnp.sin(yaw)[None]])


def command_of(action: Float[Array, " commands"], robot: RobotDescription) -> Float[Array, " commands"]:
    """Return the commands (in the actuators' units) for a policy's output: -1 to 1 is the whole range of each."""
    low, high = (jnp.asarray(bound, jnp.float32) for bound in np.array(robot.command_ranges).T)
    return low + jnp.clip((action + 1) / 2, 0.0, 1.0) * (high - low)


class LocomotionEnv(Env):
    """A task in one of the simulators; Brax's environment interface, one robot, unbatched."""

    def __init__(
        self,
        robot: RobotDescription,
        task: Task,
        config: LocomotionConfig,
        *,
        actuators: ModelParameters | None = None,
        residual: TrainedResidual | None = None,
    ) -> None:
        """Make the environment; `actuators` (None: nominal ones) and `residual` (None: none) improve the simulator.

        **Raises** `InputError` where the robot cannot do the task.
        """
        check_task(task, robot)
        self.robot, self.task, self.config, self.residual = robot, task, config, residual
        simulator = Simulator(robot, actuators)
        self.simulator = simulator.with_residual(None if residual is None else residual.bound)
        model = simulator.mj_model
        self.setting = make_setting(robot, robot.load_model(), config, actuators)
        self._colliding = colliding_geoms(model)
        self._friction = jnp.asarray(model.geom_friction)
        self._rest = jnp.asarray(robot.adapter.rest_command(robot, model), jnp.float32)

    @property
    def contents(self) -> Contents:
        """The model's numbers, the setting, and what the residual has learned and seen. Programs that take them as an
        argument serve all environments that differ in nothing else. Settings may differ from robot to robot of a batch.
        """
        residual = None if self.residual is None else (self.residual.params, self.residual.observed)
        return Contents(self.simulator.simulator.model, self.setting, residual)

    def with_contents(self, contents: Contents) -> LocomotionEnv:
        """Return the same environment with other contents, which may be traced."""
        other = copy.copy(self)
        params, observed = (None, None) if self.residual is None else contents.residual
        other.simulator, other.setting = self.simulator.with_model(contents.model, params), contents.setting
        if self.residual is not None:
            other.residual = dataclasses.replace(self.residual, params=params, observed=observed)
        return other

    def reset(self, rng: Array) -> State:
        """Start from the initial pose, at the origin, facing x; with domain randomization, nearly so."""
        return self._start(self.setting, rng)

    def renew(self, state: State, rng: Array) -> State:
        """`reset` into the simulator that `state` belongs to."""
        return self._start(locomotion_state(state).setting, rng)

    def at(self, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], rng: Array) -> State:
        """Start from a given state, with nominal friction, and without an end."""
        state = self._begin(self.setting, qpos, qvel, self._friction[self._colliding, 0], rng)
        endless = locomotion_state(state)._replace(remaining=jnp.asarray(2**30, jnp.int32))
        return dataclasses.replace(state, pipeline_state=cast(Any, endless))

    def step(self, state: State, action: Array) -> State:
        """Advance one control step under the policy's commands and the residual's force."""
        before = locomotion_state(state)
        command = self.command_of(action)
        key, key_force = jax.random.split(before.key)
        excess = self._excess(before.rollout, command)
        decay = jnp.exp(-self.config.residual_decay * excess)

        friction = {"geom_friction": self._friction.at[self._colliding, 0].set(before.friction)}
        drawn = key_force if self.config.sampled_residual else None
        simulator = self.simulator.with_fields(before.setting.fields | friction)
        simulator = simulator.with_drivetrain(before.setting.drivetrain)
        after = simulator.step(before.rollout, command, action_scale=decay, key=drawn)

        rollout, finite = after.state.keep_finite(before.rollout, before.rollout.features)
        com = jnp.where(finite, after.com, before.com)
        velocity = (com - before.com) / self.robot.control_timestep
        earned = self.task.reward(Step(velocity, rollout.features, command)) - self.config.outside_cost * excess
        reward = jnp.where(finite, earned, 0.0)
        remaining = before.remaining - 1
        now = before._replace(rollout=rollout, com=com, remaining=remaining, key=key)
        metrics = {
            "velocity_x": velocity[0],
            "velocity_y": velocity[1],
            "force": jnp.linalg.norm(after.action.wrench[0, :3]),
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

    def _start(self, setting: Setting, rng: Array) -> State:
        qpos, qvel, friction, rng = draw_start(setting, self.robot, rng)
        return self._begin(setting, qpos, qvel, friction, rng)

    def _begin(self, setting: Setting, qpos: Array, qvel: Array, friction: Array, rng: Array) -> State:
        key, key_length = jax.random.split(rng)
        mean = max(round(self.config.episode_seconds / self.robot.control_timestep), 2)
        physics = state_at(qpos, qvel)
        features, com = self.simulator.simulator.observe(physics)
        drivetrain = self.simulator.simulator.with_drivetrain(setting.drivetrain).drivetrain_at_rest(self._rest)
        history, commands = jnp.tile(features, (HISTORY, 1)), jnp.tile(self._rest, (HISTORY - 1, 1))
        rollout = RolloutState(physics, history, commands, drivetrain)
        remaining = jax.random.randint(key_length, (), mean // 2, mean + mean // 2 + 1)
        now = LocomotionState(setting, friction, rollout, com, remaining, key)
        return initial_state(now, self._observe(rollout), _METRICS)

    def _excess(self, rollout: RolloutState, command: Float[Array, " commands"]) -> Float[Array, ""]:
        """Return how far the residual's observation lies outside of its data."""
        if self.residual is None:
            return jnp.zeros(())
        return self.residual.out_of_range(rollout.history, rollout.with_command(command))


def variant_of(
    config: LocomotionConfig, actuators: ModelParameters | None, residual: TrainedResidual | None
) -> SimulatorVariant:
    """Return which of the paper's simulators this is."""
    if residual is not None:
        return SimulatorVariant(residual.model.name)
    return SimulatorVariant(identified=actuators is not None, randomized=config.domain_randomization)
