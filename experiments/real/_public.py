"""Shared code of the experiments on public recordings: from the public files to recordings of the project's format."""

from __future__ import annotations

import dataclasses
import io
import lzma
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.csv_format import write_recording
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.c_model import site_poses


def recordings_of(
    data: Path,
    made: Path,
    sources: Mapping[str, str],
    convert: Callable[[Path, str], Recording],
    robot: RobotDescription,
    *,
    decimals: int = 5,
) -> Path:
    """Return the folder that holds `NAME.csv.gz` of all recordings: `data`, or else `made`.

    In `made`, recordings that are not there yet are written from the public files in `data`.

    **Arguments**

    - `sources`: path of the public file in `data`, by name of the recording. A name may have folders. A file may be
      compressed (`.xz`).
    - `convert`: function of the public file and the recording's name that returns the recording.
    - `decimals`: see `write_recording`.

    **Raises** `InputError` if `data` lacks a public file, and from `convert`.
    """
    if all((data / f"{name}.csv.gz").is_file() for name in sources):
        return data
    for name, source in sources.items():
        target = made / f"{name}.csv.gz"
        if target.is_file():
            continue
        path = public_file(data, source)
        if path is None:
            raise InputError(
                f"{data}: has neither {name}.csv.gz nor {source}; give the folder of the public data set, or of "
                "recordings made of it."
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        write_recording(convert(path, Path(name).name), target, robot, decimals=decimals)
    return made


def public_file(data: Path, source: str) -> Path | None:
    """Return a public file, which may be compressed (`.xz`). None if there is none."""
    return next((path for path in (data / source, data / f"{source}.xz") if path.is_file()), None)


def read_text(path: Path) -> str:
    """Return the text of a public file, which may be compressed (`.xz` or `.gz`).

    **Raises** `InputError` if the file is not whole.
    """
    try:
        return lzma.open(path, "rt").read() if path.suffix == ".xz" else files.read_text(path)
    except (EOFError, lzma.LZMAError) as error:
        raise InputError(f"{path}: not a whole .xz file; download the file again.") from error


def read_columns(path: Path, wanted: Sequence[str]) -> dict[str, Float[np.ndarray, " rows"]]:
    """Return columns of a table with commas and a header.

    **Raises** `InputError` if a column is missing, if a cell of a wanted column is not a finite number, and from
    `read_text`.
    """
    header, _, body = read_text(path).partition("\n")
    columns = [column.strip() for column in header.split(",")]
    for column in wanted:
        if column not in columns:
            raise InputError(f"{path}: there is no column {column}; give a file of the public data set.")
    if not body.strip():
        raise InputError(f"{path}: there is no row below the header; download the file again.")
    places = [columns.index(column) for column in wanted]
    try:
        table = np.genfromtxt(io.StringIO(body), delimiter=",", usecols=places, ndmin=2)
    except ValueError as error:
        raise InputError(f"{path}: rows have different numbers of cells; download the file again.") from error
    bad = np.argwhere(~np.isfinite(table))
    if len(bad):
        row, place = bad[0]
        raise InputError(
            f"{path}, column {wanted[place]}, row {row + 2}: the cell is not a finite number; download the file again."
        )
    return dict(zip(wanted, table.T, strict=True))


def with_kinematics(recording: Recording, robot: RobotDescription, model: mujoco.MjModel) -> Recording:
    """Return a recording of joint angles with the poses of the description's sites, by forward kinematics."""
    qpos = np.tile(model.qpos0, (len(recording.time), 1))
    for joint, angles in recording.joint_angles.items():
        qpos[:, model.joint(joint).qposadr[0]] = angles
    position, quaternion = site_poses(model, robot.tracked, qpos)
    points = {name: site_poses(model, name, qpos)[0] for name in robot.points}
    return dataclasses.replace(recording, tracked_position=position, tracked_quaternion=quaternion, points=points)
