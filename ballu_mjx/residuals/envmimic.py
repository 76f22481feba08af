"""EnvMimic: the residual-force policy's Markov decision process (paper, section "Residual Dynamics Learning").

The actuators replay a recording's commands; the policy pushes on the balloon; the reward is high while the simulated
balloon follows the recorded one. What the policy learns is the part of the physics that the simulator lacks.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.envs.base import Env, State
from jaxtyping import Array, Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import pad_to_bucket, stack_motions
from ballu_mjx.residuals.network import (
    ForceNetworkConfig,
    network_input,
    num_loads,
    recorded_inputs,
    square_newtons,
    world_loads,
)
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import CONTROL_TIMESTEP
from ballu_mjx.sim.force_model import BoundForces, add_wrenches, to_wrenches
from ballu_mjx.sim.observation import HISTORY, commands_seen, world_rotation, wrap_angle
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.sim.step import PhysicsState, state_at


@dataclasses.dataclass(frozen=True)
class EnvMimicConfig(ForceNetworkConfig):
    """The residual-force task. Defaults of the reward are the paper's; the rest was chosen by ablation
    (docs/envmimic.md)."""

    position_weight: float = 0.7
    """Weight of the position term (paper: 0.7)."""
    orientation_weight: float = 0.3
    """Weight of the orientation term (paper: 0.3)."""
    position_scale: float = 10.0
    """Sharpness of the position term, 1/m^2 (paper: 10)."""
    orientation_scale: float = 2.0
    """Sharpness of the orientation term, 1/rad^2 (paper: 2)."""
    orientation_axes: tuple[float, float, float] = (0.2, 0.4, 0.4)
    """Diagonal of W: roll, pitch, yaw (paper: 0.2, 0.4, 0.4)."""
    fine_position_weight: float = 0.3
    """Weight of a sharper position term, added to the paper's reward. The paper's own pays 0.97 for 5 cm of error, and
    so cannot tell a good force from none within a second or two; with both fine weights 0 it stands alone."""
    fine_orientation_weight: float = 1.0
    """Weight of a sharper orientation term, likewise."""
    fine_position_scale: float = 100.0
    """Sharpness of the added position term, 1/m^2."""
    fine_orientation_scale: float = 200.0
    """Sharpness of the added orientation term, 1/rad^2: at 20 it still pays 0.92 for 6 deg of yaw."""
    force_cost: float = 20.0
    """Reward lost per N^2 of force."""
    episode_seconds: float = 3.0
    """Mean length of an episode, s; each lasts between half and one and a half times as long (robots reset together
    would stay in step, and every batch show one phase of the episode), and a recording's end cuts it short."""
    critic_sees_error: bool = True
    """Let the value function (never the policy) see how far off the recording the robot is."""
    observation_noise: float = 0.3
    """Noise on what the policy sees in training, in multiples of each entry's spread over the recordings: forces must
    then vary smoothly with the state, which carries them further from the data."""
    start_noise: float = 1.0
    """Perturbation of the starting state, in multiples of what reconstruction from motion capture leaves uncertain
    (1 mm and 0.5 deg; 1 cm/s, 2 deg/s for base and 5 deg/s for joints)."""


def check_envmimic_config(config: EnvMimicConfig) -> None:
    """**Raises** `InputError` for options out of range, naming the option and the nearest value that fits."""
    for field in dataclasses.fields(config):
        option, value = f"--{field.name.replace('_', '-')}", getattr(config, field.name)
        if isinstance(value, bool | str):
            continue
        if field.name in ("force_limit", "force_scale", "torque_scale"):
            if not (value > 0 and math.isfinite(value)):
                raise InputError(f"{option} is {value:g}: it must be greater than 0; {field.default:g} is usual.")
        elif field.name == "episode_seconds":
            least = 2 * CONTROL_TIMESTEP
            if not (value >= least and math.isfinite(value)):
                raise InputError(f"{option} is {value:g}: it must be {least:g} or more; {least:g} is the nearest.")
        elif not all(x >= 0 and math.isfinite(x) for x in (value if isinstance(value, tuple) else (value,))):
            raise InputError(f"{option} is {value}: it must be 0 or more; 0 is the nearest.")


def reward_terms(
    seen: Float[Array, " features"], target: Float[Array, " features"], config: EnvMimicConfig
) -> dict[str, Float[Array, ""]]:
    """The paper's `r_pos` and `r_orn` (`position`, `orientation`) for simulated and recorded features, and the weighted
    sum of these and of their sharper twins (`tracking`)."""
    position_error = jnp.sum((target[:3] - seen[:3]) ** 2)
    angles = wrap_angle(target[6:9] - seen[6:9])
    orientation_error = jnp.sum(jnp.array(config.orientation_axes) * angles**2)

    position = jnp.exp(-config.position_scale * position_error)
    orientation = jnp.exp(-config.orientation_scale * orientation_error)
    fine_position = jnp.exp(-config.fine_position_scale * position_error)
    fine_orientation = jnp.exp(-config.fine_orientation_scale * orientation_error)
    tracking = (
        config.position_weight * position
        + config.orientation_weight * orientation
        + config.fine_position_weight * fine_position
        + config.fine_orientation_weight * fine_orientation
    )
    return {"position": position, "orientation": orientation, "tracking": tracking}


