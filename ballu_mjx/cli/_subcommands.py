"""Commands with subcommands, other than `train`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import tyro

from ballu_mjx.cli._help import arranged, asks_for_help
from ballu_mjx.common import runtime


def run_subcommand(
    name: str,
    description: str,
    subcommands: Mapping[str, type],
    run: Callable[[Any], int],
    arguments: Sequence[str] | None,
) -> int:
    """Parse the arguments (None: those of the process) of the command `name`, and run the chosen subcommand.

    Return the exit status (`runtime.exit_status`).
    """
    arguments = sys.argv[1:] if arguments is None else arguments

    def parse_and_run() -> int:
        runtime.prepare()
        helps = asks_for_help(arguments)
        options = tyro.extras.subcommand_cli_from_dict(
            {name: arranged(each) if helps else each for name, each in subcommands.items()},
            args=arguments,
            prog=f"python -m ballu_mjx {name}",
            description=description,
            config=(tyro.conf.OmitArgPrefixes,),
        )
        return run(options)

    return runtime.exit_status(parse_and_run, arguments)
