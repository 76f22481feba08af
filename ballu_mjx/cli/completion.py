"""Shell completion of the script `ballu_mjx`: `ballu_mjx completion bash`.

tyro makes it from the options of all commands. JAX and modules that need it are imported inside functions:
`runtime.prepare` has to come first.
"""

from __future__ import annotations

import contextlib
import importlib
import io
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Union

import tyro

from ballu_mjx.common import runtime

PROGRAM = "ballu_mjx"
SHELLS = ("bash", "zsh")


def completion_script(shell: str, commands: Sequence[str]) -> str:
    """Return the completion script for a shell, one of `SHELLS`.

    It completes subcommands, options and their choices; in bash also paths. `commands` are the names of the modules in
    this package that are commands.
    """
    runtime.prepare()
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(
            {name: _parser(name) for name in commands},
            prog=PROGRAM,
            args=["--tyro-print-completion", shell],
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes),
        )
    if shell == "bash":  # tyro completes paths of options, but not of positional arguments
        text.write(f"complete -o default -F _tyro_{PROGRAM} {PROGRAM}\n")
    return text.getvalue()


def _parser(command: str) -> Any:
    """Return the type from which tyro makes a command's parser."""
    module = importlib.import_module(f"{__package__}.{command}")
    return _either(module.subcommands()) if hasattr(module, "subcommands") else module.Options


def _either(subcommands: Mapping[str, Callable[..., Any]]) -> Any:
    each = (Annotated[Any, tyro.conf.subcommand(name, constructor=made)] for name, made in subcommands.items())
    return Union[tuple(each)]  # noqa: UP007, the members are not known before
