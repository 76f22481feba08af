"""Tests of the importers of Vicon, C3D and table files and of mappings. Valid files are read, damaged ones refused."""

from __future__ import annotations

import dataclasses
import functools
import json
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from c3d_writer import DEC, INTEL, MIPS, c3d_bytes
from capture_files import ROTATIONS, vicon_section
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.recordings import FOOT_RADIUS
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.recordings.importers.c3d import read_c3d
from ballu_mjx.recordings.importers.c3d_file import C3DError, read_c3d_points
from ballu_mjx.recordings.importers.capture import read_commands, select
from ballu_mjx.recordings.importers.example_mapping import example_mapping
from ballu_mjx.recordings.importers.mapping import Commands, RoomMapping, Source, read_mapping
from ballu_mjx.recordings.importers.placement import place, with_commands
from ballu_mjx.recordings.importers.table import open_table
from ballu_mjx.recordings.importers.trajectories import rigid_body
from ballu_mjx.recordings.importers.vicon import read_vicon
from ballu_mjx.recordings.recording import Recording, cut
from ballu_mjx.robots.registry import load_robot

ROBOT = load_robot()
ROLES = ("balloon", "base", "foot_left", "foot_right")
BODIES = "\n".join(f'[{role}]\nbody = "ballu:{role}"' for role in ROLES)
KEPT = "[origin]\nstart = false\n"
HIDDEN = slice(40, 55)
"""Samples without a measurement of left foot and balloon in the files."""
Y_UP = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation matrix from capture axes with y up, z forward and x left to the axes of the recording format."""


@functools.cache
def source() -> Recording:
    """Return 3 s of a bundled recording."""
    return cut(read_recording(list_bundled("test")[0], ROBOT), slice(300))


def poses(recording: Recording) -> dict[str, tuple[np.ndarray, Rotation]]:
    """Return positions (m) and rotations of all roles. The rotations of the feet are arbitrary."""
    assert recording.tracked_position is not None and recording.tracked_quaternion is not None
    balloon = Rotation.from_quat(recording.tracked_quaternion, scalar_first=True)
    base = Rotation.from_quat(recording.orientations["base"], scalar_first=True)
    points = recording.points
    return {
        "balloon": (recording.tracked_position, balloon),
        "base": (points["base"], base),
        "foot_left": (points["foot_left"], balloon * Rotation.from_rotvec([0.1, 0.2, 0.3])),
        "foot_right": (points["foot_right"], base * Rotation.from_rotvec([-0.3, 0.2, 0.1])),
    }


def captured(
    axes: np.ndarray, offset: np.ndarray | None = None, turn: Rotation | None = None
) -> dict[str, tuple[np.ndarray, Rotation]]:
    """Return the poses in the frame of a capture, from which `axes` rotates to the frame of the recording format.

    `offset` (m, in the body's frame) and `turn` lead from the captured balloon to the model's site.
    """
    rename = Rotation.from_matrix(axes)
    found = {
        role: (position @ axes, rename.inv() * rotation * rename)
        for role, (position, rotation) in poses(source()).items()
    }
    position, rotation = found["balloon"]
    rotation = rotation if turn is None else rotation * turn.inv()
    position = position if offset is None else position - rotation.apply(offset)
    return found | {"balloon": (position, rotation)}


section = functools.partial(vicon_section, prefix="ballu:", lost=("balloon", "foot_left"), hidden=HIDDEN)

EVENTS = "Events\n100\nSubject,Context,Name,Time (s),Description\nballu,Left,Foot Strike,1.2,The heel strikes\n"
DEVICES = (
    "Devices\n1000\n,,Force plate - Force,,\nFrame,Sub Frame,Fx,Fy,Fz\n,,N,N,N\n1,0,0.1,0.2,0.3\n1,1,0.1,0.2,0.3\n"
)


def read(folder: Path, text: str, rooms: str, name: str = "walk.csv") -> Recording:
    (folder / name).write_text(text)
    (folder / "room.toml").write_text(rooms)
    room = read_mapping(folder / "room.toml", ROBOT)
    return place(read_vicon(folder / name, room), room, ROBOT, "walk")


def assert_recording(actual: Recording, *, start: float = 0.0) -> None:
    """Assert that a recording holds the poses of `source`, without the hidden samples. `start`: first time (s)."""
    expected = poses(source())
    assert actual.tracked_position is not None and actual.tracked_quaternion is not None
    np.testing.assert_allclose(actual.time, start + source().time, atol=1e-9)
    shown = np.ones(len(actual.time), bool)
    shown[HIDDEN] = False
    for role, value in {"balloon": actual.tracked_position, **actual.points}.items():
        hidden = ~shown & (role in ("balloon", "foot_left"))
        assert np.isnan(value[hidden]).all()
        np.testing.assert_allclose(value[~hidden], expected[role][0][~hidden], atol=2e-6)
    turned = Rotation.from_quat(actual.tracked_quaternion[shown], scalar_first=True)
    balloon = Rotation.from_quat(expected["balloon"][1].as_quat()[shown])
    assert (balloon.inv() * turned).magnitude().max() < 2e-6
    assert set(actual.points) == set(ROLES[1:])
    if "base" in actual.orientations:
        base = Rotation.from_quat(actual.orientations["base"], scalar_first=True)
        assert (expected["base"][1].inv() * base).magnitude().max() < 2e-6


# ---- Vicon ----


@pytest.mark.parametrize("angle", ["deg", "rad"])
@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_nexus_segments_are_read_as_rotation_vectors(tmp_path: Path, angle: str, delimiter: str):
    text = "\n\n" + section("Segments", captured(np.eye(3)), angle=angle, delimiter=delimiter, first=212)
    assert_recording(read(tmp_path, text, 'robot = "r"\n' + KEPT + BODIES), start=2.11)


@pytest.mark.parametrize("rotation", ROTATIONS)
def test_tracker_rotations_are_read_as_the_mapping_states(tmp_path: Path, rotation: str):
    text = section("Objects", captured(np.eye(3)), prefix="Global Angle ballu:", rotation=rotation, angle="rad")
    bodies = "\n".join(f'[{role}]\nbody = "{role}"\nrotation = "{rotation}"' for role in ROLES)
    assert_recording(read(tmp_path, text, 'robot = "r"\n' + KEPT + bodies))


def test_file_with_several_sections_and_subjects_is_read(tmp_path: Path):
    """The file has segments of one subject, markers of another, a force plate with another rate, and CRLF line ends."""
    everything = captured(np.eye(3))
    rigid = {role: everything[role] for role in ("balloon", "base")}
    feet = {role: everything[role] for role in ("foot_left", "foot_right")}
    chair = section("Segments", {"seat": everything["base"]}, prefix="chair:")
    parts = [
        EVENTS,
        DEVICES,
        section("Segments", rigid),
        chair,
        section("Trajectories", feet, prefix="shoes:", rotation=None),
    ]
    rooms = 'robot = "r"\n' + KEPT + BODIES.replace("ballu:foot", "shoes:foot")
    assert_recording(read(tmp_path, "\n".join(parts).replace("\n", "\r\n"), rooms))


@pytest.mark.parametrize("length", ["m", "cm", "mm"])
def test_unit_of_length_is_that_of_the_mapping_or_else_of_the_units_row(tmp_path: Path, length: str):
    text = section("Segments", captured(np.eye(3)), length=length)
    assert_recording(read(tmp_path, text, 'robot = "r"\n' + KEPT + BODIES))
    wrong = text.replace(f",{length},{length},{length}", ",in,in,in")
    assert_recording(read(tmp_path, wrong, f'robot = "r"\n{KEPT}[units]\nlength = "{length}"\n{BODIES}'))


def test_axes_offset_and_turn_map_the_capture_to_the_model_s_site(tmp_path: Path):
    offset, turn = np.array([0.03, -0.2, 0.11]), Rotation.from_rotvec(np.deg2rad([10.0, 90.0, -20.0]))
    text = section("Segments", captured(Y_UP, offset, turn))
    axes = '[axes]\nforward = "z"\nleft = "x"\nup = "y"\n'
    site = "offset = [0.03, -0.2, 0.11]\nturn = [10, 90, -20]\n"
    bodies = BODIES.replace('body = "ballu:balloon"\n', f'body = "ballu:balloon"\n{site}')
    assert_recording(read(tmp_path, text, 'robot = "r"\n' + KEPT + axes + bodies))


def test_start_moves_the_recording_to_the_origin(tmp_path: Path):
    """A walk at another place and heading in the room, on a floor at 0.2 m, gives the same recording."""
    there = Rotation.from_euler("z", 130, degrees=True)
    moved = {
        role: (there.apply(position) + [3.0, -2.0, 0.2], there * rotation)
        for role, (position, rotation) in captured(np.eye(3)).items()
    }
    rooms = 'robot = "r"\n[origin]\nfloor = FLOOR\n' + BODIES
    first = read(tmp_path, section("Segments", captured(np.eye(3))), rooms.replace("FLOOR", "0"))
    second = read(tmp_path, section("Segments", moved), rooms.replace("FLOOR", "0.2"))
    np.testing.assert_allclose(first.points["base"][0, :2], 0, atol=1e-9)
    for foot in ("foot_left", "foot_right"):
        np.testing.assert_allclose(second.points[foot], first.points[foot], atol=5e-6)
    forward = Rotation.from_quat(np.asarray(second.tracked_quaternion)[0], scalar_first=True).as_matrix()[:, 0]
    assert forward[1] == pytest.approx(0, abs=1e-9) and forward[0] > 0.9


def test_floor_feet_sets_the_floor_at_the_lowest_foot(tmp_path: Path):
    lifted = {role: (p + [0, 0, 0.7], r) for role, (p, r) in captured(np.eye(3)).items()}
    actual = read(tmp_path, section("Segments", lifted), f'robot = "r"\n[origin]\nfloor = "feet"\n{BODIES}')
    lowest = min(np.nanmin(actual.points[foot][:, 2]) for foot in ("foot_left", "foot_right"))
    assert abs(lowest - FOOT_RADIUS) < 3e-3


def test_turn_start_aligns_any_tracked_frame(tmp_path: Path):
    """The frame of the tracked object is arbitrary. Its rotation is known because the robot starts upright."""
    skew = Rotation.from_rotvec([0.7, -1.2, 2.0])
    text = section("Segments", captured(np.eye(3), turn=skew))
    bodies = BODIES.replace('body = "ballu:balloon"', 'body = "ballu:balloon"\nturn = "start"')
    actual = read(tmp_path, text, 'robot = "r"\n' + KEPT + bodies)
    shown = np.r_[0 : HIDDEN.start, HIDDEN.stop : 300]
    turned = Rotation.from_quat(np.asarray(actual.tracked_quaternion)[shown], scalar_first=True)
    expected = poses(source())["balloon"][1][shown]
    # The remaining error is the true deviation from upright and forward at the start.
    error = (expected.inv() * turned).magnitude()
    np.testing.assert_allclose(error, expected[:20].mean().magnitude(), atol=1e-5)
    assert np.rad2deg(error[0]) < 5 and np.rad2deg(skew.magnitude()) > 90


def test_body_at_exactly_zero_is_a_missing_sample(tmp_path: Path):
    text = section("Segments", captured(np.eye(3)))
    assert_recording(read(tmp_path, zeroed(text), 'robot = "r"\n' + KEPT + BODIES))


def zeroed(text: str) -> str:
    """Return the file with zeros in the empty cells of its samples."""
    lines = text.split("\n")
    return "\n".join(
        [*lines[:5], *(",".join(cell or "0" for cell in line.split(",")) if line else "" for line in lines[5:])]
    )


def test_missing_frames_leave_gaps_in_time(tmp_path: Path):
    lines = section("Segments", captured(np.eye(3))).split("\n")
    del lines[100:110]
    actual = read(tmp_path, "\n".join(lines), 'robot = "r"\n' + KEPT + BODIES)
    np.testing.assert_allclose(actual.time, np.delete(source().time, slice(95, 105)), atol=1e-9)


def line(number: int, change: Callable[[list[str]], list[str]]) -> Callable[[str], str]:
    """Return a function that changes the cells of line `number` (counted from 1, as in messages)."""

    def damage(text: str) -> str:
        lines = text.split("\n")
        lines[number - 1] = ",".join(change(lines[number - 1].split(",")))
        return "\n".join(lines)

    return damage


@pytest.mark.parametrize(
    "damage, words",
    [
        (line(80, lambda cells: cells[:9]), ["line 80", "ends before 'ballu:base'", "cut off"]),
        (line(80, lambda cells: [*cells, "7"]), ["line 80", "more cells than the header", "decimal points"]),
        (line(80, lambda cells: [*cells[:8], "12.x", *cells[9:]]), ["line 80", "ballu:base RX", "'12.x'", "empty"]),
        (line(80, lambda cells: [*cells[:8], "1e300", *cells[9:]]), ["line 80", "ballu:base RX", "number"]),
        (line(80, lambda cells: ["12", *cells[1:]]), ["line 80", "run back, from 74 to 12", "one trial"]),
        (line(80, lambda cells: ["74", *cells[1:]]), ["line 80", "run back"]),
        (line(80, lambda cells: ["1.5", *cells[1:]]), ["line 80", "'1.5,0' is not a frame"]),
        (line(80, lambda cells: [cells[0], "1", *cells[2:]]), ["line 80", "sub-frames", "cameras' rate"]),
        (line(2, lambda cells: ["many"]), ["line 2", "'many' is not a rate in Hz"]),
        (line(4, lambda cells: ["Time", *cells[1:]]), ["no line begins with Frame", "export as CSV"]),
        (
            line(5, lambda cells: [*cells[:5], "in", *cells[6:]]),
            ["line 5", "ballu:balloon TX to TZ", "'in'", "[units]"],
        ),
        (
            line(5, lambda cells: [c.replace("deg", "rad") for c in cells]),
            ["the rotation of", "which is too large", "unit of angles"],
        ),
        (line(5, lambda cells: [c.replace("deg", "mm") for c in cells]), ["line 5", "RX to RZ", "unit of angle"]),
        (line(3, lambda cells: [c.replace("ballu:base", "ballu:beam") for c in cells]), ["'ballu:base'", "ballu:"]),
        (line(3, lambda cells: [c.replace("ballu:base", "ballu:balloon") for c in cells]), ["line 4", "RX twice"]),
        (line(1, lambda cells: ["Segments", "two"]), ["line 1", "title is missing"]),
        (lambda text: "\n".join(text.split("\n")[:3]), ["no line begins with Frame"]),
        (lambda text: "\n".join(text.split("\n")[:4]), ["line 1", "ends within its header"]),
        (lambda text: "\n".join(text.split("\n")[:5]), ["no sample below the header"]),
        (lambda text: "", ["no line begins with Frame"]),
        (lambda text: text + "\n" + text.replace("Segments", "Objects"), ["several sections (Segments, Objects)"]),
        (lambda text: text.replace("Segments", "Objects"), ["rotation vector or Euler angles", 'rotation = "helical"']),
    ],
)
def test_damaged_vicon_file_is_refused_with_place_and_remedy(
    tmp_path: Path, damage: Callable[[str], str], words: list[str]
):
    with pytest.raises(InputError) as refusal:
        read(tmp_path, damage(vicon_text()), 'robot = "r"\n' + KEPT + BODIES)
    message = str(refusal.value)
    assert message.startswith(str(tmp_path / "walk.csv")) and message.endswith(".") and "\n" not in message
    for part in words:
        assert part in message


@functools.cache
def vicon_text() -> str:
    return section("Segments", captured(np.eye(3)))


def test_marker_cannot_be_the_tracked_body(tmp_path: Path):
    text = section("Trajectories", captured(np.eye(3)), rotation=None)
    with pytest.raises(InputError, match=r"room.toml, \[balloon\]: its source has no orientation; name an object"):
        read(tmp_path, text, 'robot = "r"\n' + BODIES)


CELLS = st.one_of(
    st.text(max_size=8),
    st.floats().map(repr),
    st.integers(-(10**30), 10**30).map(str),
    st.sampled_from(
        ["", " ", '"', ",", "\n", "\r", "\0", "nan", "inf", "-1e308", "1_0", "Frame", "mm", "deg", ";", "²"]
    ),
)


@functools.cache
def short_rows() -> list[list[str]]:
    bodies = {role: (position[:120], rotation[:120]) for role, (position, rotation) in captured(np.eye(3)).items()}
    return [row.split(",") for row in section("Segments", bodies).split("\n")]


@settings(max_examples=250, deadline=None)
@given(
    edits=st.lists(st.tuples(st.integers(0, 124), st.integers(0, 25), CELLS), max_size=3),
    cut=st.one_of(st.none(), st.integers(0, 30_000)),
    swapped=st.one_of(st.none(), st.tuples(st.integers(0, 124), st.integers(0, 124))),
)
def test_mutated_file_is_refused_or_keeps_its_unchanged_samples(
    edits: list[tuple[int, int, str]], cut: int | None, swapped: tuple[int, int] | None
):
    """No other exception occurs, no number is infinite, times increase, and unchanged samples keep their values."""
    rows = [list(row) for row in short_rows()]
    for row, column, text in edits:
        cells = rows[row]
        cells[min(column, len(cells) - 1)] = text
    if swapped is not None:
        rows[swapped[0]], rows[swapped[1]] = rows[swapped[1]], rows[swapped[0]]
    text = "\n".join(",".join(row) for row in rows)[:cut]
    with tempfile.TemporaryDirectory() as folder:
        path, room = Path(folder) / "walk.csv", Path(folder) / "room.toml"
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        room.write_text('robot = "r"\n' + KEPT + BODIES)
        try:
            checked = read_mapping(room, ROBOT)
            recording = place(read_vicon(path, checked), checked, ROBOT, "walk")
        except InputError as error:
            assert folder in str(error) and len(str(error)) < 600
            return
    assert (np.diff(recording.time) > 0).all()
    header = any(row < 5 for row, _, _ in edits) or (swapped is not None and min(swapped) < 5)
    clean = poses(source())["base"][0]
    for field in (recording.tracked_position, *recording.points.values()):
        assert not np.isinf(np.asarray(field)).any()
    if not header and len(recording.time) > 1:
        frames = np.round(recording.time * 100).astype(int)
        touched = {row - 5 for row, _, _ in edits}
        kept = [i for i, frame in enumerate(frames) if frame not in touched and frame < len(clean)]
        if 0 not in touched and not any("\n" in t or "\r" in t or "," in t for _, _, t in edits) and cut is None:
            np.testing.assert_allclose(recording.points["base"][kept], clean[frames[kept]], atol=2e-6)


def test_duplicate_names_are_refused_only_if_the_mapping_uses_them(tmp_path: Path):
    text = section("Segments", captured(np.eye(3)))
    twins = section("Segments", {"twin": captured(np.eye(3))["base"], "other": captured(np.eye(3))["base"]})
    rooms = 'robot = "r"\n' + KEPT + BODIES
    assert_recording(
        read(tmp_path, text + "\n" + twins.replace("ballu:other", "ballu:twin").replace("Segments", "Model"), rooms)
    )
    with pytest.raises(InputError, match="'ballu:base' has RX twice"):
        read(tmp_path, text.replace("ballu:foot_left", "ballu:base"), rooms)


def test_messages_state_the_frame_numbers_of_the_file(tmp_path: Path):
    """The trial was cropped to begin at frame 213. A marker is displaced in its 51st sample, which is frame 263."""
    found = poses(source())
    position, rotation = found["balloon"]
    markers = np.stack([position + rotation.apply(place) for place in cluster()], axis=1)
    markers[50, 0] += 0.3
    others = np.stack([found[role][0] for role in ROLES[1:]], axis=1)
    labels = [*(f"B{i}" for i in range(5)), *(f"ballu:{role}" for role in ROLES[1:])]
    (tmp_path / "walk.c3d").write_bytes(c3d_bytes(1e3 * np.concatenate([markers, others], axis=1), labels, first=213))
    with pytest.raises(InputError, match="the markers of balloon deviate from a rigid body in frame 263"):
        read_c3d(tmp_path / "walk.c3d", c3d_room(tmp_path))
    text = section("Objects", captured(np.eye(3)), rotation="quaternion", first=213)
    row = text.splitlines()[5 + 80].split(",")
    text = text.replace(",".join(row), ",".join([*row[:2], "0.5", *row[3:]]))
    bodies = "\n".join(f'[{role}]\nbody = "{role}"\nrotation = "quaternion"' for role in ROLES)
    with pytest.raises(InputError, match="the quaternion of frame 293 has length"):
        read(tmp_path, text, 'robot = "r"\n' + KEPT + bodies)


# ---- markers ----


def cluster(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.2, 0.2, (5, 3))


def test_body_pose_is_computed_from_its_markers():
    position, rotation = poses(source())["balloon"]
    places = cluster()
    markers = np.stack([position + rotation.apply(place) for place in places])
    markers[0, 10:40] = markers[1, 30:60] = np.nan  # three of five markers determine the pose
    markers[:3, 80:90] = np.nan  # two do not
    body = rigid_body(Path("x"), "balloon", markers, places, 0.01)
    missing = np.zeros(300, bool)
    missing[80:90] = True
    assert body.quaternion is not None and np.isnan(body.quaternion[missing]).all()
    turned = Rotation.from_quat(body.quaternion[~missing], scalar_first=True)
    expected = Rotation.from_quat(rotation.as_quat()[~missing])
    assert (expected.inv() * turned).magnitude().max() < 1e-7
    np.testing.assert_allclose(body.position[~missing], position[~missing], atol=1e-9)


def test_collinear_or_exchanged_markers_are_refused():
    position, rotation = poses(source())["balloon"]
    markers = np.stack([position + rotation.apply(place) for place in cluster()])
    on_a_line = np.outer(np.arange(3), [0.1, 0.0, 0.02])
    with pytest.raises(InputError, match="lie on a line"):
        rigid_body(Path("x"), "balloon", markers[:3], on_a_line, 0.01)
    markers[:2, 150] = markers[1::-1, 150]
    with pytest.raises(InputError, match="the markers of balloon deviate from a rigid body in sample 151"):
        rigid_body(Path("x"), "balloon", markers, cluster(), 0.01)


# ---- C3D ----


def c3d_content(**options: Any) -> bytes:
    """Return the recording as a C3D file. The balloon has five markers. The hidden samples have no measurements."""
    found = poses(source())
    position, rotation = found["balloon"]
    markers = {f"ballu:B{i}": position + rotation.apply(place) for i, place in enumerate(cluster())}
    markers |= {f"ballu:{role}": found[role][0] for role in ROLES[1:]}
    points = 1e3 * np.stack(list(markers.values()), axis=1)
    for hidden in [*range(5), list(markers).index("ballu:foot_left")]:
        points[HIDDEN, hidden] = np.nan
    return c3d_bytes(points, list(markers), **options)


@pytest.fixture
def c3d_file(tmp_path: Path) -> Path:
    (tmp_path / "walk.c3d").write_bytes(c3d_content())
    return tmp_path / "walk.c3d"


def c3d_room(folder: Path, more: str = "") -> RoomMapping:
    markers = ", ".join(f'"B{i}"' for i in range(5))
    balloon = f"[balloon]\nmarkers = [{markers}]\ngeometry = {cluster().tolist()}\n"
    (folder / "room.toml").write_text('robot = "r"\n' + KEPT + more + balloon + BODIES.split("\n", 2)[2])
    return read_mapping(folder / "room.toml", ROBOT)


def test_c3d_file_is_read(c3d_file: Path):
    """The file's single precision corresponds to 0.1 micrometres."""
    room = c3d_room(c3d_file.parent)
    assert_recording(place(read_c3d(c3d_file, room), room, ROBOT, "walk"))


@pytest.mark.parametrize("share", [0.0, 0.001, 0.05, 0.3, 0.9, 0.98])
def test_truncated_c3d_file_is_refused(c3d_file: Path, share: float):
    content = c3d_file.read_bytes()
    c3d_file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=r"walk.c3d: (not a|too short)"):
        read_c3d(c3d_file, c3d_room(c3d_file.parent))


