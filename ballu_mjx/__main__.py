"""`python -m ballu_mjx`: which commands there are, in the order of the work; with a command's name, that command.

The script `ballu_mjx` is the same.
"""

import importlib
import sys
from collections.abc import Sequence

from ballu_mjx.cli import completion
from ballu_mjx.common import runtime
from ballu_mjx.common.errors import InputError

COMMANDS = (
    ("recording", "record import FILE", "make a recording from a Vicon CSV, a C3D or any table"),
    ("", "record check FILE", "what is in a recording, and what is wrong with it"),
    ("", "record simulate", "record on the virtual robot"),
    ("identification", "train sysid", "actuator parameters from a suspended sweep"),
    ("residual", "train envmimic", "forces that make simulation follow recordings"),
    ("", "train aerodynamic", "the air around the balloon, identified: no forces learned, but physics"),
    ("", "train fluid", "lift, drag and moments of any body in air or water, as polynomials"),
    ("", "train supervised", "forces by regression on those that explain recordings; also analytic, by gradients"),
    ("", "evaluate RUN", "replay recordings without and with a residual"),
    ("policy", "train walk", "also turn, turn-right, walk-backward: policies in an improved simulator"),
    ("everything", "train all", "the whole story on a virtual robot"),
    ("looking", "report RUN", "a run as one page for the browser, with a replay in 3D"),
    ("", "view RUN", "the replay, or a recording, live"),
    ("", "compare RUN RUN ...", "runs side by side, mean and interval over seeds"),
    ("your own tools", "export policy RUN", "a policy as a controller that needs NumPy alone"),
    ("", "export simulator RUN", "an improved simulator for C MuJoCo"),
    ("", "export check FOLDER", "an exported policy in C MuJoCo, beside its own simulator"),
)
"""Stage, what follows `python -m ballu_mjx`, what it is for."""
NAMES = tuple(dict.fromkeys(command.split()[0] for _, command, _ in COMMANDS))
"""Of the modules that are commands."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that the first of the arguments names, or print them all; returns its exit status."""
    first, *others = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if first in NAMES:
        return importlib.import_module(f"{__package__}.cli.{first}").main(others)
    return runtime.exit_status(lambda: _own(first, others), others)


def _own(first: str, others: Sequence[str]) -> None:
    if first in ("-h", "--help"):
        _print_commands()
    elif first == "completion":
        if len(others) != 1 or others[0] not in completion.SHELLS:
            raise InputError(f"completion: give the shell, {' or '.join(completion.SHELLS)}.")
        print(completion.completion_script(others[0], NAMES))
    else:
        raise InputError(f"{first}: there is no such command; `python -m ballu_mjx` lists them.")


def _print_commands() -> None:
    print("Commands, each after `python -m ballu_mjx`; --help explains one, `train ... --quick` shows it at work.\n")
    for stage, command, purpose in COMMANDS:
        print(f"  {stage:15} {command:20} {purpose}")
    print("\n`ballu_mjx train` and so on does the same; `ballu_mjx completion bash` (or zsh) prints its completion.")


if __name__ == "__main__":
    sys.exit(main())
