"""Training from the command line: `python -m ballu_mjx.train sysid`, `... envmimic`, `... walk` and so on.

JAX and modules that need it are imported inside functions: `runtime.prepare` has to come first.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ballu_mjx.common import runtime

if TYPE_CHECKING:
    from ballu_mjx.cli._command import TrainCommand

_SIGNALS = 128
"""Exit statuses from this number on mean that all processes of a training were interrupted together."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status (`runtime.exit_status`)."""

    def run() -> int:
        # Short trainings spend most of their time on compiling.
        runtime.prepare(brief="--quick" in (sys.argv[1:] if arguments is None else arguments))
        from ballu_mjx.cli._command import run_command

        description = (
            "Identify actuators, learn residuals and train policies. Each subcommand explains its options with --help."
        )
        return run_command(_commands(), arguments, description)

    status = runtime.exit_status(run, arguments)
    if 0 < status < _SIGNALS and "jax" in sys.modules:
        from ballu_mjx.rl import distributed

        distributed.leave(status)
    return status


def subcommands() -> Mapping[str, Any]:
    """Return the types from which tyro makes the subcommands' parsers, by name."""
    from ballu_mjx.cli._command import parsers

    return parsers(_commands())


def _commands() -> Mapping[str, TrainCommand]:
    """Return the subcommands by name, in the order of use."""
    from ballu_mjx.cli import (
        pipeline,
        train_aerodynamics,
        train_envmimic,
        train_fluid,
        train_forces,
        train_policy,
        train_sysid,
    )
    from ballu_mjx.policies.tasks import TASKS

    return {
        "sysid": train_sysid.COMMAND,
        "envmimic": train_envmimic.COMMAND,
        "supervised": train_forces.SUPERVISED,
        "analytic": train_forces.ANALYTIC,
        "aerodynamic": train_aerodynamics.COMMAND,
        "fluid": train_fluid.COMMAND,
        **{name: train_policy.command_for(task) for name, task in TASKS.items()},
        "all": pipeline.COMMAND,
    }
