"""Recordings from the command line: `python -m ballu_mjx record import`, `... check`, `... simulate`.

JAX and modules that need it are imported inside functions: `runtime.prepare` has to come first.
"""

from __future__ import annotations

import dataclasses
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import tyro

from ballu_mjx.cli._subcommands import run_subcommand
from ballu_mjx.cli.record_simulate import Simulate, simulate
from ballu_mjx.common import files, runtime
from ballu_mjx.common.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Float

    from ballu_mjx.recordings.recording import Recording
    from ballu_mjx.robots.description import RobotDescription


Format = Literal[
    "auto", "lerobot", "bag", "npz", "c3d", "motive", "qualisys", "euroc", "tum", "vicon", "table"
]  # fmt: skip
LEAST_CONFIDENCE = 0.4
"""Smallest accepted confidence of an `Alignment`. Below it, another offset fits about as well."""
LEAST_CORRELATION = 0.35
"""Smallest accepted correlation. Below it, the command log does not belong to the captured motion."""


@dataclasses.dataclass(frozen=True)
class Import(runtime.CommandOptions):
    """Make a recording from a motion-capture file and a command log."""

    file: tyro.conf.Positional[Path]
    """Motion-capture file: an export of OptiTrack, Qualisys or Vicon, C3D, a TUM or EuRoC trajectory, a ROS bag or
    MCAP, a LeRobot dataset's folder, an .npz archive, or a table (a CSV with names in its first row)."""
    mapping: Path
    """TOML or JSON file that maps names in the capture to parts of the robot. `record example-mapping` prints one."""
    output: Path
    """Recording to write, NAME.csv or NAME.csv.gz. NAME.json is written beside it."""
    commands: Path | None = None
    """Command log: a CSV, an .npz archive or a bag. Commands in the motion-capture file are then not read. Without this
    option: the motion-capture file holds the commands."""
    offset: float | None = None
    """Time (s) to add to the log's times to get the capture's times. The capture begins at 0, or at its first time in a
    table. 0 if both have one clock. Without this option: the offset is estimated from the robot's motion, if the
    robot's adapter can predict this motion."""
    offset_range: tuple[float, float] | None = None
    """Smallest and largest offset (s) to search. A range is needed if the commands are periodic and several offsets
    fit."""
    delay: float = 0.05
    """Assumed delay (s) from a logged command to the start of the servo, beyond the nominal robot's. It is subtracted
    from an estimated offset, because it does not belong to the clocks."""
    format: Format = "auto"
    """Format of the file. auto: chosen by its extension and its first lines."""
    robot: str = "ballu"
    """Name of a robot, or its description file."""


@dataclasses.dataclass(frozen=True)
class Map(runtime.CommandOptions):
    """List the content of a motion-capture file, and write a draft of its mapping."""

    file: tyro.conf.Positional[Path]
    """Motion-capture file; see `record import --help`."""
    output: Path | None = None
    """Mapping to write, NAME.toml. Without this option: the mapping is printed."""
    format: Format = "auto"
    """Format of the file. auto: chosen by its extension and its first lines."""
    robot: str = "ballu"
    """Name of a robot, or its description file."""


@dataclasses.dataclass(frozen=True)
class Check(runtime.CommandOptions):
    """Summarize recordings: rate, gaps, ranges and commands. For an invalid recording, print the place and the fix."""

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """Recordings, or folders of them."""
    output: Path | None = None
    """Folder for a figure of each recording, NAME.png. Without this option: no figures."""
    robot: str = "ballu"
    """Name of a robot, or its description file."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status (`runtime.exit_status`)."""
    description = "Make and check recordings of the robot. Each subcommand explains its options with --help."
    return run_subcommand("record", description, subcommands(), _run, arguments)


def subcommands() -> dict[str, type]:
    """Return the options of the subcommands by name."""
    return {"import": Import, "map": Map, "check": Check, "simulate": Simulate, "example-mapping": _Example}


@dataclasses.dataclass(frozen=True)
class _Example(runtime.CommandOptions):
    """Print a mapping file with every key and its default. Save it, and delete the keys that you do not need."""

    robot: str = "ballu"
    """Name of a robot, or its description file."""


def _run(options: Import | Map | Check | Simulate | _Example) -> int:
    if isinstance(options, Import):
        _import(options)
    elif isinstance(options, Map):
        _map(options)
    elif isinstance(options, Check):
        return _check(options)
    elif isinstance(options, Simulate):
        simulate(options)
    else:
        from ballu_mjx.recordings.importers.example_mapping import example_mapping
        from ballu_mjx.robots.registry import load_robot

        print(example_mapping(load_robot(options.robot)), end="")
    return 0


# ---- import ----


