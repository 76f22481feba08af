"""Residual forces by regression, the paper's baseline: which force explains each recorded control step, and a network
for it.

One control step alone says little: half a millimetre of motion capture's noise over 0.05 s looks like a tenth of a
newton. And not all that a recorded step differs in from the simulated one is a matter of the force: actuators are late,
contacts slip, air turns the tracked body. A label is therefore the most likely force given the whole recording, where
capture, joints' torques and the motion itself err as well: a smoothing problem, linear along the recorded motion.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax
import scipy.linalg
from jaxtyping import Array, Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_input import recorded_inputs
from ballu_mjx.residuals.network_loads import force_frame, load_scales, load_units
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.coordinates import translations
from ballu_mjx.sim.force_sets import FORCE_SETS
from ballu_mjx.sim.linearize import ControlSteps, Linearizer, step_defects
from ballu_mjx.sim.observation import HISTORY, ObservationLayout
from ballu_mjx.sim.simulator import RolloutState, Simulator
from ballu_mjx.sim.step import state_at


@dataclasses.dataclass(frozen=True)
class SupervisedConfig:
    """Labels and regression."""

    force_spread: float | None = None
    """Standard deviation of the prior on the force along each axis, N. That on another load is, in units of the
    network's output, as wide. Without this option: the robot's own, or 6 units."""
    force_change: float | None = None
    """Standard deviation of the prior on how it changes from one control step to the next, N. A body that drags air
    along is pushed back at every contact: a smoother prior removes most of that force. Without this option: the robot's
    own, or 2 units."""
    torque_spread: float | None = None
    """Standard deviation of what the robot's joints pull beyond the model, N m. Without this option: the robot's own,
    or the size of what the model leaves unexplained at joints in the training recordings."""
    position_noise: float = 0.0005
    """Standard deviation of the recorded place, m."""
    angle_noise: float = 0.3
    """Likewise of recorded angles, deg."""
    held_angle_noise: float = 10.0
    """Likewise of the robot's held joints, which motion capture hardly shows, deg."""
    velocity_noise: float = 0.01
    """Standard deviation of what a control step changes the root's velocity by beyond all this, m/s."""
    rotation_noise: float = 3.0
    """Likewise of angular velocities from the root to the tracked body, deg/s."""
    joint_noise: float = 20.0
    """Likewise of all other joints, deg/s."""
    observation_noise: float = 1.0
    """Noise on what the network sees in training, in multiples of each entry's spread over the recordings."""
    updates: int = 4000
    """Gradient steps."""
    validate_every: int = 200
    """Gradient steps between two looks at the validation recordings' labels, whose smallest error ends the search."""
    batch_size: int = 256
    """Labels in a gradient step."""
    learning_rate: float = 1e-3
    """Adam's."""
    force_scales: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0)
    """Fractions of the forces, of which the one that acts is chosen: whose simulation follows the validation recordings
    best. A force that is right in recorded states may lead astray in simulated ones. `--force-scales 1`: all of them,
    as in the paper."""
    seed: int = 0
    """Seeds network and batches."""


def check_supervised_config(config: SupervisedConfig) -> None:
    """**Raises** `InputError` for options out of range, naming the option."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if value is None or field.name in ("observation_noise", "force_scales", "seed"):
            continue
        if not value > 0:
            raise InputError(f"--{field.name.replace('_', '-')} is {value}: it must be greater than 0.")
    if not config.force_scales or not all(0.0 <= scale <= 1.0 for scale in config.force_scales):
        raise InputError(f"--force-scales is {' '.join(map(str, config.force_scales))}: give one or more from 0 to 1.")


class _Priors(NamedTuple):
    """Standard deviations: of forces, of their change in a control step (N), of joints' torques (N m)."""

    spread: float
    change: float
    torque: float | None


def _priors(config: SupervisedConfig, unit: float, robot: RobotDescription) -> _Priors:
    own = robot.adapter.residual_scales()
    names = "force_spread", "force_change", "torque_spread"
    given = [getattr(own, name, None) if getattr(config, name) is None else getattr(config, name) for name in names]
    spread, change, torque = given
    return _Priors(_SPREAD * unit if spread is None else spread, _CHANGE * unit if change is None else change, torque)


_SPREAD, _CHANGE = 6.0, 2.0
"""Of the priors, in units of the network's output."""