def test_c3d_file_without_a_mapped_marker_or_known_unit_is_refused(c3d_file: Path):
    room = c3d_room(c3d_file.parent)
    (c3d_file.parent / "room.toml").write_text((c3d_file.parent / "room.toml").read_text().replace("B4", "B9"))
    with pytest.raises(InputError, match=r"walk.c3d: there is no marker 'B9'; fix .*room\.toml"):
        read_c3d(c3d_file, read_mapping(c3d_file.parent / "room.toml", ROBOT))
    content = bytearray(c3d_file.read_bytes())
    units = content.index(b"UNITS")
    content[content.index(b"mm", units) : content.index(b"mm", units) + 2] = b"xy"
    c3d_file.write_bytes(content)
    with pytest.raises(InputError, match=r"POINT:UNITS: the unit 'xy' is not a known unit of length"):
        read_c3d(c3d_file, room)
    assert_recording(
        place(read_c3d(c3d_file, c3d_room(c3d_file.parent, '[units]\nlength = "mm"\n')), room, ROBOT, "walk")
    )


@pytest.mark.parametrize("seed", range(12))
def test_c3d_file_with_damaged_parameters_is_refused_or_read_correctly(c3d_file: Path, seed: int):
    rng = np.random.default_rng(seed)
    content = bytearray(c3d_file.read_bytes())
    content[600:660] = rng.integers(0, 256, 60, np.uint8).tobytes()
    content[512 + rng.integers(4, 512)] = rng.integers(0, 256)
    c3d_file.write_bytes(content)
    room = c3d_room(c3d_file.parent)
    try:
        found = read_c3d(c3d_file, room)
    except InputError as error:
        assert "walk.c3d" in str(error)
    else:
        assert_recording(place(found, room, ROBOT, "walk"))


