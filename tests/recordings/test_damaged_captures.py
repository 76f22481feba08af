"""Tests of damaged capture files. Each format refuses each kind of damage by a message with file, place and remedy.

The kinds are: a truncated row, a missing header, a renamed column, a cell that is not a number, an unknown unit, and
quaternions of zeros. test_readers.py and test_importers.py test damage that concerns one format only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_files import (
    ARCHIVE,
    HIDDEN,
    NAMED,
    TABLE,
    Damage,
    in_line,
    replaced,
    shortened,
    without_line,
    write_euroc,
    write_motive,
    write_nexus,
    write_npz,
    write_qualisys_bodies,
    write_qualisys_markers,
    write_table,
    write_tracker,
    write_tum,
    zeroed,
)
from rover import write_rover

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.importers.mapping import RoomMapping, read_mapping
from ballu_mjx.recordings.importers.placement import place
from ballu_mjx.recordings.importers.readers import read_capture
from ballu_mjx.robots.description import RobotDescription

POSE = '[hull]\nbody = "pose"\n[tip]\nbody = "pose"\n'
MARKERS = '[hull]\nmarkers = ["hull1", "hull2", "hull3"]\n[tip]\nbody = "tip"\n'
TURNED = '[hull]\nbody = "hull"\nrotation = "helical"\n[tip]\nbody = "tip"\nrotation = "helical"\n'


def write_quaternions(folder: Path) -> Path:
    return write_tracker(folder, "quaternion")


FORMATS: Mapping[str, tuple[Callable[[Path], Path], str]] = {
    "motive": (write_motive, NAMED),
    "qualisys-6d": (write_qualisys_bodies, NAMED),
    "qualisys-3d": (write_qualisys_markers, MARKERS),
    "nexus": (write_nexus, NAMED),
    "tracker": (write_tracker, TURNED),
    "tracker-quaternion": (write_quaternions, NAMED),
    "tum": (write_tum, POSE),
    "euroc": (write_euroc, POSE),
    "table": (write_table, TABLE),
    "npz": (write_npz, ARCHIVE),
}
"""Function that writes a file, and the mapping of its sites, by format."""


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    return write_rover(tmp_path_factory.mktemp("rover"))


def room(folder: Path, robot: RobotDescription, text: str) -> RoomMapping:
    commands = '[commands]\narm = "none"\npush = "none"\n'
    (folder / "room.toml").write_text(f'robot = "r"\n[origin]\nstart = false\n{text}{commands}')
    return read_mapping(folder / "room.toml", robot)


def saved(name: str, array: np.ndarray) -> Damage:
    """Write `array` into an archive as `name`."""

    def damage(path: Path) -> None:
        with np.load(path, allow_pickle=False) as content:
            arrays: dict[str, Any] = {**content, name: array}
        np.savez(path, **arrays)

    return damage


CUT_OFF, NO_NUMBER = "the file was cut off; copy", "is not a number, or is too large;"
REFUSALS: list[tuple[str, Damage, list[str]]] = [
    # a truncated row
    ("motive", shortened(80, 5), ["line 80: the row ends before 'hull Rotation W'", CUT_OFF]),
    ("qualisys-6d", shortened(80, 9, "\t"), ["line 80: the row ends before 'hull Rot[0]'", CUT_OFF]),
    ("qualisys-3d", shortened(80, 9, "\t"), ["line 80: the row ends before 'hull3 Y'", CUT_OFF]),
    ("nexus", shortened(120, 6), ["line 120: the row ends before 'rover:hull'", CUT_OFF]),
    ("tracker", shortened(80, 9), ["line 80: the row ends before 'tip:tip'", CUT_OFF]),
    ("tum", shortened(80, 5, " "), ["line 80: the row ends before 'qy'", CUT_OFF]),
    ("tum", shortened(2, 5, " "), ["line 2: the row ends before 'qy'", CUT_OFF]),
    ("euroc", shortened(80, 6), ["line 80: the row ends before 'qy'", CUT_OFF]),
    ("table", shortened(80, 5), ["line 80: the row has 5 cells, the header 13", "was cut off, copy it again"]),
    # a missing header, or a missing line of it
    ("motive", without_line(1), ["line 1: the line that begins with Format Version", "is missing; export again"]),
    (
        "motive",
        without_line(3),
        ["the rows Type, Name and Rotation or Position above it are not complete; export again"],
    ),
    ("motive", without_line(7), ["no line begins with Frame, Time (Seconds); export again, with header"]),
    ("qualisys-6d", without_line(1), ["line 1: NO_OF_FRAMES is ''", "export again with the TSV header"]),
    ("qualisys-6d", without_line(9), ["DATA_INCLUDED is ''; export 3D or 6D data with the TSV header"]),
    ("qualisys-3d", without_line(10), ["DATA_INCLUDED is '3D', without names; export"]),
    ("nexus", replaced(",,rover:hull,,,,,\n", ""), ["line 17: the row of components begins with ','; export again"]),
    ("nexus", replaced(",,deg,deg,deg,mm,mm,mm\n", ""), ["line 18: it holds numbers instead of units;"]),
    ("tracker", without_line(1), ["line 1: the section's title is missing; export again"]),
    ("tracker", without_line(2), ["line 2: ',,Global Angle hull:hull", "is not a rate in Hz; export again"]),
    ("tracker", without_line(3), ["line 4: the row of components begins with ','; export again"]),
    ("tracker", without_line(4), ["no line begins with Frame, Sub Frame; export as CSV"]),
    ("tracker", without_line(5), ["line 5: it holds numbers instead of units; export again"]),
    ("euroc", without_line(1), ["line 1: it holds numbers instead of column names; write"]),
    ("table", without_line(2), ["line 2: it holds numbers instead of column names; write"]),
    # a renamed column
    ("motive", in_line(7, 7, "V"), ["line 7: 'hull' has no column Position Y; export again"]),
    ("motive", in_line(7, 2, "V"), ["line 7, hull: its rotation has the columns V, Y, Z, W", "again"]),
    ("qualisys-6d", replaced("hull X\tY", "hull V\tY"), ["line 11: the column 'hull X' is missing; export again"]),
    ("qualisys-6d", replaced("Rot[4]", "Rot[44]"), ["'hull' has a rotation matrix with 8 of 9 columns; export the"]),
    ("qualisys-3d", replaced("hull1 X", "hull1 V"), ["line 11: the column 'hull1 X' is missing; export again"]),
    ("nexus", replaced("RZ,TX,", "RZ,UX,"), ["line 17: 'hull' has the components RX, RY, RZ, UX, TY, TZ, but no"]),
    (
        "nexus",
        replaced("Frame,RX,", "Frame,QX,"),
        ["section Segments, rover:hull: it has only RY and RZ of RX, RY, RZ"],
    ),
    (
        "tracker",
        replaced("Frame,RX,RY,RZ,TX", "Frame,RX,RY,RZ,X"),
        ["line 4: 'hull' has the components RX, RY, RZ, X"],
    ),
    ("tracker", replaced("hull:hull", "hall:hall"), ["there is no body or marker 'hull'", "room.toml"]),
    ("euroc", replaced("q_RS_x [], q_RS_y []", "q_RS_y [], q_RS_x []"), ["line 1: the header is not #timestamp"]),
    ("euroc", replaced("p_RS_R_x [m], p_RS_R_y", "p_RS_R_y [m], p_RS_R_x"), ["line 1: the header is not #timestamp"]),
    ("table", replaced("hull_qw", "hull_w"), ["no column 'hull_qw'; fix ", "room.toml, did you mean 'hull_w'"]),
    # a cell that is not a number
    ("motive", in_line(80, 8, "ten"), ["line 80, hull Position Z: 'ten'", NO_NUMBER]),
    ("qualisys-6d", in_line(80, 4, "ten", "\t"), ["line 80, hull Z: 'ten'", NO_NUMBER]),
    ("qualisys-3d", in_line(80, 4, "ten", "\t"), ["line 80, hull1 Z: 'ten'", NO_NUMBER]),
    ("nexus", in_line(120, 3, "ten"), ["line 120, rover:hull RY: 'ten'", NO_NUMBER]),
    ("tracker", in_line(80, 3, "ten"), ["line 80, hull:hull RY: 'ten'", NO_NUMBER]),
    ("tum", in_line(80, 3, "ten", " "), ["line 80, tz: 'ten'", NO_NUMBER, "write nan if the sample is missing"]),
    ("tum", in_line(2, 3, "ten", " "), ["line 2, tz: 'ten'", NO_NUMBER]),
    ("tum", in_line(80, 7, "1 2", " "), ["line 80: the row has more than 8 numbers; delete the others"]),
    ("euroc", in_line(80, 3, "ten"), ["line 80, z: 'ten'", NO_NUMBER]),
    ("table", in_line(80, 3, "ten"), ["line 80, column hull_z: 'ten' is not a number; write a number"]),
    ("npz", saved("hull_pos", np.full((300, 3), "ten")), ["there is no column 'hull_pos[0]'; fix ", "room.toml"]),
    ("npz", saved("hull_pos", np.full((300, 3), np.inf)), ["hull_pos[0], sample 1: it is infinite; write NaN"]),
    # an unknown unit, or one that differs from the format's
    (
        "motive",
        replaced("Length Units,Meters", "Length Units,"),
        ["line 1, Length Units: '' is not a known unit of length", "[units]"],
    ),
    (
        "nexus",
        replaced("mm,mm,mm", "km,km,km"),
        ["line 18, rover:hull TX to TZ: the unit 'km' is not a known unit of length"],
    ),
    (
        "nexus",
        replaced("deg", "mm"),
        ["line 18, rover:hull RX to RZ: the unit 'mm' is not a known unit of angle", "[units]"],
    ),
    (
        "tracker",
        replaced("rad", "turns"),
        ["line 5, hull:hull RX to RZ: the unit 'turns' is not a known unit of angle", "[units]"],
    ),
    ("euroc", replaced("[m]", "[mm]"), ["line 1: EuRoC's positions are in m, but the header has 'p_RS_R_x [mm]'"]),
    ("euroc", replaced("0000000,", ","), ["column timestamp: the timestamps are 1 apart, but EuRoC's are in ns;"]),
    ("qualisys-6d", replaced("FRAMES\t300", "FRAMES\tmany"), ["line 1: NO_OF_FRAMES is 'many'", "export again"]),
    # quaternions that are not of unit length
    ("motive", in_line(100, 5, "3"), ["line 7, hull: the quaternion of sample 93 has length 3", "export unit"]),
    ("tracker-quaternion", in_line(80, 5, "3"), ["hull:hull: the quaternion of frame 75 has length 3", "export unit"]),
    ("tum", in_line(80, 7, "3", " "), ["columns qx, qy, qz, qw: the quaternion of sample 79 has length 3"]),
    ("euroc", in_line(80, 4, "3"), ["columns qx, qy, qz, qw: the quaternion of sample 79 has length 3"]),
    ("table", in_line(80, 7, "3"), ["columns hull_qw to hull_qz: the quaternion of sample 78 has", "room.toml"]),
]


@pytest.mark.parametrize("name, damage, words", REFUSALS)
def test_damaged_file_is_refused_with_place_and_remedy(
    tmp_path: Path, robot: RobotDescription, name: str, damage: Damage, words: list[str]
):
    write, text = FORMATS[name]
    path = write(tmp_path)
    read_capture(path, room(tmp_path, robot, text))
    damage(path)
    with pytest.raises(InputError) as refusal:
        read_capture(path, room(tmp_path, robot, text))
    message = str(refusal.value)
    assert message.startswith(str(path)) and message.endswith(".") and "\n" not in message
    for part in words:
        assert part in message, message


QUATERNIONS: Mapping[str, tuple[int, list[int], str]] = {
    "motive": (8, [2, 3, 4, 5], ","),
    "qualisys-6d": (12, list(range(9, 18)), "\t"),
    "tracker-quaternion": (6, [2, 3, 4, 5], ","),
    "tum": (2, [4, 5, 6, 7], " "),
    "euroc": (2, [4, 5, 6, 7], ","),
    "table": (3, [4, 5, 6, 7], ","),
}
"""Line of the first sample, columns of the hull's orientation, and delimiter, by format."""


@pytest.mark.parametrize("name", QUATERNIONS)
def test_orientation_of_zeros_is_a_missing_sample(tmp_path: Path, robot: RobotDescription, name: str):
    """In one sample, zeros are a gap in the orientation, and the position is kept. In all samples, the file is
    refused."""
    write, text = FORMATS[name]
    first, cells, delimiter = QUATERNIONS[name]
    path, mapping = write(tmp_path), room(tmp_path, robot, text)
    whole = read_capture(path, mapping).bodies["hull"]
    sample = HIDDEN.stop + 20
    zeroed(first + sample, cells, delimiter, last=first + sample)(path)
    found = read_capture(path, mapping).bodies["hull"]
    assert whole.quaternion is not None and found.quaternion is not None
    np.testing.assert_array_equal(found.position, whole.position)
    no_orientation = np.isnan(found.quaternion).any(axis=1) & ~np.isnan(whole.quaternion).any(axis=1)
    assert np.flatnonzero(no_orientation).tolist() == [sample]
    zeroed(first, cells, delimiter)(path)
    with pytest.raises(InputError, match=rf"{path.name}: the orientation of \[hull\] was never seen; fix the mapping"):
        place(read_capture(path, mapping), mapping, robot, "trial")
