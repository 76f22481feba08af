"""Tests that the readers of text formats and NumPy archives give the same numbers as other libraries.

The positions of the numbers in the files follow the vendors' documents, and MuJoCo converts the rotations. The same
comparisons for bags, LeRobot datasets and C3D files are in test_readers.py and test_importers.py.
"""

from __future__ import annotations

import ast
import struct
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from capture_files import (
    ARCHIVE,
    CORNERS,
    HIDDEN,
    NAMED,
    RATE,
    TABLE,
    write_euroc,
    write_motive,
    write_nexus,
    write_npz,
    write_qualisys_bodies,
    write_qualisys_markers,
    write_table,
    write_tracker,
    write_tum,
)
from rover import write_rover

from ballu_mjx.recordings.importers.mapping import read_mapping
from ballu_mjx.recordings.importers.readers import read_capture
from ballu_mjx.recordings.importers.trajectories import Body, Trajectories
from ballu_mjx.robots.description import RobotDescription

POSE = '[hull]\nbody = "pose"\n[tip]\nbody = "pose"\n'
NO_COMMANDS = '[commands]\narm = "none"\npush = "none"\n'


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    return write_rover(tmp_path_factory.mktemp("rover"))


def read_package(path: Path, robot: RobotDescription, text: str, commands: str = NO_COMMANDS) -> Trajectories:
    room = path.parent / "room.toml"
    room.write_text(f'robot = "r"\n{text}{commands}')
    return read_capture(path, read_mapping(room, robot))


# ---- independent readers ----


def cells(path: Path, above: int, separator: str = ",", rows: int | None = None) -> Any:
    """Return rows of text, read by polars, without the first `above` lines. `rows`: largest number of rows."""
    polars = pytest.importorskip("polars", reason="polars reads tables independently")
    return polars.read_csv(
        path, has_header=False, skip_lines=above, n_rows=rows, separator=separator, infer_schema=False
    )


def numbers(frame: Any, columns: Sequence[int]) -> np.ndarray:
    """Return columns as numbers, with NaN for empty cells."""
    polars = pytest.importorskip("polars")
    chosen = frame.select(polars.nth(*columns).str.strip_chars().replace("", None).cast(polars.Float64))
    return chosen.to_numpy().astype(float)


def assert_positions(found: Body, expected: np.ndarray) -> None:
    """Assert that positions are equal, up to the rounding error of a conversion of units."""
    np.testing.assert_allclose(found.position, expected, rtol=4e-16, atol=0)


def assert_orientations(found: Body, expected: np.ndarray, tolerance: float = 1e-14) -> None:
    """Assert that orientations are equal. `expected`: quaternions w, x, y, z of any length and sign."""
    assert found.quaternion is not None
    unit = expected / np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_array_equal(np.isnan(found.quaternion), np.isnan(unit))
    seen = ~np.isnan(unit).any(axis=1)
    assert seen.sum() > 200
    np.testing.assert_allclose(np.abs((found.quaternion[seen] * unit[seen]).sum(axis=1)), 1.0, atol=tolerance)


def from_vectors(vectors: np.ndarray) -> np.ndarray:
    """Return the quaternions of rotation vectors (rad)."""
    quaternion = np.full((len(vectors), 4), np.nan)
    for row, vector in zip(quaternion, vectors, strict=True):
        angle = float(np.linalg.norm(vector))
        if not np.isnan(angle):
            mujoco.mju_axisAngle2Quat(row, vector / angle if angle else [1.0, 0.0, 0.0], angle)
    return quaternion


def from_angles(angles: np.ndarray) -> np.ndarray:
    """Return the quaternions of intrinsic Euler angles about x, y and z (rad)."""
    quaternion = np.full((len(angles), 4), np.nan)
    for row, turns in zip(quaternion, angles, strict=True):
        if not np.isnan(turns).any():
            mujoco.mju_euler2Quat(row, turns, "xyz")  # lower case: intrinsic axes
    return quaternion


def from_matrices(matrices: np.ndarray) -> np.ndarray:
    """Return the quaternions of rotation matrices (nine numbers, row-major)."""
    quaternion = np.full((len(matrices), 4), np.nan)
    for row, matrix in zip(quaternion, matrices, strict=True):
        if not np.isnan(matrix).any():
            mujoco.mju_mat2Quat(row, matrix)
    return quaternion


# ---- capture programs ----


