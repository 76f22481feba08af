"""The formats that are read: how each is recognised, listed, and read by a mapping."""

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
from ballu_mjx.recordings.importers.mapping import RoomMapping
from ballu_mjx.recordings.importers.motive import open_motive, recognise_motive
from ballu_mjx.recordings.importers.pose_files import open_euroc, open_tum, recognise_euroc, recognise_tum
from ballu_mjx.recordings.importers.qualisys import open_qualisys, recognise_qualisys
from ballu_mjx.recordings.importers.table import open_table
from ballu_mjx.recordings.importers.trajectories import Trajectories, refuse
from ballu_mjx.recordings.importers.vicon import list_vicon, read_vicon, recognise_vicon

_START = 1 << 16
"""Bytes that a format is recognised by."""

Opener = Callable[[Path, RoomMapping | None], Capture]


@dataclasses.dataclass(frozen=True)
class Reader:
    """One format."""

    name: str
    """As `record import --format` takes it."""
    program: str
    """What wrote the file, for messages."""
    recognise: Callable[[Path, str], bool]
    """Whether a file is one, by its path and how its text begins."""
    read: Callable[[Path, RoomMapping], Trajectories]
    list: Callable[[Path], Contents]
    open: Opener | None = None
    """The whole file; None for formats that hold no columns."""
    clock: bool = False
    """Whether [clock] of a mapping has a meaning for it."""


def _reader(
    name: str, program: str, recognise: Callable[[Path, str], bool], open_file: Opener, *, clock: bool = False
) -> Reader:
    def read(path: Path, mapping: RoomMapping) -> Trajectories:
        return select(open_file(path, mapping), mapping)

    return Reader(name, program, recognise, read, lambda path: list_capture(open_file(path, None)), open_file, clock)


READERS: Mapping[str, Reader] = {
    reader.name: reader
    for reader in (
        _reader("lerobot", "LeRobot dataset", recognise_lerobot, open_lerobot, clock=True),
        _reader("bag", "ROS bag or MCAP", recognise_bag, open_bag, clock=True),
        _reader("npz", "NumPy archive", recognise_npz, open_npz, clock=True),
        Reader("c3d", "C3D", recognise_c3d, read_c3d, list_c3d),
        _reader("motive", "OptiTrack Motive CSV", recognise_motive, open_motive),
        _reader("qualisys", "Qualisys TSV", recognise_qualisys, open_qualisys),
        _reader("euroc", "EuRoC CSV", recognise_euroc, open_euroc),
        _reader("tum", "TUM trajectory", recognise_tum, open_tum),
        Reader("vicon", "Vicon CSV", recognise_vicon, read_vicon, list_vicon),
        _reader("table", "table", lambda path, start: True, lambda path, mapping: open_table(path), clock=True),
    )
}
"""By name, in the order in which they are tried; a table is what no other format is."""


def find_reader(path: Path, name: str | None = None) -> Reader:
    """Return the reader named `name`, or the one that recognises the file or folder at `path`.

    **Raises** `InputError` where there is no such file, or a folder that no reader knows.
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
        refuse(path, "", "a folder of no format that is known", fix)
    return found


def read_capture(path: Path, mapping: RoomMapping, name: str | None = None) -> Trajectories:
    """Return what `mapping` asks for of the file at `path`, of the format `name` or the one that it is.

    **Raises** `InputError` naming file and fix.
    """
    reader = find_reader(path, name)
    clock = mapping.clock
    if not reader.clock and (clock.time is not None or clock.episode is not None):
        problem = f"{path.name} is read as a {reader.program}, which has one clock, its own"
        refuse(mapping.path, "[clock]", problem, "leave it out")
    if clock.episode is not None and reader.name != "lerobot":
        refuse(mapping.path, "[clock] episode", f"{path.name} is no LeRobot dataset", "leave it out")
    return reader.read(path, mapping)


def open_log(path: Path, mapping: RoomMapping) -> Capture:
    """Return a log of commands: any format that holds columns.

    **Raises** `InputError` naming file and fix.
    """
    reader = find_reader(path)
    if reader.open is None or reader.name in ("motive", "qualisys", "euroc", "tum"):
        raise InputError(f"{path}: a {reader.program} holds no commands; give a table, an archive or a bag of them.")
    # The log has a clock of its own: [clock] is the capture's.
    own = mapping.commands.time if reader.name == "bag" and mapping.commands.time in ("header", "received") else None
    return reader.open(path, dataclasses.replace(mapping, clock=dataclasses.replace(mapping.clock, time=own)))
