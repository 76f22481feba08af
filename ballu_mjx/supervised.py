"""Residual forces by regression, the paper's baseline: which force explains each recorded control step, and a network
for it.

One control step alone says nothing: half a millimetre of motion capture's noise over 0.05 s looks like a tenth of a
newton, and the forces sought are hundredths. A label is therefore the smoothest, smallest force over a whole window
that makes its simulation pass through the recorded motion, with the starting state free within what reconstruction
leaves uncertain. Simulated without force and linearized, a window is a small least-squares problem with a prior.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax
from jaxtyping import Array, Float

from ballu_mjx import envmimic, robot_description, windows
from ballu_mjx.errors import InputError
from ballu_mjx.linearization import FORCE, Linearized
from ballu_mjx.windows import Windows


@dataclasses.dataclass(frozen=True)
class SupervisedConfig:
    """Labels and regression."""

    window_seconds: float = 2.0
    """Length of the windows that labels come from, s."""
    interval_seconds: float = 2.0
    """Time between the starts of two windows, s."""
    force_spread: float = 0.05
    """Standard deviation of the prior on the force along each axis, N."""
    force_change: float = 0.01
    """Standard deviation of the prior on how it changes from one control step to the next, N: this smooths labels."""
    position_noise: float = 0.002
    """Standard deviation of the recorded balloon's position about the explained motion, m: capture and what a force on
    the balloon cannot explain."""
    angle_noise: float = 0.5
    """Likewise of its orientation, deg."""
    observation_noise: float = 0.3
    """Noise on what the network sees in training, in multiples of each entry's spread over the recordings."""
    updates: int = 4000
    """Gradient steps."""
    validate_every: int = 200
    """Gradient steps between two looks at the validation recordings' labels, whose smallest error ends the search."""
    batch_size: int = 256
    """Labels in a gradient step."""
    learning_rate: float = 1e-3
    """Adam's."""
    seed: int = 0
    """Seeds network and batches."""


def check(config: SupervisedConfig) -> None:
    """**Raises** `InputError` for options out of range, naming the option."""
    windows.check(config.window_seconds, config.interval_seconds)
    positive = ("force_spread", "force_change", "position_noise", "angle_noise", "learning_rate")
    for name in (*positive, "updates", "validate_every", "batch_size"):
        if not getattr(config, name) > 0:
            raise InputError(f"--{name.replace('_', '-')} is {getattr(config, name)}: it must be greater than 0.")


def labels(
    model: mujoco.MjModel, recorded: Windows, linearized: Linearized, config: SupervisedConfig
) -> Float[np.ndarray, "windows windowsteps 3"]:
    """The force (N, world) over each control step that explains the recorded windows.

    `linearized` holds the control steps of the windows' simulation without force, window after window.
    """
    count, steps = recorded.features.shape[:2]
    features, state, seen = (np.asarray(x, np.float64).reshape(count, steps, *x.shape[1:]) for x in linearized)
    free = state.shape[2]
    unknowns = free + FORCE * steps
    noise = np.array([config.position_noise] * 3 + [np.deg2rad(config.angle_noise)] * 3)
    pose = np.r_[0:3, 6:9]
    difference = (recorded.features - features)[:, :, pose]
    difference[..., 3:] = np.arctan2(np.sin(difference[..., 3:]), np.cos(difference[..., 3:]))

    prior = np.zeros((unknowns, unknowns))
    start_spread = envmimic.start_spread(model, robot_description.ballu())
    prior[:free, :free] = np.diag(1 / start_spread**2)
    change = np.diff(np.eye(steps), axis=0)
    prior[free:, free:] = np.kron(
        np.eye(steps) / config.force_spread**2 + change.T @ change / config.force_change**2, np.eye(FORCE)
    )
    hessian, gradient = np.tile(prior, (count, 1, 1)), np.zeros((count, unknowns))
    moved = np.tile(np.eye(free, unknowns), (count, 1, 1))  # the state before a step, by the unknowns
    for step in range(steps):
        force = np.zeros((FORCE, unknowns))
        force[:, free + FORCE * step : free + FORCE * (step + 1)] = np.eye(FORCE)
        both = np.concatenate([moved, np.tile(force, (count, 1, 1))], axis=1)
        rows = seen[:, step, pose] @ both / noise[:, None]
        hessian += rows.transpose(0, 2, 1) @ rows
        gradient += np.einsum("wru,wr->wu", rows, difference[:, step] / noise)
        moved = state[:, step] @ both
    solved = np.linalg.solve(hessian, gradient[..., None])[..., 0]
    return solved[:, free:].reshape(count, steps, FORCE)


def examples(
    recorded: Windows, force: Float[np.ndarray, "windows windowsteps 3"], config: envmimic.EnvMimicConfig
) -> tuple[Float[np.ndarray, "examples inputs"], Float[np.ndarray, "examples 3"]]:
    """What the network sees of each recorded state, and the action (see `envmimic.world_force`) that is its label."""
    history = envmimic.HISTORY
    steps = recorded.features.shape[1]

    def one(window: Windows, force: Array) -> tuple[Array, Array]:
        seen = jnp.concatenate([window.history, window.features])

        def at(time: Array) -> tuple[Array, Array]:
            past = jax.lax.dynamic_slice_in_dim(seen, time, history)
            commands = jax.lax.dynamic_slice_in_dim(window.commands, time, history)
            turned = envmimic.heading_rotation(past[-1, 8]).T @ force[time]
            return envmimic.policy_input(past, commands, config), turned / config.force_scale

        return jax.vmap(at)(jnp.arange(steps))

    inputs, actions = windows.spread(one, shared=0)(recorded, np.asarray(force, np.float32))
    return inputs.reshape(-1, inputs.shape[-1]), actions.reshape(-1, FORCE)


Validate = Callable[[int, Any, float], None]
"""(gradient steps so far, the policy network's parameters, mean squared error of training since the last)."""


def regress(
    infer: Callable[[Any, Float[Array, "batch inputs"]], Float[Array, "batch 3"]],
    start: Any,
    learned: tuple[Float[np.ndarray, "examples inputs"], Float[np.ndarray, "examples 3"]],
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
