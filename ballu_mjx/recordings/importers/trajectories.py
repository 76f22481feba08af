"""Result of all importers: named markers and bodies over time, in SI units and the frame of the capture."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.validation import QUATERNION_TOLERANCE

LENGTHS: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
"""Length of each unit in metres."""
ANGLES: Mapping[str, float] = {"rad": 1.0, "deg": float(np.pi / 180)}
"""Size of each unit in radians."""
TIMES: Mapping[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Length of each unit in seconds."""
_LARGEST_TURN = 4 * np.pi * 1.001
"""Largest magnitude of an angle (rad): two turns, for unwrapped angles. It detects degrees labelled as radians."""


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """Trajectory of a marker or a rigid body over T samples. NaN where it was not seen."""

    position: Float[np.ndarray, "T 3"]
    """Position (m, capture frame)."""
    quaternion: Float[np.ndarray, "T 4"] | None = None
    """Orientation of the body's frame in the capture frame (w, x, y, z). None for a marker."""


@dataclasses.dataclass(frozen=True, eq=False)
class CommandLog:
    """Commands in a file that also holds the motion."""

    time: Float[np.ndarray, " N"]
    """Times of the commands (s, the clock of the motion)."""
    command: Float[np.ndarray, "N commands"]
    """Commands in the actuators' units, each held until the next one."""


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectories:
    """T samples of the parts of a file that a mapping selects."""

    path: Path
    """The file, for messages."""
    time: Float[np.ndarray, " T"]
    """Times (s), strictly increasing."""
    bodies: Mapping[str, Body]
    """Trajectories by site of the robot."""
    columns: Mapping[str, Float[np.ndarray, " T"]] = dataclasses.field(default_factory=dict)
    """Joint angles (rad) or positions of slides (m) by joint."""
    commands: CommandLog | None = None
    """Commands in the file. None if it holds none."""
    first_frame: int = 1
    """Number of the first frame in its trial. In a file cropped at its start it is above 1, and `time` begins later."""


def refuse(path: Path, place: str, problem: str, fix: str) -> NoReturn:
    """Raise an `InputError` that names file, place, problem and fix (`fix`)."""
    where = f"{path}, {place}" if place else str(path)
    raise InputError(f"{where}: {problem}; {fix}.")


def shorten(text: str) -> str:
    """Return the first 40 characters of `text`, with an ellipsis if it is longer."""
    return text if len(text) <= 40 else text[:40] + "..."


def suggest(name: str, known: Iterable[str], *, most: int = 12) -> str:
    """Return a hint for the end of a message: the known name closest to `name`, or the first `most` known names."""
    names = list(dict.fromkeys(known))
    close = difflib.get_close_matches(name, names, 1)
    if close:
        return f"did you mean {shorten(close[0])!r}?"
    shown = ", ".join(shorten(n) for n in names[:most]) + (", ..." if len(names) > most else "")
    return f"there are {shown}" if names else "there are none"


def find(path: Path, name: str, known: Iterable[str], what: str, mapping: Path) -> str:
    """Return the full name in `known` for a `name` in a mapping file.

    It is `name` itself, or the only full name "subject:name".

    **Arguments**

    - `path`, `mapping`: the capture file and the mapping file, for messages.
    - `what`: kind of item, for messages.

    **Raises** `InputError` if there is none or more than one.
    """
    names = list(known)
    if name in names:
        return name
    behind = [full for full in names if full.rpartition(":")[2] == name]
    if len(behind) > 1:
        fix = f"name one in {mapping}: {', '.join(behind[:4])}"
        refuse(path, "", f"{what} {shorten(name)!r} belongs to several subjects", fix)
    if not behind:
        hint = suggest(name, names).rstrip("?")
        refuse(path, "", f"there is no {what} {shorten(name)!r}", f"fix {mapping}, {hint}")
    return behind[0]


