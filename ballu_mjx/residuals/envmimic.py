"""EnvMimic: the Markov decision process of the residual-force policy (paper, section "Residual Dynamics Learning").

The actuators replay the commands of a recording, and the policy exerts forces on the robot. The reward is high while
the simulated body follows the recorded body. The policy thereby learns the part of the physics that the simulator
lacks.
"""

from __future__ import annotations

import copy
import dataclasses
import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.envs.base import Env, State
from jaxtyping import Array, Float, Int

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.rotations import quaternion_integrate
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import pad_to_bucket, stack_motions
from ballu_mjx.residuals.network_config import ForceNetworkConfig, check_network_config
from ballu_mjx.residuals.network_input import network_input, recorded_inputs
from ballu_mjx.residuals.network_loads import expected_units, force_frame, num_loads, square_newtons, world_loads
from ballu_mjx.residuals.network_mirror import network_mirror
from ballu_mjx.residuals.scales import resolve_scales
from ballu_mjx.residuals.training_range import TrainingRange
from ballu_mjx.rl.training_env import initial_state
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.coordinates import translations
from ballu_mjx.sim.force_sets import FORCE_SETS, ForceSet
from ballu_mjx.sim.observation import HISTORY, ObservationLayout, euler_to_matrix, wrap_angle
from ballu_mjx.sim.simulator import AugmentedSimulator, RolloutState, Simulator
from ballu_mjx.sim.step import state_at


@dataclasses.dataclass(frozen=True)
class EnvMimicConfig(ForceNetworkConfig):
    """Options of the residual-force task.

    Weights and sharpness of the position and orientation terms have the paper's values as defaults. The other defaults
    were chosen by ablation (docs/envmimic.md).
    """

    forces: ForceSet = "wrench"
    position_weight: float = 0.7
    """Weight of the position term (paper: 0.7)."""
    orientation_weight: float = 0.3
    """Weight of the orientation term (paper: 0.3)."""
    position_scale: float = 10.0
    """Sharpness of the position term, 1/m^2 (paper: 10)."""
    orientation_scale: float = 2.0
    """Sharpness of the orientation term, 1/rad^2 (paper: 2)."""
    orientation_axes: tuple[float, float, float] = (0.2, 0.4, 0.4)
    """Weights of roll, pitch and yaw in the orientation error, the diagonal of the paper's W (paper: 0.2, 0.4, 0.4)."""
    fine_position_weight: float = 0.3
    """Weight of an additional, sharper position term. The paper's position term is still 0.98 at an error of 5 cm, so
    it hardly rewards a good force within a second or two. With both fine weights 0, the reward is the paper's."""
    fine_orientation_weight: float = 1.0
    """Weight of an additional, sharper orientation term."""
    fine_position_scale: float = 100.0
    """Sharpness of the additional position term, 1/m^2."""
    fine_orientation_scale: float = 200.0
    """Sharpness of the additional orientation term, 1/rad^2. At 20, the term is still 0.92 at 6 deg of yaw."""
    force_cost: float | None = None
    """Cost of force, in reward per N^2. Without this option: 0.05 per squared unit of the network's
    output."""
    episode_seconds: float | None = None
    """Mean length of an episode, s. An episode also ends at the end of its recording. Without this option: 3 s, or the
    middle one of the robot's declared horizons if this is shorter. Errors that saturate within an episode do not show
    which force is better."""
    episode_spread: float = 0.5
    """Half the range of episode lengths, as a fraction of the mean length (0 to 1). Lengths are drawn uniformly. With
    0, robots that are reset together stay in phase, and every batch shows only one phase of the episode."""
    critic_sees_error: bool = True
    """Include the deviation from the recording in the input of the value function. The policy never has it."""
    observation_noise: float = 0.3
    """Standard deviation of noise on the policy's input in training, in multiples of each input's standard deviation
    over the recordings. With noise, forces vary smoothly with the state and generalize further from the data."""
    start_noise: float = 1.0
    """Perturbation of the starting state, in multiples of the uncertainty of the reconstruction from motion capture
    (1 mm and 0.5 deg; 1 cm/s, 2 deg/s for the base and 5 deg/s for joints)."""


_EPISODE_SECONDS = 3.0
"""Default mean length of an episode (s) for a robot that does not declare a shorter horizon."""