@pytest.mark.parametrize("processor", [INTEL, DEC, MIPS])
@pytest.mark.parametrize("analog_words", [0, 6])
def test_c3d_files_of_every_processor_type_are_read(tmp_path: Path, processor: int, analog_words: int):
    """Each frame may contain analog words. No parameter states their rate."""
    room = c3d_room(tmp_path)
    (tmp_path / "walk.c3d").write_bytes(c3d_content(processor=processor, analog_words=analog_words))
    assert_recording(place(read_c3d(tmp_path / "walk.c3d", room), room, ROBOT, "walk"))


@pytest.mark.parametrize("processor", [INTEL, DEC, MIPS])
@pytest.mark.parametrize("scale", [0.1, 0.1449, 0.07])
def test_c3d_integers_are_read_for_every_scale_and_processor_type(tmp_path: Path, processor: int, scale: float):
    """The sign of the scale marks integers. The byte of the sign depends on the processor type."""
    position = np.random.default_rng(0).uniform(-1000, 1000, (150, 4, 3))
    position[40:60, 1] = np.nan
    content = c3d_bytes(position, "abcd", processor=processor, scale=scale)
    actual = read_c3d_points(content).position
    np.testing.assert_allclose(actual.transpose(2, 1, 0), position, atol=0.51 * scale)


