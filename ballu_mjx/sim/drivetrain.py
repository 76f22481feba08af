"""The drivetrain: what a command meets on its way to its actuator.

Each command passes, in this order, a delay, a scale and an offset, a rate limit, a first-order lag, and backlash. The
result is the actuator's `ctrl`. With the values of `identity_drivetrain` it is the command itself. Everything is a
function of arrays: differentiable forwards, batched by `jax.vmap`, and stepped once each physics step.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class DrivetrainParameters(NamedTuple):
    """One number for each command; command units are those of the actuator's `ctrl`."""

    scale: Float[Array, " commands"]
    """Multiplies the command."""
    offset: Float[Array, " commands"]
    """Adds to the scaled command (command units)."""
    delay: Float[Array, " commands"]
    """Time from a command to its effect (s)."""
    backlash: Float[Array, " commands"]
    """Width of the play (command units)."""
    rate_limit: Float[Array, " commands"]
    """Fastest change (command units a second); inf: none."""
    lag: Float[Array, " commands"]
    """Time constant of the first-order lag (s): by so much a steady ramp is late."""


QUANTITIES = DrivetrainParameters._fields
"""What a drivetrain has of each command."""


class DrivetrainState(NamedTuple):
    """What the drivetrain remembers from one physics step to the next."""

    sent: Float[Array, "slots commands"]
    """The last commands, the newest first."""
    limited: Float[Array, " commands"]
    """After the rate limit."""
    lagged: Float[Array, " commands"]
    """After the lag."""
    played: Float[Array, " commands"]
    """After the backlash: the actuators' `ctrl`."""


def identity_drivetrain(commands: int) -> DrivetrainParameters:
    """Return the drivetrain that passes `commands` commands on unchanged."""
    one, zero = jnp.ones(commands), jnp.zeros(commands)
    return DrivetrainParameters(one, zero, zero, zero, jnp.full(commands, jnp.inf), zero)


@runtime_checkable
class HasDrivetrain(Protocol):
    """Model parameters that also say what commands meet on their way."""

    def drivetrain(self) -> DrivetrainParameters:
        """Return the drivetrain of all commands."""
        ...


def drivetrain_of(parameters: object) -> DrivetrainParameters | None:
    """Return the drivetrain that a simulator's parameters have; None where commands arrive unchanged."""
    if not isinstance(parameters, HasDrivetrain):
        return None
    found = DrivetrainParameters(*(jnp.asarray(value, jnp.float32) for value in parameters.drivetrain()))
    unchanged = identity_drivetrain(len(found.scale))
    same = all(np.array_equal(one, other) for one, other in zip(found, unchanged, strict=True))
    return None if same else found


def count_slots(longest_delay: float, timestep: float) -> int:
    """Return how many commands a state must remember for delays up to `longest_delay` (s)."""
    return math.ceil(longest_delay / timestep - 1e-9) + 2


def init_drivetrain(
    parameters: DrivetrainParameters, command: Float[Array, " commands"], slots: int
) -> DrivetrainState:
    """Return the state at rest under `command`, the backlash in its middle; `slots` are those of `count_slots`."""
    arrived = parameters.scale * command + parameters.offset
    return DrivetrainState(jnp.broadcast_to(command, (slots, len(command))), arrived, arrived, arrived)


def step_drivetrain(
    parameters: DrivetrainParameters,
    state: DrivetrainState,
    command: Float[Array, " commands"],
    timestep: float,
) -> tuple[DrivetrainState, Float[Array, " commands"]]:
    """Advance by one physics step of `timestep` (s).

    Delays between two physics steps interpolate linearly between the commands sent at both. Delays beyond the state's
    slots count as the longest that fits.

    **Returns** the next state and the actuators' `ctrl` for this step.
    """
    sent = jnp.concatenate([command[None], state.sent[:-1]])
    arrived = parameters.scale * _delayed(sent, parameters.delay / timestep) + parameters.offset
    most = parameters.rate_limit * timestep
    limited = jnp.clip(arrived, state.limited - most, state.limited + most)
    # Backward Euler: exactly the identity at lag 0, with a finite derivative there; a ramp is late by the lag.
    lagged = limited + (state.lagged - limited) * (parameters.lag / (parameters.lag + timestep))
    half = parameters.backlash / 2
    played = jnp.clip(state.played, lagged - half, lagged + half)
    return DrivetrainState(sent, limited, lagged, played), played


def scan_drivetrain(
    parameters: DrivetrainParameters,
    state: DrivetrainState,
    commands: Float[Array, "steps commands"],
    timestep: float,
) -> tuple[DrivetrainState, Float[Array, "steps commands"]]:
    """Advance by one physics step for each of `commands`; see `step_drivetrain`."""

    def step(state: DrivetrainState, command: Array) -> tuple[DrivetrainState, Array]:
        return step_drivetrain(parameters, state, command, timestep)

    return jax.lax.scan(step, state, commands)


def filter_commands(
    parameters: DrivetrainParameters, commands: Float[Array, "steps commands"], timestep: float, slots: int
) -> Float[Array, "steps commands"]:
    """Return the actuators' `ctrl` of each physics step, from rest under the first command."""
    return scan_drivetrain(parameters, init_drivetrain(parameters, commands[0], slots), commands, timestep)[1]


def _delayed(sent: Float[Array, "slots commands"], late: Float[Array, " commands"]) -> Float[Array, " commands"]:
    """Return each command as it was sent so many steps ago."""
    # Not `clip`, whose derivative at the bound itself, a delay of 0, is half of that beside it.
    late = jnp.where(late < 0, 0.0, jnp.where(late > len(sent) - 1, len(sent) - 1.0, late))
    whole = jnp.minimum(jnp.floor(late), len(sent) - 2.0)
    share = late - jax.lax.stop_gradient(whole)
    slot = jnp.arange(len(sent))[:, None]
    weights = (slot == whole) * (1 - share) + (slot == whole + 1) * share
    return jnp.sum(weights * sent, axis=0)
