"""Readers of files with the poses of one body: TUM trajectories and EuRoC's CSV.

A TUM trajectory (https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats) has lines of `timestamp tx ty tz qx qy
qz qw`, in s and m. Comments begin with #. EuRoC's ground truth (https://projects.asl.ethz.ch/datasets,
state_groundtruth_estimate0) is a CSV whose first line begins with `#timestamp`. Its columns are the time (ns), the
position (m) and the quaternion w, x, y, z. Further columns are not read. Poses are those of the body's frame in the
world frame.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ballu_mjx.common.files import read_text
from ballu_mjx.recordings.importers.capture import Capture, Stream
from ballu_mjx.recordings.importers.mapping import RoomMapping
from ballu_mjx.recordings.importers.text import check_times, parse_number, read_numbers, split_cells
from ballu_mjx.recordings.importers.trajectories import LENGTHS, TIMES, refuse, shorten, to_quaternion

BODY = "pose"
"""Name of the body of these files, for mappings."""
_TUM = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_EUROC = ("timestamp", "x", "y", "z", "qw", "qx", "qy", "qz")
_MEND = "sort the lines by time, and delete repeated ones"
_FIRST_POSES = 5
"""Number of poses by which the format is recognized, although one of them may be damaged."""
_SHORTEST_STEP = 1e-5
"""Shortest sample spacing (s). With a shorter one, the times are not in ns."""


def recognise_tum(path: Path, start: str) -> bool:
    """Return whether the first line without comment begins with a number, and one of the first has eight numbers."""
    del path
    lines = [line.split() for line in start.splitlines() if line.strip() and not line.startswith("#")][:_FIRST_POSES]
    if not lines or parse_number(lines[0][0]) is None:
        return False
    return any(len(cells) == len(_TUM) and all(parse_number(cell) is not None for cell in cells) for cells in lines)


def open_tum(path: Path, mapping: RoomMapping | None) -> Capture:
    """Return the trajectory at `path`, a body named `pose`.

    **Raises** `InputError` naming file and line if the file is damaged.
    """
    lines = read_text(path).splitlines()
    poses = [i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")]
    if not poses:
        refuse(path, "", "there is no line of eight numbers", "give a trajectory")
    first, last = poses[0], poses[-1]
    if last - first >= len(poses):
        between = next(a for a, b in zip(poses, poses[1:], strict=False) if b > a + 1) + 1
        refuse(path, f"line {between + 1}", "a line without a pose is between the poses", "delete it")
    table = read_numbers(path, lines[: last + 1], first, _TUM, None, unlimited=[0])
    return _pose(path, "a TUM trajectory", table, table[:, 0], first, [7, 4, 5, 6], mapping)


def recognise_euroc(path: Path, start: str) -> bool:
    """Return whether the first line begins with #timestamp."""
    del path
    return start.lstrip("\ufeff").lower().startswith("#timestamp") and "," in start.partition("\n")[0]


def open_euroc(path: Path, mapping: RoomMapping | None) -> Capture:
    """Return the trajectory at `path`, a body named `pose`.

    **Raises** `InputError` naming file and line if the file is damaged.
    """
    lines = read_text(path).splitlines()
    header = split_cells(lines[0], ",") if lines else []
    names = [cell.partition("[")[0].strip().lower() for cell in header[: len(_EUROC)]]
    ends = [name[-1:] for name in names[1:]]
    if ends != [name[-1] for name in _EUROC[1:]] or not all("q" in name for name in names[4:]):
        problem = "the header is not #timestamp, position x, y, z, quaternion w, x, y, z"
        refuse(path, "line 1", problem, "give EuRoC's ground truth; another table needs a header without #")
    for cell in header[1:4]:
        unit = cell.partition("[")[2].rstrip("] ")
        if unit not in ("", "m") and (mapping is None or mapping.length is None):
            problem = f"EuRoC's positions are in m, but the header has {shorten(cell)!r}"
            refuse(path, "line 1", problem, 'give m, or write length = "..." under [units] in the mapping')
    columns = [*_EUROC, *header[len(_EUROC) :]]
    table = read_numbers(path, lines, 1, columns, ",", unlimited=[0, *range(len(_EUROC), len(columns))])
    time = table[:, 0] * TIMES["ns"]
    capture = _pose(path, "an EuRoC CSV", table, time, 1, [4, 5, 6, 7], mapping)
    if len(time) > 1 and (step := float(np.median(np.diff(time)))) < _SHORTEST_STEP:
        problem = f"the timestamps are {step / TIMES['ns']:.3g} apart, but EuRoC's are in ns"
        refuse(path, "column timestamp", problem, "write them in ns")
    return capture


def _pose(
    path: Path,
    program: str,
    table: np.ndarray,
    time: np.ndarray,
    first: int,
    quaternion: list[int],
    mapping: RoomMapping | None,
) -> Capture:
    check_times(path, time, first, _MEND)
    unit = 1.0 if mapping is None or mapping.length is None else LENGTHS[mapping.length]
    place = "columns qx, qy, qz, qw"
    stream = Stream(time, table[:, 1:4] * unit, to_quaternion(path, place, table[:, quaternion], "quaternion", 1.0))
    return Capture(path, program, {BODY: stream})
