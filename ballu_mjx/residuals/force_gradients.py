"""Residual forces by the gradient of the tracking error through the simulation.

Windows of the recordings are simulated with the network's forces, and each control step is linearized
(`sim.linearize`). Backpropagation through these derivatives is backpropagation through the accurate simulator,
contacts included. For small changes of the forces, the linearized windows remain valid, so one simulation serves
several gradient steps. Then other windows are simulated and linearized.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion_windows import MotionWindows, check_motion_windows, start_motion_window
from ballu_mjx.recordings.window_errors import pseudo_huber, window_errors
from ballu_mjx.residuals.envmimic import start_spread
from ballu_mjx.residuals.network import NetworkResidual
from ballu_mjx.residuals.network_loads import square_newtons
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.force_sets import FORCE_SETS
from ballu_mjx.sim.linearize import ControlSteps, Linearized, Linearizer
from ballu_mjx.sim.observation import HISTORY, ObservationLayout
from ballu_mjx.sim.sharding import shard_over_devices
from ballu_mjx.sim.simulator import AugmentedSimulator, RolloutState


@dataclasses.dataclass(frozen=True)
class AnalyticConfig:
    """Options of learning by gradients through the simulation."""

    window_seconds: float | None = None
    """Length of a window, s. Without this option: 8 s, or the longest of the robot's declared horizons if this is
    shorter. Errors that saturate within a window have no useful gradient."""
    interval_seconds: float | None = None
    """Time between the starts of two windows, s. Without this option: the length of a window."""
    relinearizations: int = 8
    """Number of simulations. Each simulation is followed by a linearization and `updates` gradient steps."""
    windows: int = 16
    """Number of windows in a simulation, drawn anew for each simulation."""
    updates: int = 20
    """Gradient steps after each linearization. Each uses all windows of the simulation."""
    validate_every: int = 20
    """Gradient steps between two validations, at most. Each validation saves a checkpoint."""
    learning_rate: float = 1e-3
    """Learning rate of Adam."""
    max_grad_norm: float = 1.0
    """Largest norm of a gradient; longer gradients are scaled down to it. Contacts make the derivatives of some windows
    a thousand times larger than those of others."""
    averaging: int = 50
    """Time constant of the exponential average of the network's parameters, in gradient steps. The averaged network is
    validated and saved."""
    force_cost: float = 0.0
    """Cost of force, in loss per N^2."""
    observation_noise: float = 1.0
    """Standard deviation of noise on the network's input in training, in multiples of each input's standard deviation
    over the recordings."""
    start_noise: float = 0.0
    """Perturbation of a window's first state, in multiples of the uncertainty of the reconstruction."""
    seed: int = 0
    """Seed of the network's initial parameters, of the choice of windows, and of the noise."""


_WINDOW_SECONDS = 8.0
"""Default length of a window (s) for a robot that does not declare shorter horizons."""


def resolve_windows(config: AnalyticConfig, robot: RobotDescription) -> AnalyticConfig:
    """Return the options with numbers for the windows' length and interval."""
    window = config.window_seconds
    if window is None:
        longest = max(robot.horizons, default=_WINDOW_SECONDS)
        window = max(min(_WINDOW_SECONDS, longest), 2 * robot.control_timestep)
    interval = window if config.interval_seconds is None else config.interval_seconds
    return dataclasses.replace(config, window_seconds=window, interval_seconds=interval)


def check_analytic_config(config: AnalyticConfig, control_timestep: float) -> None:
    """Check resolved options for a robot with a control step of `control_timestep` (s).

    **Raises** `InputError` for an option out of range. The message names it.
    """
    assert config.window_seconds is not None and config.interval_seconds is not None, "Resolved."
    check_motion_windows(config.window_seconds, config.interval_seconds, control_timestep)
    positive = "relinearizations", "windows", "updates", "validate_every", "learning_rate", "max_grad_norm", "averaging"
    for name in positive:
        if not getattr(config, name) > 0:
            raise InputError(f"--{name.replace('_', '-')} is {getattr(config, name)}: it must be greater than 0.")