class EnvMimicEnv(Env):
    """Tracking of recorded motions by forces on the robot; Brax's environment interface, one robot, unbatched."""

    def __init__(
        self,
        model: mujoco.MjModel,
        motions: Sequence[Motion],
        config: EnvMimicConfig,
        beside: BoundForces | None = None,
        robot: RobotDescription | None = None,
    ) -> None:
        """`beside` is a residual that the simulator has already: the policy learns what it leaves. `robot` says what
        is what in `model`; None: it is BALLU."""
        self.config, self.beside = config, beside
        self.simulator = Simulator(model, robot)
        self.robot = self.simulator.robot
        self._held = np.array([model.joint(name).dofadr[0] for name in self.robot.held], int)
        self._spread_of_starts = jnp.asarray(start_spread(model, self.robot), jnp.float32)
        if beside is not None:
            self.simulator = self.simulator.altered(beside.model.fields(beside.params))
        reference, _ = stack_motions(self.simulator, motions)
        self.reference = pad_to_bucket(reference)
        self.episode_length = round(config.episode_seconds / CONTROL_TIMESTEP)
        self.recorded_inputs = recorded_inputs(reference, config, self.robot.anchored)
        self._spread = jnp.std(self.recorded_inputs, axis=0)
        shapes = jax.eval_shape(self.reset, jax.random.key(0)).obs
        self._observation_size = {name: shape.shape for name, shape in shapes.items()}

    @property
    def contents(self) -> dict[str, Any]:
        """What tells one environment from another of the same configuration, as arrays: the model's numbers, the
        recordings, and what a residual beside has learned. Programs that take it as an argument (see
        `learner.wrap_for_training`) serve them all."""
        return {
            "model": self.simulator.model,
            "reference": self.reference,
            "spread": self._spread,
            "spread of starts": self._spread_of_starts,
            "beside": None if self.beside is None else self.beside.params,
        }

    def with_contents(self, contents: Mapping[str, Any]) -> EnvMimicEnv:
        """The same with other contents, which may be traced."""
        other = copy.copy(self)
        other.simulator = self.simulator.of(contents["model"])
        other.reference = contents["reference"]
        other._spread, other._spread_of_starts = contents["spread"], contents["spread of starts"]
        other.beside = None if self.beside is None else self.beside._replace(params=contents["beside"])
        return other

    def reset(self, rng: Array) -> State:
        """Reference state initialization: a uniformly drawn time of a uniformly drawn recording, history included."""
        key_recording, key_time, key_noise, key_sensor, key_length = jax.random.split(rng, 5)
        reference = self.reference
        recording = jax.random.randint(key_recording, (), 0, jnp.sum(reference.steps > 0))
        time = jax.random.randint(key_time, (), HISTORY - 1, reference.steps[recording])
        qpos, qvel = reference.qpos[recording, time], reference.qvel[recording, time]
        qpos, qvel = self._perturb(key_noise, qpos, qvel, self.config.start_noise)
        history = jax.lax.dynamic_slice_in_dim(reference.features[recording], time - HISTORY + 1, HISTORY)
        simulation_state = {
            "physics": state_at(qpos, qvel),
            "history": history,
            "recording": recording,
            "time": time,
            "remaining": jax.random.randint(
                key_length, (), max(self.episode_length // 2, 1), self.episode_length + self.episode_length // 2 + 1
            ),
            "key": key_sensor,
        }
        zero = jnp.zeros(())
        metrics = {"reward_position": zero, "reward_orientation": zero, "force": zero, "diverged": zero}
        return State(
            pipeline_state=simulation_state,  # pyright: ignore[reportArgumentType]
            obs=self._observe(simulation_state),
            reward=zero,
            done=zero,
            metrics=metrics,
            info={"truncation": zero},
        )

    def step(self, state: State, action: Array) -> State:
        """Advance one control step under the recording's command and the policy's force."""
        s: dict[str, Any] = state.pipeline_state  # pyright: ignore[reportAssignmentType]
        recording, time = s["recording"], s["time"]
        loads = world_loads(action, s["history"][-1, 8], self.config, self.robot.anchored)
        command, wrench = self.reference.command[recording, time], to_wrenches(loads, self.config.forces)
        if self.beside is not None:
            model, params = self.beside
            commands = commands_seen(self.reference.command[recording], time)
            command = model.command(params, commands)
            wrench = add_wrenches(wrench, model.wrench(params, s["history"], commands))
        before: PhysicsState = s["physics"]
        after = self.simulator.step(before, command, wrench)
        seen, _ = self.simulator.observe(after)

        target = self.reference.features[recording, time + 1]
        finite = jnp.all(jnp.isfinite(seen)) & jnp.all(jnp.isfinite(after.qvel))
        seen = jnp.where(finite, seen, target)
        terms = reward_terms(seen, target, self.config)
        cost = self.config.force_cost * square_newtons(loads, self.config)
        reward = jnp.where(finite, terms["tracking"] - cost, 0.0)

        remaining = s["remaining"] - 1
        timed_out = (remaining <= 0) | (time + 1 >= self.reference.steps[recording])
        s = s | {
            "physics": jax.tree.map(lambda new, old: jnp.where(finite, new, old), after, before),
            "history": jnp.concatenate([s["history"][1:], seen[None]]),
            "time": time + 1,
            "remaining": remaining,
            "key": jax.random.split(s["key"], 1)[0],
        }
        metrics = {
            "reward_position": terms["position"],
            "reward_orientation": terms["orientation"],
            "force": jnp.linalg.norm(loads[:3]),
            "diverged": jnp.asarray(~finite, jnp.float32),
        }
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=s,
            obs=self._observe(s),
            reward=reward,
            done=jnp.asarray(timed_out | ~finite, jnp.float32),
            metrics=state.metrics | metrics,
            info=state.info | {"truncation": jnp.asarray(timed_out & finite, jnp.float32)},
        )

    def _perturb(
        self, key: Array, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], scale: float
    ) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
        """A state within the reconstruction's uncertainty of the recorded one."""
        key_base, key_turn, key_hinge, key_velocity = jax.random.split(key, 4)
        position, velocity = jnp.split(scale * self._spread_of_starts, 2)
        free = 0 if self.robot.anchored else 6
        nv = qvel.shape[0]
        root = []
        if free:
            base = qpos[:3] + position[:3] * jax.random.normal(key_base, (3,))
            turn = position[3:6] * jax.random.normal(key_turn, (3,))
            # A small rotation in the body frame: q (1, turn / 2), normalized.
            w, v = qpos[3], qpos[4:7]
            quaternion = jnp.concatenate([(w - v @ turn / 2)[None], v + (w * turn + jnp.cross(v, turn)) / 2])
            root = [base, quaternion / jnp.linalg.norm(quaternion)]
        recorded = qpos[len(qpos) - nv + free :]
        hinges = recorded + position[free:] * jax.random.normal(key_hinge, (nv - free,))
        hinges = hinges.at[self._held - free].set(recorded[self._held - free])
        qvel = qvel + velocity * jax.random.normal(key_velocity, qvel.shape)
        return jnp.concatenate([*root, hinges]), qvel

    @property
    def observation_size(self) -> dict[str, tuple[int, ...]]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._observation_size

    @property
    def action_size(self) -> int:
        return num_loads(self.config, self.robot)

    @property
    def backend(self) -> str:
        return "mjx"

    def _observe(self, s: dict[str, Any]) -> dict[str, Array]:
        """The policy's state, and for the value function also what the policy must not see: how far off it is.

        Why (`critic_sees_error`): an error once made lowers the reward for the rest of the episode whatever the policy
        does now. A value function blind to it leaves that in the advantages, where it drowns the force's own effect.
        """
        recording, time = s["recording"], s["time"]
        commands = commands_seen(self.reference.command[recording], time)
        seen = network_input(s["history"], commands, self.config, self.robot.anchored)
        noise = self.config.observation_noise * self._spread * jax.random.normal(s["key"], seen.shape)
        critic = [seen]
        if self.config.critic_sees_error:
            error = self.reference.features[recording, time] - s["history"][-1]
            to_heading = world_rotation(s["history"][-1, 8], self.robot.anchored).T
            critic += [to_heading @ error[:3], to_heading @ error[3:6], wrap_angle(error[6:9])]
        return {"state": seen + noise, "critic": jnp.concatenate([*critic, commands.ravel()])}


