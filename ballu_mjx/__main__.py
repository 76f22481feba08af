"""`python -m ballu_mjx` lists the commands; `python -m ballu_mjx NAME` runs one. The script `ballu_mjx` is the same."""

import importlib
import sys
from collections.abc import Sequence

from ballu_mjx.cli import completion
from ballu_mjx.common import runtime
from ballu_mjx.common.errors import InputError

COMMANDS = (
    ("recording", "record map FILE", "list the content of a motion-capture file, and draft a mapping for it"),
    ("", "record import FILE", "make a recording from a motion-capture file or table, by its mapping"),
    ("", "record check FILE", "summarize a recording and report its faults"),
    ("", "record simulate", "record on the virtual robot"),
    ("identification", "train sysid", "identify actuators, or the parameters that a description declares"),
    ("residual", "train envmimic", "learn residual forces by reinforcement learning"),
    ("", "train aerodynamic", "identify physical parameters of the air around the balloon"),
    ("", "train fluid", "fit lift, drag and moments of any body in air or water, as polynomials"),
    ("", "train supervised", "learn residual forces by regression; `train analytic` does so by gradients"),
    ("", "evaluate RUN", "replay recordings without and with a residual"),
    ("policy", "train walk", "train a policy in an improved simulator; also turn, turn-right, walk-backward"),
    ("everything", "train all", "run all of the paper's experiments on a virtual robot"),
    ("results", "report RUN", "write a run as one page for the browser, with a replay in 3D"),
    ("", "view RUN", "show a run's replay, or a recording, live in 3D"),
    ("", "compare RUN RUN ...", "compare runs: mean and interval over seeds"),
    ("your own tools", "export policy RUN", "write a policy as a controller that needs only NumPy"),
    ("", "export simulator RUN", "write an improved simulator for C MuJoCo"),
    ("", "export check FOLDER", "compare an exported policy in C MuJoCo with its own simulator"),
)
"""Stage, arguments after `python -m ballu_mjx`, and purpose of each command, in the order of use."""
NAMES = tuple(dict.fromkeys(command.split()[0] for _, command, _ in COMMANDS))
"""Names of the commands, which are modules in `cli`."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that the first argument names, or list all commands; return the exit status."""
    first, *others = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if first in NAMES:
        return importlib.import_module(f"{__package__}.cli.{first}").main(others)
    return runtime.exit_status(lambda: _own(first, others), others)


def _own(first: str, others: Sequence[str]) -> None:
    if first in ("-h", "--help"):
        _print_commands()
    elif first == "completion":
        if len(others) != 1 or others[0] not in completion.SHELLS:
            raise InputError(f"completion: name one shell, {' or '.join(completion.SHELLS)}.")
        print(completion.completion_script(others[0], NAMES))
    else:
        raise InputError(f"{first}: there is no such command; `python -m ballu_mjx` lists them.")


def _print_commands() -> None:
    print(
        "Commands, each run as `python -m ballu_mjx COMMAND`. --help explains a command; `train ... --quick` tries it "
        "in a few minutes.\n"
    )
    for stage, command, purpose in COMMANDS:
        print(f"  {stage:15} {command:20} {purpose}")
    print("\n`ballu_mjx COMMAND` does the same. `ballu_mjx completion bash` (or zsh) prints its shell completion.")


if __name__ == "__main__":
    sys.exit(main())
