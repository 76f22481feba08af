"""Options of the simulator that a locomotion policy is trained in."""

from __future__ import annotations

import dataclasses
import math

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.tasks import Task
from ballu_mjx.robots.description import RobotDescription


@dataclasses.dataclass(frozen=True)
class LocomotionConfig:
    """The simulator that a policy is trained in."""

    domain_randomization: bool = False
    """Draw friction and starting state anew for every episode, as the paper does (not masses, not buoyancy: gaits
    depend on these too finely)."""
    friction: tuple[float, float] = (0.5, 1.1)
    """Range of the coefficient of sliding friction, one for all geoms that collide."""
    start_yaw: float = 20.0
    """Starting headings are drawn from plus or minus this, deg."""
    start_tilt: float = 2.0
    """Starting roll and pitch of the base are drawn from plus or minus this, deg."""
    start_angle: float = 3.0
    """Spread of the starting angles of hinges, deg, within their ranges; joints that the robot's description holds stay
    where they are."""
    start_offset: float = 0.005
    """Spread of the starting positions of slides, m, likewise."""
    start_velocity: float = 0.03
    """Spread of the starting velocity, m/s; hinges and base turn at five times as much, rad/s."""
    episode_seconds: float = 12.0
    """Mean length of an episode, s; each lasts between half and one and a half times as long."""
    sampled_residual: bool = False
    """Draw the residual's forces from its policy's distribution, instead of taking the most likely ones."""
    residual_decay: float = 0.0
    """How fast the residual's force fades where its observation leaves the range seen in its training: it is
    multiplied by exp(-decay x excess), the excess in widths of that range. 0: not at all."""
    outside_cost: float = 0.0
    """Reward (m/s) lost per width of that range by which the residual's observation leaves it: keeps the policy where
    the residual knows what it does, which a policy paid for speed otherwise leaves. 0: nothing."""


_STARTS = ("start_yaw", "start_tilt", "start_angle", "start_offset", "start_velocity")
_NOT_NEGATIVE = (*_STARTS, "residual_decay", "outside_cost")


def check_locomotion_config(config: LocomotionConfig, control_timestep: float) -> None:
    """Check the options for a robot with so many seconds between two commands.

    **Raises** `InputError` for options out of range, naming the option and the fix.
    """
    low, high = config.friction
    if not 0 < low <= high < math.inf:
        raise InputError(f"--friction is {low:g} {high:g}: give two numbers above 0, the smaller first.")
    least = 2 * control_timestep
    if not least <= config.episode_seconds < math.inf:
        raise InputError(
            f"--episode-seconds is {config.episode_seconds:g}: it must be {least:g} or more; {least:g} is the nearest."
        )
    for name in _NOT_NEGATIVE:
        if not 0 <= getattr(config, name) < math.inf:
            raise InputError(
                f"--{name.replace('_', '-')} is {getattr(config, name):g}: it must be 0 or more; 0 is the nearest."
            )


def check_task(task: Task, robot: RobotDescription) -> None:
    """Check that a robot can do a task.

    **Raises** `InputError` where it cannot.
    """
    if robot.anchored:
        raise InputError(
            f"{task.name} needs a free-floating robot; {robot.name} is anchored ({robot.model.name} has no free joint)."
        )