def _import(options: Import) -> None:
    from ballu_mjx.recordings.csv_format import check_new, recording_name
    from ballu_mjx.recordings.importers.capture import read_commands
    from ballu_mjx.recordings.importers.mapping import read_mapping
    from ballu_mjx.recordings.importers.placement import place, with_commands
    from ballu_mjx.recordings.importers.readers import open_log, read_capture
    from ballu_mjx.recordings.validation import SHORTEST
    from ballu_mjx.robots.registry import load_robot

    check_new(options.output)
    if options.offset is not None and options.offset_range is not None:
        raise InputError("--offset and --offset-range exclude each other; give one of them.")
    if options.commands is None and (options.offset is not None or options.offset_range is not None):
        raise InputError("--offset and --offset-range need a command log; add --commands.")
    robot = load_robot(options.robot)
    mapping = read_mapping(options.mapping, robot)
    known = None if options.format == "auto" else options.format
    trajectories = read_capture(options.file, mapping, known, has_log=options.commands is not None)
    recording = place(trajectories, mapping, robot, recording_name(options.output))
    if recording.time[-1] - recording.time[0] < SHORTEST:
        raise InputError(f"{options.file}: lasts less than {SHORTEST:g} s; capture for longer.")
    cropped = trajectories.first_frame > 1
    begins = f", from frame {trajectories.first_frame}, {recording.time[0]:.2f} s of the trial" if cropped else ""
    duration = recording.time[-1] - recording.time[0]
    print(f"{options.file}: {len(recording.time)} samples, {duration:.2f} s{begins}")
    if options.commands is None:
        if trajectories.commands is None:
            raise InputError(
                f"{options.file}: holds no commands; give their log by --commands, or name their columns under "
                f"[commands] in {options.mapping}."
            )
        time, command = trajectories.commands.time, trajectories.commands.command
    else:
        time, command = read_commands(open_log(options.commands, mapping), mapping.commands, mapping)
        found = _offset(options, robot, recording, time, command) if options.offset is None else options.offset
        time = time + found
    recording, cut = with_commands(options.commands or options.file, recording, time, command)
    if max(cut) > 0:
        print(f"cut off, without commands: {cut[0]:.2f} s at the start, {cut[1]:.2f} s at the end")
    if options.commands is not None and (changes := _changes(command)) > 0 and _changes(recording.command) == 0:
        print(
            f"{options.commands}: the commands change {changes} times, and never within the capture; check time_unit "
            f"under [commands] in {options.mapping}, and --offset."
        )
    _write(options, robot, recording)


def _changes(command: Float[np.ndarray, "N commands"]) -> int:
    return int(np.any(np.diff(command, axis=0) != 0, axis=1).sum())


def _offset(
    options: Import,
    robot: RobotDescription,
    recording: Recording,
    time: Float[np.ndarray, " N"],
    command: Float[np.ndarray, "N commands"],
) -> float:
    """Return the offset (s) of the command log, estimated from the robot's motion, and print it.

    **Raises** `InputError` if the offset is not clear.
    """
    from ballu_mjx.recordings.clock_alignment import align
    from ballu_mjx.recordings.recording_hooks import hooks_of

    log, by_hand = options.commands, "give the offset by --offset"
    for path, clock in ((log, time), (options.file, recording.time)):
        if not 1.0 <= clock[-1] - clock[0] <= _LONGEST_SEARCH:
            raise InputError(
                f"{path}: lasts {clock[-1] - clock[0]:.4g} s; offsets are estimated for 1 to {_LONGEST_SEARCH:g} s, "
                f"cut it or {by_hand}."
            )
    response = hooks_of(robot).response(recording, time, command)
    if response is None:
        raise InputError(
            f"{log}: the capture holds no motion that the adapter of {robot.name} predicts from commands; {by_hand}."
        )
    motion, grid, predicted = response
    within = options.offset_range
    if within is not None:
        within = min(within) + options.delay, max(within) + options.delay
    found = align(recording.time, motion, grid, predicted, within=within)
    if found is None:
        raise InputError(
            f"{log}: the commands or the robot never move, or log and capture hardly overlap; {by_hand}, or correct "
            "--offset-range."
        )
    best, offset = found.best, found.best.offset - options.delay
    answer = f"offset {offset:+.3f} s: correlation {best.correlation:.2f} over {found.overlap:.1f} s"
    if abs(best.correlation) < LEAST_CORRELATION:
        raise InputError(
            f"{log}: the commands do not fit the motion at any offset; best is {answer}. Give this trial's log, "
            f"correct [commands] in {options.mapping}, or {by_hand}."
        )
    if best.correlation < 0:
        raise InputError(
            f"{log}: the robot moves against the commands, at {answer}; reverse the ranges of [commands] in "
            f"{options.mapping}, or {by_hand}."
        )
    other = found.second
    if other is not None and found.confidence < LEAST_CONFIDENCE:
        raise InputError(
            f"{log}: the commands repeat themselves, so that two offsets fit: {answer}, and "
            f"{other.offset - options.delay:+.3f} s ({other.correlation:.2f}), a confidence of {found.confidence:.2f}; "
            "give the right one by --offset, or a range by --offset-range."
        )
    print(f"{log}: {answer}; good to about {_ALIGNMENT_ERROR:g} s")
    if other is not None:
        apart = f"{other.offset - options.delay:+.3f} s, correlation {other.correlation:.2f}"
        print(f"  next best {apart}: confidence {found.confidence:.2f} of 1")
    return offset


