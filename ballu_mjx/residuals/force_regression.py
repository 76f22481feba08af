"""Residual forces by regression, the paper's baseline: labels for the recorded control steps, and a network for them.

A label is the force that explains a recorded control step. A single control step determines it poorly: motion-capture
noise of 0.5 mm over 0.05 s looks like 0.1 N. Moreover, the force is not the only difference between a recorded and a
simulated step: actuators are late, contacts slip, and air rotates the tracked body.

A label is therefore the most likely force given the whole recording. Recorded positions, joint torques and the
simulated motion have errors too. This is a smoothing problem, linearized along the recorded motion.
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
    """Options of the labels and of the regression."""

    force_spread: float | None = None
    """Standard deviation of the prior on the force along each axis, N. Other loads have the same prior in units of the
    network's output. Without this option: 6 units."""
    force_change: float | None = None
    """Standard deviation of the prior on the change of the force between two control steps, N. Smaller values smooth
    the labels. They also remove most of the force by which dragged-along air pushes a body back at every contact.
    Without this option: 2 units."""
    torque_spread: float | None = None
    """Standard deviation of the joint torques that the model lacks, N m. Without this option: the largest RMS torque
    that the model leaves unexplained at a joint in the training recordings."""
    slide_force_spread: float | None = None
    """Standard deviation of the forces along slides that the model lacks, N. Without this option: the largest RMS force
    that the model leaves unexplained along a slide in the training recordings."""
    position_noise: float = 0.0005
    """Standard deviation of the error of recorded positions, m."""
    angle_noise: float = 0.3
    """Standard deviation of the error of recorded angles, deg."""
    held_angle_noise: float = 10.0
    """Standard deviation of the error of the angles of held joints, which motion capture hardly measures, deg."""
    velocity_noise: float = 0.01
    """Standard deviation of the change of the root's velocity in a control step that neither loads nor joint torques
    explain, m/s."""
    rotation_noise: float = 3.0
    """Standard deviation of the same unexplained change of the angular velocities of the bodies from the root to the
    tracked body, deg/s."""
    joint_noise: float = 20.0
    """Standard deviation of the same unexplained change of the angular velocities of all other joints, deg/s."""
    observation_noise: tuple[float, ...] = (0.1, 0.3, 1.0)
    """Standard deviations of noise on the network's input in training, in multiples of each input's standard deviation
    over the recordings. A network is fitted for each of them. The one with the smallest open-loop error on the
    validation recordings is kept. Noise helps where recordings are few, and hides forces that change fast, such as dry
    friction."""
    updates: int = 4000
    """Number of gradient steps."""
    validate_every: int = 200
    """Gradient steps between two validations on the labels of the validation recordings. The network with the smallest
    error there is kept."""
    batch_size: int = 256
    """Number of labels in a gradient step."""
    learning_rate: float = 1e-3
    """Learning rate of Adam."""
    force_shares: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0)
    """Shares of the forces to try (0 to 1). The share with the smallest open-loop error on the validation recordings is
    kept, because forces that are right in recorded states may be wrong in simulated states. `--force-shares 1` keeps
    the whole forces, as in the paper."""
    seed: int = 0
    """Seed of the network's initial parameters and of the batches."""


def check_supervised_config(config: SupervisedConfig) -> None:
    """Check options.

    **Raises** `InputError` for an option out of range. The message names it.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if value is None or field.name in ("observation_noise", "force_shares", "seed"):
            continue
        if not value > 0:
            raise InputError(f"--{field.name.replace('_', '-')} is {value}: it must be greater than 0.")
    if not config.observation_noise or not all(noise >= 0.0 for noise in config.observation_noise):
        given = " ".join(map(str, config.observation_noise))
        raise InputError(f"--observation-noise is {given}: give one or more numbers of 0 or more.")
    if not config.force_shares or not all(0.0 <= share <= 1.0 for share in config.force_shares):
        raise InputError(f"--force-shares is {' '.join(map(str, config.force_shares))}: give one or more from 0 to 1.")


class _Priors(NamedTuple):
    """Standard deviations of the priors."""

    spread: float
    """Of forces (N)."""
    change: float
    """Of the change of forces in a control step (N)."""
    torque: float | None
    """Of joint torques (N m). None if unknown."""
    slide_force: float | None
    """Of forces along slides (N). None if unknown."""


def _priors(config: SupervisedConfig, unit: float) -> _Priors:
    """Return the priors of the options, or else in units (N) of the network's output."""
    spread, change = config.force_spread, config.force_change
    return _Priors(
        _SPREAD * unit if spread is None else spread,
        _CHANGE * unit if change is None else change,
        config.torque_spread,
        config.slide_force_spread,
    )


_SPREAD, _CHANGE = 6.0, 2.0
"""Standard deviations of the priors on forces and on their change, in units of the network's output."""