class ForceLabeller:
    """Labels recorded motions."""

    def __init__(
        self,
        linearize: Linearizer,
        config: SupervisedConfig,
        env: ForceNetworkConfig | None = None,
    ) -> None:
        """Prepare to label motions of the robot that `linearize` simulates.

        `linearize` has the network's force set, and the torques of the robot's joints; where its simulator has a
        residual, labels are what that leaves. `env` is of the network to be (None: its defaults).
        """
        env = env or ForceNetworkConfig()
        self._simulator = linearize.simulator.simulator
        self._model, self._linearize = self._simulator.mj_model, linearize
        scales = load_scales(env, self._simulator.robot)
        self._in_newtons = scales.units / scales.newtons
        self._priors = _priors(config, scales.newtons, self._simulator.robot)
        if self._priors.torque is None and linearize.directions > 2 * self._model.nv + linearize.loads:
            raise ValueError("Nothing tells the spread of the joints' torques; give torque_spread.")
        self._measured, self._process = _noise(self._model, self._simulator.robot, config)

    def __call__(self, motion: Motion) -> Float[np.ndarray, "steps loads"]:
        """The loads (N, N m; world) over each control step that explain the recorded motion."""
        count, past = len(motion.command), HISTORY - 1
        reference, _ = stack_motions(self._simulator, [motion])
        states = state_at(reference.qpos[0, :-1], reference.qvel[0, :-1])
        history, commands = (
            np.lib.stride_tricks.sliding_window_view(
                np.pad(x, [(past, 0), (0, 0)], mode="edge"), HISTORY, axis=0
            ).swapaxes(1, 2)
            for x in (np.asarray(reference.features[0, :-1]), motion.command)
        )
        drivetrain = jax.tree.map(lambda x: x[0], reference.drivetrain)
        rollout = RolloutState(states, jnp.asarray(history), jnp.asarray(commands[:, :past]), drivetrain)
        loads = np.zeros((count, self._linearize.loads))
        linear = self._linearize(ControlSteps(rollout, commands[:, past], loads))
        defect = step_defects(self._model, linear, motion.qpos[1:], motion.qvel[1:])
        return self._explain(np.asarray(linear.state, np.float64), defect)

    def _explain(
        self, state: Float[np.ndarray, "steps states directions"], defect: Float[np.ndarray, "steps states"]
    ) -> Float[np.ndarray, "steps loads"]:
        """The most likely loads of control steps that end `defect` off the recorded state after, to first order.

        Unknown at each time are the state's deviation from the recorded one and the step's inputs; each time is tied to
        the next alone, so that one banded factorization solves for a whole recording.
        """
        (count, after, every), loads = state.shape, self._linearize.loads
        force = np.arange(after, after + loads)
        known = np.any(state, axis=(1, 2), keepdims=True)[:, 0]  # zeros where there are no derivatives
        weight = known / self._process**2
        spread = np.r_[
            self._measured,
            np.full(self._model.nv, _ANY_VELOCITY),
            self._priors.spread * self._in_newtons,
            np.full(every - after - loads, self._priors.torque),
        ]
        here = np.tile(np.diag(spread**-2.0), (count + 1, 1, 1))
        here[:-1] += state.transpose(0, 2, 1) @ (weight[:, :, None] * state)
        here[1:, range(after), range(after)] += weight
        towards = np.zeros_like(here)  # rows of the time after, columns of this one
        towards[:-1, :after] -= weight[:, :, None] * state
        change = (self._priors.change * self._in_newtons) ** -2.0
        here[:-1, force, force] += change
        here[1:, force, force] += change
        towards[:-1, force, force] -= change
        right = np.zeros((count + 1, every))
        right[:-1] -= np.einsum("tsd,ts->td", state, weight * defect)
        right[1:, :after] += weight * defect

        columns = np.concatenate([here, towards], axis=1)
        lower = np.zeros((2 * every, count + 1, every))
        for place in range(every):
            lower[: 2 * every - place, :, place] = columns[:, place:, place].T
        found = scipy.linalg.solveh_banded(lower.reshape(2 * every, -1), right.ravel(), lower=True)
        return found.reshape(count + 1, every)[:-1, force]


_ANY_VELOCITY = 10.0
"""m/s and rad/s: recorded velocities are differences of recorded places, and say nothing of their own."""