_LONGEST_SEARCH = 7200.0
"""Longest capture or log (s) for which an offset is estimated."""
_ALIGNMENT_ERROR = 0.05
"""Error (s) that an estimated offset does not exceed in nine of ten trials of virtual robots
(benchmarks/alignment.py)."""


def _write(options: Import, robot: RobotDescription, recording: Recording) -> None:
    """Write the recording, and read it back to check it. A recording that cannot be read is deleted."""
    from ballu_mjx.recordings.csv_format import read_recording, sidecar_path, write_recording
    from ballu_mjx.recordings.summary import held_sites

    options.output.parent.mkdir(parents=True, exist_ok=True)
    write_recording(recording, options.output, robot)
    try:
        read = read_recording(options.output, robot)
    except InputError as error:
        for path in (options.output, sidecar_path(options.output)):
            path.unlink()
        found = str(error).replace(f"{options.output}, ", "").replace(f"{options.output}: ", "")
        raise InputError(
            f"{options.file}: gives no valid recording with {options.mapping}, nothing written: {found} Check [units], "
            f"[clock] and [axes] in {options.mapping}, too."
        ) from error
    duration = read.time[-1] - read.time[0]
    filled = sum(read.interpolated.values())
    held = "".join(f"; {count} samples of {sites} were held, not seen" for sites, count in held_sites(read))
    print(f"{options.output}: {duration:.2f} s, {filled} cells filled in when read{held}; `record check` tells more")


# ---- map ----


def _map(options: Map) -> None:
    from ballu_mjx.recordings.importers.contents import describe_contents
    from ballu_mjx.recordings.importers.draft import draft_mapping
    from ballu_mjx.recordings.importers.readers import find_reader
    from ballu_mjx.robots.registry import load_robot

    if options.output is not None:
        if options.output.suffix != ".toml":
            raise InputError(f"--output {options.output}: a mapping is TOML; give a name that ends in .toml.")
        if options.output.exists():
            raise InputError(f"{options.output}: exists already; delete it, or give another --output.")
        files.check_folder(options.output.parent)
    robot = load_robot(options.robot)
    contents = find_reader(options.file, None if options.format == "auto" else options.format).list(options.file)
    text = draft_mapping(contents, robot)
    if options.output is None:
        print(text, end="")
        return
    print("\n".join(describe_contents(contents)))
    files.write(options.output, text)
    guesses, empty = text.count("# a guess"), text.count("# choose ")
    remaining = (
        f"{guesses} {'guess' if guesses == 1 else 'guesses'} to check, {empty} {'place' if empty == 1 else 'places'}"
    )
    print(f"{options.output}: {remaining} to complete; then `record import` takes it")


# ---- check ----


def _check(options: Check) -> int:
    from ballu_mjx.recordings.csv_format import list_recordings, read_recording, recording_name
    from ballu_mjx.recordings.summary import find_gaps, summarize_recording
    from ballu_mjx.robots.registry import load_robot
    from ballu_mjx.viz.recording import draw_recording

    robot = load_robot(options.robot)
    paths = list_recordings(options.recordings)
    if not paths:
        raise InputError("There is no recording to check; name a recording, or a folder of recordings.")
    if options.output is not None:
        files.check_folder(options.output)
        options.output.mkdir(parents=True, exist_ok=True)
    names = Counter(map(recording_name, paths))
    broken = 0
    for path in paths:
        try:
            recording = read_recording(path, robot)
        except InputError as error:
            print(error, file=sys.stderr)
            broken += 1
            continue
        gaps = find_gaps(path)
        print(summarize_recording(path, recording, robot, gaps))
        if options.output is not None:
            # Recordings of several folders may have the same name.
            stem = recording.name if names[recording.name] == 1 else f"{path.parent.name}-{recording.name}"
            figure = options.output / f"{stem}.png"
            draw_recording(figure, recording, robot, gaps)
            print(f"  drawn in {figure}")
    return 2 if broken else 0
