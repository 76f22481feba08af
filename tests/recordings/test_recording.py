"""Tests of the recording format: round trips, interpolation of gaps, and refusal of damaged files."""

from __future__ import annotations

import csv
import dataclasses
import functools
import gzip
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu import recordings as ballu_recordings
from ballu_mjx.ballu.recordings import make_recording
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings import csv_format
from ballu_mjx.recordings.csv_format import list_bundled, list_recordings
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.registry import load_robot

read_recording = functools.partial(csv_format.read_recording, robot=load_robot())
write_recording = functools.partial(csv_format.write_recording, robot=load_robot())
COLUMNS = {
    "time": ("time",),
    "command": ("command_left", "command_right"),
    "balloon_position": tuple(f"balloon_{axis}" for axis in "xyz"),
    "balloon_quaternion": tuple(f"balloon_q{axis}" for axis in "wxyz"),
    "base_position": tuple(f"base_{axis}" for axis in "xyz"),
    "base_quaternion": tuple(f"base_q{axis}" for axis in "wxyz"),
    "foot_position": tuple(f"foot_{side}_{axis}" for side in ("left", "right") for axis in "xyz"),
    "motor": ("motor_left", "motor_right"),
    "knee": ("knee_left", "knee_right"),
}
"""BALLU's columns by key of `arrays`, in the order of the file."""

FREE = {"format": "ballu-recording/1", "kind": "free", "robot": "virtual", "notes": "a bow"}
ARRAYS = [field for field in COLUMNS if field != "time"]
Table = dict[str, list[str]]


def smooth(time: np.ndarray) -> Recording:
    """Return a recording of a robot that sways, turns and bends its knees, as smooth functions of time."""
    wave = np.sin(2 * np.pi * 0.5 * time)
    swing = np.stack([wave, -wave], 1)
    one, zero = np.ones_like(time), np.zeros_like(time)
    along = 0.15 * (time - time[0])
    foot = np.stack([along[:, None] + 0.05 * swing, 0.058 * np.outer(one, [1, -1]), 0.004 + 0.02 * (1 + swing)], 2)

    def orientation(*angles: np.ndarray) -> np.ndarray:
        return Rotation.from_euler("ZYX", np.stack(angles, 1)).as_quat(canonical=True, scalar_first=True)

    return make_recording(
        name="smooth",
        kind="free",
        robot="virtual",
        notes="a bow",
        time=time,
        command=np.stack([time % 1 < 0.5, time % 1 >= 0.5], 1).astype(float),
        balloon_position=np.stack([along, 0.02 * wave, 1.1 + 0.01 * wave], 1),
        balloon_quaternion=orientation(0.4 * time - 0.4 * time[0], 0.1 * wave, 0.05 * wave),
        base_position=np.stack([along + 0.01 * wave, zero, 0.7 + 0.01 * wave], 1),
        base_quaternion=orientation(0.4 * time - 0.4 * time[0], 0.2 * wave, zero),
        foot_position=foot,
        motor=0.8 + 0.7 * swing,
        knee=0.9 + 0.4 * swing,
    )


@functools.cache
def steady() -> Recording:
    return smooth(np.arange(0, 400) / 100)


def arrays(recording: Recording) -> dict[str, np.ndarray | None]:
    return {
        "time": recording.time,
        "command": recording.command,
        "balloon_position": recording.tracked_position,
        "balloon_quaternion": recording.tracked_quaternion,
        "base_position": ballu_recordings.base_position(recording),
        "base_quaternion": recording.orientations.get("base"),
        "foot_position": ballu_recordings.foot_position(recording),
        "motor": ballu_recordings.motor(recording),
        "knee": ballu_recordings.knee(recording),
    }


def changed(recording: Recording, **fields: Any) -> Recording:
    named = {name: getattr(recording, name) for name in ("name", "kind", "robot", "notes")}
    return make_recording(**{**named, **arrays(recording), **fields})  # pyright: ignore[reportArgumentType]


