"""Report of a run as one page for the browser: `python -m ballu_mjx report RUN`."""

from __future__ import annotations

import dataclasses
import sys
import webbrowser
from collections.abc import Sequence
from pathlib import Path

import tyro

from ballu_mjx.cli._help import parse_options, refuse_without
from ballu_mjx.common import files, runtime
from ballu_mjx.common.errors import InputError
from ballu_mjx.viz import video
from ballu_mjx.viz.report import REPORT_FILE, render
from ballu_mjx.viz.report_content import collect


@dataclasses.dataclass(frozen=True)
class Options(runtime.CommandOptions):
    """Write a report of a run, or of a folder of `train all`, as one page for the browser. It needs no network."""

    run: tyro.conf.Positional[Path]
    """Folder of the run, or of `train all`."""
    output: Path | None = None
    """File to write. Without this option: report.html in the run's folder."""
    open: bool = False
    """Open the page in the browser."""
    video: bool = False
    """Also write the replay as MP4, beside the page."""
    show: str | None = None
    """Recording (or task) for the video. Without this option: the first."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status (`runtime.exit_status`)."""

    def run() -> None:
        options = parse_options(Options, arguments, "python -m ballu_mjx report")
        if options.video:
            video.choose_renderer()
        else:
            refuse_without(options, ("show",), "--video")
        runtime.prepare()
        _report(options)

    return runtime.exit_status(run, arguments)


def _report(options: Options) -> None:
    path = options.output or options.run / REPORT_FILE
    if path.is_dir():
        raise InputError(f"--output {path}: is a folder; give a file.")
    files.check_folder(path.parent)
    content = collect(options.run)
    if options.show is not None and options.show not in (names := [take.name for take in content.takes]):
        raise InputError(f"--show {options.show}: there is no such replay; give one of {', '.join(names) or 'none'}.")
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write(path, render(content))
    print(f"Written to {path}, {path.stat().st_size / 1e6:.1f} MB.")
    if not content.takes:
        print(
            "The report has no replay in 3D. An identification has none. For a residual, "
            "`python -m ballu_mjx evaluate RUN --output RUN` writes it."
        )
    elif options.video:
        shown = next(take for take in content.takes if options.show in (None, take.name))
        try:
            video.write(path.with_suffix(".mp4"), shown)
            print(f"Written to {path.with_suffix('.mp4')}: {shown.name}.")
        except InputError as error:
            print(error, file=sys.stderr)
    if options.open:
        webbrowser.open(path.resolve().as_uri())
