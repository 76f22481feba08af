"""Training from the command line: `python -m ballu_mjx.train sysid`, `... envmimic`, `... walk` and so on.

JAX and modules that need it are imported inside functions: `runtime.prepare` has to come first.
"""

from __future__ import annotations

import argparse
import contextlib
import pkgutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ballu_mjx.common import files, runtime
from ballu_mjx.common.errors import InputError
from ballu_mjx.runs.layout import CONFIG_FILE

if TYPE_CHECKING:
    from ballu_mjx.cli._command import TrainCommand

_METHODS: Mapping[str, str] = {
    "sysid": "ballu_mjx.cli.train_sysid:COMMAND",
    "envmimic": "ballu_mjx.cli.train_envmimic:COMMAND",
    "supervised": "ballu_mjx.cli.train_forces:SUPERVISED",
    "analytic": "ballu_mjx.cli.train_forces:ANALYTIC",
    "aerodynamic": "ballu_mjx.cli.train_aerodynamics:COMMAND",
    "fluid": "ballu_mjx.cli.train_fluid:COMMAND",
    "all": "ballu_mjx.cli.pipeline:COMMAND",
}
"""Places of the subcommands other than tasks, by name."""
_SIGNALS = 128
"""Exit statuses from this number on mean that all processes of a training were interrupted together."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status (`runtime.exit_status`)."""

    def run() -> int:
        given = sys.argv[1:] if arguments is None else arguments
        # Short trainings spend most of their time on compiling.
        runtime.prepare(brief=_is_brief(given), joins=any(each.startswith("--coordinator") for each in given))
        from ballu_mjx.cli._command import run_command

        description = (
            "Identify actuators, learn residuals and train policies. Each subcommand explains its options with --help."
        )
        return run_command(_commands(next(iter(given), None)), given, description)

    status = runtime.exit_status(run, arguments)
    if 0 < status < _SIGNALS and "jax" in sys.modules:
        from ballu_mjx.rl import distributed

        distributed.leave(status)
    return status


def subcommands() -> Mapping[str, Any]:
    """Return the types from which tyro makes the subcommands' parsers, by name."""
    from ballu_mjx.cli._command import parsers

    return parsers(_commands())


def _is_brief(arguments: Sequence[str]) -> bool:
    """Return whether this command, or the one that began the run it resumes, has --quick.

    A resumed training then compiles as before, and gives the same numbers as an uninterrupted one. The options are read
    here because JAX has to be configured before they are parsed. Faults are reported by the parsing.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--resume", type=Path, nargs="?")
    try:
        options, _ = parser.parse_known_args(arguments)
    except argparse.ArgumentError:  # for example --quick=yes
        return False
    if options.quick or options.resume is None:
        return options.quick
    with contextlib.suppress(InputError, OSError, LookupError, TypeError):
        config = files.read_json(options.resume / CONFIG_FILE, "restore it")
        return "--quick" in config["starts"][0]["command"]
    return False


def _commands(only: str | None = None) -> Mapping[str, TrainCommand]:
    """Return the subcommands by name, in the order of use. If `only` names one of them, return it alone.

    The modules of other subcommands are then not imported, which takes a second.
    """
    if only is not None and only in _METHODS:
        return {only: pkgutil.resolve_name(_METHODS[only])}
    from ballu_mjx.cli import train_policy
    from ballu_mjx.policies.tasks import TASKS

    policies = {name: train_policy.command_for(task) for name, task in TASKS.items()}
    if only is not None and only in policies:
        return {only: policies[only]}
    methods = {name: pkgutil.resolve_name(place) for name, place in _METHODS.items()}
    whole = methods.pop("all")
    return {**methods, **policies, "all": whole}
