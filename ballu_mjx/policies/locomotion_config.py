"""Options of the simulator in which a locomotion policy is trained."""

from __future__ import annotations

import dataclasses
import math

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.tasks import Task
from ballu_mjx.robots.description import RobotDescription


@dataclasses.dataclass(frozen=True)
class LocomotionConfig:
    """Options of the simulator in which a policy is trained."""

    domain_randomization: bool = False
    """Draw friction and the starting state anew for every episode, as in the paper. --friction and the options of start
    and pushes need it. Masses and buoyancy are not drawn, because they change gaits too much."""
    friction: tuple[float, float] = (0.5, 1.1)
    """Range of the coefficient of sliding friction. One value is drawn for all geoms that collide. A residual that
    changes the friction (aerodynamic) changes the range by the same factor."""
    start_yaw: float = 20.0
    """Largest starting heading, deg. It is drawn between minus and plus this angle."""
    start_tilt: float = 2.0
    """Largest starting roll and pitch of the base, deg. They are drawn between minus and plus this angle."""
    start_angle: float = 3.0
    """Standard deviation of the starting angles of hinges, deg. Angles stay within the joints' ranges. Joints that the
    robot's description lists as held do not vary."""
    start_offset: float = 0.005
    """Standard deviation of the starting positions of slides, m. Positions stay within the joints' ranges, and held
    joints do not vary."""
    start_velocity: float = 0.03
    """Standard deviation of the starting velocities, m/s. For rotations of hinges and base: five times as much,
    rad/s."""
    push_force: float = 0.0
    """Standard deviation of a constant force on the tracked body along each horizontal axis of the world, N. With
    domain randomization, it is drawn anew for every episode. A policy learns to steer against forces that its
    simulator lacks."""
    push_torque: float = 0.0
    """Standard deviation of a constant torque on the tracked body about the vertical axis, N m. It is drawn like
    --push-force."""
    episode_seconds: float = 12.0
    """Mean duration of an episode, s. Each one lasts between half and one and a half times as long."""
    sampled_residual: bool = False
    """Sample the residual forces from the policy's distribution instead of using its mode."""
    outside_cost: float = 0.0
    """Cost (reward, m/s) for each width of the training range by which the residual's observation lies outside this
    range by more than 0.1 widths, 0 or more. It keeps the policy where the residual is reliable. A policy that is
    rewarded for speed otherwise leaves this range. 0 for no cost."""


_STARTS = ("start_yaw", "start_tilt", "start_angle", "start_offset", "start_velocity")
_LONGEST_EPISODE = 86_400.0
"""Largest mean length of an episode (s): a day. Its number of control steps stays far below 2**31."""
DRAWN_OPTIONS = ("friction", *_STARTS, "push_force", "push_torque")
"""Options that have no effect without domain randomization."""
_NOT_NEGATIVE = (*DRAWN_OPTIONS[1:], "outside_cost")


def check_locomotion_config(config: LocomotionConfig, control_timestep: float) -> None:
    """Check the options for a robot with control steps of `control_timestep` seconds.

    **Raises** `InputError` if an option is out of range, naming the option and the fix.
    """
    low, high = config.friction
    if not 0 < low <= high < math.inf:
        raise InputError(f"--friction is {low:g} {high:g}: give two numbers above 0, the smaller first.")
    least = 2 * control_timestep
    if not least <= config.episode_seconds <= _LONGEST_EPISODE:
        nearest = _LONGEST_EPISODE if config.episode_seconds > _LONGEST_EPISODE else least
        raise InputError(
            f"--episode-seconds is {config.episode_seconds:g}: it must be between {least:g} and {_LONGEST_EPISODE:g}; "
            f"{nearest:g} is the nearest."
        )
    for name in _NOT_NEGATIVE:
        if not 0 <= getattr(config, name) < math.inf:
            raise InputError(
                f"--{name.replace('_', '-')} is {getattr(config, name):g}: it must be 0 or more; 0 is the nearest."
            )


def check_task(task: Task, robot: RobotDescription) -> None:
    """Check that a robot can perform a task.

    **Raises** `InputError` if it cannot.
    """
    if robot.anchored:
        raise InputError(
            f"{task.name} needs a free-floating robot; {robot.name} is anchored ({robot.model.name} has no free joint)."
        )