@pytest.mark.parametrize("version", ["1.21", "1.22", "1.23", "1.25"])
@pytest.mark.parametrize("unit, metres", [("Meters", 1.0), ("Centimeters", 0.01), ("Millimeters", 0.001)])
def test_motive_numbers_match_polars(tmp_path: Path, robot: RobotDescription, version: str, unit: str, metres: float):
    """Line 3 of the header has the types, and line 4 the names. Its last two lines have the quantities and axes."""
    path = write_motive(tmp_path, version, unit)
    found = read_package(path, robot, NAMED)
    above = 8 if version == "1.25" else 7
    header = cells(path, 2, rows=above - 2).rows()
    kinds, names, parts, axes = header[0], header[1], header[-2], header[-1]
    frame = cells(path, above)

    def of(kind: str, name: str, part: str, letters: str) -> np.ndarray:
        places = {column[3]: i for i, column in enumerate(zip(kinds, names, parts, axes, strict=True)) if
                  column[:3] == (kind, name, part)}  # fmt: skip
        return numbers(frame, [places[letter] for letter in letters])

    np.testing.assert_array_equal(found.time, numbers(frame, [1])[:, 0])
    assert_positions(found.bodies["hull"], of("Rigid Body", "hull", "Position", "XYZ") * metres)
    assert_orientations(found.bodies["hull"], of("Rigid Body", "hull", "Rotation", "WXYZ"))
    assert_positions(found.bodies["tip"], of("Marker", "tip", "Position", "XYZ") * metres)


def test_qualisys_bodies_match_polars(tmp_path: Path, robot: RobotDescription):
    """After frame and time, each body has 16 numbers: x, y, z (mm), three angles, residual, column-major matrix."""
    path = write_qualisys_bodies(tmp_path)
    found = read_package(path, robot, NAMED)
    frame = cells(path, path.read_text().splitlines().index("BODY_NAMES\thull\ttip") + 2, "\t")
    np.testing.assert_array_equal(found.time, numbers(frame, [1])[:, 0])
    for first, name in ((2, "hull"), (18, "tip")):
        table = numbers(frame, range(first, first + 16))
        table[(table == 0).all(axis=1)] = np.nan
        assert_positions(found.bodies[name], table[:, :3] / 1000)
        by_rows = table[:, [7, 10, 13, 8, 11, 14, 9, 12, 15]]
        # The matrix has five decimals, so it is a rotation only up to rounding errors.
        assert_orientations(found.bodies[name], from_matrices(by_rows), 1e-9)


def test_qualisys_markers_match_polars(tmp_path: Path, robot: RobotDescription):
    """After frame and time, each marker has three numbers (mm)."""
    path = write_qualisys_markers(tmp_path)
    frame = cells(path, path.read_text().splitlines().index("\t".join(["MARKER_NAMES", *CORNERS, "tip"])) + 2, "\t")
    for number, name in enumerate([*CORNERS, "tip"]):
        geometry = list(CORNERS.values())
        hull = f"[hull]\nmarkers = {list(CORNERS)}\ngeometry = {geometry}\n"
        found = read_package(path, robot, f'{hull}[tip]\nbody = "{name}"\n')
        np.testing.assert_array_equal(found.time, numbers(frame, [1])[:, 0])
        assert_positions(found.bodies["tip"], numbers(frame, range(2 + 3 * number, 5 + 3 * number)) / 1000)


def test_vicon_nexus_numbers_match_polars(tmp_path: Path, robot: RobotDescription):
    """Each section has five lines above the samples. Segments have rotation vectors (deg) and positions (mm)."""
    path = write_nexus(tmp_path)
    found = read_package(path, robot, NAMED)
    lines = path.read_text().splitlines()
    tables = {
        title: cells(path, lines.index(title) + 5, rows=len(found.time)) for title in ("Segments", "Trajectories")
    }
    frames = numbers(tables["Segments"], [0])[:, 0]
    np.testing.assert_allclose(found.time, (frames - 1) / RATE, rtol=4e-16)
    segment = numbers(tables["Segments"], range(2, 8))
    assert np.isnan(segment[HIDDEN]).all()
    assert_positions(found.bodies["hull"], segment[:, 3:] / 1000)
    assert_orientations(found.bodies["hull"], from_vectors(np.deg2rad(segment[:, :3])))
    assert_positions(found.bodies["tip"], numbers(tables["Trajectories"], range(2, 5)) / 1000)