def to_quaternion(
    path: Path,
    place: str,
    values: Float[np.ndarray, "T n"],
    rotation: str,
    unit: float,
    frames: Int[np.ndarray, " T"] | None = None,
    *,
    fix: str = "export unit quaternions again",
) -> Float[np.ndarray, "T 4"]:
    """Return unit quaternions (w, x, y, z) from a file's columns. A NaN in a row, or a zero quaternion, gives NaN.

    **Arguments**

    - `path`: the file, for messages.
    - `place`: name of the columns, for messages.
    - `values`: the columns.
    - `rotation`: "quaternion" (columns w, x, y, z), "helical" (rotation vector, whose length is the angle) or Euler
      angles in SciPy's notation, for example "XYZ" about the body's axes in turn, or "xyz" about the capture's axes.
    - `unit`: size of the columns' unit (rad). Ignored for quaternions.
    - `frames`: frame numbers of the samples, for messages. None if the file has none.
    - `fix`: fix in the message about invalid quaternions.

    **Raises** `InputError` if a quaternion is not of length 1, or if an angle is too large.
    """
    quaternion = np.full((len(values), 4), np.nan)
    seen = ~np.isnan(values).any(axis=1)

    def called(row: int) -> str:
        return f"sample {row + 1}" if frames is None else f"frame {frames[row]}"

    if rotation == "quaternion":
        with np.errstate(over="ignore"):
            length = np.linalg.norm(values, axis=1)
        seen &= length != 0
        bad = seen & (np.abs(length - 1) > QUATERNION_TOLERANCE)
        if bad.any():
            row = int(bad.argmax())
            problem = f"the quaternion of {called(row)} has length {length[row]:.3g} instead of 1"
            refuse(path, place, problem, fix)
        quaternion[seen] = values[seen] / length[seen, None]
        return quaternion
    angles = values * unit
    bad = seen & (np.abs(angles) > _LARGEST_TURN).any(axis=1)
    if bad.any():
        row = int(bad.argmax())
        problem = f"the rotation of {called(row)} is {np.abs(angles[row]).max():.3g} rad, which is too large"
        refuse(path, place, problem, "correct the unit of angles, in the file or under [units] in the mapping")
    if rotation == "helical":
        turned = Rotation.from_rotvec(angles[seen])
    else:
        turned = Rotation.from_euler(rotation, angles[seen])
    quaternion[seen] = turned.as_quat(scalar_first=True)
    return quaternion


def rigid_body(
    path: Path,
    name: str,
    markers: Float[np.ndarray, "markers T 3"],
    geometry: Float[np.ndarray, "markers 3"] | None,
    tolerance: float,
    frames: Int[np.ndarray, " T"] | None = None,
) -> Body:
    """Return the pose of a rigid body from its markers, by least squares. A sample with fewer than three gives NaN.

    **Arguments**

    - `path`: the file, for messages.
    - `name`: name of the body, for messages.
    - `markers`: positions (m, capture frame), NaN where a marker was not seen.
    - `geometry`: positions of the markers in the body's frame (m). If None, the body's frame has its origin at their
      mean, and its axes are parallel to the capture's in the first sample that shows all markers.
    - `tolerance`: largest error of a sample (m, root mean square). A larger one means that markers were mixed up.
    - `frames`: frame numbers of the samples, for messages. None if the file has none.

    **Raises** `InputError` if the markers lie on a line, are never seen together, or are not rigid.
    """
    seen = ~np.isnan(markers).any(axis=2)
    if geometry is not None:
        places = geometry
    else:
        together = seen.all(axis=0)
        if not together.any():
            refuse(path, "", f"the markers of {name} are never all seen at once", "leave out the one seen least")
        first = markers[:, int(together.argmax())]
        places = first - first.mean(axis=0)
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    if spread[1] < 0.05 * spread[0] or spread[0] == 0:
        refuse(path, "", f"the markers of {name} lie on a line", "add one beside it, to determine the orientation")
    samples = markers.shape[1]
    position, quaternion = np.full((samples, 3), np.nan), np.full((samples, 4), np.nan)
    patterns, which = np.unique(seen, axis=1, return_inverse=True)
    for number, pattern in enumerate(patterns.T):
        if pattern.sum() < 3:
            continue
        rows = np.flatnonzero(which.reshape(-1) == number)
        points, model = markers[pattern][:, rows].transpose(1, 0, 2), places[pattern]
        if np.linalg.svd(model - model.mean(axis=0), compute_uv=False)[1] < 0.05 * spread[0]:
            continue  # The markers that are seen lie on a line.
        middle, centre = points.mean(axis=1), model.mean(axis=0)
        # Kabsch's algorithm, for all samples with the same markers at once.
        u, _, vt = np.linalg.svd(np.einsum("mi,tmj->tij", model - centre, points - middle[:, None]))
        flip = np.sign(np.linalg.det(u @ vt))
        u[:, :, 2] *= flip[:, None]
        turn = np.swapaxes(u @ vt, 1, 2)
        fitted = np.einsum("tij,mj->tmi", turn, model - centre) + middle[:, None]
        error = np.sqrt(((fitted - points) ** 2).sum(axis=2).mean(axis=1))
        if error.max() > tolerance:
            worst = int(rows[int(error.argmax())])
            where = f"sample {worst + 1}" if frames is None else f"frame {frames[worst]}"
            problem = f"the markers of {name} deviate from a rigid body in {where}, by {1e3 * error.max():.0f} mm"
            refuse(path, "", problem, "correct their labels there, or leave the wrong marker out")
        position[rows] = middle - np.einsum("tij,j->ti", turn, centre)
        quaternion[rows] = Rotation.from_matrix(turn).as_quat(scalar_first=True)
    return Body(position, quaternion)
