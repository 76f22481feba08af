"""Shared code of the training commands: their definition, options that --quick and --resume imply, and messages."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import tyro

from ballu_mjx.cli._help import arranged, asks_for_help
from ballu_mjx.common.errors import InputError
from ballu_mjx.residuals.registry import RESIDUAL_TASKS
from ballu_mjx.residuals.run_config import run_robot
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.rl.resume_point import ResumePoint, find_resume_point
from ballu_mjx.rl.training_loop import TrainingInterrupted
from ballu_mjx.robots.description import RobotDescription, check_simulates
from ballu_mjx.robots.registry import DEFAULT_ROBOT, load_robot
from ballu_mjx.runs.checkpoints import restore_checkpoint
from ballu_mjx.runs.folder import Run, read_config, typed_config, typed_values
from ballu_mjx.runs.layout import CONFIG_FILE
from ballu_mjx.runs.record import MemoryRecord, TrainingRecord

PROGRAM = "python -m ballu_mjx.train"
_KEPT = ("validate_every", "keep_every", "wandb")
"""Options in a command's data section that --resume takes from the run."""


@dataclasses.dataclass(frozen=True)
class TrainCommand:
    """Subcommand of `train`.

    **Fields**

    - `summary`: its help text.
    - `sections`: its options by section name, as dataclass instances that hold the defaults.
    - `run`: function that takes the sections by name and returns the exit status.
    - `quick`: defaults under --quick, by section and option.
    - `defaults`: function that takes the data section and returns the defaults that it implies, by section and option.
      None if only --quick changes defaults.
    """

    summary: str
    sections: Mapping[str, Any]
    run: Callable[..., int]
    quick: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    defaults: Callable[[Any], Mapping[str, Mapping[str, Any]]] | None = None

    @property
    def help(self) -> str:
        """Summary, with the defaults under --quick."""
        changed = [_flag(name, value) for values in self.quick.values() for name, value in values.items()]
        return self.summary + (f" Defaults under --quick: {' '.join(changed)}." if changed else "")

    def implied(self, name: str, data: Any) -> Mapping[str, Any] | None:
        """Return the sections with the defaults that the options in `data` imply. None if these change no default.

        **Raises** `InputError` if the run of --resume is not from the command `name`.
        """
        folder: Path | None = getattr(data, "resume", None)
        if folder is not None:
            config = read_config(folder, name)
            given = {option: config["data"][option] for option in _KEPT if option in config.get("data", {})}
            kept = typed_values(type(self.sections["data"]), given, "data", folder / CONFIG_FILE)
            stored = {
                section: typed_config(type(default), config, section, folder)
                for section, default in self.sections.items()
                if section != "data"
            }
            return {"data": dataclasses.replace(self.sections["data"], **kept), **stored}
        if self.defaults is not None:
            changed = self.defaults(data)
        else:
            changed = self.quick if getattr(data, "quick", False) else {}
        if not changed:
            return None
        return {
            section: dataclasses.replace(default, **changed.get(section, {}))
            for section, default in self.sections.items()
        }


def _flag(name: str, value: Any) -> str:
    """Return an option as it is typed on the command line."""
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        return f"--{'' if value else 'no-'}{flag}"
    return " ".join([f"--{flag}", *map(str, value if isinstance(value, tuple) else (value,))])


def parsers(commands: Mapping[str, TrainCommand], sections: Mapping[str, Mapping[str, Any]] | None = None) -> dict:
    """Return a dataclass for each of the `commands`, from which tyro makes the parser.

    `sections` holds sections by command name. They replace the command's own sections, with other defaults.
    """
    return {name: _parser(name, each, (sections or {}).get(name)) for name, each in commands.items()}


def _parser(name: str, command: TrainCommand, sections: Mapping[str, Any] | None) -> type:
    fields = [(n, type(default), default) for n, default in (sections or command.sections).items()]
    made = dataclasses.make_dataclass(name.replace("-", "_"), fields, frozen=True)
    made.__doc__ = command.help
    made.command = name  # pyright: ignore[reportAttributeAccessIssue]
    return made


