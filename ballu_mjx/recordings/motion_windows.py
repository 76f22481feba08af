"""Short windows of recorded motion, and their simulation. Residuals are fitted to them with derivatives.

A window starts in a recorded state and runs under the recorded commands. It is short, so that errors do not compound.
It is long enough for a force of hundredths of a newton to move the tracked body by more than the uncertainty of the
starting state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.recordings.window_errors import window_errors
from ballu_mjx.sim.drivetrain import DrivetrainState
from ballu_mjx.sim.observation import HISTORY
from ballu_mjx.sim.simulator import AugmentedSimulator, RolloutState, Simulator
from ballu_mjx.sim.step import state_at


class MotionWindows(NamedTuple):
    """Windows of recorded motions, each of `windowsteps` control steps."""

    qpos: Float[Array | np.ndarray, "windows nq"]
    """Generalized positions at the windows' starts."""
    qvel: Float[Array | np.ndarray, "windows nv"]
    """Generalized velocities at the windows' starts."""
    history: Float[Array | np.ndarray, "windows steps features"]
    """`observation.observe_features` of the first state and of the two states before it."""
    commands: Float[Array | np.ndarray, "windows allsteps commands"]
    """Commands, from two control steps before the window's start to its end."""
    features: Float[Array | np.ndarray, "windows windowsteps features"]
    """Recorded `observe_features` after each control step."""
    drivetrain: DrivetrainState | None = None
    """State of the drivetrain at the windows' starts. None if the simulator has no drivetrain."""


def check_motion_windows(window_seconds: float, interval_seconds: float, control_timestep: float) -> None:
    """Check that the windows' length and interval (s) are finite and at least two control steps.

    **Raises** `InputError` that names the option otherwise.
    """
    for name, value in (("--window-seconds", window_seconds), ("--interval-seconds", interval_seconds)):
        shortest = 2 * control_timestep
        if not shortest <= value < math.inf:
            raise InputError(
                f"{name} is {value:g} s; give a finite time of {shortest:g} s (two control steps) or more."
            )


def cut_motion_windows(
    simulator: Simulator, motions: Sequence[Motion], window_seconds: float, interval_seconds: float
) -> MotionWindows:
    """Return windows of `window_seconds` that start every `interval_seconds` in each motion.

    **Raises** `InputError` if no recording is as long as a window.
    """
    steps, every = (round(s / simulator.robot.control_timestep) for s in (window_seconds, interval_seconds))
    history = HISTORY
    places = [
        (number, start)
        for number, motion in enumerate(motions)
        for start in range(history - 1, len(motion.command) - steps + 1, every)
    ]
    if not places:
        needed = window_seconds + (history - 1) * simulator.robot.control_timestep
        names = ", ".join(motion.name for motion in motions)
        raise InputError(
            f"{names}: no recording lasts {needed:g} s, a window and the {history - 1} control steps before it; give "
            "longer recordings, or reduce --window-seconds."
        )
    reference, _ = stack_motions(simulator, motions)
    qpos, qvel, features, command = (np.asarray(x) for x in reference[:4])

    def of(array: np.ndarray, first: int, count: int) -> np.ndarray:
        return np.stack([array[r, s + first : s + first + count] for r, s in places])

    return MotionWindows(
        of(qpos, 0, 1)[:, 0],
        of(qvel, 0, 1)[:, 0],
        of(features, 1 - history, history),
        of(command, 1 - history, steps + history - 1),
        of(features, 1, steps),
        jax.tree.map(np.asarray, reference.drivetrain_at(*np.array(places).T)),
    )


def start_motion_window(window: MotionWindows) -> tuple[RolloutState, Float[Array, "windowsteps commands"]]:
    """Return the state at the start of one window, and the commands of its control steps."""
    physics = state_at(jnp.asarray(window.qpos), jnp.asarray(window.qvel))
    past = HISTORY - 1
    history, commands = jnp.asarray(window.history), jnp.asarray(window.commands)
    drivetrain = jax.tree.map(jnp.asarray, window.drivetrain)
    return RolloutState(physics, history, commands[:past], drivetrain), commands[past:]


def simulate_motion_window(simulator: AugmentedSimulator, window: MotionWindows) -> Float[Array, "windowsteps errors"]:
    """Return `window_errors` of one window, simulated from its start. JAX's transformations apply to this function."""
    state, commands = start_motion_window(window)

    def step(state: RolloutState, command: Array) -> tuple[RolloutState, Array]:
        after = simulator.step(state, command).state
        return after, after.features

    _, features = jax.lax.scan(step, state, commands)
    return window_errors(features, window.features, simulator.robot)