@pytest.mark.parametrize("processor", [INTEL, DEC])
@pytest.mark.parametrize("scale", [-1.0, 0.1])
def test_c3d_positions_match_ezc3d(tmp_path: Path, processor: int, scale: float):
    ezc3d = pytest.importorskip("ezc3d", reason="the independent reader is in the extra `test`")
    position = np.random.default_rng(1).uniform(-1000, 1000, (90, 5, 3))
    content = c3d_bytes(position, "abcde", processor=processor, scale=scale, rate=119.88)
    (tmp_path / "walk.c3d").write_bytes(content)
    expected = np.asarray(ezc3d.c3d(str(tmp_path / "walk.c3d"))["data"]["points"])[:3]
    np.testing.assert_allclose(read_c3d_points(content).position, expected, rtol=1e-7)


@pytest.mark.parametrize("unit", ["m", "meters", "mete", "Metres", "mm", "millimeters", "cm", "centimetre"])
def test_c3d_units_are_read_in_every_common_spelling(tmp_path: Path, unit: str):
    room = c3d_room(tmp_path)
    (tmp_path / "walk.c3d").write_bytes(c3d_content(unit=unit))
    factor = 1.0 if unit.startswith(("mm", "milli")) else {"m": 1e3, "c": 10.0}[unit[0].lower()]
    bodies = read_c3d(tmp_path / "walk.c3d", c3d_room(tmp_path, '[units]\nlength = "mm"\n')).bodies
    if factor != 1.0:  # the markers then contradict the geometry in the mapping
        room = dataclasses.replace(room, sources={role: room.sources[role] for role in ROLES[1:]})
    metres = read_c3d(tmp_path / "walk.c3d", room).bodies
    np.testing.assert_allclose(metres["base"].position, factor * bodies["base"].position, rtol=1e-12)