def compile_rollout(
    simulator: AugmentedSimulator, forces: NetworkResidual
) -> Callable[[Any, MotionWindows], tuple[ControlSteps, Float[np.ndarray, "windows windowsteps features"]]]:
    """Return a compiled function that simulates windows in `simulator` under the loads of `forces`.

    The function takes the parameters of `forces` and the windows. It returns the control steps of all windows in one
    axis, window after window, and the features after each control step.
    """

    def run(params: Any, window: MotionWindows) -> tuple[ControlSteps, Array]:
        def step(state: RolloutState, command: Array) -> tuple[RolloutState, tuple[ControlSteps, Array]]:
            seen = forces.inputs(state.history, state.with_command(command))
            loads = forces.loads(params, seen, state.features[ObservationLayout.yaw])
            action = FORCE_SETS[forces.config.forces].act(loads, forces.robot)
            after = simulator.step(state, command, action).state
            return after, (ControlSteps(state, command, loads), after.features)

        return jax.lax.scan(step, *start_motion_window(window))[1]

    spread = shard_over_devices(run, shared=1)

    def whole(params: Any, recorded: MotionWindows) -> tuple[ControlSteps, np.ndarray]:
        steps, features = spread(params, recorded)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), steps), features

    return whole


Report = Callable[[int, Any, dict[str, float]], None]
"""Function of the number of gradient steps so far, the averaged parameters, and metrics."""


def train(
    forces: NetworkResidual,
    wrap: Callable[[Any], Any],
    start: Any,
    recorded: MotionWindows,
    spread: Float[np.ndarray, " inputs"],
    config: AnalyticConfig,
    report: Report,
    linearize: Linearizer,
) -> None:
    """Learn the parameters of `forces`.

    **Arguments**

    - `forces`: the network.
    - `wrap`: function that turns the learned parameters into parameters of `forces`.
    - `start`: initial values of the learned parameters.
    - `recorded`: windows of the training recordings.
    - `spread`: standard deviation of each input of the network over the recordings.
    - `config`: options of the method.
    - `report`: function that is called every `config.validate_every` gradient steps.
    - `linearize`: linearization of the simulator to correct, including its base residual, for the force set of
      `forces`. Derivatives with respect to joint torques are ignored.

    Windows that diverge are left out of the gradient steps and of the loss.

    **Raises** `InputError` if all windows of a simulation diverge.
    """
    simulate = compile_rollout(linearize.simulator, forces)
    optimizer = optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(config.learning_rate))
    plain = linearize.simulator.simulator
    starts = start_spread(plain.mj_model, plain.robot)
    update = _updates(forces, wrap, optimizer, spread, starts, config, plain.robot)
    carry = (start, optimizer.init(start), start)
    key = jax.random.key(config.seed)
    done = simulated = 0
    for _ in range(config.relinearizations):
        key, own = jax.random.split(key)
        drawn = np.asarray(jax.random.permutation(own, len(recorded.qpos)))[: config.windows]
        taken = jax.tree.map(lambda x, drawn=drawn: np.asarray(x)[drawn], recorded)
        steps, features = simulate(wrap(jax.device_get(carry[0])), taken)
        losses = np.asarray(jax.vmap(functools.partial(_loss, robot=plain.robot))(features, taken.features))
        data = _in_windows(linearize(steps), steps.loads, taken)
        simulated += len(steps.loads) * (2 + linearize.directions)
        finite = np.flatnonzero(np.isfinite(losses) & _are_finite(data))
        if not len(finite):
            raise InputError(
                f"All {len(losses)} windows of the training recordings diverge in simulation after {done} gradient "
                "steps; give a smaller --learning-rate or --window-seconds."
            )
        rows = np.resize(finite, len(losses))  # Others replace diverged windows: a compiled program has a fixed size.
        data = jax.tree.map(lambda x, rows=rows: x[rows], data)
        loss = float(np.mean(losses[finite]))
        for first in range(0, config.updates, config.validate_every):
            key, own = jax.random.split(key)
            count = min(config.validate_every, config.updates - first)
            carry, (linear, gradient) = update(carry, jax.random.split(own, count), data)
            done += count
            found = {"loss": loss, "linear_loss": float(jnp.mean(linear)), "gradient": float(jnp.median(gradient))}
            report(done, jax.device_get(carry[2]), {**found, "control_steps": simulated})


