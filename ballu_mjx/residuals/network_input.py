"""Input of a residual network: motion and commands of the last control steps."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.recordings.reference import ReferenceMotions
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.observation import (
    HISTORY,
    ObservationLayout,
    commands_seen,
    heading_observation,
    heading_observation_names,
)


def network_input(
    history: Float[Array, "3 features"],
    commands: Float[Array, "3 commands"],
    config: ForceNetworkConfig,
    robot: RobotDescription,
) -> Float[Array, " inputs"]:
    """Return the input of a residual network: `heading_observation`, and the commands if `config.observe_command`.

    Commands are fractions of their ranges (0 to 1), the coming command last.
    """
    seen = heading_observation(
        history, robot.anchored, relative=config.relative_observation, turned=config.heading_frame
    )
    if not config.observe_command:
        return seen
    low, high = np.array(robot.command_ranges, np.float32).T
    return jnp.concatenate([seen, ((commands - low) / (high - low)).ravel()])


def network_input_names(config: ForceNetworkConfig, robot: RobotDescription) -> list[str]:
    """Return the names of the numbers of `network_input`, each with its unit and control step."""
    steps = ["now", "one control step ago", "two control steps ago"][:HISTORY][::-1]
    seen = heading_observation_names((robot.tracked, *robot.points))
    names = [f"{name}, {step}" for step in steps for name in seen]
    if config.observe_command:
        steps = ["coming", "last", "last but one"][:HISTORY][::-1]
        names += [f"command {command}, share of its range, {step}" for step in steps for command in robot.commands]
    return names


def num_inputs(config: ForceNetworkConfig, robot: RobotDescription) -> int:
    """Return the number of entries of `network_input`."""
    return HISTORY * (ObservationLayout.of(robot).size + len(robot.commands) * config.observe_command)


def recorded_inputs(
    reference: ReferenceMotions, config: ForceNetworkConfig, robot: RobotDescription
) -> Float[Array, "states inputs"]:
    """Return `network_input` for every recorded state that has a history."""

    def inputs(recording: Array, time: Array) -> Array:
        history = jax.lax.dynamic_slice_in_dim(reference.features[recording], time - HISTORY + 1, HISTORY)
        return network_input(history, commands_seen(reference.command[recording], time), config, robot)

    steps = np.asarray(reference.steps)
    pairs = np.array([(r, k) for r, count in enumerate(steps) for k in range(HISTORY - 1, count)])
    return jax.jit(jax.vmap(inputs))(*pairs.T)