@pytest.mark.parametrize("name", ["Hüfte", "Cadera_ñ", "Ågot"])
@pytest.mark.parametrize("encoding", ["latin-1", "utf-8"])
def test_c3d_labels_are_read_in_latin_1_and_utf_8(name: str, encoding: str):
    found = read_c3d_points(c3d_bytes(np.zeros((10, 2, 3)) + 1, [name.encode(encoding), b"other"]))
    assert found.labels == (name, "other")


def test_c3d_file_with_more_than_65535_frames_is_read_whole_or_refused():
    """The frame count in the header wraps or saturates at 16 bits. Other parameters may hold the full count."""
    position = np.arange(70_000.0)[:, None, None] + np.arange(1.0, 4.0)
    end = {("TRIAL", "ACTUAL_START_FIELD"): (2, [1, 0]), ("TRIAL", "ACTUAL_END_FIELD"): (2, [70_000 & 0xFFFF, 1])}
    counted = {("POINT", "LONG_FRAMES"): (4, [70_000.0])}
    for last, parameters in ((4_464, end), (65_535, end), (4_464, counted), (65_535, counted)):
        found = read_c3d_points(c3d_bytes(position, ["a"], last=last, parameters=parameters)).position
        np.testing.assert_array_equal(found[0, 0], position[:, 0, 0])
    for last in (4_464, 65_535):
        with pytest.raises(C3DError, match=r"70,000 frames|holds 70,"):
            read_c3d_points(c3d_bytes(position, ["a"], last=last))
    long = {("POINT", "FRAMES"): (4, [300.0])}  # as a floating-point number
    assert read_c3d_points(c3d_bytes(position[:300], ["a"], parameters=long)).position.shape == (3, 1, 300)