def _in_windows(
    linearized: Linearized, loads: Float[Array | np.ndarray, "steps loads"], recorded: MotionWindows
) -> tuple[Linearized, Float[Array, "windows windowsteps loads"], MotionWindows]:
    """Return linearized control steps and loads with separate axes of windows and steps, and the windows as arrays."""
    shape, inputs = recorded.features.shape[:2], linearized.state.shape[1] + loads.shape[1]
    linearized = linearized._replace(state=linearized.state[..., :inputs], seen=linearized.seen[..., :inputs])
    parts = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32).reshape(*shape, *x.shape[1:]), (linearized, loads))
    return *parts, jax.tree.map(jnp.asarray, recorded)


def _are_finite(data: Any) -> Bool[np.ndarray, " windows"]:
    """Return for each window whether all its numbers are finite. Windows are the first axis of all arrays."""
    parts = [np.isfinite(np.asarray(x)).reshape(len(x), -1).all(axis=1) for x in jax.tree.leaves(data)]
    return np.all(parts, axis=0)


def _loss(
    features: Float[Array | np.ndarray, "windowsteps features"],
    recorded: Float[Array | np.ndarray, "windowsteps features"],
    robot: RobotDescription,
) -> Float[Array, ""]:
    """Return the pseudo-Huber loss of the error of a whole window."""
    return pseudo_huber(jnp.sum(window_errors(features, recorded, robot) ** 2))


def _updates(
    forces: NetworkResidual,
    wrap: Callable[[Any], Any],
    optimizer: optax.GradientTransformation,
    spread: Float[np.ndarray, " inputs"],
    start_spread: Float[np.ndarray, " directions"],
    config: AnalyticConfig,
    robot: RobotDescription,
) -> Callable[..., Any]:
    """Return a compiled function that makes gradient steps on linearized windows, one for each random key."""

    def window_loss(
        params: Any, key: Array, linear: Linearized, about: Float[Array, "windowsteps loads"], window: MotionWindows
    ) -> tuple[Array, Array]:
        key_start, key_noise = jax.random.split(key)
        first = config.start_noise * start_spread * jax.random.normal(key_start, start_spread.shape)

        def step(carry: tuple, inputs: tuple) -> tuple[tuple, tuple]:
            moved, history = carry
            linear, about, time, key = inputs
            commands = jax.lax.dynamic_slice_in_dim(window.commands, time, HISTORY)
            noise = config.observation_noise * spread * jax.random.normal(key, spread.shape)
            loads = forces.loads(
                wrap(params), forces.inputs(history, commands) + noise, history[-1, ObservationLayout.yaw]
            )
            both = jnp.concatenate([moved, loads - about])
            features = linear.features + linear.seen @ both
            return (linear.state @ both, jnp.concatenate([history[1:], features[None]])), (features, loads)

        steps = len(window.features)
        through = linear, about, jnp.arange(steps), jax.random.split(key_noise, steps)
        _, (features, loads) = jax.lax.scan(step, (first, window.history), through)
        tracking = _loss(features, window.features, robot)
        return tracking + config.force_cost * jnp.mean(square_newtons(loads, forces.config, robot)), tracking

    @jax.jit
    def some(carry: tuple, keys: Array, data: tuple) -> tuple[tuple, tuple]:
        count = len(data[1])

        def update(carry: tuple, key: Array) -> tuple[tuple, tuple]:
            params, state, average = carry

            def loss(params: Any) -> tuple[Array, Array]:
                both = jax.vmap(lambda key, *own: window_loss(params, key, *own))(jax.random.split(key, count), *data)
                return jnp.mean(both[0]), jnp.mean(both[1])

            (_, tracking), gradient = jax.value_and_grad(loss, has_aux=True)(params)
            change, state = optimizer.update(gradient, state, params)
            params = optax.apply_updates(params, change)
            average = jax.tree.map(lambda a, p: a + (p - a) / config.averaging, average, params)
            return (params, state, average), (tracking, optax.tree.norm(gradient))

        return jax.lax.scan(update, carry, keys)

    return some