def _noise(
    model: mujoco.MjModel, robot: RobotDescription, config: SupervisedConfig
) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " 2*nv"]]:
    """Return standard deviations of recorded positions, and of what a control step is off by beyond its inputs.

    Both are along the directions of `mjx.Data.qvel`, the second also along the velocities'. Slides count as
    translations. A held slide is as many times less certain than others as a held hinge.
    """
    degree = np.pi / 180
    trunk, body = [], int(model.site_bodyid[model.site(robot.tracked).id])
    while body:  # from the tracked body down to the root
        trunk.append(body)
        body = int(model.body_parentid[body])
    velocity = np.where(np.isin(model.dof_bodyid, trunk), config.rotation_noise, config.joint_noise) * degree
    measured = np.full(model.nv, config.angle_noise * degree)
    along = translations(model)
    velocity[along], measured[along] = config.velocity_noise, config.position_noise
    held = [model.joint(name).dofadr[0] for name in robot.held]
    measured[held] = np.where(
        along[held],
        config.position_noise * config.held_angle_noise / config.angle_noise,
        config.held_angle_noise * degree,
    )
    return measured, np.concatenate([velocity * model.opt.timestep, velocity])


def examples(
    simulator: Simulator,
    motions: Sequence[Motion],
    loads: Sequence[Float[np.ndarray, "steps loads"]],
    config: ForceNetworkConfig,
) -> tuple[Float[np.ndarray, "examples inputs"], Float[np.ndarray, "examples loads"]]:
    """Return what the network sees of each recorded state that has a history, and the action that is its label.

    Actions are those of `network_loads.world_loads`.
    """
    reference, _ = stack_motions(simulator, motions)
    first = HISTORY - 1
    inputs = np.asarray(recorded_inputs(reference, config, simulator.robot))
    units = load_units(config, simulator.robot)
    if not FORCE_SETS[config.forces].turns:
        return inputs, np.asarray(np.concatenate([each[first:] for each in loads]) / units, np.float32)
    headings = np.asarray(reference.features[..., ObservationLayout.yaw])
    yaw = [seen[first:count] for seen, count in zip(headings, reference.steps, strict=True)]
    labels = np.concatenate([each[first:] for each in loads])
    robot = simulator.robot
    to_world = np.asarray(jax.vmap(lambda yaw: force_frame(yaw, config, robot))(jnp.asarray(np.concatenate(yaw))))
    turned = np.einsum("nji,nvj->nvi", to_world, labels.reshape(len(labels), -1, 3)).reshape(labels.shape)
    return inputs, np.asarray(turned / units, np.float32)


Validate = Callable[[int, Any, float], None]
"""(gradient steps so far, the policy network's parameters, mean squared error of training since the last)."""


def regress(
    infer: Callable[[Any, Float[Array, "batch inputs"]], Float[Array, "batch loads"]],
    start: Any,
    learned: tuple[Float[np.ndarray, "examples inputs"], Float[np.ndarray, "examples loads"]],
    config: SupervisedConfig,
    validate: Validate,
) -> None:
    """Fit the parameters of `infer`, from `start`, to `examples` by squared error; every `validate_every` steps
    `validate` is told."""
    inputs, actions = learned
    optimizer = optax.adam(config.learning_rate)
    spread = np.std(inputs, axis=0)

    @jax.jit
    def some(carry: tuple, keys: Array) -> tuple[tuple, Array]:
        def update(carry: tuple, key: Array) -> tuple[tuple, Array]:
            params, state = carry
            key_choice, key_noise = jax.random.split(key)
            chosen = jax.random.randint(key_choice, (config.batch_size,), 0, len(inputs))
            noise = config.observation_noise * spread * jax.random.normal(key_noise, (config.batch_size, len(spread)))
            seen = jnp.asarray(inputs)[chosen] + noise

            def error(params: Any) -> Array:
                return jnp.mean((infer(params, seen) - jnp.asarray(actions)[chosen]) ** 2)

            value, slope = jax.value_and_grad(error)(params)
            change, state = optimizer.update(slope, state, params)
            return (optax.apply_updates(params, change), state), value

        return jax.lax.scan(update, carry, keys)

    carry, key = (start, optimizer.init(start)), jax.random.key(config.seed)
    for done in range(0, config.updates, config.validate_every):
        key, own = jax.random.split(key)
        count = min(config.validate_every, config.updates - done)
        carry, values = some(carry, jax.random.split(own, count))
        validate(done + count, carry[0], float(jnp.mean(values)))