@pytest.mark.parametrize("header_count", [2, 16])
def test_number_of_analog_words_follows_from_the_file_length(header_count: int):
    """In public files of one program, the header counts channels instead of samples."""
    position = np.random.default_rng(2).uniform(-1, 1, (80, 3, 3))
    channels = {("ANALOG", "USED"): (2, [2]), ("ANALOG", "RATE"): (4, [700.0])}
    content = bytearray(c3d_bytes(position, "abc", analog_words=14, parameters=channels))
    content[4:6] = struct.pack("<H", header_count)
    np.testing.assert_allclose(read_c3d_points(bytes(content)).position.transpose(2, 1, 0), position, rtol=1e-6)
    with pytest.raises(C3DError, match="analog words in a frame"):
        read_c3d_points(bytes(content) + bytes(3000))


def test_c3d_file_with_contradictory_parameters_is_refused():
    content = bytearray(c3d_bytes(np.ones((30, 2, 3)), "ab", scale=0.1))
    content[12:16] = struct.pack("<f", 0.2)
    with pytest.raises(C3DError, match=r"a scale of 0\.2, POINT:SCALE 0\.1"):
        read_c3d_points(bytes(content))
    content[12:16] = struct.pack("<f", -0.1)
    with pytest.raises(C3DError, match="do not agree whether its numbers are integers"):
        read_c3d_points(bytes(content))
    content[12:16], content[2] = struct.pack("<f", 0.1), 3
    with pytest.raises(C3DError, match="counts 3 points in a frame, POINT:USED 2"):
        read_c3d_points(bytes(content))


@pytest.mark.parametrize("first", [1, 0, 213])
def test_time_of_a_cropped_trial_follows_from_its_frame_number(tmp_path: Path, first: int):
    """Cropping the start of a trial, as Nexus does, does not shift its times."""
    room = c3d_room(tmp_path)
    (tmp_path / "walk.c3d").write_bytes(c3d_content(first=first))
    start = max(first - 1, 0) / 100
    assert read_c3d(tmp_path / "walk.c3d", room).time[0] == pytest.approx(start)
    (tmp_path / "walk.csv").write_text(section("Segments", captured(np.eye(3)), first=first))
    (tmp_path / "vicon.toml").write_text('robot = "r"\n' + KEPT + BODIES)
    read_csv = read_vicon(tmp_path / "walk.csv", read_mapping(tmp_path / "vicon.toml", ROBOT))
    assert read_csv.time[0] == pytest.approx(start) and read_csv.first_frame == max(first, 1)


def test_file_that_is_not_a_c3d_is_refused(tmp_path: Path):
    (tmp_path / "walk.c3d").write_bytes(struct.pack("<256H", *range(256)))
    with pytest.raises(InputError, match="walk.c3d: not a C3D file"):
        read_c3d(tmp_path / "walk.c3d", c3d_room(tmp_path))


# ---- tables ----