@pytest.mark.parametrize("rotation", ["helical", "XYZ", "quaternion"])
def test_vicon_tracker_numbers_match_polars(tmp_path: Path, robot: RobotDescription, rotation: str):
    """Each object has a rotation vector (rad), Euler angles (rad) or a quaternion x, y, z, w, then a position (mm)."""
    path = write_tracker(tmp_path, rotation)
    convention = f'rotation = "{rotation}"\n'
    found = read_package(path, robot, f'[hull]\nbody = "hull"\n{convention}[tip]\nbody = "tip"\n{convention}')
    frame = cells(path, 5)
    np.testing.assert_allclose(found.time, (numbers(frame, [0])[:, 0] - 1) / RATE, rtol=4e-16)
    width = 7 if rotation == "quaternion" else 6
    for number, name in enumerate(("hull", "tip")):
        table = numbers(frame, range(2 + width * number, 2 + width * (number + 1)))
        assert_positions(found.bodies[name], table[:, -3:] / 1000)
        if rotation == "quaternion":
            assert_orientations(found.bodies[name], table[:, [3, 0, 1, 2]])
        else:
            assert_orientations(
                found.bodies[name], (from_vectors if rotation == "helical" else from_angles)(table[:, :3])
            )


# ---- trajectories, tables, archives ----


@pytest.mark.parametrize(
    "write, reader", [(write_tum, "read_tum_trajectory_file"), (write_euroc, "read_euroc_csv_trajectory")]
)
def test_trajectories_of_one_body_match_evo(
    tmp_path: Path, robot: RobotDescription, write: Callable[[Path], Path], reader: str
):
    files = pytest.importorskip("evo.tools.file_interface", reason="evo reads TUM and EuRoC files independently")
    path = write(tmp_path)
    found = read_package(path, robot, POSE)
    expected_trajectory = getattr(files, reader)(str(path))
    np.testing.assert_allclose(found.time, expected_trajectory.timestamps, rtol=4e-16)
    assert_positions(found.bodies["hull"], expected_trajectory.positions_xyz)
    assert_orientations(found.bodies["hull"], expected_trajectory.orientations_quat_wxyz)


def test_tables_match_polars(tmp_path: Path, robot: RobotDescription):
    polars = pytest.importorskip("polars", reason="polars reads tables independently")
    path = write_table(tmp_path)
    found = read_package(path, robot, TABLE, '[commands]\narm = "arm_cmd"\npush = "push_cmd"\n')
    frame = polars.read_csv(path, comment_prefix="#", infer_schema_length=None)

    def of(*names: str) -> np.ndarray:
        return frame.select(*names).cast(polars.Float64).to_numpy().astype(float)

    np.testing.assert_allclose(found.time, of("time")[:, 0] / 1000, rtol=4e-16)
    assert_positions(found.bodies["hull"], of("hull_x", "hull_y", "hull_z"))
    assert_orientations(found.bodies["hull"], of("hull_qw", "hull_qx", "hull_qy", "hull_qz"))
    assert_positions(found.bodies["tip"], of("tip_x", "tip_y", "tip_z"))
    assert found.commands is not None
    np.testing.assert_allclose(found.commands.command, of("arm_cmd", "push_cmd"), rtol=1e-12)


def array_of(content: bytes) -> np.ndarray:
    """Return an array from the bytes of an .npy file, by NumPy Enhancement Proposal 1, without NumPy's reader."""
    assert content[:6] == b"\x93NUMPY" and content[6] == 1
    (length,) = struct.unpack("<H", content[8:10])
    header = ast.literal_eval(content[10 : 10 + length].decode("latin-1"))
    assert header["descr"] == "<f8" and not header["fortran_order"]
    values = [value for (value,) in struct.iter_unpack("<d", content[10 + length :])]
    return np.reshape(values, header["shape"])


def test_archives_match_the_npy_specification(tmp_path: Path, robot: RobotDescription):
    path = write_npz(tmp_path)
    found = read_package(path, robot, ARCHIVE, '[commands]\narm = "command_arm"\npush = "command_push"\n')
    with zipfile.ZipFile(path) as archive:
        arrays = {name: array_of(archive.read(f"{name}.npy")) for name in
                  ("time", "hull_pos", "hull_quat", "tip_pos", "command_arm", "command_push")}  # fmt: skip
    np.testing.assert_array_equal(found.time, arrays["time"])
    assert_positions(found.bodies["hull"], arrays["hull_pos"])
    assert_orientations(found.bodies["hull"], arrays["hull_quat"])
    assert_positions(found.bodies["tip"], arrays["tip_pos"])
    assert found.commands is not None
    commands = np.stack([arrays["command_arm"], arrays["command_push"]], axis=1)
    np.testing.assert_allclose(found.commands.command, commands, rtol=1e-12)
