"""`python -m ballu_mjx export RUN`: a policy for the robot's own computer."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import tyro

from ballu_mjx.common import runtime
from ballu_mjx.policies.deploy.export import ExportOptions, export_policy


@dataclasses.dataclass(frozen=True)
class Options(runtime.CommandOptions, ExportOptions):
    """Write a locomotion policy as a controller for the robot that needs Python and NumPy only."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status (`runtime.exit_status`)."""

    def run() -> None:
        runtime.prepare()
        options = tyro.cli(Options, args=arguments, prog="python -m ballu_mjx export")
        export_policy(options)

    return runtime.exit_status(run, arguments)