COLUMNS = """
robot = "r"
[origin]
start = false
[units]
length = "cm"
angle = "deg"
[clock]
time_unit = "ms"
[balloon]
position = ["bx", "by", "bz"]
orientation = ["bw", "bi", "bj", "bk"]
rotation = "quaternion"
[base]
position = ["px", "py", "pz"]
[foot_left]
position = ["lx", "ly", "lz"]
[foot_right]
position = ["rx", "ry", "rz"]
[knee_left]
column = "kl"
sign = -1
zero = 10
[knee_right]
column = "kr"
[motor_left]
column = "kl"
[motor_right]
column = "kr"
[commands]
time = "clock"
left = "servo"
right = "servo2"
range_left = [0, 90]
range_right = [180, 90]
"""


def table_text() -> str:
    found = poses(source())
    columns = [1e3 * source().time, *(100 * found["balloon"][0].T), *found["balloon"][1].as_quat(scalar_first=True).T]
    for role in ROLES[1:]:
        columns += list(100 * found[role][0].T)
    wave = 30 * np.sin(source().time)
    columns += [10 - wave, wave, 90 * source().command[:, 0], 180 - 90 * source().command[:, 1]]
    names = "clock bx by bz bw bi bj bk px py pz lx ly lz rx ry rz kl kr servo servo2"
    rows = [names.replace(" ", ","), *(",".join(f"{x:.9g}" for x in row) for row in zip(*columns, strict=True))]
    lines = [row.split(",") for row in rows]
    for row in lines[HIDDEN.start + 1 : HIDDEN.stop + 1]:
        row[1:8], row[11:14] = [""] * 7, [""] * 3
    return "\n".join(",".join(row) for row in lines) + "\n"


def read_columns(folder: Path, text: str, rooms: str = COLUMNS) -> tuple[Recording, np.ndarray]:
    (folder / "walk.csv").write_text(text)
    (folder / "room.toml").write_text(rooms)
    room = read_mapping(folder / "room.toml", ROBOT)
    found = select(open_table(folder / "walk.csv"), room)
    assert found.commands is not None
    return place(found, room, ROBOT, "walk"), found.commands.command


def test_table_is_read(tmp_path: Path):
    actual, command = read_columns(tmp_path, table_text())
    assert_recording(actual)
    np.testing.assert_allclose(command, source().command, atol=1e-7)
    for knee in ("knee_left", "knee_right"):
        np.testing.assert_allclose(actual.joint_angles[knee], np.deg2rad(30 * np.sin(source().time)), atol=1e-8)


@pytest.mark.parametrize(
    "damage, words",
    [
        (lambda t, m: (t.replace("lx", "mx"), m), ["walk.csv: there is no column 'lx'", "fix", "room.toml"]),
        (lambda t, m: (t.replace("bx,by", "by,by"), m), ["walk.csv"]),
        (lambda t, m: ("\n".join(t.split("\n")[:50]) + "\n1,2,3\n", m), ["line 51", "3 cells, the header 21"]),
        (lambda t, m: (t.replace("\n10,", "\nten,"), m), ["line 3, column clock", "'ten' is not a number"]),
        (lambda t, m: (t.replace("\n10,", "\n,"), m), ["line 3, column clock", "time is missing"]),
        (lambda t, m: (t.replace("\n10,", "\n-5,"), m), ["line 3, column clock", "runs back"]),
        (lambda t, m: ("clock,bx\n", m), ["no sample below a header"]),
        (lambda t, m: (t, m.replace('length = "cm"\n', "")), ["room.toml, [units]", "length of a table's"]),
        (lambda t, m: (t, m.replace("[0, 90]", "[0, 45]")), ["column servo", "outside of 0 to 45", "range_left"]),
        (lambda t, m: (t, m.replace('"clock"', '"watch"')), ["no column 'watch' of times", "rate"]),
        (lambda t, m: (t, m.replace('"bw", "bi", "bj", "bk"', '"bi", "bj", "bk", "px"')), ["quaternion", "length"]),
    ],
)  # fmt: skip
def test_damaged_tables_are_refused(tmp_path: Path, damage: Callable[[str, str], tuple[str, str]], words: list[str]):
    with pytest.raises(InputError) as refusal:
        read_columns(tmp_path, *damage(table_text(), COLUMNS))
    for part in words:
        assert part in str(refusal.value)


def test_command_log_holds_each_command_until_the_next(tmp_path: Path):
    log = tmp_path / "log.csv"
    log.write_text("time,command_left,command_right\n5,0.2,0\n5.5,,1\n6.25,0.7,\n")
    time, command = read_commands(open_table(log), Commands.of(ROBOT))
    assert time.tolist() == [5.0, 5.5, 6.25]
    assert command.tolist() == [[0.2, 0.0], [0.2, 1.0], [0.7, 1.0]]
    with_log, trimmed = with_commands(log, source(), time - 5.0, command)
    # Commands begin at 0 s. The last one is held for 0.75 s, the longest interval between commands.
    assert trimmed == pytest.approx((0.0, 0.99)) and with_log.time[-1] == pytest.approx(2.0)
    assert with_log.command[[0, 49, 50, 124, 125, 200]].tolist() == [
        [0.2, 0],
        [0.2, 0],
        *[[0.2, 1]] * 2,
        *[[0.7, 1]] * 2,
    ]
    with pytest.raises(InputError, match=r"log.csv: its commands, from 10.00 to 12.00 s .* do not overlap it"):
        with_commands(log, source(), time + 5.0, command)


# ---- mappings ----


def test_example_mapping_is_valid_and_shows_the_defaults(tmp_path: Path):
    (tmp_path / "example.toml").write_text(example_mapping(ROBOT))
    bare = "\n".join(f'[{role}]\nbody = "ballu:{role}"' for role in ROLES)
    (tmp_path / "bare.toml").write_text('robot = "ballu-1"\n' + bare)
    example, bare = (read_mapping(tmp_path / f"{name}.toml", ROBOT) for name in ("example", "bare"))
    for field in dataclasses.fields(RoomMapping):
        if field.name not in ("path", "axes"):
            assert getattr(example, field.name) == getattr(bare, field.name), field.name
    np.testing.assert_array_equal(example.axes, np.eye(3))