def without(recording: Recording, *fields: str) -> Recording:
    return changed(recording, **dict.fromkeys(fields))


def assert_close(actual: Recording, expected: Recording, tolerance: float) -> None:
    for field in ARRAYS:
        a, b = arrays(actual)[field], arrays(expected)[field]
        assert (a is None) == (b is None), field
        if a is not None:
            # Quaternions are written with one decimal less.
            assert b is not None
            allowed = max(tolerance, 1e-4) if field.endswith("quaternion") else tolerance
            np.testing.assert_allclose(a, np.asarray(b), atol=allowed, rtol=0, err_msg=field)


def load(path: Path) -> Table:
    with path.open(newline="") as stream:
        header, *rows = csv.reader(stream)
    return {name: [row[i] for row in rows] for i, name in enumerate(header)}


def save(table: Table, path: Path) -> None:
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows([list(table), *zip(*table.values(), strict=True)])


@functools.cache
def written() -> tuple[bytes, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "walk.csv"
        write_recording(steady(), path)
        return path.read_bytes(), path.with_suffix(".json").read_bytes()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return the path of a valid recording with all columns."""
    (tmp_path / "walk.csv").write_bytes(written()[0])
    (tmp_path / "walk.json").write_bytes(written()[1])
    return tmp_path / "walk.csv"


# ---- reading and writing ----


@pytest.mark.parametrize("name", ["walk.csv", "walk.csv.gz"])
@pytest.mark.parametrize("left_out", [(), ("base_quaternion", "motor", "knee")])
def test_recording_is_read_back(tmp_path: Path, name: str, left_out: tuple[str, ...]) -> None:
    expected = without(steady(), *left_out)
    write_recording(expected, tmp_path / name)
    actual = read_recording(tmp_path / name)
    assert (actual.name, actual.kind, actual.robot, actual.notes) == ("walk", "free", "virtual", "a bow")
    np.testing.assert_array_equal(actual.time, expected.time)
    assert_close(actual, expected, 1e-5)
    assert actual.interpolated == {} and actual.trimmed == (0, 0)


def test_suspended_recording_needs_only_motors_and_knees(tmp_path: Path) -> None:
    positions = ["balloon_position", "balloon_quaternion", "base_position", "base_quaternion", "foot_position"]
    expected = dataclasses.replace(without(steady(), *positions), kind="suspended")
    write_recording(expected, tmp_path / "sweep.csv")
    assert_close(read_recording(tmp_path / "sweep.csv"), expected, 1e-5)


@pytest.mark.parametrize("ending", [".csv", ".csv.gz"])
def test_files_are_reproducible_to_the_byte(tmp_path: Path, ending: str) -> None:
    for name in ("one", "two"):
        write_recording(steady(), tmp_path / f"{name}{ending}")
    assert (tmp_path / f"one{ending}").read_bytes() == (tmp_path / f"two{ending}").read_bytes()
    assert (tmp_path / "one.json").read_bytes() == (tmp_path / "two.json").read_bytes()


def test_26_bundled_recordings_fit_in_two_megabytes(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    clean = smooth(np.arange(2000) / 100)
    noisy: dict[str, Any] = {
        f: v + 5e-4 * rng.standard_normal(v.shape) for f, v in arrays(clean).items() if "pos" in f and v is not None
    }
    turn = Rotation.from_rotvec(np.deg2rad(0.3) * rng.standard_normal((2000, 3)))
    turned = Rotation.from_quat(np.asarray(clean.tracked_quaternion), scalar_first=True) * turn
    noisy["balloon_quaternion"] = turned.as_quat(scalar_first=True)
    bundle = changed(without(clean, "base_quaternion", "motor", "knee"), **noisy)
    write_recording(bundle, tmp_path / "walk.csv.gz", decimals=4)
    assert 26 * (tmp_path / "walk.csv.gz").stat().st_size < 2e6


def test_columns_may_have_any_order(path: Path) -> None:
    table = load(path)
    shuffled = list(np.random.default_rng(0).permutation(list(table)))
    save({name: table[name] for name in shuffled}, path)
    assert_close(read_recording(path), steady(), 1e-5)


def test_recording_with_jittered_times_is_read_back(tmp_path: Path) -> None:
    time = 1e5 + np.cumsum(np.random.default_rng(0).uniform(0.002, 0.03, 200))
    expected = smooth(time)
    write_recording(expected, tmp_path / "walk.csv")
    actual = read_recording(tmp_path / "walk.csv")
    np.testing.assert_allclose(actual.time, time, atol=1e-6, rtol=0)
    assert_close(actual, expected, 1e-5)


@pytest.mark.parametrize(
    "change",
    [
        lambda b: b"\xef\xbb\xbf" + b,
        lambda b: b.replace(b"\n", b"\r\n"),
        lambda b: b + b"\n\n",
        lambda b: b + b"," * 26 + b"\n",
        lambda b: b.rstrip(b"\n"),
        lambda b: b.replace(b",", b" , "),
        lambda b: b'"' + b.replace(b",", b'","').replace(b"\n", b'"\n"').removesuffix(b'"'),
    ],
    ids=["byte order mark", "CRLF", "blank lines", "blank cells", "no last newline", "spaces", "quotes"],
)
def test_changes_that_spreadsheets_make_are_accepted(path: Path, change: Callable[[bytes], bytes]) -> None:
    path.write_bytes(change(path.read_bytes()))
    assert_close(read_recording(path), steady(), 1e-5)


# ---- gaps ----


def test_short_gaps_are_interpolated_and_counted_by_column(path: Path) -> None:
    """Over a gap h of 0.3 s, the error of linear interpolation of the known motion is at most w^2 A h^2 / 8. The
    same bound holds for slerp."""
    table = load(path)
    for name in table.keys() - {"time", "command_left", "command_right"}:
        table[name][100:130] = [""] * 30
    table["foot_right_z"][200] = table["balloon_qy"][300] = ""
    save(table, path)
    actual = read_recording(path)
    bend = (2 * np.pi * 0.5) ** 2 * 0.31**2 / 8
    amplitudes = {"balloon_position": 0.02, "base_position": 0.01, "foot_position": 0.05, "motor": 0.7, "knee": 0.4}
    for field in ARRAYS:
        error = np.abs(np.asarray(arrays(actual)[field]) - arrays(steady())[field]).max()
        assert error < amplitudes.get(field, 0.15) * bend + 1e-5, field
    counts = dict.fromkeys(table.keys() - {"time", "command_left", "command_right"}, 30)
    quaternion = dict.fromkeys(COLUMNS["balloon_quaternion"], 31)
    assert actual.interpolated == counts | quaternion | {"foot_right_z": 31}
    assert actual.trimmed == (0, 0)


def test_held_quaternions_of_zeros_are_refused_with_column_and_row(path: Path) -> None:
    """A client that holds the last position of a body it does not see may write such quaternions."""
    table = load(path)
    rows = len(table["time"])
    for axis in "xyz":
        table[f"balloon_{axis}"][rows - 30 :] = [table[f"balloon_{axis}"][rows - 31]] * 30
        table[f"balloon_q{axis}"][rows - 30 :] = ["0"] * 30
    table["balloon_qw"][rows - 30 :] = ["0"] * 30
    save(table, path)
    with pytest.raises(InputError, match="column balloon_qw.*length 0 instead of 1"):
        read_recording(path)


def test_orientations_are_interpolated_along_the_shortest_rotation(path: Path) -> None:
    """A constant rate of turn is recovered exactly, for any sign of the quaternions beside the gap."""
    table = load(path)
    yaw = np.linspace(0, 3, 400)
    for name, value in zip(
        COLUMNS["balloon_quaternion"], [np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], strict=True
    ):
        value = np.where(np.arange(400) < 120, value, -value)
        table[name] = ["" if 100 <= i < 140 else f"{1.01 * v:.9f}" for i, v in enumerate(value)]
    save(table, path)
    expected = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], 1)
    actual = read_recording(path).tracked_quaternion
    np.testing.assert_allclose(actual, expected, atol=1e-8)  # pyright: ignore[reportArgumentType, reportCallIssue]


def test_gaps_of_half_a_second_are_interpolated_and_longer_ones_refused(path: Path) -> None:
    table = load(path)
    table["knee_left"][100:150] = [""] * 50
    save(table, path)
    assert read_recording(path).interpolated == {"knee_left": 50}
    table["knee_left"][150] = ""
    save(table, path)
    with pytest.raises(InputError, match="column knee_left, row 102"):
        read_recording(path)


def test_gaps_at_the_ends_are_trimmed(path: Path) -> None:
    table = load(path)
    table["base_x"][:20] = [""] * 20
    table["balloon_qx"][390:] = [""] * 10
    table["base_y"][15:25] = [""] * 10
    save(table, path)
    actual = read_recording(path)
    assert actual.trimmed == (20, 10)
    assert actual.interpolated == {"base_y": 5}
    np.testing.assert_allclose(actual.time, steady().time[20:390])
    np.testing.assert_allclose(arrays(actual)["knee"], arrays(steady())["knee"][20:390], atol=1e-5)  # pyright: ignore


def test_missing_samples_are_written_as_empty_cells(tmp_path: Path) -> None:
    base = np.array(arrays(steady())["base_position"])
    base[50:60] = np.nan
    write_recording(changed(steady(), base_position=base), tmp_path / "walk.csv")
    assert load(tmp_path / "walk.csv")["base_x"][49:61].count("") == 10
    assert read_recording(tmp_path / "walk.csv").interpolated == {"base_x": 10, "base_y": 10, "base_z": 10}


# ---- damage ----


def cell(name: str, row: int, text: str) -> Callable[[Table], object]:
    """Return a function that sets one cell. `row` counts the header as row 1."""
    return lambda table: table[name].__setitem__(row - 2, text)


def scaled(factor: float, *columns: str) -> Callable[[Table], object]:
    return lambda t: t.update({c: [repr(factor * float(v)) for v in t[c]] for c in columns})


def emptied(name: str, first: int, last: int) -> Callable[[Table], object]:
    return lambda table: table[name].__setitem__(slice(first - 2, last - 1), [""] * (last - first + 1))


def dropped(*columns: str) -> Callable[[Table], object]:
    return lambda table: [table.pop(column) for column in columns]


def renamed(**names: str) -> Callable[[Table], object]:
    return lambda table: [table.__setitem__(new, table.pop(old)) for new, old in names.items()]


def rows_kept(rows: slice) -> Callable[[Table], object]:
    return lambda table: table.update({name: cells[rows] for name, cells in table.items()})


def exchanged(**sources: str) -> Callable[[Table], object]:
    return lambda table: table.update({new: list(table[old]) for new, old in sources.items()})


POSITIONS = [c for field in ("balloon_position", "base_position", "foot_position") for c in COLUMNS[field]]
QUATERNION = COLUMNS["balloon_quaternion"]

DAMAGE = {
    "column missing": (dropped("base_z"), "base_z", 1, "the column is missing"),
    "command missing": (dropped("command_left"), "command_left", 1, "the column is missing"),
    "half an optional group": (dropped("knee_right"), "knee_right", 1, "add it or delete knee_left"),
    "column unknown": (renamed(Base_X="base_x"), "Base_X", 1, "rename it to base_x"),
    "column without name": (lambda t: t.update({"": t["time"]}), "28 (no name)", 1, "unknown"),
    "not a number": (cell("base_y", 7, "hidden"), "base_y", 7, "'hidden' is not a finite number"),
    "written nan": (cell("base_y", 7, "NaN"), "base_y", 7, "leave the cell empty"),
    "infinite": (cell("motor_left", 401, "-inf"), "motor_left", 401, "not a finite number"),
    "overflow": (cell("motor_left", 2, "1e999"), "motor_left", 2, "not a finite number"),
    "underscore": (cell("base_y", 7, "0_0"), "base_y", 7, "not a finite number"),
    "time back": (cell("time", 9, "0.05"), "time", 9, "runs back, from 0.06 to 0.05 s"),
    "time still": (cell("time", 9, "0.06"), "time", 9, "stands still"),
    "time missing": (cell("time", 9, ""), "time", 9, "the time is missing"),
    "too slow": (rows_kept(slice(None, None, 6)), "time", None, "16.7 samples per second are fewer than 20"),
    "time in ms": (scaled(1000, "time"), "time", None, "convert to seconds"),
    "too short": (rows_kept(slice(0, 100)), "time", 101, "0.99 s are shorter than 1 s"),
    "one row": (rows_kept(slice(0, 1)), "time", 2, "shorter than 1 s"),
    "rows left out": (lambda t: [t[c].__delitem__(slice(99, 199)) for c in t], "time", 101, "rows are missing"),
    "percent": (scaled(100, "command_left"), "command_left", 2, "100 is outside 0 to 1"),
    "negative command": (cell("command_right", 30, "-0.01"), "command_right", 30, "outside 0 to 1"),
    "command gap": (cell("command_right", 30, ""), "command_right", 30, "the command is missing"),
    "knees in degrees": (scaled(180 / np.pi, "knee_left", "knee_right"), "knee_left", 2, "convert degrees to radians"),
    "motors in degrees": (scaled(180 / np.pi, "motor_left", "motor_right"), "motor_left", 2, "degrees"),
    "millimetres": (scaled(1000, *POSITIONS), "balloon_z", 2, "convert millimetres to metres"),
    "feet in millimetres": (scaled(1000, *COLUMNS["foot_position"]), "foot_left_z", 2, "millimetres"),
    "one column in millimetres": (scaled(1000, "balloon_y"), "balloon_y", 3, "millimetres"),
    "far away": (cell("base_x", 100, "1e4"), "base_x", 100, "farther than 100 m"),
    "underground": (cell("base_z", 100, "-0.7"), "base_z", 100, "not a height"),
    "jump": (cell("foot_left_y", 100, "0.4"), "foot_left_y", 100, "jumps by 0.342 m"),
    "quaternion not unit": (cell("balloon_qw", 50, "0.5"), "balloon_qw", 50, "instead of 1"),
    "quaternion zero": (lambda t: [cell(c, 50, "0")(t) for c in COLUMNS["base_quaternion"]], "base_qw", 50, "length 0"),
    "Euler angles in degrees": (scaled(57.3, *QUATERNION), "balloon_qw", 2, "length 57.3 instead of 1"),
    "x, y, z, w": (
        exchanged(balloon_qw="balloon_qx", balloon_qx="balloon_qy", balloon_qy="balloon_qz", balloon_qz="balloon_qw"),
        "balloon_qw",
        2,
        "w, x, y, z order",
    ),
    "gap too long": (emptied("base_y", 200, 250), "base_y", 200, "0.51 s are missing in a row"),
    "gap at the start": (emptied("base_y", 2, 52), "base_y", 2, "0.51 s are missing in a row"),
    "gap at the end": (emptied("foot_right_x", 351, 401), "foot_right_x", 351, "0.51 s are missing in a row"),
    "quaternion gap": (emptied("balloon_qy", 200, 250), "balloon_qy", 200, "0.51 s are missing in a row"),
    "optional column empty": (emptied("motor_right", 2, 401), "motor_right", 2, "or delete motor_right"),
    "mandatory column empty": (emptied("base_x", 2, 401), "base_x", 2, "4 s are missing in a row"),
    "y up": (exchanged(**{c: c[:-1] + {"y": "z", "z": "y"}.get(c[-1], "x") for c in POSITIONS}), "b", 2, "x forward"),
    "floor not at 0": (
        lambda t: t.update({c: [repr(0.5 + float(v)) for v in t[c]] for c in POSITIONS if c[-1] == "z"}),
        "foot_left_z",
        152,
        "not that of the floor, 0",
    ),
    "feet exchanged": (
        exchanged(**{c: c.replace("left", "r").replace("right", "left").replace("_r_", "_right_") for c in POSITIONS}),
        "foot_left_y",
        2,
        "left foot is not to the left",
    ),
    "left-handed": (scaled(-1, *[c for c in POSITIONS if c.endswith("_y")]), "foot_left_y", 2, "y left"),
}


@pytest.mark.parametrize(("damage", "column", "row", "words"), DAMAGE.values(), ids=DAMAGE.keys())
def test_damaged_table_is_refused_with_column_and_row(
    path: Path, damage: Callable[[Table], object], column: str, row: int | None, words: str
) -> None:
    table = load(path)
    damage(table)
    save(table, path)
    assert_refused(path, words, f"column {column}", "" if row is None else f"row {row}: ")


def assert_refused(path: Path, *words: str, file: str = "walk.csv") -> str:
    """Assert that `path` is refused by one sentence that contains the file's name and `words`. Return the message."""
    with pytest.raises(InputError) as caught:
        read_recording(path)
    message = str(caught.value)
    for word in (file, *words):
        assert word in message
    assert message.endswith(".") and "\n" not in message and "; " in message
    return message


TEXT_DAMAGE = {
    "empty file": (lambda b: b"", "the file is empty"),
    "header only": (lambda b: b[: b.index(b"\n") + 1], "row 2: there is no sample"),
    "header and blank": (lambda b: b[: b.index(b"\n") + 1] + b"\n\n", "row 2: there is no sample"),
    "column twice": (
        lambda b: b.replace(b"base_y", b"base_x", 1),
        "column base_x, row 1: the column appears twice",
    ),
    "semicolons": (
        lambda b: b.replace(b".", b"\0").replace(b",", b";").replace(b"\0", b","),
        "row 1: the header has no",
    ),
    "row too short": (lambda b: b + b"4,0.5\n", "column command_right, row 402: the row ends before it"),
    "row too long": (lambda b: b[:-1] + b",1\n", "column 28 (no name), row 401: the row has more cells"),
    "blank row": (lambda b: b.replace(b"\n0.02,", b"\n\n0.02,", 1), "column time, row 4: the row is blank"),
    "Latin-1": (lambda b: b.replace(b"\n0.02,", b"\n0.02\xb0,", 1), "line 4 is not UTF-8"),
    "UTF-16": (lambda b: b.decode().encode("utf-16"), "not UTF-8"),
    "zeros": (lambda b: bytes(1000), "row 1: unknown column"),
    "unfinished quote": (lambda b: b.replace(b"\n0.02,", b'\n"0.02,', 1), "row 4: not readable as a table"),
    "endless cell": (lambda b: b.replace(b"\n0.02,", b"\n" + b"0" * 200_000 + b",", 1), "row 4: not readable"),
    "pickle": (lambda b: b"\x80\x04cos\nsystem\n", "not UTF-8"),
}


@pytest.mark.parametrize(("damage", "words"), TEXT_DAMAGE.values(), ids=TEXT_DAMAGE.keys())
def test_file_that_is_not_a_valid_table_is_refused(path: Path, damage: Callable[[bytes], bytes], words: str) -> None:
    path.write_bytes(damage(path.read_bytes()))
    assert_refused(path, words)


JSON_DAMAGE = {
    "empty": ("", "not JSON"),
    "not JSON": ("{'format': 1}", "not JSON (line 1"),
    "deep": ("[" * 100_000, "not JSON"),
    "not an object": ("[]", "not a JSON object"),
    "no format": (json.dumps({**FREE, "format": None}), '"format" is null'),
    "version": (json.dumps({**FREE, "format": "ballu-recording/2"}), '"format" is "ballu-recording/2"'),
    "kind": (json.dumps({**FREE, "kind": "walk"}), '"kind" is "walk"'),
    "kind of kind": (json.dumps({**FREE, "kind": ["free"]}), '"kind" is ["free"]'),
    "no kind": (json.dumps({k: v for k, v in FREE.items() if k != "kind"}), '"kind" is missing'),
    "no robot": (json.dumps({k: v for k, v in FREE.items() if k != "robot"}), '"robot" is missing'),
    "robot number": (json.dumps({**FREE, "robot": 3}), '"robot" is 3'),
    "notes": (json.dumps({**FREE, "notes": {}}), '"notes" is {}'),
}


@pytest.mark.parametrize(("text", "words"), JSON_DAMAGE.values(), ids=JSON_DAMAGE.keys())
def test_damaged_description_is_refused(path: Path, text: str, words: str) -> None:
    path.with_suffix(".json").write_text(text)
    assert_refused(path, words, file="walk.json")


def test_missing_description_is_refused(path: Path) -> None:
    path.with_suffix(".json").unlink()
    assert_refused(path, '"format": "ballu-recording/1"', file="walk.json")


def test_unknown_keys_in_the_description_are_accepted(path: Path) -> None:
    path.with_suffix(".json").write_text(json.dumps({**FREE, "date": "2024-02-03"}))
    assert read_recording(path).robot == "virtual"


@pytest.mark.parametrize("column", ["motor_left", "knee_left"])
def test_suspended_recording_without_angles_is_refused(path: Path, column: str) -> None:
    path.with_suffix(".json").write_text(json.dumps({**FREE, "kind": "suspended"}))
    table = load(path)
    dropped(column, column.replace("left", "right"))(table)
    save(table, path)
    assert_refused(path, f"column {column}, row 1: the column is missing, and suspended recordings need it")


def test_suspended_recording_with_part_of_a_column_group_is_refused(path: Path) -> None:
    path.with_suffix(".json").write_text(json.dumps({**FREE, "kind": "suspended"}))
    table = load(path)
    dropped("balloon_y")(table)
    save(table, path)
    assert_refused(path, "column balloon_y, row 1", "add it or delete balloon_x, balloon_z")


def test_recording_too_short_after_trimming_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "walk.csv"
    write_recording(smooth(np.arange(121) / 100), path)
    table = load(path)
    emptied("base_x", 2, 41)(table)
    save(table, path)
    assert_refused(path, "all columns have samples for 0.8 s only", "row 42")


def test_damaged_gzip_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "walk.csv.gz"
    write_recording(steady(), path)
    whole = path.read_bytes()
    flipped = bytes(b ^ 255 if i == 5000 else b for i, b in enumerate(whole))
    for damaged in (whole[:-1000], b"time,command_left\n", flipped):
        path.write_bytes(damaged)
        assert_refused(path, "not a whole gzip file", file="walk.csv.gz")


def test_gzip_that_expands_beyond_the_limit_is_refused(path: Path) -> None:
    with gzip.open(path.with_name("walk.csv.gz"), "wb", compresslevel=1) as stream:
        for _ in range(130):
            stream.write(bytes(2**20))
    assert_refused(path.with_name("walk.csv.gz"), "more than 128 MiB", "split it", file="walk.csv.gz")


# ---- paths ----


def test_paths_expand_to_sorted_files_without_duplicates(tmp_path: Path) -> None:
    for name in ("b.csv", "a.csv.gz", "c.csv"):
        write_recording(smooth(np.arange(3) / 100), tmp_path / name)
    (tmp_path / "._a.csv").touch()
    everything = [tmp_path / name for name in ("a.csv.gz", "b.csv", "c.csv")]
    assert list_recordings([tmp_path]) == everything
    assert list_recordings([tmp_path / "c.csv", tmp_path]) == [everything[2], *everything[:2]]


def test_paths_without_a_recording_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing.csv: there is no such file"):
        list_recordings([tmp_path / "nothing.csv"])
    with pytest.raises(InputError, match="holds no recording"):
        list_recordings([tmp_path])
    (tmp_path / "walk.txt").touch()
    with pytest.raises(InputError, match=r"walk.txt: .* must end in .csv"):
        list_recordings([tmp_path / "walk.txt"])
    with pytest.raises(InputError, match=r"walk.txt: .* must end in .csv"):
        read_recording(tmp_path / "walk.txt")
    with pytest.raises(InputError, match="gone.csv: there is no such file"):
        read_recording(tmp_path / "gone.csv")
    for name in ("walk.csv", "walk.csv.gz"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match="delete one of the two"):
        list_recordings([tmp_path])


def test_bundled_recordings_are_listed_from_the_assets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_format, "assets", lambda: tmp_path)
    (tmp_path / "recordings" / "test").mkdir(parents=True)
    write_recording(steady(), tmp_path / "recordings" / "test" / "far.csv.gz")
    assert [read_recording(p).name for p in list_bundled("test")] == ["far"]