def resolve_envmimic(
    config: EnvMimicConfig, simulator: Simulator | AugmentedSimulator, motions: Sequence[Motion]
) -> EnvMimicConfig:
    """Return the options with numbers for the length of episodes and for all scales (`scales.resolve_scales`).

    `motions` are the training motions.

    **Raises** `InputError` from `resolve_scales`.
    """
    if config.episode_seconds is None:
        robot = simulator.robot
        middle = statistics.median_low(robot.horizons or (_EPISODE_SECONDS,))
        seconds = max(min(_EPISODE_SECONDS, middle), 2 * robot.control_timestep)
        config = dataclasses.replace(config, episode_seconds=seconds)
    return resolve_scales(config, simulator, motions)


def check_envmimic_config(config: EnvMimicConfig, control_timestep: float) -> None:
    """Check the options for a robot with a control step of `control_timestep` (s).

    **Raises** `InputError` for an option out of range. The message names the option and the nearest allowed value.
    """
    check_network_config(config)
    of_network = {field.name for field in dataclasses.fields(ForceNetworkConfig)}
    for field in dataclasses.fields(config):
        option, value = f"--{field.name.replace('_', '-')}", getattr(config, field.name)
        if value is None or isinstance(value, bool | str) or field.name in of_network:
            continue
        if field.name == "episode_seconds":
            least = 2 * control_timestep
            if not (value >= least and math.isfinite(value)):
                raise InputError(f"{option} is {value:g}: it must be {least:g} or more; {least:g} is the nearest.")
        elif field.name == "episode_spread":
            if not 0 <= value <= 1:
                nearest = int(value > 1)
                raise InputError(f"{option} is {value:g}: it must be between 0 and 1; {nearest} is the nearest.")
        elif not all(x >= 0 and math.isfinite(x) for x in (value if isinstance(value, tuple) else (value,))):
            raise InputError(f"{option} is {value}: it must be 0 or more; 0 is the nearest.")


def reward_terms(
    seen: Float[Array, " features"], target: Float[Array, " features"], config: EnvMimicConfig, upright: bool = True
) -> dict[str, Float[Array, ""]]:
    """Return the reward's terms for simulated features `seen` and recorded features `target`.

    `position` and `orientation` are the paper's `r_pos` and `r_orn`. `tracking` is the weighted sum of these and of the
    additional, sharper terms.

    Euler angles of a robot that is not `upright` jump. Its squared orientation error is therefore 4 sin^2(angle / 2) of
    the rotation between both orientations, times the mean weight of the three axes.
    """
    layout = ObservationLayout
    position_error = jnp.sum((target[layout.position] - seen[layout.position]) ** 2)
    if upright:
        angles = wrap_angle(target[layout.euler_angles] - seen[layout.euler_angles])
        orientation_error = jnp.sum(jnp.array(config.orientation_axes) * angles**2)
    else:
        one, other = (euler_to_matrix(each[layout.euler_angles]) for each in (target, seen))
        orientation_error = sum(config.orientation_axes) / 3 * jnp.sum((one - other) ** 2) / 2

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


_METRICS = ("reward_position", "reward_orientation", "force", "diverged")


class TrackingState(NamedTuple):
    """State of one episode of `EnvMimicEnv`."""

    rollout: RolloutState
    recording: Int[Array, ""]
    """Index of the recording that the episode follows."""
    time: Int[Array, ""]
    """Control steps since the start of the recording."""
    remaining: Int[Array, ""]
    """Control steps until the end of the episode."""
    key: Array
    """Random key of the noise on the policy's input."""


def tracking_state(state: State) -> TrackingState:
    """Return the `TrackingState` in `state`. Brax declares it as a state of its own physics."""
    return cast(TrackingState, state.pipeline_state)


