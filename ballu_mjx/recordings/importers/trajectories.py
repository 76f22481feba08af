"""What all importers give: named markers and bodies over time, in SI units and the capture's own frame."""

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

LENGTHS: Mapping[str, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
"""Metres in a unit."""
ANGLES: Mapping[str, float] = {"rad": 1.0, "deg": float(np.pi / 180)}
"""Radians in a unit."""
TIMES: Mapping[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds in a unit."""
QUATERNION_TOLERANCE = 0.02
_LARGEST_TURN = 4 * np.pi * 1.001
"""rad; angles that were counted on over a full turn or two are read, degrees called radians are not."""


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """A marker or a rigid body over T samples; NaN where it was not seen."""

    position: Float[np.ndarray, "T 3"]
    """m, capture frame."""
    quaternion: Float[np.ndarray, "T 4"] | None = None
    """w, x, y, z: the body's frame in the capture's. None for a marker."""


@dataclasses.dataclass(frozen=True, eq=False)
class CommandLog:
    """Commands that a file holds beside its motion."""

    time: Float[np.ndarray, " N"]
    """s, the clock of the file's motion."""
    command: Float[np.ndarray, "N commands"]
    """In the actuators' units, each held until the next."""


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectories:
    """T samples of what a file holds, as far as a mapping asks for it."""

    path: Path
    time: Float[np.ndarray, " T"]
    """s, strictly increasing."""
    bodies: Mapping[str, Body]
    """By the robot's site."""
    columns: Mapping[str, Float[np.ndarray, " T"]] = dataclasses.field(default_factory=dict)
    """Joint angles (rad; of slides, m) by joint."""
    commands: CommandLog | None = None
    """None where the file holds none."""
    first_frame: int = 1
    """Of the trial: a file that was cropped at its start begins later, and so does `time`."""


def refuse(path: Path, place: str, problem: str, mend: str) -> NoReturn:
    """Raise the sentence."""
    where = f"{path}, {place}" if place else str(path)
    raise InputError(f"{where}: {problem}; {mend}.")


def shorten(text: str) -> str:
    """At most 40 characters of `text`."""
    return text if len(text) <= 40 else text[:40] + "..."


def suggest(name: str, known: Iterable[str], *, most: int = 12) -> str:
    """What the file holds instead of `name`, for the end of a sentence."""
    names = list(dict.fromkeys(known))
    close = difflib.get_close_matches(name, names, 1)
    if close:
        return f"did you mean {shorten(close[0])!r}?"
    shown = ", ".join(shorten(n) for n in names[:most]) + (", ..." if len(names) > most else "")
    return f"there are {shown}" if names else "there are none"


def find(path: Path, name: str, known: Iterable[str], what: str, mapping: Path) -> str:
    """The full name in `known` that `name` means, in `mapping`: itself, or the only one that is it behind a subject's.

    **Raises** `InputError` where there is none or several.
    """
    names = list(known)
    if name in names:
        return name
    behind = [full for full in names if full.rpartition(":")[2] == name]
    if len(behind) > 1:
        mend = f"name one in {mapping}: {', '.join(behind[:4])}"
        refuse(path, "", f"{what} {shorten(name)!r} belongs to several subjects", mend)
    if not behind:
        hint = suggest(name, names).rstrip("?")
        refuse(path, "", f"there is no {what} {shorten(name)!r}", f"mend {mapping}, {hint}")
    return behind[0]


def to_quaternion(
    path: Path,
    place: str,
    values: Float[np.ndarray, "T n"],
    rotation: str,
    unit: float,
    frames: Int[np.ndarray, " T"] | None = None,
    *,
    mend: str = "export unit quaternions again",
) -> Float[np.ndarray, "T 4"]:
    """Unit quaternions (w, x, y, z) from a file's columns; NaN where any of the columns is.

    **Arguments**

    - `place`: names the columns in messages.
    - `rotation`: "quaternion" (columns w, x, y, z), "helical" (rotation vector, of the angle's length) or Euler angles
      in SciPy's notation: "XYZ" about the body's own axes in turn, "xyz" about the capture's, and so on.
    - `unit`: radians in a unit of the columns; not for quaternions.
    - `frames`: the file's own numbers of the samples, for messages; None: it has none.
    - `mend`: what to do about quaternions that are none.

    **Raises** `InputError` for quaternions that are none, and angles that are too large to be meant.
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
            refuse(path, place, problem, mend)
        quaternion[seen] = values[seen] / length[seen, None]
        return quaternion
    angles = values * unit
    bad = seen & (np.abs(angles) > _LARGEST_TURN).any(axis=1)
    if bad.any():
        row = int(bad.argmax())
        problem = f"{called(row)} is turned by {np.abs(angles[row]).max():.3g} rad"
        refuse(path, place, problem, "mend the unit of angles, in the file or under [units] in the mapping")
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
    """The rigid body that carries `markers`, by least squares from all that are seen, three at least.

    **Arguments**

    - `name`: of the body, for messages.
    - `markers`: m, capture frame, NaN where hidden.
    - `geometry`: where they sit in the body's frame (m). None: the frame has its origin in their middle and stands
      like the capture's in the first sample that shows all of them.
    - `tolerance`: m; a sample that fits no better (root mean square) is refused, for a marker was then mixed up.
    - `frames`: the file's own numbers of the samples, for messages; None: it has none.

    **Raises** `InputError` for markers on a line, never seen together, or not rigid.
    """
    seen = ~np.isnan(markers).any(axis=2)
    if geometry is not None:
        places = geometry
    else:
        together = seen.all(axis=0)
        if not together.any():
            refuse(path, "", f"the markers of {name} are never all seen at once", "leave the worst one out")
        first = markers[:, int(together.argmax())]
        places = first - first.mean(axis=0)
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    if spread[1] < 0.05 * spread[0] or spread[0] == 0:
        refuse(path, "", f"the markers of {name} lie on a line", "add one beside it, or orientation is not known")
    samples = markers.shape[1]
    position, quaternion = np.full((samples, 3), np.nan), np.full((samples, 4), np.nan)
    patterns, which = np.unique(seen, axis=1, return_inverse=True)
    for number, pattern in enumerate(patterns.T):
        if pattern.sum() < 3:
            continue
        rows = np.flatnonzero(which.reshape(-1) == number)
        points, model = markers[pattern][:, rows].transpose(1, 0, 2), places[pattern]
        if np.linalg.svd(model - model.mean(axis=0), compute_uv=False)[1] < 0.05 * spread[0]:
            continue  # what is left lies on a line
        middle, centre = points.mean(axis=1), model.mean(axis=0)
        # Kabsch's algorithm, all samples with the same markers at once.
        u, _, vt = np.linalg.svd(np.einsum("mi,tmj->tij", model - centre, points - middle[:, None]))
        flip = np.sign(np.linalg.det(u @ vt))
        u[:, :, 2] *= flip[:, None]
        turn = np.swapaxes(u @ vt, 1, 2)
        fitted = np.einsum("tij,mj->tmi", turn, model - centre) + middle[:, None]
        error = np.sqrt(((fitted - points) ** 2).sum(axis=2).mean(axis=1))
        if error.max() > tolerance:
            worst = int(rows[int(error.argmax())])
            where = f"sample {worst + 1}" if frames is None else f"frame {frames[worst]}"
            problem = f"in {where} the markers of {name} are off their places by {1e3 * error.max():.0f} mm"
            refuse(path, "", problem, "mend their labels there, or leave the marker out")
        position[rows] = middle - np.einsum("tij,j->ti", turn, centre)
        quaternion[rows] = Rotation.from_matrix(turn).as_quat(scalar_first=True)
    return Body(position, quaternion)
