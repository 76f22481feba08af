"""Short windows of recorded motion, and their simulation: what residuals are fitted to by derivatives.

A window starts in a recorded state and runs under the recorded commands. It is short enough for errors not to compound,
and long enough for a force of hundredths of a newton to move the tracked body by more than the starting state's
uncertainty.
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
    """Windows of recorded motions; `windowsteps` control steps each."""

    qpos: Float[Array | np.ndarray, "windows nq"]
    """First states."""
    qvel: Float[Array | np.ndarray, "windows nv"]
    history: Float[Array | np.ndarray, "windows steps features"]
    """`observation.observe_features` of the first state and the two before."""
    commands: Float[Array | np.ndarray, "windows allsteps commands"]
    """From two control steps before the first on."""
    features: Float[Array | np.ndarray, "windows windowsteps features"]
    """Recorded, after each control step."""
    drivetrain: DrivetrainState | None = None
    """In the first states; None where the simulator has no drivetrain."""


def check_motion_windows(window_seconds: float, interval_seconds: float, control_timestep: float) -> None:
    """Check the windows' length and distance, at least two control steps (s).

    **Raises** `InputError` for lengths out of range, naming the option."""
    for name, value in (("--window-seconds", window_seconds), ("--interval-seconds", interval_seconds)):
        shortest = 2 * control_timestep
        if not shortest <= value < math.inf:
            raise InputError(f"{name} is {value:g}: it must be {shortest:g} or more; {shortest:g} is the nearest.")


def cut_motion_windows(
    simulator: Simulator, motions: Sequence[Motion], window_seconds: float, interval_seconds: float
) -> MotionWindows:
    """Windows of the given length, one every `interval_seconds`.

    **Raises** `InputError` where no recording is as long as a window.
    """
    steps, every = (round(s / simulator.robot.control_timestep) for s in (window_seconds, interval_seconds))
    history = HISTORY
    places = [
        (number, start)
        for number, motion in enumerate(motions)
        for start in range(history - 1, len(motion.command) - steps + 1, every)
    ]
    if not places:
        raise InputError(f"No recording lasts {window_seconds:g} s; give longer ones, or --window-seconds.")
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
    """Return where one window starts, and the commands of its control steps."""
    physics = state_at(jnp.asarray(window.qpos), jnp.asarray(window.qvel))
    past = HISTORY - 1
    history, commands = jnp.asarray(window.history), jnp.asarray(window.commands)
    drivetrain = jax.tree.map(jnp.asarray, window.drivetrain)
    return RolloutState(physics, history, commands[:past], drivetrain), commands[past:]


def simulate_motion_window(simulator: AugmentedSimulator, window: MotionWindows) -> Float[Array, "windowsteps errors"]:
    """Return `window_errors` of one window, simulated from its start; JAX's own transformations apply."""
    state, commands = start_motion_window(window)

    def step(state: RolloutState, command: Array) -> tuple[RolloutState, Array]:
        after = simulator.step(state, command).state
        return after, after.features

    _, features = jax.lax.scan(step, state, commands)
    return window_errors(features, window.features, simulator.robot)