class EnvMimicEnv(Env):
    """Brax environment in which a policy makes one robot follow recorded motions by residual forces; unbatched."""

    def __init__(
        self,
        simulator: Simulator | AugmentedSimulator,
        motions: Sequence[Motion],
        config: EnvMimicConfig,
    ) -> None:
        """Make the environment for `motions`.

        If `simulator` has a residual, that residual also acts, and the policy learns the remaining forces.
        """
        self.simulator = simulator.with_residual(None)
        self.config = resolve_envmimic(config, self.simulator, motions)
        plain = self.simulator.simulator
        model, self.robot = plain.mj_model, plain.robot
        self._held = np.array([model.joint(name).dofadr[0] for name in self.robot.held], int)
        self._spread_of_starts = jnp.asarray(start_spread(model, self.robot), jnp.float32)
        reference, _ = stack_motions(plain, motions)
        self.reference = pad_to_bucket(reference)
        assert self.config.episode_seconds is not None, "Resolved."
        self.episode_length = round(self.config.episode_seconds / self.robot.control_timestep)
        self.recorded_inputs = recorded_inputs(reference, config, self.robot)
        self.mirror = network_mirror(self.config, self.robot)
        self.observed = TrainingRange.of(self.recorded_inputs, self.mirror)
        self._spread = jnp.std(self.recorded_inputs, axis=0)
        self.initial_action = jnp.asarray(expected_units(self.config, self.robot), jnp.float32)
        shapes = jax.eval_shape(self.reset, jax.random.key(0)).obs
        self._observation_size = {name: shape.shape for name, shape in shapes.items()}

    @property
    def parameters(self) -> dict[str, Any]:
        """Return the parameters that differ between environments of the same configuration, as arrays.

        They are the model's numbers, the recordings, and the parameters of a base residual. A compiled program that
        takes them as an argument (see `training_env.wrap_for_training`) can run all of these environments.
        """
        return {
            "model": self.simulator.simulator.model,
            "drivetrain": self.simulator.simulator.drivetrain,
            "reference": self.reference,
            "spread": self._spread,
            "spread of starts": self._spread_of_starts,
            "initial action": self.initial_action,
            "observed": None if self.config.fade_width is None else self.observed,
            "base residual": None if self.simulator.residual is None else self.simulator.residual.params,
        }

    def with_parameters(self, parameters: Mapping[str, Any]) -> EnvMimicEnv:
        """Return the same environment with other parameters, which may be traced."""
        other = copy.copy(self)
        simulator = self.simulator.with_model(parameters["model"], parameters["base residual"])
        other.simulator = simulator.with_drivetrain(parameters["drivetrain"])
        other.reference = parameters["reference"]
        other._spread, other._spread_of_starts = parameters["spread"], parameters["spread of starts"]
        other.initial_action, other.observed = parameters["initial action"], parameters["observed"]
        return other

    def reset(self, rng: Array) -> State:
        """Start an episode by reference state initialization.

        The episode starts at a uniformly drawn time of a uniformly drawn recording, with the recorded history.
        """
        key_recording, key_time, key_noise, key_sensor, key_length = jax.random.split(rng, 5)
        reference = self.reference
        recording = jax.random.randint(key_recording, (), 0, jnp.sum(reference.steps > 0))
        time = jax.random.randint(key_time, (), HISTORY - 1, reference.steps[recording])
        qpos, qvel = reference.qpos[recording, time], reference.qvel[recording, time]
        qpos, qvel = self._perturb(key_noise, qpos, qvel, self.config.start_noise)
        history = jax.lax.dynamic_slice_in_dim(reference.features[recording], time - HISTORY + 1, HISTORY)
        commands = jax.lax.dynamic_slice_in_dim(reference.command[recording], time - HISTORY + 1, HISTORY - 1)
        spread = int(self.config.episode_spread * self.episode_length)
        remaining = jax.random.randint(
            key_length, (), max(self.episode_length - spread, 1), self.episode_length + spread + 1
        )
        drivetrain = reference.drivetrain_at(recording, time)
        rollout = RolloutState(state_at(qpos, qvel), history, commands, drivetrain)
        tracking = TrackingState(rollout, recording, time, remaining, key_sensor)
        return initial_state(tracking, self._observe(tracking), _METRICS)

    def step(self, state: State, action: Array) -> State:
        """Advance by one control step under the recorded command and the policy's loads."""
        before = tracking_state(state)
        recording, time = before.recording, before.time
        yaw = before.rollout.features[ObservationLayout.yaw]
        loads, expected = (world_loads(each, yaw, self.config, self.robot) for each in (action, self.initial_action))
        command = self.reference.command[recording, time]
        if self.config.fade_width is not None:
            seen = network_input(before.rollout.history, before.rollout.with_command(command), self.config, self.robot)
            loads = loads * self.observed.fade(seen, self.config.fade_width)
        does = FORCE_SETS[self.config.forces].act(loads, self.robot)
        after = self.simulator.step(before.rollout, command, does).state

        target = self.reference.features[recording, time + 1]
        rollout, finite = after.keep_finite(before.rollout, target)
        terms = reward_terms(rollout.features, target, self.config, self.robot.upright)
        assert self.config.force_cost is not None, "Resolved."
        cost = self.config.force_cost * square_newtons(loads - expected, self.config, self.robot)
        reward = jnp.where(finite, terms["tracking"] - cost, 0.0)

        remaining = before.remaining - 1
        timed_out = (remaining <= 0) | (time + 1 >= self.reference.steps[recording])
        key = jax.random.split(before.key, 1)[0]
        tracking = TrackingState(rollout, recording, time + 1, remaining, key)
        metrics = {
            "reward_position": terms["position"],
            "reward_orientation": terms["orientation"],
            "force": jnp.linalg.norm(loads[:3]),
            "diverged": jnp.asarray(~finite, jnp.float32),
        }
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=tracking,
            obs=self._observe(tracking),
            reward=reward,
            done=jnp.asarray(timed_out | ~finite, jnp.float32),
            metrics=state.metrics | metrics,
            info=state.info | {"truncation": jnp.asarray(timed_out & finite, jnp.float32)},
        )

    def _perturb(
        self, key: Array, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"], scale: float
    ) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
        """Return a recorded state with noise of `scale` times the uncertainty of the reconstruction."""
        key_base, key_turn, key_hinge, key_velocity = jax.random.split(key, 4)
        position, velocity = jnp.split(scale * self._spread_of_starts, 2)
        free = 0 if self.robot.anchored else 6
        nv = qvel.shape[0]
        root = []
        if free:
            base = qpos[:3] + position[:3] * jax.random.normal(key_base, (3,))
            turn = position[3:6] * jax.random.normal(key_turn, (3,))
            root = [base, quaternion_integrate(qpos[3:7], turn)]
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

    def _observe(self, tracking: TrackingState) -> dict[str, Array]:
        """Return the inputs of the policy (`state`) and of the value function (`critic`).

        With `critic_sees_error`, the value function also has the deviation from the recording, which the policy must
        not see. A past error lowers the reward for the rest of the episode, independently of the present force. Without
        the deviation, the value function cannot predict this, and it outweighs the effect of the force in the
        advantages.
        """
        rollout, recording, time = tracking.rollout, tracking.recording, tracking.time
        commands = rollout.with_command(self.reference.command[recording, time])
        seen = network_input(rollout.history, commands, self.config, self.robot)
        noise = self.config.observation_noise * self._spread * jax.random.normal(tracking.key, seen.shape)
        critic = [seen]
        if self.config.critic_sees_error:
            error = self.reference.features[recording, time] - rollout.features
            layout = ObservationLayout
            to_heading = force_frame(rollout.features[layout.yaw], self.config, self.robot).T
            critic += [to_heading @ error[layout.position], to_heading @ error[layout.velocity]]
            critic += [wrap_angle(error[layout.euler_angles])]
        return {"state": seen + noise, "critic": jnp.concatenate([*critic, commands.ravel()])}


def start_spread(model: mujoco.MjModel, robot: RobotDescription) -> Float[np.ndarray, " directions"]:
    """Return the uncertainty of reconstructed states, as standard deviations along the directions of `qvel`.

    Positions come first (1 mm and 0.5 deg), then velocities (1 cm/s, 2 deg/s for a free base and 5 deg/s for joints).
    The positions of held joints have 0.001 deg or 0.001 mm: through a stiff transmission, a degree would mean a large
    force, which no reconstruction error causes.
    """
    degree, along = np.pi / 180, translations(model)
    position, velocity = np.where(along, 1e-3, 0.5 * degree), np.where(along, 0.01, 5 * degree)
    if not robot.anchored:
        velocity[3:6] = 2 * degree
    held = [model.joint(name).dofadr[0] for name in robot.held]
    position[held] = np.where(along[held], 1e-6, 1e-3 * degree)
    return np.concatenate([position, velocity])
