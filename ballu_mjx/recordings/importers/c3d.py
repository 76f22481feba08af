"""C3D files (https://www.c3d.org), read by ezc3d: the extra `import`."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.importers.c3d_process import read_points
from ballu_mjx.recordings.importers.mapping import MARKER_TOLERANCE, RoomMapping
from ballu_mjx.recordings.importers.trajectories import LENGTHS, Body, Trajectories, find, refuse, rigid_body, shorten

_BLOCK = 512
_LONGEST_HEADER_COUNT = 65535
"""Frames that a header can count; longer files state their length elsewhere."""
_AGAIN = "copy or export it again"


def read_c3d(path: Path, mapping: RoomMapping) -> Trajectories:
    """The markers that `mapping` names, from the C3D at `path`; a negative residual is a sample not seen.

    **Raises** `InputError` where ezc3d is not installed, and for files that are damaged, cut off, without unit or rate,
    or without such markers.
    """
    frames = _check_size(path)
    try:
        found = read_points(str(path))
    except ImportError as error:
        mend = 'install it by `pip install "ballu-mjx[import]"`'
        raise InputError(f"{path}: C3D files are read by ezc3d, which is not installed; {mend}.") from error
    except ValueError as error:
        refuse(path, "", f"not a whole C3D file ({shorten(str(error))})", _AGAIN)
    points, count = found.position, found.position.shape[2]
    if count == 0 or (frames is not None and count < frames) or found.residual.shape != points.shape[1:]:
        refuse(path, "", f"holds {count} of the {frames or 'its'} frames that its header states", _AGAIN)
    rate = mapping.rate or found.rate
    if rate is None or not 1 <= rate <= 1e5:
        refuse(path, "POINT:RATE", f"{rate} is not a rate in Hz", "export again, or write rate = ... in the mapping")
    unit = mapping.length or found.unit.lower()
    if unit not in LENGTHS:
        mend = 'write length = "..." under [units] in the mapping'
        refuse(path, "POINT:UNITS", f"the unit {shorten(unit)!r} is no length that is known", mend)
    labels = found.labels[: points.shape[1]]
    points = points * LENGTHS[unit]
    if np.isinf(points).any():
        refuse(path, "", "holds infinite positions", _AGAIN)
    points[:, (found.residual < 0) | (points == 0).all(axis=0)] = np.nan

    def marker(name: str) -> np.ndarray:
        full = find(path, name, [label for label in labels if label], "marker", mapping.path)
        if labels.count(full) > 1:
            refuse(path, "POINT:LABELS", f"{shorten(full)!r} stands there twice", "give markers different names")
        return points[:, labels.index(full)].T

    if not mapping.sources:
        refuse(mapping.path, "", "it asks for no marker of a C3D file", "say what its sites are, or give a table")
    bodies = {}
    for role, source in mapping.sources.items():
        if source.position:
            refuse(mapping.path, f"[{role}]", "a C3D file has no columns", "write markers = [...] there")
        if source.markers:
            geometry = None if source.geometry is None else np.array(source.geometry)
            several = np.stack([marker(name) for name in source.markers])
            bodies[role] = rigid_body(path, role, several, geometry, MARKER_TOLERANCE)
        else:
            bodies[role] = Body(marker(source.body or ""))
    return Trajectories(path, np.arange(count) / rate, bodies)


def _check_size(path: Path) -> int | None:
    """Frames that the header states, where the file is long enough for them; ezc3d takes what it finds.

    None where the header cannot count them.
    """
    if not path.is_file():
        refuse(path, "", "there is no such file", "check the path")
    try:
        with path.open("rb") as stream:
            header = stream.read(_BLOCK)
            stream.seek((max(header[0], 1) - 1) * _BLOCK + 3 if header else 0)
            processor = stream.read(1)
        size = path.stat().st_size
    except OSError as error:
        refuse(path, "", f"cannot be read ({error.strerror})", "check the file and its permissions")
    if len(header) < _BLOCK or header[1] != 0x50:
        refuse(path, "", "not a C3D file", "give one, or a CSV")
    order = ">" if processor == b"\x56" else "<"  # MIPS: the greater byte first
    points, analog, first, last = struct.unpack(order + "4H", header[2:10])
    (scale,) = struct.unpack(order + "f", header[12:16])
    (start,) = struct.unpack(order + "H", header[16:18])
    if last == _LONGEST_HEADER_COUNT:
        return None
    frames = last - first + 1
    # The sign bit says floating point: also in DEC's format, whose exponent is another.
    bytes_each = 4 if np.signbit(scale) or (processor == b"\x55" and header[13] & 0x80) else 2
    if frames < 1 or start < 2 or size < (start - 1) * _BLOCK + frames * (4 * points + analog) * bytes_each:
        refuse(path, "", f"too short for the {max(frames, 0)} frames that its header states", _AGAIN)
    return frames
