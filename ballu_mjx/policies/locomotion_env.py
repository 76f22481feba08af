"""Learning to move: tasks in a simulator that is vanilla, identified, randomized, or improved by EnvMimic's forces
(paper, section "Improved Sim-to-real Transfer").

What tells one simulator from another (actuators, friction, starting states) travels in the environment's state, as
data: settings share a compiled program. A residual adds a network, and so makes another one, but one for all residuals
of its kind.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.envs.base import Env, State
from jaxtyping import Array, Float, Int

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.tasks import Step, Task
from ballu_mjx.policies.variants import SimulatorVariant
from ballu_mjx.residuals.trained import TrainedResidual
from ballu_mjx.rl.training_env import initial_state
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters, bare_parameters
from ballu_mjx.sim.drivetrain import DrivetrainParameters, drivetrain_of
from ballu_mjx.sim.observation import HISTORY, ObservationLayout, heading_observation
from ballu_mjx.sim.simulator import RolloutState, Simulator
from ballu_mjx.sim.step import state_at


@dataclasses.dataclass(frozen=True)
class LocomotionConfig:
    """The simulator that a policy is trained in."""

    domain_randomization: bool = False
    """Draw friction and starting state anew for every episode, as the paper does (not masses, not buoyancy: gaits
    depend on these too finely)."""
    friction: tuple[float, float] = (0.5, 1.1)
    """Range of the coefficient of sliding friction, one for all geoms that collide."""
    start_yaw: float = 20.0
    """Starting headings are drawn from plus or minus this, deg."""
    start_tilt: float = 2.0
    """Starting roll and pitch of the base are drawn from plus or minus this, deg."""
    start_angle: float = 3.0
    """Spread of the starting angles of hinges, deg, within their ranges; joints that the robot's description holds stay
    where they are."""
    start_offset: float = 0.005
    """Spread of the starting positions of slides, m, likewise."""
    start_velocity: float = 0.03
    """Spread of the starting velocity, m/s; hinges and base turn at five times as much, rad/s."""
    episode_seconds: float = 12.0
    """Mean length of an episode, s; each lasts between half and one and a half times as long."""
    sampled_residual: bool = False
    """Draw the residual's forces from its policy's distribution, instead of taking the most likely ones."""
    residual_decay: float = 0.0
    """How fast the residual's force fades where its observation leaves the range seen in its training: it is
    multiplied by exp(-decay x excess), the excess in widths of that range. 0: not at all."""
    outside_cost: float = 0.0
    """Reward (m/s) lost per width of that range by which the residual's observation leaves it: keeps the policy where
    the residual knows what it does, which a policy paid for speed otherwise leaves. 0: nothing."""


_STARTS = ("start_yaw", "start_tilt", "start_angle", "start_offset", "start_velocity")
_NOT_NEGATIVE = (*_STARTS, "residual_decay", "outside_cost")


def check_locomotion_config(config: LocomotionConfig, control_timestep: float) -> None:
    """Check the options for a robot with so many seconds between two commands.

    **Raises** `InputError` for options out of range, naming the option and the fix.
    """
    low, high = config.friction
    if not 0 < low <= high < math.inf:
        raise InputError(f"--friction is {low:g} {high:g}: give two numbers above 0, the smaller first.")
    least = 2 * control_timestep
    if not least <= config.episode_seconds < math.inf:
        raise InputError(
            f"--episode-seconds is {config.episode_seconds:g}: it must be {least:g} or more; {least:g} is the nearest."
        )
    for name in _NOT_NEGATIVE:
        if not 0 <= getattr(config, name) < math.inf:
            raise InputError(
                f"--{name.replace('_', '-')} is {getattr(config, name):g}: it must be 0 or more; 0 is the nearest."
            )


def check_task(task: Task, robot: RobotDescription) -> None:
    """Check that a robot can do a task.

    **Raises** `InputError` where it cannot.
    """
    if robot.anchored:
        raise InputError(
            f"{task.name} needs a free-floating robot; {robot.name} is anchored ({robot.model.name} has no free joint)."
        )


class StartSpread(NamedTuple):
    """How starting states vary."""

    turn: Float[Array, " 3"]
    """Largest roll, pitch and yaw (rad)."""
    joint: Float[Array, " joints"]
    """Standard deviation of each joint (rad, m)."""
    velocity: Float[Array, " nv"]
    """Standard deviation of each velocity (m/s, rad/s)."""


class Setting(NamedTuple):
    """What tells one simulator from another, as arrays; see `make_setting`."""

    fields: dict[str, Array]
    """Fields of the MJX model that identified actuators change."""
    drivetrain: DrivetrainParameters | None
    """What commands meet on their way to the actuators; None: nothing."""
    initial: Float[Array, " nq"]
    """Pose that episodes start from."""
    joint_range: Float[Array, "joints 2"]
    """Smallest and largest value of each joint (rad, m); infinite where it has no limit."""
    friction: Float[Array, "colliding 2"]
    """Range of the sliding friction of each geom that collides."""
    spread: StartSpread


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
        self._root = 0 if robot.anchored else 7
        """Numbers of the root's pose in `qpos`."""

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
        key_friction, key_turn, key_joint, key_velocity, rng = jax.random.split(rng, 5)
        low, high = setting.friction.T
        friction = low + (high - low) * jax.random.uniform(key_friction)
        initial, spread, root = setting.initial, setting.spread, self._root
        joints = initial[root:] + spread.joint * jax.random.normal(key_joint, (len(initial) - root,))
        joints = jnp.clip(joints, *setting.joint_range.T)
        if root:
            half = spread.turn * jax.random.uniform(key_turn, (3,), minval=-1.0) / 2
            quaternion = _product(jnp.concatenate([jnp.ones(1), half]), initial[3:7])
            joints = jnp.concatenate([initial[:3], quaternion / jnp.linalg.norm(quaternion), joints])
        qvel = spread.velocity * jax.random.normal(key_velocity, spread.velocity.shape)
        return self._begin(setting, joints, qvel, friction, rng)

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


