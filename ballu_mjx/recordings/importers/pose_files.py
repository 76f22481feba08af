"""Files of one body's poses: TUM trajectories and EuRoC's CSV.

TUM (https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats): lines of `timestamp tx ty tz qx qy qz qw`, in s
and m, with # before comments. EuRoC (https://projects.asl.ethz.ch/datasets, state_groundtruth_estimate0): a CSV whose
first line begins with `#timestamp`, in ns, then the position (m), then the quaternion w, x, y, z; what follows is not
read. Both give the body's frame in the world's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ballu_mjx.common.files import read_text
from ballu_mjx.recordings.importers.capture import Capture, Stream
from ballu_mjx.recordings.importers.mapping import RoomMapping
from ballu_mjx.recordings.importers.text import check_times, parse_number, read_numbers, split_cells
from ballu_mjx.recordings.importers.trajectories import LENGTHS, TIMES, refuse, to_quaternion

BODY = "pose"
"""What mappings call the one body of these files."""
_TUM = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_EUROC = ("timestamp", "x", "y", "z", "qw", "qx", "qy", "qz")
_MEND = "sort the lines by time, and delete repeated ones"


def recognise_tum(path: Path, start: str) -> bool:
    """Whether the first line that is no comment is one of eight numbers between blanks."""
    del path
    line = next((line for line in start.splitlines() if line.strip() and not line.startswith("#")), "")
    cells = line.split()
    return len(cells) == len(_TUM) and all(parse_number(cell) is not None for cell in cells)


def open_tum(path: Path, mapping: RoomMapping | None) -> Capture:
    """Return the trajectory at `path`, a body named `pose`.

    **Raises** `InputError` naming file, line and fix.
    """
    lines = read_text(path).splitlines()
    poses = [i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")]
    if not poses:
        refuse(path, "", "there is no line of eight numbers", "give a trajectory")
    first, last = poses[0], poses[-1]
    if last - first >= len(poses):
        between = next(a for a, b in zip(poses, poses[1:], strict=False) if b > a + 1) + 1
        refuse(path, f"line {between + 1}", "a line without a pose stands among the poses", "delete it")
    table = read_numbers(path, lines[: last + 1], first, _TUM, None, unlimited=[0])
    return _pose(path, "a TUM trajectory", table, table[:, 0], first, [7, 4, 5, 6], mapping)


def recognise_euroc(path: Path, start: str) -> bool:
    """Whether the first line begins with #timestamp."""
    del path
    return start.lstrip("\ufeff").lower().startswith("#timestamp") and "," in start.partition("\n")[0]


def open_euroc(path: Path, mapping: RoomMapping | None) -> Capture:
    """Return the trajectory at `path`, a body named `pose`.

    **Raises** `InputError` naming file, line and fix.
    """
    lines = read_text(path).splitlines()
    header = split_cells(lines[0], ",") if lines else []
    if len(header) < len(_EUROC) or "q" not in header[4].lower() or "w" not in header[4].lower():
        problem = "the header is not #timestamp, position x, y, z, quaternion w, x, y, z"
        refuse(path, "line 1", problem, "give EuRoC's ground truth; another table needs a header without #")
    columns = [*_EUROC, *header[len(_EUROC) :]]
    table = read_numbers(path, lines, 1, columns, ",", unlimited=[0, *range(len(_EUROC), len(columns))])
    return _pose(path, "an EuRoC CSV", table, table[:, 0] * TIMES["ns"], 1, [4, 5, 6, 7], mapping)


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
