"""Options of a network that computes residual forces: its input, and the loads of its output."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from ballu_mjx.common.errors import InputError
from ballu_mjx.sim.force_sets import ForceSet


@dataclasses.dataclass(frozen=True)
class ForceNetworkConfig:
    """Options of the input and output of a network that computes residual forces."""

    forces: ForceSet = "force"
    """Loads that the network's output stands for: a force on the tracked body (force, as in the paper), a force and a
    torque on it (wrench), forces on it and at all measured points (multi), forces and torques along joints (joints), or
    changes of the commands (commands)."""
    force_limit: float | None = None
    """Largest force along each axis, N (paper: 1). Other loads have the same limit in units of the network's output.
    Without this option: 20 units."""
    force_scale: float | None = None
    """Force for one unit of the network's output, N. Without this option: from the training recordings, the RMS of the
    missing force along an axis, rounded to 1, 2 or 5 times a power of ten. Joints and commands have
    `--scales` instead; for limit and cost, one of their units counts as this force."""
    torque_scale: float | None = None
    """Torque for one unit of the network's output, N m, with `--forces wrench`. Without this option: the same as for
    the force, from the missing torque. For limit and cost, a unit of torque counts as a unit of force."""
    scales: tuple[float, ...] = ()
    """Load for one unit of each output, in order, with `--forces joints` (N m, for slides N) or `--forces commands`
    (the commands' units). Without this option: the same as for the force, from the missing loads."""
    expected_loads: tuple[float, ...] = ()
    """Loads at which an untrained network starts, and from which EnvMimic's force cost counts (N, N m, commands' units;
    in the frame of the network's output). One value stands for all loads. Without this option: the mean of the loads
    that the model leaves unexplained in the training recordings. The paper's policy starts at 0."""
    observe_command: bool = True
    """Include the coming command and the last two commands in the network's input. The paper's state has none."""
    relative_observation: bool = True
    """Take horizontal positions in the network's input relative to the tracked body, so that the forces do not depend
    on the place in the room. The paper takes them in the world frame. For an anchored robot they are always in the
    world frame."""
    heading_frame: bool = True
    """Express vectors and yaw in the network's input, and its forces, in the heading frame of the tracked body. The
    paper uses the world frame. For an anchored robot it is always the world frame."""
    fade_width: float | None = None
    """Let the loads fade outside the training range of the network's input: they are multiplied by exp(-(d / width)^4).
    d is the distance from that range, in widths of the range, less a margin of 0.1. Without this option, loads do not
    fade. With it, the simulator far from the recordings is the one that this training started from."""
    mirror: bool = False
    """Make the network's output symmetric about the robot's xz plane, apart from a constant: mirrored motions then have
    mirrored forces. The robot's description must declare `mirror`. Not with `--forces joints`."""


def check_network_config(config: ForceNetworkConfig) -> None:
    """Check the options of the network's input and output.

    **Raises** `InputError` for an option out of range. The message names the option.
    """
    for name in ("force_limit", "force_scale", "torque_scale", "scales", "fade_width"):
        value = getattr(config, name)
        if value is not None and not all(
            x > 0 and math.isfinite(x) for x in (value if isinstance(value, tuple) else (value,))
        ):
            option = f"--{name.replace('_', '-')}"
            raise InputError(f"{option} is {value}: it must be greater than 0; leave it out for the default.")
    if not all(map(math.isfinite, config.expected_loads)):
        raise InputError(
            f"--expected-loads is {config.expected_loads}: give finite numbers; leave it out for the default."
        )


def network_values(config: ForceNetworkConfig) -> dict[str, Any]:
    """Return the options of the network's input and output in `config`, by name, without those of a subclass."""
    return {field.name: getattr(config, field.name) for field in dataclasses.fields(ForceNetworkConfig)}