class ForceLabeller:
    """Estimator of the loads that explain recorded motions."""

    def __init__(
        self,
        linearize: Linearizer,
        config: SupervisedConfig,
        env: ForceNetworkConfig | None = None,
    ) -> None:
        """Prepare the estimation.

        **Arguments**

        - `linearize`: linearization of the robot's simulator, for the loads of the network's force set and for joint
          torques. If the simulator has a residual, the labels are the loads in addition to it.
        - `config`: options of the labels.
        - `env`: options of the network's output. None for the defaults.
        """
        env = env or ForceNetworkConfig()
        self._simulator = linearize.simulator.simulator
        self._model, self._linearize = self._simulator.mj_model, linearize
        scales = load_scales(env, self._simulator.robot)
        self._in_newtons = scales.units / scales.newtons
        self._priors = _priors(config, scales.newtons)
        slides = translations(self._model)[linearize.joint_directions]
        options = {"torque_spread": self._priors.torque, "slide_force_spread": self._priors.slide_force}
        for there, (name, value) in zip((not slides.all(), bool(slides.any())), options.items(), strict=True):
            if there and value is None:
                raise ValueError(f"The spread of what the model lacks at joints is unknown; set {name}.")
        self._at_joints = np.where(slides, self._priors.slide_force or 0.0, self._priors.torque or 0.0)
        self._measured, self._process = _noise(self._model, self._simulator.robot, config)

    def __call__(self, motion: Motion) -> Float[np.ndarray, "steps loads"]:
        """Return the loads (N, N m, commands' units; world frame) that explain each control step of a motion."""
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
        """Return the most likely loads of all control steps of a recording, to first order.

        `defect` is the difference between the simulated and the recorded state after each step. The unknowns at each
        time are the deviation of the state from the recorded state, and the inputs of the step. Each time is coupled
        only to the next, so one banded factorization solves for a whole recording.
        """
        (count, after, every), loads = state.shape, self._linearize.loads
        force = np.arange(after, after + loads)
        known = np.any(state, axis=(1, 2), keepdims=True)[:, 0]  # The linearizer returns zeros without derivatives.
        weight, defect = known / self._process**2, np.where(known, defect, 0.0)  # A diverged step has a defect of NaN.
        spread = np.r_[
            self._measured,
            np.full(self._model.nv, _ANY_VELOCITY),
            self._priors.spread * self._in_newtons,
            self._at_joints,
        ]
        here = np.tile(np.diag(spread**-2.0), (count + 1, 1, 1))
        here[:-1] += state.transpose(0, 2, 1) @ (weight[:, :, None] * state)
        here[1:, range(after), range(after)] += weight
        coupling = np.zeros_like(here)  # Rows belong to the next time, columns to this time.
        coupling[:-1, :after] -= weight[:, :, None] * state
        change = (self._priors.change * self._in_newtons) ** -2.0
        here[:-1, force, force] += change
        here[1:, force, force] += change
        coupling[:-1, force, force] -= change
        right = np.zeros((count + 1, every))
        right[:-1] -= np.einsum("tsd,ts->td", state, weight * defect)
        right[1:, :after] += weight * defect

        columns = np.concatenate([here, coupling], axis=1)
        lower = np.zeros((2 * every, count + 1, every))
        for place in range(every):
            lower[: 2 * every - place, :, place] = columns[:, place:, place].T
        found = scipy.linalg.solveh_banded(lower.reshape(2 * every, -1), right.ravel(), lower=True)
        return found.reshape(count + 1, every)[:-1, force]


_ANY_VELOCITY = 10.0
"""Standard deviation of the error of recorded velocities (m/s, rad/s). It is large, because these velocities are
derived from recorded positions and carry no further information."""


def _noise(
    model: mujoco.MjModel, robot: RobotDescription, config: SupervisedConfig
) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " 2*nv"]]:
    """Return the standard deviations of errors of recorded positions, and of unexplained changes in a control step.

    Both are along the directions of `mjx.Data.qvel`. The second has the changes of positions, then those of velocities.
    Slides count as translations. Held slides have a larger error than other slides, by the same factor as held hinges.
    """
    degree = np.pi / 180
    trunk, body = [], int(model.site_bodyid[model.site(robot.tracked).id])
    while body:  # From the tracked body down to the root.
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
    """Return examples for the regression, one for each recorded state that has a history.

    **Returns** the inputs of the network, and the labels as outputs of the network (see `network_loads.world_loads`).
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
"""Function of the number of gradient steps so far, the parameters of the policy network, and the mean squared training
error since the last call."""


def regress(
    infer: Callable[[Any, Float[Array, "batch inputs"]], Float[Array, "batch loads"]],
    start: Any,
    learned: tuple[Float[np.ndarray, "examples inputs"], Float[np.ndarray, "examples loads"]],
    config: SupervisedConfig,
    noise: float,
    validate: Validate,
) -> None:
    """Fit the parameters of a network to examples by least squares.

    **Arguments**

    - `infer`: function of parameters and inputs that returns the network's outputs.
    - `start`: initial parameters.
    - `learned`: inputs and outputs to learn, from `examples`.
    - `config`: options of the regression.
    - `noise`: one of `config.observation_noise`.
    - `validate`: function that is called every `config.validate_every` gradient steps.
    """
    inputs, actions = learned
    optimizer = optax.adam(config.learning_rate)
    spread = np.std(inputs, axis=0)

    @jax.jit
    def some(carry: tuple, keys: Array) -> tuple[tuple, Array]:
        def update(carry: tuple, key: Array) -> tuple[tuple, Array]:
            params, state = carry
            key_choice, key_noise = jax.random.split(key)
            chosen = jax.random.randint(key_choice, (config.batch_size,), 0, len(inputs))
            errors = noise * spread * jax.random.normal(key_noise, (config.batch_size, len(spread)))
            seen = jnp.asarray(inputs)[chosen] + errors

            def error(params: Any) -> Array:
                return jnp.mean((infer(params, seen) - jnp.asarray(actions)[chosen]) ** 2)

            value, gradient = jax.value_and_grad(error)(params)
            change, state = optimizer.update(gradient, state, params)
            return (optax.apply_updates(params, change), state), value

        return jax.lax.scan(update, carry, keys)

    carry, key = (start, optimizer.init(start)), jax.random.key(config.seed)
    for done in range(0, config.updates, config.validate_every):
        key, own = jax.random.split(key)
        count = min(config.validate_every, config.updates - done)
        carry, values = some(carry, jax.random.split(own, count))
        validate(done + count, carry[0], float(jnp.mean(values)))