def test_mapping_may_be_json(tmp_path: Path):
    (tmp_path / "room.json").write_text(
        '{"robot": "r", ' + ", ".join(f'"{role}": {{"body": "{role}"}}' for role in ROLES) + "}"
    )
    assert read_mapping(tmp_path / "room.json", ROBOT).sources["base"].body == "base"


@pytest.mark.parametrize(
    "old, new, words",
    [
        ('robot = "r"', "", ["key robot", "missing"]),
        ('robot = "r"', 'robot = "r', ["not TOML", "example-mapping"]),
        ("[base]", "[bass]", ["[base]", "missing"]),
        ('body = "ballu:base"', 'bdy = "ballu:base"', ["[base]", "source is missing"]),
        ('body = "ballu:base"', 'body = "b"\nofset = [0, 0, 0]', ["[base] ofset", "no such key", "offset"]),
        ('body = "ballu:base"', 'body = "b"\noffset = [0, 0]', ["[base] offset", "3 numbers"]),
        ('body = "ballu:base"', 'body = "b"\noffset = [0, 0, 30]', ["[base] offset", "metres"]),
        ('body = "ballu:base"', 'body = "b"\nrotation = "XXZ"', ["[base] rotation", "helical"]),
        ('body = "ballu:base"', 'markers = ["a", "b"]', ["[base] markers", "three"]),
        ('body = "ballu:base"', 'body = "b"\nmarkers = ["a", "b", "c"]', ["body and markers"]),
        ('robot = "r"', 'robot = "r"\n[axes]\nup = "w"', ["[axes] up", '"w"', '"-y"']),
        ('robot = "r"', 'robot = "r"\n[axes]\nup = "-z"', ["[axes]", "left-handed"]),
        ('robot = "r"', 'robot = "r"\n[axes]\nup = "y"', ["[axes]", "same way"]),
        ('robot = "r"', 'robot = "r"\n[units]\nlength = "inch"', ["[units] length", "m, cm, mm"]),
        ('robot = "r"', 'robot = "r"\n[units]\ntime = "min"', ["[units] time", "s, ms"]),
        (
            'robot = "r"',
            'robot = "r"\n[units]\ntime = "ms"\n[clock]\ntime_unit = "ms"',
            ["[clock] time_unit", "[units]", "leave"],
        ),
        ('robot = "r"', 'robot = "r"\n[clock]\nepisode = -1', ["[clock] episode", "-1"]),
        ('robot = "r"', 'robot = "r"\nkind = "loose"', ["key kind", "free, suspended"]),
        ('robot = "r"', 'robot = "r"\nrate = 0', ["key rate", "positive"]),
        ('robot = "r"', 'robot = "r"\nbase = 3', ["not TOML"]),
        (
            'robot = "r"',
            'robot = "r"\n[commands]\nrange_left = [1, 1]',
            ["range_left", "at command 0 and at command 1"],
        ),
    ],
)
def test_invalid_mappings_are_refused(tmp_path: Path, old: str, new: str, words: list[str]):
    text = 'robot = "r"\n' + BODIES
    assert old in text
    (tmp_path / "room.toml").write_text(text.replace(old, new))
    with pytest.raises(InputError) as refusal:
        read_mapping(tmp_path / "room.toml", ROBOT)
    assert str(refusal.value).startswith(str(tmp_path / "room.toml"))
    for part in words:
        assert part in str(refusal.value)


def test_mapping_of_an_earlier_version_may_have_the_time_unit_under_units(tmp_path: Path):
    (tmp_path / "room.toml").write_text('robot = "r"\n[units]\ntime = "ms"\n' + BODIES)
    assert read_mapping(tmp_path / "room.toml", ROBOT).clock.time_unit == "ms"


VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.sampled_from(["x", "-z"])),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
KEYS = [("", field.name) for field in dataclasses.fields(RoomMapping)]
KEYS += [("balloon", field.name) for field in dataclasses.fields(Source)]
KEYS += [("commands", key) for key in ("time", "time_unit", "left", "right", "range_left", "range_right")]
KEYS += [("axes", "up"), ("origin", "start"), ("origin", "floor"), ("units", "angle"), ("knee_left", "column")]
KEYS += [("clock", key) for key in ("time", "time_unit", "episode")]


@settings(max_examples=150, deadline=None)
@given(changes=st.lists(st.tuples(st.sampled_from(KEYS), VALUES), min_size=1, max_size=3))
def test_mapping_with_any_values_is_read_or_refused(changes: list[tuple[tuple[str, str], object]]):
    content: dict = {"robot": "r", **{role: {"body": role} for role in ROLES}}
    for (table, key), value in changes:
        place = content.setdefault(table, {}) if table else content
        if isinstance(place, dict):
            place[key] = value
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.json"
        path.write_text(json.dumps(content))
        try:
            checked = read_mapping(path, ROBOT)
        except InputError as error:
            assert str(error).startswith(str(path))
        else:
            assert np.linalg.det(checked.axes) == pytest.approx(1.0) and checked.robot.strip()


def test_names_shared_by_two_subjects_must_include_the_subject(tmp_path: Path):
    found = captured(np.eye(3))
    text = section("Segments", found) + "\n" + section("Segments", {"base": found["base"]}, prefix="twin:")
    with pytest.raises(InputError, match=r"'base' belongs to several subjects; name one in .*: ballu:base, twin:base"):
        read(tmp_path, text, 'robot = "r"\n' + BODIES.replace("ballu:", ""))