def start_spread(model: mujoco.MjModel, robot: RobotDescription) -> Float[np.ndarray, " directions"]:
    """What reconstruction leaves uncertain of a state, as standard deviations of positions and velocities along the
    directions of `qvel`: 1 mm and 0.5 deg; 1 cm/s, and 2 deg/s for the base and 5 deg/s for joints.

    Held joints (BALLU's motors) hardly vary: the cable makes a degree of theirs a push on the knee that no
    reconstruction error is.
    """
    degree = np.pi / 180
    slides = np.concatenate([_DIRECTIONS[kind] for kind in model.jnt_type]) == _ALONG
    position, velocity = np.where(slides, 1e-3, 0.5 * degree), np.where(slides, 0.01, 5 * degree)
    if not robot.anchored:
        velocity[3:6] = 2 * degree
    position[[model.joint(name).dofadr[0] for name in robot.held]] = 1e-3 * degree
    return np.concatenate([position, velocity])


_ALONG, _ABOUT = 0, 1
_DIRECTIONS = {
    int(mujoco.mjtJoint.mjJNT_FREE): [_ALONG] * 3 + [_ABOUT] * 3,
    int(mujoco.mjtJoint.mjJNT_SLIDE): [_ALONG],
    int(mujoco.mjtJoint.mjJNT_HINGE): [_ABOUT],
}
"""What the velocities of a joint are, by its type."""
