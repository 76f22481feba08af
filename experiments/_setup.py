"""Shared code of the experiments, as scripts or as notebooks. Call `prepare` before imports that need JAX."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ballu_mjx.common.results import Table


def prepare() -> None:
    """Install the package in Colab, remove a notebook's own arguments, and set JAX's start-up options.

    In a notebook, write the options of the experiment into `sys.argv[1:]` after this call.
    """
    if "google.colab" in sys.modules:
        if not Path("constraints.txt").exists():
            raise SystemExit("Clone the repository first, and change to its folder: %cd ballu-mjx.")
        subprocess.run([sys.executable, "-m", "pip", "install", "-q", "-c", "constraints.txt", "-e", "."], check=True)
    if "ipykernel" in sys.modules:
        sys.argv[1:] = []
        sys.path.insert(0, ".")
    from ballu_mjx.common import runtime

    runtime.prepare(brief="--quick" in sys.argv[1:])  # spends most of its time on compiling


def parse(parser: argparse.ArgumentParser, output: Path, arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Add the option `--output` to a parser that has `--quick`, and parse the command line, or `arguments`.

    A list with an entry twice is an error. The default of `--output` is the folder `output`. With `--quick` it is a
    folder beside it, because finished trainings are not repeated: a full run in the same folder would take those of the
    quick run.
    """
    quick = output.with_name(f"{output.name}-quick")
    parser.add_argument("--output", type=Path, help=f"folder of all results ({output}, or {quick} under --quick)")
    options = parser.parse_args(arguments)
    for name, given in vars(options).items():
        if isinstance(given, list) and len(set(given)) < len(given):
            parser.error(f"--{name.replace('_', '-')} has an entry twice; a repetition is no other sample.")
    if options.output is None:
        options.output = quick if options.quick else output
    return options


def reserve(folder: Path, **settings: object) -> None:
    """Reserve a folder, whose finished results a later call takes over, for these settings of the experiment.

    **Raises** `InputError` naming the differences if the folder has results of other settings, or of unknown ones.
    """
    from ballu_mjx.common import files
    from ballu_mjx.common.errors import InputError

    path = folder / "settings.json"
    if path.exists():
        found = files.read_json(path, "choose another folder with --output")
        wanted = json.loads(json.dumps(settings))
        other = [f"{name} {found.get(name)}" for name in wanted if wanted[name] != found.get(name)]
        if other:
            raise InputError(f"{folder} has results with {', '.join(other)}; choose another folder with --output.")
    elif folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder} has files but no {path.name}; choose another folder with --output.")
    else:
        folder.mkdir(parents=True, exist_ok=True)
        files.write(path, json.dumps(settings, indent=2) + "\n")


def write_table(text: str, folder: Path) -> None:
    """Print Markdown `text`, and write it to `table.md` in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "table.md").write_text(text + "\n", encoding="utf-8")
    print(text)


def write_tables(
    tables: Mapping[str, Table], folder: Path, results: Path | None, seeds: Mapping[str, Sequence[int]]
) -> None:
    """Print tables, and write them to `table.md` in a folder.

    If `results` is not None, also write their data and the `seeds` by use to this JSON file.
    """
    from ballu_mjx.common.results import write_results

    write_table("\n\n".join(f"### {name}\n\n{table.to_markdown()}" for name, table in tables.items()), folder)
    if results is not None:
        write_results(results, tables, "Development data", seeds=seeds)
        print(f"\nWritten to {results}; `python docs/render.py` renders it.")


def run(main: Callable[[], None]) -> None:
    """Call `main`. Exit with a one-sentence message after invalid input, and without traceback after an interrupt."""
    from ballu_mjx.common.errors import InputError

    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        sys.exit(130)