# ---- properties ----


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    rate=st.floats(50, 500),
    origin=st.floats(-1e6, 1e6),
    left_out=st.sets(st.sampled_from(["base_quaternion", "motor", "knee"])),
    compressed=st.booleans(),
    text=st.text(st.characters(codec="utf-8")),
)
def test_any_valid_recording_is_read_back(
    seed: int, rate: float, origin: float, left_out: set[str], compressed: bool, text: str
) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.uniform(0.8, 1.0, int(2 * rate)) / rate
    recording = without(smooth(np.round(origin, 3) + np.cumsum(steps)), *left_out)
    recording = dataclasses.replace(recording, command=rng.uniform(0, 1, recording.command.shape), notes=text)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("walk.csv.gz" if compressed else "walk.csv")
        write_recording(recording, path)
        actual = read_recording(path)
    assert actual.notes == text and not actual.interpolated
    np.testing.assert_allclose(actual.time, recording.time, atol=1e-6, rtol=0)
    np.testing.assert_allclose(actual.command, recording.command, atol=5.1e-5)
    assert_close(dataclasses.replace(actual, command=recording.command), recording, 2e-5)


CELLS = st.one_of(
    st.text(max_size=12),
    st.floats().map(repr),
    st.integers(-(10**400), 10**400).map(lambda n: format(n, "x")),
    st.sampled_from(
        ["", " ", '"', ",", "\n", "\r", "\0", "nan", "inf", "1e308", "-1e308", "1e-320", "٣", "1,5", "0x1"]
    ),
)


@functools.cache
def short_text() -> list[list[str]]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "walk.csv"
        write_recording(smooth(np.arange(101) / 100), path)
        return [line.split(",") for line in path.read_text().splitlines()]


@settings(max_examples=150, deadline=None)
@given(row=st.integers(0, 101), column=st.integers(0, 26), text=CELLS)
def test_file_with_one_changed_cell_is_read_completely_or_refused(row: int, column: int, text: str) -> None:
    """For any text in one cell, the reader returns a complete recording or refuses the file. Warnings count as
    errors."""
    rows = [list(cells) for cells in short_text()]
    rows[row][column] = text
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "walk.csv"
        path.write_bytes("\n".join(",".join(cells) for cells in rows).encode("utf-8", "surrogatepass"))
        path.with_suffix(".json").write_text(json.dumps(FREE))
        try:
            recording = read_recording(path)
        except InputError as error:
            assert str(path) in str(error)
        else:
            assert all(
                np.isfinite(np.asarray(value, float)).all() for value in arrays(recording).values() if value is not None
            )