def run_command(commands: Mapping[str, TrainCommand], arguments: Sequence[str] | None, description: str) -> int:
    """Parse the arguments (None: those of the process), run the command that they name, and return its exit status.

    --resume, --quick and other options change defaults. A second parse uses these defaults.

    **Raises** `InputError` for options that cannot be used.
    """

    def parse(sections: Mapping[str, Mapping[str, Any]] | None = None) -> Any:
        made = parsers(commands, sections)
        if asks_for_help(arguments):
            made = {name: arranged(each, commands[name].sections) for name, each in made.items()}
        return tyro.extras.subcommand_cli_from_dict(
            made,
            args=arguments,
            prog=PROGRAM,
            description=description,
            config=(tyro.conf.OmitArgPrefixes,),
        )

    given = parse()
    name, command = given.command, commands[given.command]
    implied = command.implied(name, getattr(given, "data", None))
    if implied is not None:
        given = parse({name: implied})
    try:
        return command.run(**{section: getattr(given, section) for section in command.sections})
    except TrainingInterrupted as stopped:
        return stopped.status


def load_chosen_robot(
    robot: str | None, resume: Path | None = None, task: str | None = None, residual: Path | None = None
) -> RobotDescription:
    """Return the robot to train for.

    With `resume` and `task`, it is the robot of the resumed run. Otherwise it is `robot`, the value of --robot. Without
    --robot, it is the robot of the run `residual`. Without all of these, it is the default robot.

    **Raises** `InputError` if the robot does not exist, or if both --robot and --resume are given.
    """
    if resume is not None and task is not None:
        if robot is not None:
            raise InputError("--robot does not go with --resume, which keeps the run's robot; leave one out.")
        return run_robot(read_config(resume, task), resume)
    if robot is None and residual is not None:
        return run_robot(read_config(residual, *RESIDUAL_TASKS), residual)
    found = load_robot(DEFAULT_ROBOT if robot is None else robot)
    check_simulates(found)
    return found


def find_start(task: str, data: Any, ppo: PPOConfig) -> ResumePoint:
    """Return the point at which training starts, given a command's data section; print a notice about it, if any.

    **Raises** `InputError` from `find_resume_point`.
    """
    start = find_resume_point(task, data.resume, ppo, output=data.output, quick=data.quick)
    if start.notice is not None:
        print(start.notice, file=sys.stderr)
    return start


@dataclasses.dataclass
class Written:
    """Folder to which a command writes."""

    folder: Path | None = None


@contextlib.contextmanager
def written_to(*, first: bool = True) -> Iterator[Written]:
    """Print the output folder and the elapsed time at the end.

    The command sets `folder` of the yielded object. `first` is whether this process writes and prints.
    """
    started, written = time.perf_counter(), Written()
    yield written
    if first:
        print(f"\nWritten to {written.folder}. {time.perf_counter() - started:.0f} s in all.")


@contextlib.contextmanager
def open_run(
    folder: Path, content: Mapping[str, Any], resumed_at: int | None, wandb: str | None, *, first: bool = True
) -> Iterator[TrainingRecord]:
    """Open a run's folder for training (see `Run`), or a record in memory if another process writes (`first` False).

    If training is interrupted, print the command that resumes it.
    """
    if not first:
        record = MemoryRecord(content)
        if resumed_at is not None and resumed_at >= 0:  # if nothing is left to train, no further result is saved
            step, params = restore_checkpoint(folder, "last")
            record.save(step, params, math.inf)
        yield record
        return
    with Run(folder, content, resumed_at=resumed_at, wandb=wandb) as run:
        print("Compiling: about a minute the first time ...", flush=True)
        try:
            yield run
        except TrainingInterrupted as stopped:
            print(f"Interrupted; saved at step {stopped.step:,}.", file=sys.stderr)
            print(f"To resume: {PROGRAM} {content['task']} --resume {shlex.quote(str(folder))}", file=sys.stderr)
            raise
