"""The commands `record import`, `record check`, `record simulate` and `record example-mapping`."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import typing
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.gaits import GAITS
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.cli import record
from ballu_mjx.recordings.csv_format import (
    list_bundled,
    read_recording,
    recording_name,
    sidecar_path,
    write_recording,
)
from ballu_mjx.recordings.importers.example_mapping import example_mapping
from ballu_mjx.recordings.recording import Recording, cut
from ballu_mjx.recordings.summary import find_gaps
from ballu_mjx.robots.registry import load_robot

ROLES = ("balloon", "base", "foot_left", "foot_right")


@pytest.fixture(scope="module")
def recorded() -> Recording:
    """Return 15 s of random jumps, which are different at all times."""
    (path,) = [path for path in list_bundled("test") if path.name.startswith("far-1")]
    return first(read_recording(path, load_robot()), 15.0)


def first(recording: Recording, seconds: float) -> Recording:
    return cut(recording, slice(int((recording.time <= seconds).sum())))


def vicon_file(recording: Recording, path: Path) -> None:
    """Write a Tracker file of objects with quaternions, in a rotated and shifted world frame."""
    rotation = Rotation.from_euler("z", -70, degrees=True)
    assert recording.tracked_position is not None and recording.tracked_quaternion is not None
    balloon = Rotation.from_quat(recording.tracked_quaternion, scalar_first=True)
    columns = []
    for position in (recording.tracked_position, *(recording.points[role] for role in ROLES[1:])):
        columns += [(rotation * balloon).as_quat(), 1e3 * (rotation.apply(position) + [2.0, 1.0, 0.0])]
    names = [f"Global Angle ballu:{role}" + "," * 6 for role in ROLES]
    rows = [
        "Objects",
        "100",
        ",," + ",".join(names),
        "Frame,Sub Frame" + ",RX,RY,RZ,RW,TX,TY,TZ" * 4,
        "," + ",,,,,mm,mm,mm" * 4,
        *(f"{i + 1},0," + ",".join(f"{x:.6g}" for x in row) for i, row in enumerate(np.hstack(columns))),
    ]
    path.write_text("\n".join(rows) + "\n")


def log_file(recording: Recording, path: Path, clock: float) -> None:
    """Write a log of the commands as servo angles (deg) at 20 Hz."""
    rows = zip(recording.time[::5] + clock, *(90 * recording.command[::5].T), strict=True)
    path.write_text("t,l,r\n" + "".join(f"{t:.4f},{a:.3f},{b:.3f}\n" for t, a, b in rows))


ROOM = 'robot = "mine"\n[commands]\ntime = "t"\nleft = "l"\nright = "r"\nrange_left = [0, 90]\nrange_right = [0, 90]\n'
ROOM += "".join(f'[{role}]\nbody = "{role}"\n' for role in ROLES)


@pytest.fixture
def room(tmp_path: Path, recorded: Recording, monkeypatch: pytest.MonkeyPatch) -> Path:
    vicon_file(recorded, tmp_path / "walk.csv")
    log_file(recorded, tmp_path / "log.csv", 512.25)
    (tmp_path / "room.toml").write_text(ROOM)
    monkeypatch.chdir(tmp_path)
    return tmp_path


LINE = "import walk.csv --mapping room.toml --commands log.csv --output out/walk.csv.gz".split()


def test_import_with_a_given_offset_reproduces_the_recording(
    room: Path, recorded: Recording, capsys: pytest.CaptureFixture[str]
):
    assert record.main([*LINE, "--offset", "-512.25"]) == 0
    read = read_recording(room / "out" / "walk.csv.gz", load_robot())
    assert (read.robot, read.kind, len(read.time)) == ("mine", "free", len(recorded.time))
    np.testing.assert_allclose(read.command, recorded.command, atol=1e-4)
    # The import rotates and shifts the walk to its start. Distances from the start stay the same.
    steps, expected = (np.linalg.norm(p - p[0], axis=1) for p in (read.points["base"], recorded.points["base"]))
    np.testing.assert_allclose(steps, expected, atol=3e-5)
    assert "15.00 s" in capsys.readouterr().out


def test_capture_cropped_at_its_start_keeps_its_commands(
    room: Path, recorded: Recording, capsys: pytest.CaptureFixture[str]
):
    """Cropping removes frames but does not shift time. The offset stays valid, and the output names the first frame."""
    lines = (room / "walk.csv").read_text().splitlines()
    (room / "walk.csv").write_text("\n".join([*lines[:5], *lines[217:]]) + "\n")
    assert record.main([*LINE, "--offset", "-512.25"]) == 0
    read = read_recording(room / "out" / "walk.csv.gz", load_robot())
    np.testing.assert_allclose(read.command, recorded.command[212:], atol=1e-4)
    assert "12.88 s, from frame 213, 2.12 s of the trial" in capsys.readouterr().out


def test_log_in_milliseconds_that_is_read_as_seconds_is_reported(room: Path, capsys: pytest.CaptureFixture[str]):
    """The first command of this log then lasts longer than the whole capture."""
    lines = (room / "log.csv").read_text().splitlines()
    held = [(float(t) - 512.25, rest) for t, rest in (line.split(",", 1) for line in lines[1:])]
    (room / "log.csv").write_text("\n".join([lines[0], *(f"{1e3 * t:.1f},{rest}" for t, rest in held[::20])]) + "\n")
    assert record.main([*LINE, "--offset", "0"]) == 0
    output = capsys.readouterr().out
    assert "log.csv: the commands change 15 times, and never within the capture; check time_unit" in output
    (room / "room.toml").write_text(ROOM.replace('time = "t"', 'time = "t"\ntime_unit = "ms"'))
    assert record.main([*LINE[:-1], "out/again.csv", "--offset", "0"]) == 0
    assert "never within the capture" not in capsys.readouterr().out


def test_import_finds_the_offset_and_prints_its_confidence(room: Path, capsys: pytest.CaptureFixture[str]):
    assert record.main(LINE) == 0
    output = capsys.readouterr().out
    offset = float(output.split("offset ")[1].split(" s:")[0])
    assert offset == pytest.approx(-512.25, abs=0.08)
    assert "confidence 0." in output and "good to about 0.05 s" in output


def test_periodic_log_requires_an_offset_or_its_range(room: Path, capsys: pytest.CaptureFixture[str]):
    (path,) = [path for path in list_bundled("test") if path.name.startswith("near-1")]
    walk = first(read_recording(path, load_robot()), 15.0)
    vicon_file(walk, room / "walk.csv")
    log_file(walk, room / "log.csv", 0.0)
    assert record.main(LINE) == 2
    error = capsys.readouterr().err
    assert error.startswith("log.csv: the commands repeat themselves") and "--offset" in error
    assert "Traceback" not in error and error.count("\n") == 1
    assert not (room / "out").exists()
    assert record.main([*LINE, "--offset-range", "-0.4", "0.4"]) == 0


@pytest.mark.parametrize(
    "change, line, message",
    [
        (lambda text: text.replace("[0, 90]", "[90, 0]"), [], "the robot moves against the commands"),
        (lambda text: text, ["--offset", "3"], "log.csv: its commands, from 515.25"),
        (lambda text: text, ["--offset", "1", "--offset-range", "0", "1"], "give one of them"),
        (lambda text: text.replace('"foot_left"', '"foot_middle"'), [], "no body or marker 'foot_middle'"),
        (
            lambda text: text.replace("t_left]", "t_]").replace("t_right]", "t_left]").replace("t_]", "t_right]"),
            ["--offset", "-512.25"],
            "swap the feet",
        ),
        (lambda text: "[units]\nlength = 'm'\n" + text.replace('robot = "mine"\n', ""), [], "key robot"),
        (lambda text: text + '[units]\nlength = "m"\n', ["--offset", "-512.25"], "nothing written"),
    ],
)  # fmt: skip
def test_invalid_imports_are_refused_and_write_nothing(
    room: Path, change: Callable[[str], str], line: list[str], message: str, capsys: pytest.CaptureFixture[str]
):
    (room / "room.toml").write_text(change(ROOM))
    assert record.main([*LINE, *line]) == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error and error.count("\n") == 1
    assert not list(room.glob("out/*"))


def test_import_does_not_overwrite_files(room: Path, capsys: pytest.CaptureFixture[str]):
    (room / "out").mkdir()
    (room / "out" / "walk.json").write_text("mine")
    assert record.main([*LINE, "--offset", "-512.25"]) == 2
    assert "walk.json: exists already" in capsys.readouterr().err
    assert (room / "out" / "walk.json").read_text() == "mine"


def test_sweep_is_imported_from_a_table_with_commands(tmp_path: Path):
    """Angles are in degrees, one knee has the opposite sign, and times are milliseconds of an absolute clock."""
    (path,) = list_bundled("suspended")
    sweep = read_recording(path, load_robot())
    angles = [np.rad2deg(sweep.joint_angles[j]) for j in ("motor_left", "motor_right", "knee_left", "knee_right")]
    columns = [1e3 * sweep.time + 1e9, *sweep.command.T, *angles[:2], 90 - angles[2], angles[3]]
    rows = [",".join(f"{x:.11g}" for x in row) for row in zip(*columns, strict=True)]
    (tmp_path / "bench.csv").write_text("\n".join(["ms,cl,cr,ml,mr,kl,kr", *rows]) + "\n")
    joints = {"motor_left": "ml", "motor_right": "mr", "knee_left": "kl", "knee_right": "kr"}
    mapping = 'robot = "r"\nkind = "suspended"\n[units]\nangle = "deg"\n[clock]\ntime_unit = "ms"\n'
    mapping += '[commands]\ntime = "ms"\nleft = "cl"\nright = "cr"\n'
    mapping += "".join(f'[{name}]\ncolumn = "{column}"\n' for name, column in joints.items())
    mapping = mapping.replace('column = "kl"', 'column = "kl"\nsign = -1\nzero = 90')
    (tmp_path / "room.toml").write_text(mapping)
    line = ["import", tmp_path / "bench.csv", "--mapping", tmp_path / "room.toml", "--output", tmp_path / "sweep.csv"]
    assert record.main(list(map(str, line))) == 0
    read = read_recording(tmp_path / "sweep.csv", load_robot())
    assert set(read.joint_angles) == set(sweep.joint_angles) == set(joints)
    for joint, angle in sweep.joint_angles.items():
        np.testing.assert_allclose(read.joint_angles[joint], angle, atol=2e-5)
    np.testing.assert_allclose(read.command, sweep.command, atol=1e-4)
    assert read.kind == "suspended" and read.time[0] == 0


# ---- check ----


def test_check_reports_dropouts_and_changes_of_commands(
    tmp_path: Path, recorded: Recording, capsys: pytest.CaptureFixture[str]
):
    base = np.array(recorded.points["base"])
    base[100:112] = base[500:503] = np.nan
    hidden = dataclasses.replace(recorded, points={**recorded.points, "base": base})
    write_recording(hidden, tmp_path / "walk.csv", load_robot())
    gaps = find_gaps(tmp_path / "walk.csv")
    assert gaps == {f"base_{axis}": [(1.0, 1.11), (5.0, 5.02)] for axis in "xyz"}
    assert record.main(["check", str(tmp_path), "--output", str(tmp_path / "figures")]) == 0
    output = capsys.readouterr().out
    assert "15.00 s, 1501 samples, 100 Hz, jitter 0.00 ms" in output
    assert "base_x ... base_z: 2 drop-outs, 0.15 s in all, the longest 0.12 s" in output
    changes = int((np.diff(recorded.command[:, 0]) != 0).sum())
    assert f"{changes} changes" in output
    assert (tmp_path / "figures" / "walk.png").stat().st_size > 2e4


def test_check_continues_after_a_damaged_recording(
    tmp_path: Path, recorded: Recording, capsys: pytest.CaptureFixture[str]
):
    for name in ("a", "b"):
        write_recording(recorded, tmp_path / f"{name}.csv", load_robot())
    text = (tmp_path / "a.csv").read_text().split("\n")
    (tmp_path / "a.csv").write_text("\n".join([*text[:10], "x" + text[10], *text[11:]]))
    assert record.main(["check", str(tmp_path)]) == 2
    output = capsys.readouterr()
    assert "a.csv, column time, row 11" in output.err and "b.csv: free" in output.out


# ---- simulate ----


def test_simulate_replays_a_log_of_commands(tmp_path: Path):
    log = tmp_path / "log.csv"
    log.write_text("time,command_left,command_right\n7,0,0.5\n7.5,1,0.5\n9,0,0\n")
    path = tmp_path / "walk.csv"
    line = ["simulate", "--commands", log, "--output", path, "--robot-seed", 3, "--trial-seed", 4]
    assert record.main(list(map(str, line))) == 0
    read = read_recording(path, load_robot())
    assert read.robot == virtual_robot.draw_robot(3).name
    assert read.time[-1] == pytest.approx(2.05)
    at = [read.command[round(100 * t)].tolist() for t in (0.0, 0.48, 0.5, 1.98, 2.0)]
    assert at == [[0, 0.5], [0, 0.5], [1, 0.5], [1, 0.5], [0, 0]]


def test_simulate_is_reproducible_by_its_seeds(tmp_path: Path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        line = ["simulate", "--gait", "waves", "--seconds", 1.5, "--output", tmp_path / name / "walk.csv"]
        assert record.main([*map(str, line), "--trial-seed", str(seed)]) == 0
    first, again, other = ((tmp_path / name / "walk.csv").read_bytes() for name in "abc")
    assert first == again != other


def test_simulate_records_a_sweep(tmp_path: Path):
    line = ["simulate", "--suspended", "--levels", 5, "--hold", 0.5, "--output", tmp_path / "sweep.csv"]
    assert record.main(list(map(str, line))) == 0
    read = read_recording(tmp_path / "sweep.csv", load_robot())
    assert read.kind == "suspended" and np.unique(read.command[:, 0]).tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]


@pytest.mark.parametrize("line", [[], ["--gait", "waves", "--commands", "x"], ["--gait", "waves", "--seconds", "0.1"]])
def test_simulate_needs_one_source_of_commands_and_enough_seconds(
    tmp_path: Path, line: list[str], capsys: pytest.CaptureFixture[str]
):
    assert record.main(["simulate", "--output", str(tmp_path / "x.csv"), *line]) == 2
    assert "--" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_simulate_offers_every_gait():
    named, _ = typing.get_args(typing.get_type_hints(record.Simulate)["gait"])
    assert typing.get_args(named) == tuple(GAITS)


# ---- the command ----


def test_example_mapping_is_printed_and_documented(tmp_path: Path):
    line = [sys.executable, "-m", "ballu_mjx", "record", "example-mapping"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert done.returncode == 0 and done.stdout == example_mapping(load_robot())
    page = (Path(__file__).parents[2] / "docs" / "data.md").read_text()
    assert example_mapping(load_robot()) in page


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--suspended", "--seconds", "60"], "--seconds has no effect beside --suspended"),
        (["--gait", "walking", "--hold", "1"], "--hold has no effect beside a gait"),
        (["--commands", "a.csv", "--seconds", "5"], "--seconds has no effect beside --commands"),
    ],
)
def test_simulation_refuses_options_without_an_effect(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
):
    assert record.main(["simulate", "--output", str(tmp_path / "a.csv"), *options]) == 2
    assert message in capsys.readouterr().err


def test_figures_of_recordings_with_the_same_name_are_kept_apart(tmp_path: Path):
    source = list_bundled("test")[0]
    for folder in ("one", "other"):
        (tmp_path / folder).mkdir()
        for path in (source, sidecar_path(source)):
            (tmp_path / folder / path.name).write_bytes(path.read_bytes())
    folders = [str(tmp_path / folder) for folder in ("one", "other")]
    assert record.main(["check", *folders, "--output", str(tmp_path / "figures")]) == 0
    name = recording_name(source)
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {f"one-{name}.png", f"other-{name}.png"}
