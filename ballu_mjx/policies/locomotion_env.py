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
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.envs.base import Env, State
from jaxtyping import Array, Float

from ballu_mjx.ballu.model import KNEES, MOTORS, SIDES, standing_qpos
from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.tasks import Step, Task
from ballu_mjx.residuals.trained import TrainedResidual
from ballu_mjx.robots.model import CONTROL_TIMESTEP, ModelParameters
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.observation import HISTORY, heading_observation
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.sim.step import PhysicsState, state_at


@dataclasses.dataclass(frozen=True)
class LocomotionConfig:
    """The simulator that a policy is trained in."""

    domain_randomization: bool = False
    """Draw friction and starting state anew for every episode, as the paper does (not masses, not buoyancy: gaits
    depend on these too finely)."""
    friction: tuple[float, float] = (0.5, 1.1)
    """Range of the coefficient of friction between feet and floor (nominal: 0.9)."""
    start_yaw: float = 20.0
    """Starting headings are drawn from plus or minus this, deg."""
    start_tilt: float = 2.0
    """Spread of the base's starting roll and pitch, deg."""
    start_angle: float = 3.0
    """Spread of starting hip and neck angles, deg; knees are drawn as far from their stops, motors stay at 0."""
    start_velocity: float = 0.03
    """Spread of the starting velocity, m/s; joints and base turn at five times as much, rad/s."""
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


def check_locomotion_config(config: LocomotionConfig) -> None:
    """**Raises** `InputError` for options out of range, naming the option and the mend."""
    low, high = config.friction
    if not 0 < low <= high < math.inf:
        raise InputError(f"--friction is {low:g} {high:g}: give two numbers above 0, the smaller first.")
    least = 2 * CONTROL_TIMESTEP
    if not least <= config.episode_seconds < math.inf:
        raise InputError(
            f"--episode-seconds is {config.episode_seconds:g}: it must be {least:g} or more; {least:g} is the nearest."
        )
    for name in ("start_yaw", "start_tilt", "start_angle", "start_velocity", "residual_decay", "outside_cost"):
        if not 0 <= getattr(config, name) < math.inf:
            raise InputError(
                f"--{name.replace('_', '-')} is {getattr(config, name):g}: it must be 0 or more; 0 is the nearest."
            )


def setting_name(config: LocomotionConfig, identified: bool, residual: str | None) -> str:
    """What the paper calls a simulator: the residual's name, or `vanilla` with `+sysid` and `+dr` as they apply."""
    if residual is not None:
        return residual
    return "vanilla" + "+sysid" * identified + "+dr" * config.domain_randomization


Setting = dict[str, Any]
"""What tells one simulator from another, as arrays; see `setting_of`."""
Contents = dict[str, Any]
"""See `LocomotionEnv.contents`."""
OBSERVATIONS = 28
_METRICS = ("velocity_x", "velocity_y", "force", "outside", "excess", "diverged")


def locomotion_observation(features: Float[Array, " 27"]) -> Float[Array, " 28"]:
    """Return what a locomotion policy sees of `observe_features`: the paper's state, of the current control step only.

    Horizontal positions are relative to the balloon's and turned into its heading, like velocities, for a gait is the
    same one wherever it goes. The heading itself stands at the end, as cosine and sine: the task's direction is fixed
    in the world.
    """
    yaw = features[8]
    relative = heading_observation(features[None])  # its last entry, the yaw relative to itself, is 0
    return jnp.concatenate([relative[:-1], jnp.cos(yaw)[None], jnp.sin(yaw)[None]])


def command_of(action: Float[Array, " 2"]) -> Float[Array, " 2"]:
    """Servo commands in [0, 1] for a policy's output: -1 to 1 is the whole range."""
    return jnp.clip((action + 1) / 2, 0.0, 1.0)


