"""Recordings of the virtual BALLU: `python -m ballu_mjx record simulate`.

Of the recording commands, only this one imports the virtual robot, inside a function. Its result is a recording file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from ballu_mjx.common import runtime
from ballu_mjx.common.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Float

    from ballu_mjx.robots.description import RobotDescription


@dataclasses.dataclass(frozen=True)
class Simulate(runtime.CommandOptions):
    """Record on the virtual BALLU, to try a method or commands before using the hardware."""

    output: Path
    """Recording to write, NAME.csv or NAME.csv.gz. NAME.json is written beside it."""
    commands: Path | None = None
    """CSV with the columns time (s), command_left and command_right in [0, 1], played at the control rate."""
    gait: Literal["walking", "turning", "hopping", "one-legged", "telegraph", "waves"] | None = None
    """Named command sequence, instead of --commands."""
    seconds: float = 20.0
    """Length of the gait (s)."""
    robot_seed: int = 0
    """Seed of the virtual robot's physical parameters. 0 is the robot of the bundled recordings."""
    trial_seed: int = 0
    """Seed of the trial's conditions: draught, starting state, noise and drop-outs of motion capture."""
    suspended: bool = False
    """Record an actuator sweep with the feet off the ground instead of a gait."""
    levels: int = 20
    """Number of command levels of the sweep, spread over [0, 1]."""
    hold: float = 2.0
    """Time for which the sweep holds each level (s)."""


def simulate(options: Simulate) -> None:
    """Simulate, write the recording, and print the summary of `record check`."""
    from ballu_mjx.ballu.virtual import robot as virtual_robot
    from ballu_mjx.recordings.csv_format import check_new, read_recording, recording_name, write_recording
    from ballu_mjx.recordings.summary import find_gaps, summarize_recording
    from ballu_mjx.robots.registry import load_robot

    check_new(options.output)
    for name in ("robot_seed", "trial_seed"):
        if getattr(options, name) < 0:
            raise InputError(f"--{name.replace('_', '-')} {getattr(options, name)}: seeds are 0 or more.")
    _check_used(options)
    robot, name = load_robot(), recording_name(options.output)
    virtual = virtual_robot.draw_robot(options.robot_seed)
    if options.suspended:
        if options.commands is not None or options.gait is not None:
            raise InputError("--suspended: a sweep has its own commands; leave out --commands and --gait.")
        if not (2 <= options.levels <= 1000 and 0.1 <= options.hold <= 60.0):
            raise InputError("--levels, --hold: give 2 levels or more, and 0.1 to 60 s.")
        result = virtual_robot.record_sweep(
            virtual, options.trial_seed, name, commands=options.levels, hold=options.hold
        )  # fmt: skip
    else:
        commands, notes = _commands(options, robot)
        result = virtual_robot.record(
            virtual,
            virtual_robot.draw_trial(options.trial_seed),
            virtual_robot.open_loop(commands),
            len(commands) * robot.control_timestep,
            name,
            notes,
        )
    options.output.parent.mkdir(parents=True, exist_ok=True)
    write_recording(result, options.output, robot, decimals=4)
    recording, gaps = read_recording(options.output, robot), find_gaps(options.output)
    print(summarize_recording(options.output, recording, robot, gaps))


def _check_used(options: Simulate) -> None:
    """Check that no option is given that has no effect beside the others.

    **Raises** `InputError` if there is one.
    """
    unused, beside = ("levels", "hold"), "a gait" if options.commands is None else "--commands"
    if options.suspended:
        unused, beside = ("seconds",), "--suspended"
    elif options.commands is not None:
        unused = ("seconds", *unused)
    for name in unused:
        if getattr(options, name) != getattr(Simulate, name):
            raise InputError(f"--{name} has no effect beside {beside}; leave it out.")


def _commands(options: Simulate, robot: RobotDescription) -> tuple[Float[np.ndarray, "steps 2"], str]:
    """Return the commands at the control rate, and a note that describes them."""
    from ballu_mjx.ballu.gaits import GAITS
    from ballu_mjx.recordings.importers.capture import read_commands
    from ballu_mjx.recordings.importers.mapping import Commands
    from ballu_mjx.recordings.importers.table import open_table

    if (options.commands is None) == (options.gait is None):
        raise InputError("--commands, --gait: give one of them, or --suspended for a sweep.")
    if options.commands is None:
        if not 1.0 <= options.seconds <= 3600.0:
            raise InputError(f"--seconds {options.seconds:g}: give 1 to 3600 s.")
        assert options.gait is not None
        gaits: dict[str, Callable[[float], Float[np.ndarray, "steps 2"]]] = dict(GAITS)
        return gaits[options.gait](options.seconds), f"{options.gait}, open loop."
    time, command = read_commands(open_table(options.commands), Commands.of(robot))
    step = robot.control_timestep
    steps = int(round((time[-1] - time[0]) / step, 6)) + 1
    if not 1.0 <= steps * step <= 3600.0:
        raise InputError(f"{options.commands}: lasts {steps * step:g} s; give 1 to 3600 s.")
    held = np.searchsorted(time, time[0] + step * np.arange(steps) + 1e-6, side="right") - 1
    return command[held], f"{options.commands.name}, open loop."