def colliding_geoms(model: mujoco.MjModel) -> Int[np.ndarray, " colliding"]:
    """Return the ids of the geoms that may touch others, the world's included."""
    return np.flatnonzero((model.geom_contype != 0) | (model.geom_conaffinity != 0))


def make_setting(
    robot: RobotDescription, model: mujoco.MjModel, config: LocomotionConfig, actuators: ModelParameters | None
) -> Setting:
    """Return what tells a simulator from another; `model` is the nominal robot, `actuators` None: nominal ones."""
    parameters = robot.adapter.nominal_actuators(model) if actuators is None else actuators
    improved = robot.load_model(actuators)
    on = 1.0 if config.domain_randomization else 0.0
    degree = np.pi / 180
    # One program: thirty small ones take half a second of every start.
    fields = {} if parameters is None else jax.jit(lambda parameters: parameters.fields(model))(parameters)
    first = 0 if robot.anchored else 1
    hinges = model.jnt_type[first:] == int(mujoco.mjtJoint.mjJNT_HINGE)
    joint = np.where(hinges, config.start_angle * degree, config.start_offset)
    joint[[model.joint(name).id - first for name in robot.held]] = 0.0
    limited = improved.jnt_limited[first:, None].astype(bool)
    along = np.concatenate([[True] * 3 + [False] * 3] * first + [~hinges])
    turn = np.array([config.start_tilt, config.start_tilt, config.start_yaw])
    own = improved.geom_friction[colliding_geoms(model), 0]
    drawn = np.tile(config.friction, (len(own), 1))
    return Setting(
        fields=jax.tree.map(jnp.float32, fields),
        drivetrain=drivetrain_of(bare_parameters(actuators)),
        initial=jnp.asarray(robot.adapter.initial_qpos(robot, improved), jnp.float32),
        joint_range=jnp.asarray(np.where(limited, improved.jnt_range[first:], [-np.inf, np.inf]), jnp.float32),
        friction=jnp.asarray(drawn if config.domain_randomization else np.stack([own, own], axis=1), jnp.float32),
        spread=StartSpread(
            turn=jnp.asarray(on * turn * degree, jnp.float32),
            joint=jnp.asarray(on * joint, jnp.float32),
            velocity=jnp.asarray(on * config.start_velocity * np.where(along, 1.0, 5.0), jnp.float32),
        ),
    )


def variant_of(
    config: LocomotionConfig, actuators: ModelParameters | None, residual: TrainedResidual | None
) -> SimulatorVariant:
    """Return which of the paper's simulators this is."""
    if residual is not None:
        return SimulatorVariant(residual.model.name)
    return SimulatorVariant(identified=actuators is not None, randomized=config.domain_randomization)


def _product(one: Float[Array, " 4"], other: Float[Array, " 4"]) -> Float[Array, " 4"]:
    """Return the product of two quaternions (w, x, y, z): `other` first, then `one`."""
    scalar = one[0] * other[0] - one[1:] @ other[1:]
    return jnp.concatenate([scalar[None], one[0] * other[1:] + other[0] * one[1:] + jnp.cross(one[1:], other[1:])])