class LocomotionEnv(Env):
    """A task in one of the simulators; Brax's environment interface, one robot, unbatched."""

    def __init__(
        self,
        model: mujoco.MjModel,
        task: Task,
        config: LocomotionConfig,
        *,
        actuators: ModelParameters | None = None,
        residual: TrainedResidual | None = None,
    ) -> None:
        """`model` is the nominal robot; `actuators` (None: nominal ones) and `residual` (None: none) improve it."""
        self.task, self.config, self.residual = task, config, residual
        self.simulator = Simulator(model)
        if residual is not None:
            self.simulator = self.simulator.altered(residual.fields)
        self.setting = setting_of(model, config, actuators)
        self._feet = np.array([model.geom(f"foot_{side}").id for side in SIDES])
        self._friction = jnp.asarray(model.geom_friction)
        self._knees = jnp.asarray(np.arange(model.nq)[7:][KNEES])

    @property
    def contents(self) -> Contents:
        """The model's numbers, and what the residual has learned and seen: what tells one environment from another of
        the same task, configuration and kind of residual, as arrays (beside the setting, which may differ from robot to
        robot). Programs that take it as an argument serve them all."""
        residual = None if self.residual is None else (self.residual.params, self.residual.observed)
        return {"model": self.simulator.model, "setting": self.setting, "residual": residual}

    def with_contents(self, contents: Contents) -> LocomotionEnv:
        """The same with other contents, which may be traced."""
        other = copy.copy(self)
        other.simulator, other.setting = self.simulator.of(contents["model"]), contents["setting"]
        if self.residual is not None:
            params, observed = contents["residual"]
            other.residual = dataclasses.replace(self.residual, params=params, observed=observed)
        return other

    def reset(self, rng: Array) -> State:
        """Standing, at the origin, facing x; with domain randomization, nearly so."""
        return self._start(self.setting, rng)

    def renew(self, state: State, rng: Array) -> State:
        """`reset` into the simulator that `state` belongs to."""
        s: dict[str, Any] = state.pipeline_state  # pyright: ignore[reportAssignmentType]
        return self._start(s["setting"], rng)

    def at(self, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], rng: Array) -> State:
        """Start from a given state, with nominal friction, and without an end."""
        state = self._begin(self.setting, qpos, qvel, jnp.asarray(self._friction[self._feet[0], 0]), rng)
        s: dict[str, Any] = state.pipeline_state  # pyright: ignore[reportAssignmentType]
        return dataclasses.replace(state, pipeline_state=s | {"remaining": jnp.asarray(2**30, jnp.int32)})  # pyright: ignore

    def step(self, state: State, action: Array) -> State:
        """Advance one control step under the policy's commands and the residual's force."""
        s: dict[str, Any] = state.pipeline_state  # pyright: ignore[reportAssignmentType]
        command = command_of(action)
        commands = jnp.concatenate([s["commands"][1:], command[None]])
        key, key_force = jax.random.split(s["key"])
        wrench, excess = self._wrench(s["history"], commands, key_force)

        fields = s["setting"]["fields"] | {"geom_friction": self._friction.at[self._feet, 0].set(s["friction"])}
        simulator = self.simulator.altered(fields)
        earlier: PhysicsState = s["physics"]
        arriving = command if self.residual is None else self.residual.command(commands)
        after = simulator.step(earlier, arriving, wrench)
        features, com = simulator.observe(after)

        finite = jnp.all(jnp.isfinite(features)) & jnp.all(jnp.isfinite(after.qvel))
        before: Array = s["com"]
        last: Array = s["history"][-1]
        features, com = jnp.where(finite, features, last), jnp.where(finite, com, before)
        velocity = (com - before) / CONTROL_TIMESTEP
        earned = self.task.reward(Step(velocity, features, command)) - self.config.outside_cost * excess
        reward = jnp.where(finite, earned, 0.0)
        remaining = s["remaining"] - 1
        s = s | {
            "physics": jax.tree.map(lambda new, old: jnp.where(finite, new, old), after, earlier),
            "com": com,
            "history": jnp.concatenate([s["history"][1:], features[None]]),
            "commands": commands,
            "remaining": remaining,
            "key": key,
        }
        metrics = {
            "velocity_x": velocity[0],
            "velocity_y": velocity[1],
            "force": jnp.linalg.norm(wrench[0, :3]),
            "outside": jnp.asarray(excess > 0.0, jnp.float32),
            "excess": excess,
            "diverged": jnp.asarray(~finite, jnp.float32),
        }
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=s,
            obs=locomotion_observation(features),
            reward=reward,
            done=jnp.asarray((remaining <= 0) | ~finite, jnp.float32),
            metrics=state.metrics | metrics,
            info=state.info | {"truncation": jnp.asarray((remaining <= 0) & finite, jnp.float32)},
        )

    @property
    def observation_size(self) -> int:
        return OBSERVATIONS

    @property
    def action_size(self) -> int:
        return 2

    @property
    def backend(self) -> str:
        return "mjx"

    def _start(self, setting: Setting, rng: Array) -> State:
        key_friction, key_turn, key_hinge, key_velocity, rng = jax.random.split(rng, 5)
        low, high = setting["friction"]
        friction = jax.random.uniform(key_friction, minval=low, maxval=high)
        spread, standing = setting["spread"], setting["standing"]
        turn = spread["turn"] * jax.random.uniform(key_turn, (3,), minval=-1.0)
        half = turn / 2
        quaternion = jnp.concatenate([jnp.ones(1), half])  # from upright, which `standing` is
        hinges = standing[7:] + spread["hinge"] * jax.random.normal(key_hinge, (standing.shape[0] - 7,))
        hinges = hinges.at[MOTORS].set(standing[7:][MOTORS])
        hinges = hinges.at[KNEES].set(jnp.maximum(hinges, standing[7:])[KNEES])
        qpos = jnp.concatenate([standing[:3], quaternion / jnp.linalg.norm(quaternion), hinges])
        qvel = spread["velocity"] * jax.random.normal(key_velocity, (self.simulator.nv,))
        qvel = qvel * jnp.where(jnp.arange(self.simulator.nv) < 3, 1.0, 5.0)
        return self._begin(setting, qpos, qvel, friction, rng)

    def _begin(self, setting: Setting, qpos: Array, qvel: Array, friction: Array, rng: Array) -> State:
        key, key_length = jax.random.split(rng)
        mean = max(round(self.config.episode_seconds / CONTROL_TIMESTEP), 2)
        physics = state_at(qpos, qvel)
        features, com = self.simulator.observe(physics)
        s = {
            "setting": setting,
            "friction": friction,
            "physics": physics,
            "com": com,
            "history": jnp.tile(features, (HISTORY, 1)),
            "commands": jnp.zeros((HISTORY, 2)),
            "remaining": jax.random.randint(key_length, (), mean // 2, mean + mean // 2 + 1),
            "key": key,
        }
        zero = jnp.zeros(())
        metrics: dict[str, Array] = {name: zero for name in _METRICS}
        return State(
            pipeline_state=s,  # pyright: ignore[reportArgumentType]
            obs=locomotion_observation(features),
            reward=zero,
            done=zero,
            metrics=metrics,
            info={"truncation": zero},
        )

    def _wrench(
        self, history: Float[Array, "3 27"], commands: Float[Array, "3 2"], key: Array
    ) -> tuple[Float[Array, "loaded 6"], Float[Array, ""]]:
        """The residual's wrenches (N, N m; world), and how far its observation lies outside of its data."""
        if self.residual is None:
            return jnp.zeros((1, 6)), jnp.zeros(())
        excess = self.residual.excess(history, commands)
        wrench = self.residual.wrench(history, commands, key if self.config.sampled_residual else None)
        return wrench * jnp.exp(-self.config.residual_decay * excess), excess


def setting_of(model: mujoco.MjModel, config: LocomotionConfig, actuators: ModelParameters | None) -> Setting:
    """What tells a simulator from another, as arrays: model fields, starting pose, ranges of what is drawn."""
    parameters = load_robot().adapter.nominal_actuators(model) if actuators is None else actuators
    assert parameters is not None
    improved = load_robot().load_model(actuators)
    nominal = float(model.geom_friction[model.geom("foot_left").id, 0])
    on = 1.0 if config.domain_randomization else 0.0
    degree = np.pi / 180
    # One program: thirty small ones take half a second of every start.
    fields = jax.jit(lambda parameters: parameters.fields(model))(parameters)
    turn = np.array([config.start_tilt, config.start_tilt, config.start_yaw]) * degree
    return {
        "fields": jax.tree.map(jnp.float32, fields),
        "standing": jnp.asarray(standing_qpos(improved), jnp.float32),
        "friction": jnp.array(config.friction if config.domain_randomization else (nominal, nominal)),
        "spread": {
            "turn": jnp.asarray(on * turn, jnp.float32),
            "hinge": jnp.asarray(on * config.start_angle * degree, jnp.float32),
            "velocity": jnp.asarray(on * config.start_velocity, jnp.float32),
        },
    }
