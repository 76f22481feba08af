"""Order of the options in --help: data, length of training and what to learn first; processes and debugging last.

tyro groups options by the dataclass that holds them, with those of base classes first. For --help alone, the options
are therefore copied into other dataclasses, one for each purpose.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import sys
import textwrap
import typing
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple, TypeVar

import tyro

from ballu_mjx.common.errors import InputError

_Options = TypeVar("_Options")
_ASKS_FOR_HELP = ("-h", "--help")


class _Group(NamedTuple):
    title: str
    description: str
    names: tuple[str, ...]
    """Names of the options, in the order in which --help shows them."""


_FIRST = (
    _Group(
        "data",
        "Recordings, robot and simulator, and where results go. A path is a recording (.csv or .csv.gz) or a folder of "
        "them.",
        ("recordings", "validation", "test", "robot", "actuators", "residual", "levels", "fixed_from", "mapping")
        + ("commands", "format", "robot_seed", "robot_family", "tasks", "output"),
    ),
    _Group(
        "length of training",
        "Number of steps, seeds and checkpoints, and the run to resume.",
        ("quick", "num_timesteps", "policy_steps", "residual_steps", "updates", "relinearizations", "evaluations")
        + ("starts", "steps", "rounds", "seed", "seeds", "trials", "takes", "validate_every", "keep_every", "resume"),
    ),
    _Group(
        "what to learn",
        "Choices of the method and of the quantities to learn.",
        ("preset", "forces", "terms", "free", "force_shares", "motion", "objective", "also", "domain_randomization"),
    ),
)
_LAST = (
    _Group(
        "several processes",
        "One training in several processes, on one or several machines (docs/distributed.md).",
        ("coordinator", "num_processes", "process_id"),
    ),
    _Group("logging and debugging", "", ("wandb", "debug")),
)
_DETAILS = {
    "data": "more",
    "env": "task details",
    "ppo": "reinforcement learning details",
    "fit": "method details",
    "windows": "details of windows",
    "sampling": "details of sampling",
    "pipeline": "more",
}
"""Title of the group with a section's remaining options."""


def asks_for_help(arguments: Sequence[str] | None) -> bool:
    """Return whether the arguments (None: those of the process) ask for --help."""
    return any(each in _ASKS_FOR_HELP for each in (sys.argv[1:] if arguments is None else arguments))


def parse_options(options: type[_Options], arguments: Sequence[str] | None, prog: str) -> _Options:
    """Return a command's options, parsed from its arguments (None: those of the process).

    --help shows the options in the order of this module.
    """
    if asks_for_help(arguments):
        tyro.cli(arranged(options), args=arguments, prog=prog, config=(tyro.conf.OmitArgPrefixes,))
    return tyro.cli(options, args=arguments, prog=prog)


def arranged(options: type, sections: Mapping[str, Any] | None = None) -> type:
    """Return a dataclass for --help alone, which holds the same options as another dataclass, in groups.

    **Arguments**

    - `options`: dataclass of the command's options, or of its sections.
    - `sections`: defaults of each section, by name. None if `options` has no sections.
    """
    held = {"": options} if sections is None else sections
    found = {name: _described_fields(section) for name, section in held.items()}

    def take(wanted: Sequence[_Group]) -> list[tuple[str, str, list[Any]]]:
        taken = []
        for group in wanted:
            fields = [fields.pop(name) for name in group.names for fields in found.values() if name in fields]
            if fields:
                taken.append((group.title, group.description, fields))
        return taken

    first, last = take(() if sections is None else _FIRST), take(_LAST)
    rest = []
    for name, fields in found.items():
        if fields:
            described = "" if sections is None or name == "data" else inspect.getdoc(type(sections[name])) or ""
            rest.append((_DETAILS.get(name, name), described, list(fields.values())))
    made = []
    for number, (title, description, fields) in enumerate([*first, *rest, *last]):
        if not title:
            made += fields
            continue
        group = dataclasses.make_dataclass(f"Group{number}", fields, frozen=True, kw_only=True)
        group.__doc__ = description or " "  # without a docstring, dataclasses write their signature there
        made.append((f"group{number}", Annotated[group, tyro.conf.arg(name=title)]))
    result = dataclasses.make_dataclass(options.__name__, made, frozen=True, kw_only=True)
    result.__doc__ = options.__doc__
    return result


def _described_fields(section: Any) -> dict[str, tuple[str, Any, Any]]:
    """Return the fields of a dataclass by name, with their help, in the form that `dataclasses.make_dataclass` takes.

    `section` is the dataclass, or an instance whose values are the defaults.
    """
    options = section if isinstance(section, type) else type(section)
    hints, said, found = typing.get_type_hints(options, include_extras=True), _field_docstrings(options), {}
    for field in dataclasses.fields(options):
        kind = Annotated[hints[field.name], tyro.conf.arg(help=said.get(field.name, ""))]
        copied = dataclasses.field(default=field.default, default_factory=field.default_factory)  # pyright: ignore
        if section is not options:
            copied = dataclasses.field(default=getattr(section, field.name))
        found[field.name] = (field.name, kind, copied)
    return found


def _field_docstrings(options: type) -> dict[str, str]:
    """Return the docstring of each field by name, those of base classes included."""
    found: dict[str, str] = {}
    for cls in reversed(options.__mro__):
        if not dataclasses.is_dataclass(cls):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
        assert isinstance(body, ast.ClassDef)
        for field, text in zip(body.body, body.body[1:], strict=False):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
                and isinstance(text.value.value, str)
            ):
                found[field.target.id] = " ".join(text.value.value.split())
    return found


def refuse_without(options: Any, names: Sequence[str], needed: str) -> None:
    """Check that options which have no effect without another one, `needed`, have their defaults.

    `options` is a dataclass, and `names` are names of its fields.

    **Raises** `InputError` that names the first other option.
    """
    for name in names:
        if getattr(options, name) != getattr(type(options), name):
            raise InputError(
                f"--{name.replace('_', '-')} has no effect without {needed}; leave it out, or add {needed}."
            )
