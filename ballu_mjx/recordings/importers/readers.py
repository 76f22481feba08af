"""Registry of the file formats, with functions that recognise, list and read each of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.importers.arrays import open_lerobot, open_npz, recognise_lerobot, recognise_npz
from ballu_mjx.recordings.importers.bags import open_bag, recognise_bag
from ballu_mjx.recordings.importers.c3d import list_c3d, read_c3d, recognise_c3d
from ballu_mjx.recordings.importers.capture import Capture, list_capture, select
from ballu_mjx.recordings.importers.contents import Contents
from ballu_mjx.recordings.importers.mapping import Commands, RoomMapping
from ballu_mjx.recordings.importers.motive import open_motive, recognise_motive
from ballu_mjx.recordings.importers.pose_files import open_euroc, open_tum, recognise_euroc, recognise_tum
from ballu_mjx.recordings.importers.qualisys import open_qualisys, recognise_qualisys
from ballu_mjx.recordings.importers.table import open_table
from ballu_mjx.recordings.importers.trajectories import Trajectories, refuse
from ballu_mjx.recordings.importers.vicon import list_vicon, read_vicon, recognise_vicon

_START = 1 << 16
"""Number of bytes at the start of a file by which its format is recognised."""

Opener = Callable[[Path, RoomMapping | None], Capture]
"""Function that reads a whole file. The mapping is None to list the file."""


@dataclasses.dataclass(frozen=True)
class Reader:
    """Functions of one file format."""

    name: str
    """Name of the format, as in `record import --format`."""
    program: str
    """Kind of file, for messages."""
    recognise: Callable[[Path, str], bool]
    """Function that returns whether a file has this format, from its path and the start of its text."""
    read: Callable[[Path, RoomMapping], Trajectories]
    """Function that reads the parts that a mapping selects."""
    list: Callable[[Path], Contents]
    """Function that lists the content of a file."""
    open: Opener | None = None
    """Function that reads the whole file. None if the format has no such function."""
    clock: bool = False
    """Whether the table [clock] of a mapping applies to this format."""
    rate: bool = True
    """Whether the rate of a mapping applies to this format."""


def _reader(
    name: str,
    program: str,
    recognise: Callable[[Path, str], bool],
    open_file: Opener,
    *,
    clock: bool = False,
    rate: bool = True,
) -> Reader:
    def read(path: Path, mapping: RoomMapping) -> Trajectories:
        return select(open_file(path, mapping), mapping)

    return Reader(
        name, program, recognise, read, lambda path: list_capture(open_file(path, None)), open_file, clock, rate
    )


READERS: Mapping[str, Reader] = {
    reader.name: reader
    for reader in (
        _reader("lerobot", "LeRobot dataset", recognise_lerobot, open_lerobot, clock=True, rate=False),
        _reader("bag", "ROS bag or MCAP", recognise_bag, open_bag, clock=True, rate=False),
        _reader("npz", "NumPy archive", recognise_npz, open_npz, clock=True),
        Reader("c3d", "C3D", recognise_c3d, read_c3d, list_c3d),
        _reader("motive", "OptiTrack Motive CSV", recognise_motive, open_motive),
        _reader("qualisys", "Qualisys TSV", recognise_qualisys, open_qualisys),
        _reader("euroc", "EuRoC CSV", recognise_euroc, open_euroc, rate=False),
        _reader("tum", "TUM trajectory", recognise_tum, open_tum, rate=False),
        Reader("vicon", "Vicon CSV", recognise_vicon, read_vicon, list_vicon),
        _reader("table", "table", lambda path, start: True, lambda path, mapping: open_table(path), clock=True),
    )
}
"""Readers by name, in the order in which they are tried. A file of no other format is a table."""


def find_reader(path: Path, name: str | None = None) -> Reader:
    """Return the reader named `name`, or the one that recognises the file or folder at `path`.

    **Raises** `InputError` if there is no such file, or if no reader recognises a folder.
    """
    if not path.exists():
        refuse(path, "", "there is no such file", "check the path")
    if name is not None:
        return READERS[name]
    start = ""
    if path.is_file():
        try:
            with path.open("rb") as stream:
                start = stream.read(_START).decode("utf-8-sig", errors="replace")
        except OSError as error:
            refuse(path, "", f"cannot be read ({error.strerror})", "check the file and its permissions")
    found = next(reader for reader in READERS.values() if reader.recognise(path, start))
    if path.is_dir() and found.name == "table":
        fix = "give a file in it; a ROS 2 bag holds metadata.yaml, a LeRobot dataset meta/info.json"
        refuse(path, "", "a folder of unknown format", fix)
    return found


def read_capture(path: Path, mapping: RoomMapping, name: str | None = None, *, has_log: bool = False) -> Trajectories:
    """Return the parts of the file at `path` that `mapping` selects.

    **Arguments**

    - `name`: the format. None to recognise it.
    - `has_log`: whether a command log belongs to the file. Commands in the file are then not read.

    **Raises** `InputError` if the file cannot be read, or lacks a selected part.
    """
    reader = find_reader(path, name)
    clock = mapping.clock
    if not reader.clock and (clock.time is not None or clock.episode is not None):
        problem = f"{path.name} is read as a {reader.program}, which has only one clock"
        refuse(mapping.path, "[clock]", problem, "leave it out")
    if not reader.clock and clock.time_unit != "s":
        problem = f"{path.name} is read as a {reader.program}, whose format fixes the unit of times"
        refuse(mapping.path, "[clock] time_unit", problem, "leave it out")
    if not reader.rate and mapping.rate is not None:
        problem = f"{path.name} is read as a {reader.program}, which has a time for each sample"
        refuse(mapping.path, "rate", problem, "leave it out")
    if clock.episode is not None and reader.name != "lerobot":
        refuse(mapping.path, "[clock] episode", f"{path.name} is not a LeRobot dataset", "leave it out")
    if has_log:
        none = dataclasses.replace(mapping.commands, columns={}, limits=(), ranges=())
        mapping = dataclasses.replace(mapping, commands=none)
    return reader.read(path, mapping)


def open_log(path: Path, mapping: RoomMapping) -> Capture:
    """Return the command log at `path`, in any format with columns.

    **Raises** `InputError` if the file cannot be read, or if its format holds no commands.
    """
    reader = find_reader(path)
    if reader.open is None or reader.name in ("motive", "qualisys", "euroc", "tum"):
        raise InputError(f"{path}: a {reader.program} holds no commands; give them as a table, an archive or a bag.")
    # [clock] is for the capture. The clock of the log is under [commands].
    own = mapping.commands.time if reader.name == "bag" and mapping.commands.time != Commands.time else None
    clock = dataclasses.replace(mapping.clock, time=own, log=True)
    return reader.open(path, dataclasses.replace(mapping, clock=clock))
