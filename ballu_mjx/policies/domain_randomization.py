"""Domain randomization: the distribution of friction, starting states and pushes, and samples of it."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common.rotations import quaternion_product
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters, bare_parameters, colliding_geoms
from ballu_mjx.sim.drivetrain import DrivetrainParameters, drivetrain_of


class StartSpread(NamedTuple):
    """Spread of starting states."""

    turn: Float[Array, " 3"]
    """Largest roll, pitch and yaw (rad), with either sign."""
    joint: Float[Array, " joints"]
    """Standard deviation of each joint (rad, m)."""
    velocity: Float[Array, " nv"]
    """Standard deviation of each velocity (m/s, rad/s)."""


class SimulatorSetting(NamedTuple):
    """Parameters that differ between simulators of the same task, as arrays; see `make_simulator_setting`."""

    fields: dict[str, Array]
    """Fields of the MJX model that identified actuators change, by name."""
    drivetrain: DrivetrainParameters | None
    """Parameters of the drivetrain between command and actuator. None if there is no drivetrain."""
    initial: Float[Array, " nq"]
    """Generalized positions at which episodes start, before the spread is added."""
    joint_range: Float[Array, "joints 2"]
    """Smallest and largest value of each joint (rad, m). Infinite if the joint has no limit."""
    friction: Float[Array, "colliding 2"]
    """Range of the sliding friction coefficient of each geom that collides."""
    spread: StartSpread
    push: Float[Array, " 6"]
    """Standard deviation of the constant force (N) and torque (N m) on the tracked body, world frame."""


def make_simulator_setting(
    robot: RobotDescription, model: mujoco.MjModel, config: LocomotionConfig, actuators: ModelParameters | None
) -> SimulatorSetting:
    """Return the parameters that differ between simulators of the same task.

    `model` is the nominal robot. `actuators` None: the nominal actuators.
    """
    parameters = robot.adapter.nominal_actuators(model) if actuators is None else actuators
    improved = robot.load_model(actuators)
    on = 1.0 if config.domain_randomization else 0.0
    degree = np.pi / 180
    # One compiled program: thirty small ones would take half a second at every start.
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
    return SimulatorSetting(
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
        push=on * jnp.array([config.push_force] * 2 + [0.0] * 3 + [config.push_torque], jnp.float32),
    )


class Start(NamedTuple):
    """Starting state, friction and push of an episode, drawn from a setting."""

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    friction: Float[Array, " colliding"]
    """Sliding friction coefficients of the geoms that collide."""
    push: Float[Array, " 6"]
    """Constant force (N) and torque (N m) on the tracked body, world frame."""
    rng: Array
    """Random key for the next draws."""


def draw_start(setting: SimulatorSetting, robot: RobotDescription, rng: Array) -> Start:
    """Draw friction, starting state and push. Without domain randomization, they have the setting's own values."""
    key_friction, key_turn, key_joint, key_velocity, rng, key_push = jax.random.split(rng, 6)
    push = setting.push * jax.random.normal(key_push, (6,))
    low, high = setting.friction.T
    friction = low + (high - low) * jax.random.uniform(key_friction)
    initial, spread = setting.initial, setting.spread
    root = 0 if robot.anchored else 7  # size of the root's pose in `qpos`
    joints = initial[root:] + spread.joint * jax.random.normal(key_joint, (len(initial) - root,))
    joints = jnp.clip(joints, *setting.joint_range.T)
    if root:
        half = spread.turn * jax.random.uniform(key_turn, (3,), minval=-1.0) / 2
        quaternion = initial[3:7]
        for turn in jnp.concatenate([jnp.cos(half)[:, None], jnp.diag(jnp.sin(half))], axis=1):  # roll, pitch, yaw
            quaternion = quaternion_product(turn, quaternion)
        joints = jnp.concatenate([initial[:3], quaternion / jnp.linalg.norm(quaternion), joints])
    qvel = spread.velocity * jax.random.normal(key_velocity, spread.velocity.shape)
    return Start(joints, qvel, friction, push, rng)
