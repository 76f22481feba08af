"""EnvMimic: the residual-force policy's Markov decision process (paper, section "Residual Dynamics Learning").

The actuators replay a recording's commands; the policy pushes on the balloon; the reward is high while the simulated
balloon follows the recorded one. What the policy learns is the part of the physics that the simulator lacks.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.envs.base import Env, State
from jaxtyping import Array, Float, Int
from mujoco import mjx

from ballu_mjx import batch_last, robot_description, simulation
from ballu_mjx import robot as ballu
from ballu_mjx.errors import InputError
from ballu_mjx.forces import Applied, Fields, ForceSet, placed, together, vectors
from ballu_mjx.reconstruction import Motion
from ballu_mjx.robot_description import RobotDescription


@dataclasses.dataclass(frozen=True)
class EnvMimicConfig:
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
    forces: ForceSet = "force"
    """What the policy pushes with: a force on the balloon (the paper's), a force and a torque there (wrench), or forces
    at balloon, base and feet (multi)."""
    force_limit: float = 1.0
    """Largest force along each axis, N (paper: 1)."""
    force_scale: float = 0.05
    """Force, N, that one unit of the policy's output stands for. The forces that close the gap are hundredths of a
    newton: with 1 N a unit, PPO's first steps throw the robot over, with a constant learning rate for good."""
    torque_scale: float = 0.005
    """Torque, N m, that one unit of the policy's output stands for, where it pushes with one. Limit and cost are, unit
    for unit, those of a force."""
    force_cost: float = 20.0
    """Reward lost per N^2 of force."""
    episode_seconds: float = 3.0
    """Mean length of an episode, s; each lasts between half and one and a half times as long (robots reset together
    would stay in step, and every batch show one phase of the episode), and a recording's end cuts it short."""
    critic_sees_error: bool = True
    """Let the value function (never the policy) see how far off the recording the robot is."""
    observe_command: bool = True
    """Let the policy see the commands (now and the last two), which the paper's state leaves out."""
    observation_noise: float = 0.3
    """Noise on what the policy sees in training, in multiples of each entry's spread over the recordings: forces must
    then vary smoothly with the state, which carries them further from the data."""
    start_noise: float = 1.0
    """Perturbation of the starting state, in multiples of what reconstruction from motion capture leaves uncertain
    (1 mm and 0.5 deg; 1 cm/s, 2 deg/s for base and 5 deg/s for joints)."""


def check(config: EnvMimicConfig) -> None:
    """**Raises** `InputError` for options out of range, naming the option and the nearest value that fits."""
    for field in dataclasses.fields(config):
        option, value = f"--{field.name.replace('_', '-')}", getattr(config, field.name)
        if isinstance(value, bool | str):
            continue
        if field.name in ("force_limit", "force_scale", "torque_scale"):
            if not (value > 0 and math.isfinite(value)):
                raise InputError(f"{option} is {value:g}: it must be greater than 0; {field.default:g} is usual.")
        elif field.name == "episode_seconds":
            least = 2 * ballu.CONTROL_TIMESTEP
            if not (value >= least and math.isfinite(value)):
                raise InputError(f"{option} is {value:g}: it must be {least:g} or more; {least:g} is the nearest.")
        elif not all(x >= 0 and math.isfinite(x) for x in (value if isinstance(value, tuple) else (value,))):
            raise InputError(f"{option} is {value}: it must be 0 or more; 0 is the nearest.")


class Reference(NamedTuple):
    """Recorded motions, stacked and padded to the longest: what an episode starts from and is compared with."""

    qpos: Float[Array, "recordings states nq"]
    qvel: Float[Array, "recordings states nv"]
    features: Float[Array, "recordings states features"]
    command: Float[Array, "recordings steps commands"]
    steps: Int[Array, " recordings"]
    """Control steps of each recording."""


HISTORY = 3
"""Control steps that the policy sees: the current one and the last two (paper)."""


def features(
    data: mjx.Data, sites: Int[np.ndarray, " sites"], bodies: Int[np.ndarray, " sites"], root: int = 1
) -> Float[Array, " features"]:
    """What motion capture sees of a state, in the world frame.

    Position, velocity and Euler angles (roll, pitch, yaw) of the tracked body (the balloon), position and velocity of
    each point (base, left and right foot); m, m/s, rad. `sites`, of `bodies` below the body `root` of the world, begin
    with the tracked one. `data` must hold current `com_vel`.
    """
    position = data.site_xpos[sites]
    offset = position - data.subtree_com[root]
    # cvel is the spatial velocity (angular, linear) about the whole robot's centre of mass.
    velocity = data.cvel[bodies, 3:] + jnp.cross(data.cvel[bodies, :3], offset)
    euler = euler_angles(data.xquat[bodies[0]])
    kinematics = jnp.concatenate([position, velocity], axis=1)
    return jnp.concatenate([kinematics[0], euler, kinematics[1:].ravel()])


def feet(features: Float[np.ndarray, "*states 27"]) -> Float[np.ndarray, "*states 2 3"]:
    """Positions (m, world) of BALLU's left and right foot in `features`."""
    return np.stack([features[..., 15:18], features[..., 21:24]], axis=-2)


def euler_angles(quaternion: Float[Array, " 4"]) -> Float[Array, " 3"]:
    """Roll, pitch and yaw (rad; intrinsic z-y-x) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return jnp.stack([roll, pitch, yaw])


def wrap_angle(angle: Array) -> Array:
    """The same angle in (-pi, pi]."""
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))


def heading_rotation(yaw: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Rotation about z that takes vectors in the balloon's heading frame to the world."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def world_rotation(yaw: Float[Array, ""], anchored: bool) -> Float[Array, "3 3"]:
    """Rotation that takes vectors in the frame of observations and forces to the world: by heading, or none."""
    return heading_rotation(jnp.zeros_like(yaw) if anchored else yaw)


def observation(history: Float[Array, "steps features"], anchored: bool = False) -> Float[Array, " observations"]:
    """The policy's state, from the features of the last control steps (three in the paper; the current one last).

    The paper's state, made independent of place and heading: horizontal positions are taken from the current
    balloon's, and positions, velocities and yaw from its heading. A force that depends on where in the room the
    robot stands would fit the recordings and nothing else. Heights stay absolute, for the floor is. Of an anchored
    robot everything is absolute: its place and heading are part of its physics.
    """
    now = history[-1]
    origin = now[:3] * jnp.array([0.0, 0.0, 0.0] if anchored else [1.0, 1.0, 0.0])
    heading = jnp.zeros_like(now[8]) if anchored else now[8]
    to_heading = heading_rotation(heading).T

    def relative(frame: Float[Array, " features"]) -> Array:
        vectors = jnp.concatenate([frame[:6], frame[9:]]).reshape(-1, 3)
        is_position = jnp.tile(jnp.array([True, False]), len(vectors) // 2)
        vectors = jnp.where(is_position[:, None], vectors - origin, vectors) @ to_heading.T
        return jnp.concatenate([vectors.ravel(), frame[6:8], wrap_angle(frame[8:9] - heading)])

    return jax.vmap(relative)(history).ravel()


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


class Simulator:
    """The MJX robot between control steps: states in, states and features out."""

    def __init__(self, model: mujoco.MjModel, robot: RobotDescription | None = None) -> None:
        """`robot` says what is what in `model`; None: it is BALLU."""
        robot = robot or robot_description.ballu()
        self.robot = robot
        self.nv = model.nv
        self.model = simulation.put_model(model)
        self._template = simulation.make_data(model)
        self._count = simulation.substeps(model)
        sites = [model.site(name).id for name in (robot.tracked, *robot.points)]
        self._root = int(model.body_rootid[model.site_bodyid[sites[0]]])
        self._sites = tuple(zip(sites, model.site_bodyid[sites].tolist(), strict=True))
        self._masses = jnp.asarray(model.body_mass / model.body_mass.sum())

    def altered(self, fields: Mapping[str, Array]) -> Simulator:
        """The same with other model fields, which may be traced. The centre of mass stays that of the model's own
        masses: air that the robot drags along is no part of it."""
        return self.of(ballu.with_fields(self.model, dict(fields)))

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

    def observe(self, state: simulation.State) -> tuple[Float[Array, " features"], Float[Array, " 3"]]:
        """Features and centre of mass (m, world) of a state."""
        return _observe(self.model, self._template, state, self._masses, self._sites, self._root)

    def observe_all(
        self, qpos: Float[Array, "... nq"], qvel: Float[Array, "... nv"]
    ) -> tuple[Float[Array, "... features"], Float[Array, "... 3"]]:
        """`observe`, of any number of states; one compiled program serves them all."""
        shape, count = qpos.shape[:-1], math.prod(qpos.shape[:-1])
        filled = np.arange(-(-count // _CHUNK) * _CHUNK) % count
        flat = simulation.at(qpos.reshape(count, -1), qvel.reshape(count, -1))
        chunks = [simulation.State(*(x[part] for x in flat)) for part in filled.reshape(-1, _CHUNK)]
        fixed = self._masses, self._sites, self._root
        pieces = [_observe_chunk(self.model, self._template, chunk, *fixed) for chunk in chunks]
        features, com = (jnp.concatenate(parts)[:count] for parts in zip(*pieces, strict=True))
        return features.reshape(*shape, -1), com.reshape(*shape, -1)

    def step(
        self, state: simulation.State, command: Float[Array, "*parts commands"], wrench: Float[Array, "loaded 6"]
    ) -> simulation.State:
        """One control step under a command, or one for each of equal parts of it; wrenches are on the tracked body
        and, if more, at the robot's points. See `simulation.control_step`."""
        parts = command.reshape(-1, command.shape[-1])
        commands = jnp.repeat(parts, self._count // len(parts), axis=0)
        sites, bodies = zip(*self._sites[: len(wrench)], strict=True)
        return simulation.control_step(
            self.model, self._template, state, commands, wrench, bodies=bodies, points=sites[1:], count=self._count
        )


@functools.partial(jax.jit, static_argnames=("sites", "root"))
def _observe(
    model: mjx.Model,
    template: mjx.Data,
    state: simulation.State,
    masses: Float[Array, " bodies"],
    sites: tuple[tuple[int, int], ...],
    root: int,
) -> tuple[Float[Array, " features"], Float[Array, " 3"]]:
    """`Simulator.observe`; `masses` are shares of the whole, `sites` ids of sites and of their bodies."""
    site, body = np.array(sites).T

    def seen(model: mjx.Model, template: mjx.Data, state: simulation.State, masses: Array) -> tuple[Array, Array]:
        data = simulation.load(template, state)
        data = mjx.com_vel(model, mjx.com_pos(model, mjx.kinematics(model, data)))
        return features(data, site, body, root), masses @ data.xipos

    return batch_last.fast(seen)(model, template, state, masses)


_CHUNK = 1024
"""States that `Simulator.observe_all` looks at in one go."""


@functools.partial(jax.jit, static_argnames=("sites", "root"))
def _observe_chunk(
    model: mjx.Model,
    template: mjx.Data,
    states: simulation.State,
    masses: Float[Array, " bodies"],
    sites: tuple[tuple[int, int], ...],
    root: int,
) -> tuple[Float[Array, "states features"], Float[Array, "states 3"]]:
    return jax.vmap(lambda state: _observe(model, template, state, masses, sites, root))(states)


def stack(simulator: Simulator, motions: Sequence[Motion]) -> tuple[Reference, Float[Array, "recordings states 3"]]:
    """Motions as one `Reference`, and their centres of mass (m, world)."""
    longest = max(len(motion.qpos) for motion in motions)

    def pad(arrays: list[np.ndarray], length: int) -> Array:
        return jnp.asarray(
            np.stack([np.pad(a, [(0, length - len(a)), (0, 0)], mode="edge") for a in arrays]), jnp.float32
        )

    qpos = pad([motion.qpos for motion in motions], longest)
    qvel = pad([motion.qvel for motion in motions], longest)
    command = pad([motion.command for motion in motions], longest - 1)
    steps = jnp.array([len(motion.command) for motion in motions])

    feature, com = simulator.observe_all(qpos, qvel)
    return Reference(qpos, qvel, feature, command, steps), com


def roomy(reference: Reference) -> Reference:
    """`reference` with room for more: recordings of no steps, and states behind the last ones, up to the next powers of
    two. Programs are compiled for sizes, and recordings made anew are seldom just as many and as long."""
    recordings, states = reference.qpos.shape[:2]
    more = (
        max(1 << (recordings - 1).bit_length(), _ROOM[0]) - recordings,
        max(1 << (states - 1).bit_length(), _ROOM[1]) - states,
    )

    def filled(x: Array) -> Array:
        return jnp.pad(x, [(0, more[0]), (0, more[1]), (0, 0)], mode="edge")

    motion = Reference(*map(filled, reference[:-1]), steps=reference.steps)  # pyright: ignore[reportCallIssue]
    return motion._replace(steps=jnp.pad(reference.steps, (0, more[0])))


_ROOM = (16, 512)
"""Recordings and states (25 s) that there is always room for."""


def policy_input(
    history: Float[Array, "3 features"],
    commands: Float[Array, "3 commands"],
    config: EnvMimicConfig,
    anchored: bool = False,
) -> Float[Array, " inputs"]:
    """`observation`, with the commands (the coming one last) where the configuration asks for them."""
    seen = observation(history, anchored)
    return jnp.concatenate([seen, commands.ravel()]) if config.observe_command else seen


def input_size(config: EnvMimicConfig, robot: RobotDescription) -> int:
    """Numbers in `policy_input`."""
    return HISTORY * (robot.features + len(robot.commands) * config.observe_command)


def action_size(config: EnvMimicConfig, robot: RobotDescription) -> int:
    """Numbers in an action."""
    return 3 * vectors(config.forces, len(robot.points))


def units(config: EnvMimicConfig, size: int) -> Float[np.ndarray, " loads"]:
    """What one unit of each number of an action stands for, N or N m."""
    scale = np.full(size, config.force_scale)
    if config.forces == "wrench":
        scale[3:] = config.torque_scale
    return scale


def square_newtons(loads: Float[Array, "*batch loads"], config: EnvMimicConfig) -> Float[Array, "*batch"]:
    """What loads cost force for (N^2): their squares, a torque counted as the force that takes as many units."""
    in_newtons = loads / units(config, loads.shape[-1]) * config.force_scale
    return jnp.sum(in_newtons**2, axis=-1)


def world_loads(
    action: Float[Array, " loads"], yaw: Float[Array, ""], config: EnvMimicConfig, anchored: bool = False
) -> Float[Array, " loads"]:
    """The loads (N, N m; world; see `forces.placed`) that an action stands for, within the limit along each axis.

    Actions are in the balloon's heading frame, like the observation: the same situation met in another direction
    calls for the same force, turned. Those on an anchored robot are in the world's.
    """
    most = config.force_limit / config.force_scale
    loads = jnp.asarray(units(config, len(action))) * jnp.clip(action, -most, most)
    return (loads.reshape(-1, 3) @ world_rotation(yaw, anchored).T).ravel()


@dataclasses.dataclass(frozen=True)
class ForcePolicy:
    """EnvMimic's kind of residual (see `forces.ForceModel`): a policy's action is what pushes the robot.

    **Fields**

    - `config`: what the policy sees, and what its actions mean.
    - `infer`: (parameters, observation) to the most likely action.
    - `sample`: (parameters, observation, key) to a drawn one; None: there is none to be had.
    - `anchored`: whether the robot is (`robot_description.RobotDescription`).
    """

    config: EnvMimicConfig
    infer: Callable[[Any, Float[Array, " inputs"]], Float[Array, " loads"]]
    sample: Callable[[Any, Float[Array, " inputs"], Array], Float[Array, " loads"]] | None = None
    name: str = "envmimic"
    anchored: bool = False

    def inputs(
        self, history: Float[Array, "steps features"], commands: Float[Array, "steps commands"]
    ) -> Float[Array, " inputs"]:
        """What the policy sees."""
        return policy_input(history, commands, self.config, self.anchored)

    def fields(self, params: Any) -> Fields:
        """None: forces are all there is."""
        return {}

    def command(self, params: Any, commands: Float[Array, "steps commands"]) -> Float[Array, "1 commands"]:
        """The command as it is."""
        return commands[-1:]

    def wrench(
        self,
        params: Any,
        history: Float[Array, "steps features"],
        commands: Float[Array, "steps commands"],
        key: Array | None = None,
    ) -> Float[Array, "loaded 6"]:
        """The policy's loads, where they act."""
        seen, yaw = self.inputs(history, commands), history[-1, 8]
        if key is None or self.sample is None:
            loads = self.loads(params, seen, yaw)
        else:
            loads = world_loads(self.sample(params, seen, key), yaw, self.config, self.anchored)
        return placed(loads, self.config.forces)

    def loads(self, params: Any, seen: Float[Array, " inputs"], yaw: Float[Array, ""]) -> Float[Array, " loads"]:
        """The most likely loads (N, N m; world) for what the policy sees, at a heading."""
        return world_loads(self.infer(params, seen), yaw, self.config, self.anchored)


class EnvMimicEnv(Env):
    """Tracking of recorded motions by forces on the robot; Brax's environment interface, one robot, unbatched."""

    def __init__(
        self,
        model: mujoco.MjModel,
        motions: Sequence[Motion],
        config: EnvMimicConfig,
        beside: Applied | None = None,
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
        reference, _ = stack(self.simulator, motions)
        self.reference = roomy(reference)
        self.episode_length = round(config.episode_seconds / ballu.CONTROL_TIMESTEP)
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
            "physics": simulation.at(qpos, qvel),
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
        command, wrench = self.reference.command[recording, time], placed(loads, self.config.forces)
        if self.beside is not None:
            model, params = self.beside
            commands = commands_seen(self.reference.command[recording], time)
            command = model.command(params, commands)
            wrench = together(wrench, model.wrench(params, s["history"], commands))
        before: simulation.State = s["physics"]
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
        return action_size(self.config, self.robot)

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
        seen = policy_input(s["history"], commands, self.config, self.robot.anchored)
        noise = self.config.observation_noise * self._spread * jax.random.normal(s["key"], seen.shape)
        critic = [seen]
        if self.config.critic_sees_error:
            error = self.reference.features[recording, time] - s["history"][-1]
            to_heading = world_rotation(s["history"][-1, 8], self.robot.anchored).T
            critic += [to_heading @ error[:3], to_heading @ error[3:6], wrap_angle(error[6:9])]
        return {"state": seen + noise, "critic": jnp.concatenate([*critic, commands.ravel()])}


def recorded_inputs(
    reference: Reference, config: EnvMimicConfig, anchored: bool = False
) -> Float[Array, "states inputs"]:
    """What the policy would see of every recorded state."""

    def inputs(recording: Array, time: Array) -> Array:
        history = jax.lax.dynamic_slice_in_dim(reference.features[recording], time - HISTORY + 1, HISTORY)
        return policy_input(history, commands_seen(reference.command[recording], time), config, anchored)

    steps = np.asarray(reference.steps)
    pairs = np.array([(r, k) for r, count in enumerate(steps) for k in range(HISTORY - 1, count)])
    return jax.jit(jax.vmap(inputs))(*jnp.array(pairs).T)


def commands_seen(commands: Float[Array, "steps commands"], time: Int[Array, ""]) -> Float[Array, "3 commands"]:
    """The commands of the last two control steps and the coming one."""
    start = jnp.clip(time - HISTORY + 1, 0, commands.shape[0] - HISTORY)
    return jax.lax.dynamic_slice_in_dim(commands, start, HISTORY)


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
