"""Reader of C3D files (https://www.c3d.org), which hold markers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ballu_mjx.recordings.importers.c3d_file import C3DError, C3DPoints, read_c3d_points
from ballu_mjx.recordings.importers.contents import Contents, Item
from ballu_mjx.recordings.importers.mapping import MARKER_TOLERANCE, RoomMapping
from ballu_mjx.recordings.importers.trajectories import LENGTHS, Body, Trajectories, find, refuse, rigid_body, shorten

_METRES = ("mete", "meter", "meters", "metre", "metres")
_SPELLINGS = {name: "m" for name in _METRES}
_SPELLINGS |= {f"centi{name}": "cm" for name in _METRES} | {f"milli{name}": "mm" for name in _METRES}
"""Spellings of length units by various programs. Visual3D keeps only four letters."""


def recognise_c3d(path: Path, start: str) -> bool:
    """Return whether the file's name ends in .c3d."""
    del start
    return path.suffix.lower() == ".c3d"


def list_c3d(path: Path) -> Contents:
    """Return the list of the markers in the C3D file at `path`.

    **Raises** `InputError` if the file is missing, damaged or cut off.
    """
    found = _read_points(path)
    seen = np.all(np.isfinite(found.position), axis=0)
    items = [
        Item(label, "marker", len(each), found.rate, share=float(np.mean(each)), unit=found.unit or "unknown")
        for label, each in zip(found.labels, seen, strict=False)
        if label
    ]
    return Contents(path, "a C3D file", items, notes=["C3D holds only markers. Give a body by three or more of them."])


def _read_points(path: Path) -> C3DPoints:
    if not path.is_file():
        refuse(path, "", "there is no such file", "check the path")
    try:
        return read_c3d_points(path.read_bytes())
    except OSError as error:
        refuse(path, "", f"cannot be read ({error.strerror})", "check the file and its permissions")
    except C3DError as error:
        refuse(path, "", error.problem, error.fix)


def read_c3d(path: Path, mapping: RoomMapping) -> Trajectories:
    """Return the markers that `mapping` names from the C3D file at `path`. A negative residual means: not seen.

    Time counts from the trial's first frame, also if the file begins at a later one.

    **Raises** `InputError` if the file is damaged or cut off, or lacks a unit, a rate or one of the markers.
    """
    found = _read_points(path)
    points, count = found.position, found.position.shape[2]
    rate = mapping.rate or found.rate
    if rate is None or not 1 <= rate <= 1e5:
        refuse(path, "POINT:RATE", f"{rate} is not a rate in Hz", "export again, or write rate = ... in the mapping")
    unit = mapping.length or _SPELLINGS.get(found.unit.lower(), found.unit.lower())
    if unit not in LENGTHS:
        fix = 'write length = "..." under [units] in the mapping'
        refuse(path, "POINT:UNITS", f"the unit {shorten(unit)!r} is not a known unit of length", fix)
    labels = found.labels[: points.shape[1]]
    points = points * LENGTHS[unit]

    def marker(name: str) -> np.ndarray:
        full = find(path, name, [label for label in labels if label], "marker", mapping.path)
        if labels.count(full) > 1:
            refuse(path, "POINT:LABELS", f"{shorten(full)!r} appears twice", "give markers different names")
        position = points[:, labels.index(full)].T
        if np.isinf(position).any():
            refuse(path, "", f"{shorten(full)!r} has infinite positions", "export it again")
        return position

    if not mapping.sources:
        refuse(mapping.path, "", "it selects no marker of a C3D file", "name the markers of its sites")
    frames, bodies = found.first_frame + np.arange(count), {}
    for role, source in mapping.sources.items():
        if source.position:
            refuse(mapping.path, f"[{role}]", "a C3D file has no columns", "write markers = [...] there")
        if source.markers:
            geometry = None if source.geometry is None else np.array(source.geometry)
            several = np.stack([marker(name) for name in source.markers])
            bodies[role] = rigid_body(path, role, several, geometry, MARKER_TOLERANCE, frames)
        else:
            bodies[role] = Body(marker(source.body or ""))
    start = max(found.first_frame - 1, 0)
    return Trajectories(path, (start + np.arange(count)) / rate, bodies, first_frame=start + 1)
