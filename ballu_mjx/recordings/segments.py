"""Short windows of recorded motion, and how far a simulated one is off: what residuals are fitted to by derivatives.

A window starts in a recorded state and runs under the recorded commands. It is short enough for errors not to compound,
and long enough for a force of hundredths of a newton to move the tracked body by more than the starting state's
uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.drivetrain import DrivetrainState
from ballu_mjx.sim.observation import HISTORY, ObservationLayout, euler_to_matrix, wrap_angle
from ballu_mjx.sim.simulator import AugmentedSimulator, RolloutState, Simulator
from ballu_mjx.sim.step import state_at

POSITION = (0.002, 0.01)
"""Expected error of the tracked body's position (m) at a window's start, and what each second adds."""
ANGLE = (np.deg2rad(0.3), np.deg2rad(0.6))
"""Likewise of its orientation (rad)."""
_LOST = 20.0
"""What a window counts as that diverged in simulation, in expected errors."""
OUTLYING = 3.0
"""Expected errors beyond which a window counts less: a contact point slipped there, for example."""


class Segments(NamedTuple):
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


def check_segments(window_seconds: float, interval_seconds: float, control_timestep: float) -> None:
    """Check the windows' length and distance, at least two control steps (s).

    **Raises** `InputError` for lengths out of range, naming the option."""
    for name, value in (("--window-seconds", window_seconds), ("--interval-seconds", interval_seconds)):
        shortest = 2 * control_timestep
        if not shortest <= value < math.inf:
            raise InputError(f"{name} is {value:g}: it must be {shortest:g} or more; {shortest:g} is the nearest.")


def cut_segments(
    simulator: Simulator, motions: Sequence[Motion], window_seconds: float, interval_seconds: float
) -> Segments:
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

    return Segments(
        of(qpos, 0, 1)[:, 0],
        of(qvel, 0, 1)[:, 0],
        of(features, 1 - history, history),
        of(command, 1 - history, steps + history - 1),
        of(features, 1, steps),
        jax.tree.map(np.asarray, reference.drivetrain_at(*np.array(places).T)),
    )


def start_segment(window: Segments) -> tuple[RolloutState, Float[Array, "windowsteps commands"]]:
    """Return where one window starts, and the commands of its control steps."""
    physics = state_at(jnp.asarray(window.qpos), jnp.asarray(window.qvel))
    past = HISTORY - 1
    history, commands = jnp.asarray(window.history), jnp.asarray(window.commands)
    drivetrain = jax.tree.map(jnp.asarray, window.drivetrain)
    return RolloutState(physics, history, commands[:past], drivetrain), commands[past:]


def simulate_segment(simulator: AugmentedSimulator, window: Segments) -> Float[Array, "windowsteps errors"]:
    """Return `segment_errors` of one window, simulated from its start; JAX's own transformations apply."""
    state, commands = start_segment(window)

    def step(state: RolloutState, command: Array) -> tuple[RolloutState, Array]:
        after = simulator.step(state, command).state
        return after, after.features

    _, features = jax.lax.scan(step, state, commands)
    return segment_errors(features, window.features, simulator.robot)


def segment_errors(
    features: Float[Array | np.ndarray, "windowsteps features"],
    recorded: Float[Array | np.ndarray, "windowsteps features"],
    robot: RobotDescription,
) -> Float[Array, "windowsteps errors"]:
    """Return errors of the tracked body's position and orientation, in expected errors.

    Errors of orientation are those of roll, pitch and yaw of an upright robot. Of others they are the nine differences
    of the rotation matrices over sqrt(2), whose length is the angle between small rotations and grows up to 180 deg.
    Neighbours in time say the same: all of a window's squares add up to one for each of the six degrees of freedom
    where errors are as expected.
    """
    steps, layout = len(recorded), ObservationLayout
    time = np.arange(1, steps + 1)[:, None] * robot.control_timestep
    difference = jnp.asarray(features) - recorded
    position = difference[:, layout.position]
    if robot.upright:
        angles = wrap_angle(difference[:, layout.euler_angles])
    else:
        one, other = (jax.vmap(euler_to_matrix)(jnp.asarray(x)[:, layout.euler_angles]) for x in (features, recorded))
        angles = ((one - other) / np.sqrt(2)).reshape(steps, 9)
    start, each_second = np.array([POSITION] * 3 + [ANGLE] * angles.shape[1]).T
    return jnp.concatenate([position, angles], axis=1) / ((start + each_second * time) * np.sqrt(steps))


def pseudo_huber(squared: Any) -> Any:
    """Pseudo-Huber loss of windows, by their errors' squared length: that itself below `OUTLYING`, linear above."""
    return 2 * OUTLYING**2 * ((1 + squared / OUTLYING**2) ** 0.5 - 1)


def count_lost(errors: Float[np.ndarray, "windows entries"]) -> Float[np.ndarray, "windows entries"]:
    """Return errors of windows in which those that diverged have `_LOST` in all."""
    finite = np.isfinite(errors).all(axis=1, keepdims=True)
    return np.where(finite, errors, _LOST / math.sqrt(errors.shape[1]))
