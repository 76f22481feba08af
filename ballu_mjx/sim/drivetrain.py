"""The drivetrain: effects such as delay, lag and backlash between a command and its actuator.

Each command passes, in this order, a delay, a scale and an offset, a rate limit, a first-order lag, and backlash. The
result is the actuator's `ctrl`. With the values of `identity_drivetrain` it equals the command. All functions are pure
functions of arrays. They support forward derivatives and `jax.vmap`, and advance by physics steps.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class DrivetrainParameters(NamedTuple):
    """Parameters of a drivetrain, one number for each command. Command units are those of the actuator's `ctrl`."""

    scale: Float[Array, " commands"]
    """Factor on the command."""
    offset: Float[Array, " commands"]
    """Offset that is added to the scaled command (command units)."""
    delay: Float[Array, " commands"]
    """Time from a command to its effect (s)."""
    backlash: Float[Array, " commands"]
    """Width of the backlash (command units)."""
    rate_limit: Float[Array, " commands"]
    """Largest rate of change (command units per second). Infinite if there is no limit."""
    lag: Float[Array, " commands"]
    """Time constant of the first-order lag (s). The output trails a steady ramp by this time."""


QUANTITIES = DrivetrainParameters._fields
"""Names of the drivetrain's parameters."""


class DrivetrainState(NamedTuple):
    """State of the drivetrain between two physics steps, in command units."""

    sent: Float[Array, "slots commands"]
    """Most recent commands, one for each physics step, the newest first."""
    limited: Float[Array, " commands"]
    """Command after the rate limit."""
    lagged: Float[Array, " commands"]
    """Command after the lag."""
    after_backlash: Float[Array, " commands"]
    """Command after the backlash: the actuators' `ctrl`."""


def identity_drivetrain(commands: int) -> DrivetrainParameters:
    """Return the drivetrain that does not change its commands. `commands` is their number."""
    one, zero = jnp.ones(commands), jnp.zeros(commands)
    return DrivetrainParameters(one, zero, zero, zero, jnp.full(commands, jnp.inf), zero)


@runtime_checkable
class HasDrivetrain(Protocol):
    """Model parameters that include a drivetrain."""

    def drivetrain(self) -> DrivetrainParameters:
        """Return the parameters of the drivetrain, for all commands."""
        ...


def drivetrain_of(parameters: object) -> DrivetrainParameters | None:
    """Return the drivetrain in a simulator's parameters. None if there is none, or if it changes no command."""
    if not isinstance(parameters, HasDrivetrain):
        return None
    found = DrivetrainParameters(*(jnp.asarray(value, jnp.float32) for value in parameters.drivetrain()))
    unchanged = identity_drivetrain(len(found.scale))
    same = all(np.array_equal(one, other) for one, other in zip(found, unchanged, strict=True))
    return None if same else found


def count_slots(longest_delay: float, timestep: float) -> int:
    """Return the number of commands that a state must store for delays up to `longest_delay` (s)."""
    return math.ceil(longest_delay / timestep - 1e-9) + 2


def init_drivetrain(
    parameters: DrivetrainParameters, command: Float[Array, " commands"], slots: int
) -> DrivetrainState:
    """Return the state at rest under `command`, with the backlash centred. `slots` is the result of `count_slots`."""
    arrived = parameters.scale * command + parameters.offset
    return DrivetrainState(jnp.broadcast_to(command, (slots, len(command))), arrived, arrived, arrived)


def step_drivetrain(
    parameters: DrivetrainParameters,
    state: DrivetrainState,
    command: Float[Array, " commands"],
    timestep: float,
) -> tuple[DrivetrainState, Float[Array, " commands"]]:
    """Advance by one physics step of `timestep` (s).

    A delay between two physics steps interpolates linearly between the commands sent at both. A delay that exceeds the
    state's slots is clipped to the longest one that fits.

    **Returns** the next state and the actuators' `ctrl` for this step.
    """
    sent = jnp.concatenate([command[None], state.sent[:-1]])
    arrived = parameters.scale * _delayed(sent, parameters.delay / timestep) + parameters.offset
    most = parameters.rate_limit * timestep
    limited = jnp.clip(arrived, state.limited - most, state.limited + most)
    # Backward Euler is exactly the identity at lag 0 and has a finite derivative there. It delays a ramp by the lag.
    lagged = limited + (state.lagged - limited) * (parameters.lag / (parameters.lag + timestep))
    after_backlash = _after_backlash(parameters.backlash / 2, state, lagged)
    return DrivetrainState(sent, limited, lagged, after_backlash), after_backlash


def scan_drivetrain(
    parameters: DrivetrainParameters,
    state: DrivetrainState,
    commands: Float[Array, "steps commands"],
    timestep: float,
) -> tuple[DrivetrainState, Float[Array, "steps commands"]]:
    """Advance by one physics step for each row of `commands`; see `step_drivetrain`."""

    def step(state: DrivetrainState, command: Array) -> tuple[DrivetrainState, Array]:
        return step_drivetrain(parameters, state, command, timestep)

    return jax.lax.scan(step, state, commands)


def filter_commands(
    parameters: DrivetrainParameters, commands: Float[Array, "steps commands"], timestep: float, slots: int
) -> Float[Array, "steps commands"]:
    """Return the actuators' `ctrl` in each physics step, starting at rest under the first command."""
    return scan_drivetrain(parameters, init_drivetrain(parameters, commands[0], slots), commands, timestep)[1]


def _after_backlash(
    half: Float[Array, " commands"], state: DrivetrainState, lagged: Float[Array, " commands"]
) -> Float[Array, " commands"]:
    """Return the previous output, clipped to `lagged` plus and minus half the backlash."""
    low, high, before, wide = lagged - half, lagged + half, state.after_backlash, half > 0
    # `clip` would halve derivatives at its bounds. An output at a bound follows that bound while a command is held.
    rises, falls = (before < low) | (wide & (before == low)), (before > high) | (wide & (before == high))
    # Without backlash the bounds are equal. The output follows every command there, and the derivative with respect to
    # the backlash is that of the last move: its offset from the command stays the same.
    held = jnp.where(wide, before, lagged + (before - state.lagged))
    return jnp.where(rises, low, jnp.where(falls, high, held))


def _delayed(sent: Float[Array, "slots commands"], late: Float[Array, " commands"]) -> Float[Array, " commands"]:
    """Return each command as it was sent `late` physics steps ago, interpolated linearly."""
    # `clip` would halve the derivative at its bound, which is a delay of 0.
    late = jnp.where(late < 0, 0.0, jnp.where(late > len(sent) - 1, len(sent) - 1.0, late))
    whole = jnp.minimum(jnp.floor(late), len(sent) - 2.0)
    share = late - jax.lax.stop_gradient(whole)
    slot = jnp.arange(len(sent))[:, None]
    weights = (slot == whole) * (1 - share) + (slot == whole + 1) * share
    return jnp.sum(weights * sent, axis=0)
