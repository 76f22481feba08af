"""Tests of every capture format. Files in the vendors' layouts are mapped by `record map`, imported and compared."""

from __future__ import annotations

import dataclasses
import json
import sys
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_files import (
    ARCHIVE,
    COMMAND,
    CORNERS,
    HIDDEN,
    HULL,
    NAMED,
    RATE,
    SAMPLES,
    START,
    TIME,
    TIP,
    Y_UP,
    euroc_text,
    in_line,
    replaced,
    rows,
    tum_text,
    write_motive,
    write_npz,
    write_qualisys_bodies,
    write_qualisys_markers,
    write_table,
    write_tum,
)
from rover import write_rover
from scipy.spatial.transform import Rotation

from ballu_mjx.cli import record
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.recordings.importers.capture import read_commands
from ballu_mjx.recordings.importers.mapping import Clock, RoomMapping, read_mapping
from ballu_mjx.recordings.importers.readers import READERS, find_reader, open_log, read_capture
from ballu_mjx.recordings.importers.table import Table
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    return write_rover(tmp_path_factory.mktemp("rover"))


# ---- formats that need optional packages ----


def ros_messages(store: Any) -> Any:
    """Yield topic, type, time of arrival (ns) and message, in order of arrival.

    The hull's messages have stamps and a rate of 100 Hz, the tip's 50 Hz. Commands have no header.
    """
    types = store.types
    version = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else {}

    def header(ns: int) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        return types["std_msgs/msg/Header"](**version, stamp=stamp, frame_id="room")

    point, turn = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"]
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    quaternion = HULL.turn.as_quat()
    for i in range(SAMPLES):
        ns = START + i * 10**7
        pose = types["geometry_msgs/msg/Pose"](
            position=point(*HULL.place[i].tolist()), orientation=turn(*quaternion[i].tolist())
        )
        yield (
            "/mocap/hull",
            "geometry_msgs/msg/PoseStamped",
            ns + ARRIVAL_DELAY,
            types["geometry_msgs/msg/PoseStamped"](header=header(ns), pose=pose),
        )
        if i % 2 == 0:
            yield (
                "/mocap/tip",
                "geometry_msgs/msg/PointStamped",
                ns + ARRIVAL_DELAY + 1,
                types["geometry_msgs/msg/PointStamped"](header=header(ns), point=point(*TIP.place[i].tolist())),
            )
        yield (
            "/cmd",
            "std_msgs/msg/Float64MultiArray",
            ns + ARRIVAL_DELAY + 2,
            types["std_msgs/msg/Float64MultiArray"](layout=layout, data=COMMAND[i]),
        )


ARRIVAL_DELAY = 3_000_000
"""Delay (ns) between a message's stamp and its arrival at the recorder."""


def write_bag(folder: Path, kind: str = "ros2") -> Path:
    pytest.importorskip("rosbags", reason="bags are read where rosbags is installed")
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store: Any = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    path = folder / ("trial.bag" if kind == "ros1" else "trial")
    writer: Any
    if kind == "ros1":
        writer = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    with writer:
        topics: dict[str, Any] = {}
        for topic, message_type, ns, message in ros_messages(store):
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, message_type, typestore=store)
            serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
            writer.write(topics[topic], ns, serialize(message, message_type))
    return next(path.glob("*.mcap")) if kind == "mcap" else path


def write_json_mcap(folder: Path, encoding: str = "json") -> Path:
    writer_module = pytest.importorskip("mcap.writer", reason="MCAP is read where mcap is installed")
    path = folder / "trial.mcap"
    with path.open("wb") as stream:
        writer = writer_module.Writer(stream)
        writer.start(profile="", library="test")
        schema = writer.register_schema("State", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/state", encoding, schema)
        quaternion = HULL.turn.as_quat(scalar_first=True)
        for i in range(SAMPLES):
            content = {
                "hull": dict(zip("xyz", HULL.place[i].tolist(), strict=True)),
                "hull_q": dict(zip("wxyz", quaternion[i].tolist(), strict=True)),
                "tip": dict(zip("xyz", TIP.place[i].tolist(), strict=True)),
                "command": COMMAND[i].tolist(),
                "comment": "text is no column",
            }
            writer.add_message(channel, START + i * 10**7, json.dumps(content).encode(), START + i * 10**7)
        writer.finish()
    return path


def write_lerobot(folder: Path, version: str = "v2.1", episodes: int = 1) -> Path:
    pyarrow = pytest.importorskip("pyarrow", reason="LeRobot datasets are read where pyarrow is installed")
    from pyarrow import parquet  # pyright: ignore[reportMissingImports]

    state = np.hstack([HULL.place, HULL.turn.as_quat(scalar_first=True), TIP.place]).astype(np.float32)
    names = ["hull_x", "hull_y", "hull_z", "qw", "qx", "qy", "qz", "tip_x", "tip_y", "tip_z"]
    path = folder / "dataset"
    (path / "meta").mkdir(parents=True)
    features = {
        "observation.state": {"dtype": "float32", "shape": [10], "names": {"motors": names}},
        "action": {"dtype": "float32", "shape": [2], "names": ["arm", "push"]},
    }
    info = {"codebase_version": version, "fps": int(RATE), "total_episodes": episodes, "features": features}
    (path / "meta" / "info.json").write_text(json.dumps(info))
    tables = [
        pyarrow.table(
            {
                "observation.state": list(state + 0.01 * number),
                "action": list(COMMAND.astype(np.float32)),
                "timestamp": TIME.astype(np.float32),
                "frame_index": np.arange(SAMPLES),
                "episode_index": np.full(SAMPLES, number),
                "task": ["swing"] * SAMPLES,
            }
        )
        for number in range(episodes)
    ]
    data = path / "data" / "chunk-000"
    data.mkdir(parents=True)
    if version == "v3.0":
        parquet.write_table(pyarrow.concat_tables(tables), data / "file-000.parquet")
    else:
        for number, table in enumerate(tables):
            parquet.write_table(table, data / f"episode_{number:06d}.parquet")
    return path


def write_log(folder: Path, start: float = 0.0) -> Path:
    path = folder / "log.csv"
    body = rows([TIME + start, *COMMAND.T], ",", 6, lost=[])
    path.write_text("time,command_arm,command_push\n" + body)
    return path


# ---- map, import, compare ----


def run(*line: object) -> None:
    assert record.main([str(each) for each in line]) == 0


def imported(folder: Path, path: Path, robot: RobotDescription, change: Mapping[str, str] | None = None) -> Recording:
    """Return the recording that is imported with the mapping of `record map`, after the replacements `change`."""
    room, output = folder / "room.toml", folder / "out" / "trial.csv"
    run("map", path, "--output", room, "--robot", robot.file)
    text = room.read_text()
    for old, new in (change or {}).items():
        assert old in text, text
        text = text.replace(old, new)
    room.write_text(text)
    log = ["--commands", folder / "log.csv", "--offset", 0] if (folder / "log.csv").exists() else []
    run("import", path, "--mapping", room, "--output", output, "--robot", robot.file, *log)
    return read_recording(output, robot)


def assert_motion(found: Recording, *, gaps: bool, tip: float = 2e-5) -> None:
    count = len(found.time)
    """Assert that a recording is that of the motion in `capture_files`.

    `gaps`: whether the format marks the hidden samples as missing. `tip`: tolerance of the tip's position (m).
    """
    assert SAMPLES - 2 <= count <= SAMPLES
    np.testing.assert_allclose(found.time, TIME[:count], atol=2e-6)
    shown = np.ones(count, bool)
    if gaps:
        assert found.interpolated["hull_x"] == HIDDEN.stop - HIDDEN.start
        shown[HIDDEN] = False
    np.testing.assert_allclose(np.asarray(found.tracked_position)[shown], HULL.place[:count][shown], atol=2e-5)
    turned = Rotation.from_quat(np.asarray(found.tracked_quaternion)[shown], scalar_first=True)
    assert (Rotation.from_quat(HULL.turn.as_quat()[:count][shown]).inv() * turned).magnitude().max() < 2e-4
    np.testing.assert_allclose(found.points["tip"], TIP.place[:count], atol=tip)
    np.testing.assert_allclose(found.command, COMMAND[:count], atol=1e-4)


@pytest.mark.parametrize("version, unit", [("1.22", "Meters"), ("1.25", "Millimeters")])
def test_motive_csv_is_imported(tmp_path: Path, robot: RobotDescription, version: str, unit: str):
    write_log(tmp_path)
    assert_motion(imported(tmp_path, write_motive(tmp_path, version, unit), robot), gaps=True)


@pytest.mark.parametrize("columns", [0, 3])
def test_motive_csv_padded_by_a_spreadsheet_is_imported(tmp_path: Path, robot: RobotDescription, columns: int):
    """Spreadsheets pad every row to the width of the widest row, or beyond it."""
    path = write_motive(tmp_path)
    lines = [line.split(",") for line in path.read_text().splitlines()]
    width = columns + max(map(len, lines))
    path.write_text("\n".join(",".join(cells + [""] * (width - len(cells))) for cells in lines))
    write_log(tmp_path)
    assert_motion(imported(tmp_path, path, robot), gaps=True)


def test_map_reports_that_motive_s_expected_markers_are_not_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run("map", write_motive(tmp_path))
    printed = capsys.readouterr().out
    assert "Expected positions of markers are not measurements and are not read: hull:Marker 001." in printed
    assert "96.3 % seen" in printed and 'up = "y"' in printed


def test_body_takes_precedence_over_a_marker_of_the_same_name(tmp_path: Path, robot: RobotDescription):
    """In takes of skeletons, the label of a marker may be the name of a bone."""
    path = write_motive(tmp_path)
    path.write_text(path.read_text().replace("tip,tip,tip", "hull,hull,hull"))
    contents = find_reader(path).list(path)
    assert [(item.name, item.kind) for item in contents.items] == [("hull", "body")]
    assert any("Markers that share their names with bodies are not read: hull." in note for note in contents.notes)
    found = read_capture(path, room(tmp_path, robot, NAMED.replace('"tip"', '"hull"'), commands=NO_COMMANDS))
    seen = np.r_[0 : HIDDEN.start, HIDDEN.stop : SAMPLES]
    np.testing.assert_allclose(found.bodies["hull"].position[seen], (HULL.place @ Y_UP)[seen], atol=1e-6)


def test_qualisys_bodies_are_imported(tmp_path: Path, robot: RobotDescription):
    write_log(tmp_path)
    assert_motion(imported(tmp_path, write_qualisys_bodies(tmp_path), robot), gaps=True)


def test_qualisys_markers_are_imported(tmp_path: Path, robot: RobotDescription):
    write_log(tmp_path)
    geometry = f"\ngeometry = {list(CORNERS.values())}"
    line = 'markers = ["hull1", "hull2", "hull3", "hull4"]'
    assert_motion(
        imported(tmp_path, write_qualisys_markers(tmp_path), robot, {line: line + geometry + " #"}), gaps=True
    )


def test_map_assigns_markers_with_other_names_to_the_only_body(tmp_path: Path, robot: RobotDescription):
    """All markers except the point's are assigned to the body. The mapping calls this a guess, and can be imported."""
    write_log(tmp_path)
    path = write_qualisys_markers(tmp_path)
    path.write_text(path.read_text().replace("hull", "rig"))
    line = 'markers = ["rig1", "rig2", "rig3", "rig4"]'
    guessed = f"{line}  # a guess: keep three or more that sit on the body"
    assert_motion(imported(tmp_path, path, robot, {guessed: f"{line}\ngeometry = {list(CORNERS.values())}"}), gaps=True)


def test_numpy_archives_are_imported(tmp_path: Path, robot: RobotDescription):
    assert_motion(imported(tmp_path, write_npz(tmp_path), robot), gaps=True)


def test_tables_are_imported(tmp_path: Path, robot: RobotDescription):
    assert_motion(imported(tmp_path, write_table(tmp_path), robot), gaps=True)


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
def test_bags_are_imported(tmp_path: Path, robot: RobotDescription, kind: str):
    """Commands have no stamps, so all times are the recorder's. The tip, at half the rate, is interpolated."""
    found = imported(tmp_path, write_bag(tmp_path, kind), robot)
    assert 'time = "received"' in (tmp_path / "room.toml").read_text()
    assert_motion(found, gaps=False, tip=3e-4)


def test_bag_times_are_stamps_or_times_of_arrival(tmp_path: Path, robot: RobotDescription):
    path = write_bag(tmp_path)
    for clock, start in (("header", START), ("received", START + ARRIVAL_DELAY)):
        found = read_capture(path, room(tmp_path, robot, BAG + f'[clock]\ntime = "{clock}"\n', commands=NO_COMMANDS))
        assert found.time[0] == pytest.approx(start * 1e-9, abs=1e-6)
        np.testing.assert_allclose(np.diff(found.time), 0.01, atol=1e-6)
        np.testing.assert_allclose(found.bodies["hull"].position, HULL.place, atol=1e-12)


def test_commands_of_a_motive_take_are_read_from_a_bag(tmp_path: Path, robot: RobotDescription):
    """The bag's clock differs from Motive's."""
    take, log = write_motive(tmp_path), write_bag(tmp_path)
    mapping = tmp_path / "room.toml"
    text = 'robot = "r"\n[axes]\nforward = "z"\nleft = "x"\nup = "y"\n[hull]\nbody = "hull"\n[tip]\nbody = "tip"\n'
    mapping.write_text(text + '[commands]\ntime = "received"\narm = "/cmd:data[0]"\npush = "/cmd:data[1]"\n')
    line = ["--mapping", mapping, "--output", tmp_path / "out.csv", "--robot", robot.file, "--commands", log]
    run("import", take, *line, f"--offset={-(START + ARRIVAL_DELAY) * 1e-9 - 1e-4:.6f}")
    assert_motion(read_recording(tmp_path / "out.csv", robot), gaps=True)


def test_log_replaces_the_commands_of_the_capture(tmp_path: Path, robot: RobotDescription):
    """One column of the capture has the name of a command, but other values."""
    path = write_npz(tmp_path)
    with np.load(path) as archive:
        kept = {name: archive[name] for name in archive.files if not name.startswith("command_")}
    np.savez(path, **kept, command_arm=100 * TIME)
    mapping = room(tmp_path, robot, ARCHIVE).path
    line = ["--mapping", mapping, "--output", tmp_path / "out.csv", "--robot", robot.file]
    run("import", path, *line, "--commands", write_log(tmp_path), "--offset", 0)
    assert_motion(read_recording(tmp_path / "out.csv", robot), gaps=True)


@pytest.mark.parametrize(
    ("write", "commands", "words"),
    [
        (write_bag, 'arm = "/cmd:data[0]"\npush = "/cmd:data[1]"\n', 'write time = "received" under [commands] in'),
        (
            write_bag,
            'time = "recieved"\narm = "/cmd:data[0]"\npush = "/cmd:data[1]"\n',
            "[commands] time: a bag has no column 'recieved'; write \"header\"",
        ),
        (
            lambda folder: write_lerobot(folder, episodes=2),
            'time = "timestamp"\narm = "action[0]"\npush = "action[1]"\n',
            "holds 2 episodes, 0 to 1; give the commands of one episode as a table",
        ),
    ],
)
def test_message_about_a_log_does_not_name_the_keys_of_the_capture(
    tmp_path: Path, robot: RobotDescription, write: Callable[[Path], Path], commands: str, words: str
):
    mapping = room(tmp_path, robot, NAMED, commands=commands)
    with pytest.raises(InputError) as refused:
        read_commands(open_log(write(tmp_path), mapping), mapping.commands, mapping)
    assert words in str(refused.value) and "[clock]" not in str(refused.value)


def test_message_about_a_capture_names_its_table(tmp_path: Path, robot: RobotDescription):
    text = BAG + '[clock]\ntime = "header"\n'
    mapping = room(tmp_path, robot, text, commands='arm = "/cmd:data[0]"\npush = "/cmd:data[1]"\n')
    with pytest.raises(InputError, match=r'/cmd: not all of .*; write time = "received" under \[clock\] in'):
        read_capture(write_bag(tmp_path), mapping)


def test_mcap_with_json_messages_is_imported(tmp_path: Path, robot: RobotDescription):
    pytest.importorskip("rosbags")
    assert_motion(imported(tmp_path, write_json_mcap(tmp_path), robot), gaps=False)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_lerobot_episodes_are_read_by_number(tmp_path: Path, robot: RobotDescription, version: str):
    path = write_lerobot(tmp_path, version, episodes=2)
    text = LEROBOT + "[clock]\nepisode = 0\n"
    found = read_capture(path, room(tmp_path, robot, text, commands='arm = "action[0]"\npush = "action[1]"\n'))
    assert found.commands is not None
    np.testing.assert_allclose(found.time, TIME, atol=1e-6)
    np.testing.assert_allclose(found.bodies["hull"].position, HULL.place, atol=1e-6)
    np.testing.assert_allclose(found.bodies["tip"].position, TIP.place, atol=1e-6)
    np.testing.assert_allclose(found.commands.command, COMMAND, atol=1e-6)
    later = read_capture(path, room(tmp_path, robot, text.replace("episode = 0", "episode = 1")))
    np.testing.assert_allclose(later.bodies["hull"].position, HULL.place + 0.01, atol=1e-6)
    with pytest.raises(InputError, match=r"holds 2 episodes, 0 to 1; select one by episode = ... under \[clock\]"):
        read_capture(path, room(tmp_path, robot, LEROBOT))
    with pytest.raises(InputError, match="there is no episode 7; its episodes are 0 to 1, 2 in all"):
        read_capture(path, room(tmp_path, robot, text.replace("episode = 0", "episode = 7")))


def test_map_selects_one_of_several_episodes(tmp_path: Path, robot: RobotDescription):
    path = write_lerobot(tmp_path, episodes=2)
    assert_motion(imported(tmp_path, path, robot), gaps=False)
    text = (tmp_path / "room.toml").read_text()
    assert "episode = 0  # of 2" in text
    (tmp_path / "room.toml").write_text(text.replace("episode = 0", "episode = 1"))
    later = read_capture(path, read_mapping(tmp_path / "room.toml", robot))
    np.testing.assert_allclose(later.bodies["tip"].position, TIP.place + 0.01, atol=1e-6)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_lerobot_numbers_match_polars(tmp_path: Path, robot: RobotDescription, version: str):
    polars = pytest.importorskip("polars", reason="polars reads parquet independently of pyarrow")
    path = write_lerobot(tmp_path, version, episodes=2)
    frame = polars.read_parquet(sorted((path / "data").rglob("*.parquet")))
    for episode in range(2):
        episode_rows = frame.filter(polars.col("episode_index") == episode)
        state, action = (np.array(episode_rows[name].to_list()) for name in ("observation.state", "action"))
        text = LEROBOT + f"[clock]\nepisode = {episode}\n"
        found = read_capture(path, room(tmp_path, robot, text, commands='arm = "action[0]"\npush = "action[1]"\n'))
        assert found.commands is not None
        np.testing.assert_array_equal(found.time, episode_rows["timestamp"].to_numpy())
        np.testing.assert_array_equal(found.bodies["hull"].position, state[:, :3])
        np.testing.assert_array_equal(found.bodies["tip"].position, state[:, 7:])
        np.testing.assert_allclose(found.commands.command, action, atol=1e-12)


def test_map_uses_the_feature_names_of_a_lerobot_dataset(tmp_path: Path, robot: RobotDescription):
    path = write_lerobot(tmp_path)
    assert_motion(imported(tmp_path, path, robot), gaps=False)
    contents = find_reader(path).list(path)
    assert [item.label for item in contents.items if item.name == "observation.state[3]"] == ["qw"]
    assert any("states no units" in note for note in contents.notes)


# ---- files of one body ----


@pytest.mark.parametrize("name, text", [("pose.txt", tum_text()), ("data.csv", euroc_text())])
def test_trajectories_of_one_body_are_read(tmp_path: Path, robot: RobotDescription, name: str, text: str):
    (tmp_path / name).write_text(text)
    found = read_capture(tmp_path / name, room(tmp_path, robot, '[hull]\nbody = "pose"\n[tip]\nbody = "pose"\n'))
    np.testing.assert_allclose(found.time - found.time[0], TIME, atol=1e-6)
    assert found.time[0] == pytest.approx(1.7e9)
    body = found.bodies["hull"]
    np.testing.assert_allclose(body.position, HULL.place, atol=1e-6)
    turned = Rotation.from_quat(np.asarray(body.quaternion), scalar_first=True)
    assert (HULL.turn.inv() * turned).magnitude().max() < 1e-6


def room(folder: Path, robot: RobotDescription, text: str, commands: str = "", **top: object) -> RoomMapping:
    (folder / "room.toml").write_text(
        'robot = "r"\n' + "".join(f"{key} = {value}\n" for key, value in top.items()) + text + "[commands]\n" + commands
    )
    return read_mapping(folder / "room.toml", robot)


BAG = '[hull]\nbody = "/mocap/hull"\n[tip]\nbody = "/mocap/tip"\n'
NO_COMMANDS = 'arm = "none"\npush = "none"\n'
LEROBOT = """[units]
length = "m"
[hull]
position = ["observation.state[0]", "observation.state[1]", "observation.state[2]"]
orientation = ["observation.state[3]", "observation.state[4]", "observation.state[5]", "observation.state[6]"]
rotation = "quaternion"
[tip]
position = ["observation.state[7]", "observation.state[8]", "observation.state[9]"]
"""


# ---- damage ----


def cut_text(path: Path) -> None:
    text = path.read_text()
    path.write_text(text[: int(len(text) * 0.7)].rpartition("\n")[0] + "\n99,")


def cut_bytes(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * 0.7)])


@pytest.mark.parametrize(
    "write, damage, text, words",
    [
        (write_motive, cut_text, NAMED, ["the row ends before", "cut off"]),
        (
            write_motive,
            replaced("Meters", "Cubits"),
            NAMED,
            ["line 1, Length Units: 'Cubits' is not a known unit of length"],
        ),
        (write_motive, replaced("Frame,Time (Seconds)", "Frames,Times"), NAMED, ["no line begins with Frame, Time"]),
        (write_motive, replaced(",Name,", ",Named,"), NAMED, ["the rows Type, Name and Rotation or Position"]),
        (write_motive, in_line(80, 1, "0.1"), NAMED, ["line 80", "time runs back or stands still"]),
        (write_motive, in_line(80, 0, "3"), NAMED, ["line 80", "runs back", "one take per file"]),
        (write_motive, in_line(80, 3, "0,5"), NAMED, ["line 80", "more cells than the header"]),
        (write_motive, in_line(80, 3, "ten"), NAMED, ["line 80, hull Rotation Y: 'ten' is not a number"]),
        (write_motive, in_line(100, 2, "0.9"), NAMED, ["hull: the quaternion of sample 93 has length"]),
        (write_motive, replaced("Quaternion", "XYZ"), NAMED, ["Rotation Type is 'XYZ'", "export quaternions"]),
        (
            write_motive,
            replaced("hull,hull,hull,hull,hull,hull,hull,hull", "a,a,a,a,a,a,a,a"),
            NAMED,
            ["no body or marker 'hull'", "room.toml"],
        ),
        (
            write_motive,
            None,
            NAMED + '[clock]\ntime = "t"\n',
            ["room.toml, [clock]", "OptiTrack Motive CSV", "leave it"],
        ),
        (
            write_motive,
            None,
            NAMED.replace('"hull"', '"hull"\nrotation = "XYZ"'),
            ["[hull] rotation", "states its convention"],
        ),
        (
            write_qualisys_bodies,
            lambda path: path.write_text("\n".join(path.read_text().split("\n")[:200])),
            NAMED,
            ["holds 189 of the 300 frames that its header states", "cut off"],
        ),
        (write_qualisys_bodies, None, ARCHIVE, ["a Qualisys TSV, which has bodies", 'body = "..."', "hull, tip"]),
        (write_tum, None, ARCHIVE, ["a TUM trajectory, which has bodies", 'body = "..."', "there are pose"]),
        (write_qualisys_bodies, replaced("Rot[4]\t", "", 1), NAMED, ["the row has more cells than the header"]),
        (write_qualisys_bodies, replaced("DATA_INCLUDED\t6D", "DATA_INCLUDED\t2D"), NAMED, ["DATA_INCLUDED is '2D'"]),
        (
            write_qualisys_bodies,
            in_line(50, 10, "0.2", "\t"),
            NAMED,
            ["hull: Rot[0] to Rot[8] of sample", "not a rotation matrix"],
        ),
        (write_qualisys_bodies, in_line(50, 1, "0.01", "\t"), NAMED, ["line 50", "time runs back"]),
        (
            write_qualisys_bodies,
            replaced("BODY_NAMES\thull\ttip", "BODY_NAMES\thull\thull"),
            NAMED,
            ["'hull'", "twice"],
        ),
        (write_npz, cut_bytes, ARCHIVE, ["not a complete .npz file"]),
        (
            write_npz,
            None,
            ARCHIVE.replace("tip_pos[0]", "tip_pos[3]"),
            ["there is no column 'tip_pos[3]'", "room.toml"],
        ),
        (
            write_npz,
            None,
            ARCHIVE.replace('length = "m"', ""),
            ["[units]", "the unit of length of trial.npz's columns"],
        ),
        (
            write_npz,
            lambda path: np.savez(path, time=-TIME, hull_pos=HULL.place),
            ARCHIVE.partition("[hull]")[0] + NAMED,
            ["it has columns, write position"],
        ),
        (
            write_npz,
            lambda path: np.savez(path, x=np.array([{}], object)),
            ARCHIVE,
            ["no array with one number per sample"],
        ),
        (write_bag, None, BAG.replace("/mocap/tip", "/mocap/top"), ["no body or marker '/mocap/top'"]),
        (write_bag, None, BAG + '[clock]\ntime = "t"\n', ["[clock] time", "a bag has no column 't'", '"received"']),
        (write_bag, lambda path: cut_bytes(next(path.glob("*.db3"))), BAG, ["trial"]),
        (write_json_mcap, cut_bytes, NAMED, ["not a complete MCAP file", "mcap recover"]),
        (lambda folder: write_json_mcap(folder, "protobuf"), None, NAMED, ["encoded as 'protobuf'", "JSON"]),
        (lambda folder: write_bag(folder, "ros1"), cut_bytes, BAG, ["trial.bag: not a complete bag"]),
        (
            write_lerobot,
            lambda path: cut_bytes(next(path.rglob("*.parquet"))),
            LEROBOT,
            ["not a complete parquet file"],
        ),
        (write_lerobot, lambda path: next(path.rglob("*.parquet")).unlink(), LEROBOT, ["no parquet file under data/"]),
        (
            write_lerobot,
            lambda path: (path / "meta" / "info.json").write_text("{}"),
            LEROBOT,
            ['"features" is missing'],
        ),
        (write_table, replaced("# exported on a Tuesday, by hand\ntime,", "#\n0.5,", 1), NAMED, ["it has columns"]),
        (
            write_table,
            lambda path: path.write_text("1,2,3\n4,5,6\n"),
            NAMED,
            ["line 1: it holds numbers instead of column names"],
        ),
        (
            write_table,  # `ros2 topic echo --csv` writes seconds, nanoseconds and a frame's name, but no header
            lambda path: path.write_text("".join(f"17,{i}0000000,map,0.1,0.2,1.5,0,0,0,1\n" for i in range(50))),
            ARCHIVE,
            ["line 1: it holds numbers instead of column names", "above the numbers"],
        ),
    ],
)
def test_damaged_file_is_refused_with_a_specific_message(
    tmp_path: Path,
    robot: RobotDescription,
    write: Callable[[Path], Path],
    damage: Callable[[Path], object] | None,
    text: str,
    words: list[str],
):
    path = write(tmp_path)
    if damage is not None:
        damage(path)
    with pytest.raises(InputError) as refusal:
        read_capture(path, room(tmp_path, robot, text, commands=NO_COMMANDS))
    message = str(refusal.value)
    assert message.startswith(str(tmp_path)) and message.endswith(".") and "\n" not in message
    for part in words:
        assert part in message, message


def test_damaged_trajectory_files_are_refused(tmp_path: Path, robot: RobotDescription):
    for name, text, words in (
        ("a.txt", tum_text().replace("\n1700000000.5", "\n1600000000.5", 1), "line 52: time runs back"),
        ("b.txt", tum_text()[:-40], "line 301: the row ends before"),
        ("e.txt", tum_text().replace("\n1700000000.5", "\n# lost\n1700000000.5", 1), "line 52: a line without a pose"),
        ("c.csv", euroc_text().replace("q_RS_w", "p_w"), "the header is not #timestamp"),
        ("d.csv", euroc_text()[:-30], "the row ends before"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=rf"{name}.*{words}"):
            read_capture(tmp_path / name, room(tmp_path, robot, '[hull]\nbody = "pose"\n[tip]\nbody = "pose"\n'))


@pytest.mark.parametrize(
    "package, extra, write", [("rosbags", "bags", write_bag), ("mcap", "bags", write_json_mcap),
                              ("pyarrow", "lerobot", write_lerobot)],
)  # fmt: skip
def test_message_names_the_missing_package_and_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, extra: str, write: Callable[[Path], Path]
):
    path = write(tmp_path)
    for name in [each for each in sys.modules if each.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"{package}, which is not installed; install it by .*\[{extra}\]"):
        find_reader(path).list(path)


# ---- the registry of readers, and `record map` ----


def test_format_option_lists_every_reader():
    assert set(typing.get_args(record.Format)) == {"auto", *READERS}


def test_folder_of_unknown_format_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="a folder of unknown format; give a file in it"):
        find_reader(tmp_path)


def write_two_clocks(folder: Path, table: str, log: str) -> None:
    """Write a capture as a table with times in ms, and a command log with times in s.

    The log's clock is 12 s ahead. `table` and `log` are the names of the time columns.
    """
    names = [table, *(f"hull_{axis}" for axis in range(3)), *(f"turn_{part}" for part in range(4))]
    columns = [1e3 * TIME, *HULL.place.T, *HULL.turn.as_quat(scalar_first=True).T, *TIP.place.T]
    header = ",".join([*names, *(f"tip_{axis}" for axis in range(3))])
    (folder / "trial.csv").write_text(f"{header}\n{rows(columns, ',', 7, lost=[])}")
    text = write_log(folder, 12.0).read_text()
    (folder / "log.csv").write_text(text.replace("time,", f"{log},", 1))


TWO_CLOCKS = """[units]
length = "m"
[hull]
position = ["hull_0", "hull_1", "hull_2"]
orientation = ["turn_0", "turn_1", "turn_2", "turn_3"]
rotation = "quaternion"
[tip]
position = ["tip_0", "tip_1", "tip_2"]
[clock]
time_unit = "ms"
"""


@pytest.mark.parametrize(
    ("table", "log", "clock", "commands"),
    [
        ("stamp", "sent", 'time = "stamp"\n', 'time = "sent"\n'),
        ("%time", "time", 'time = "%time"\n', ""),
        # One key for both files, because a comment sign before a header's first name is not part of the name.
        ("%time", "time", "", 'time = "%time"\n'),
        ("%time", "time", "", 'time = "time"\n'),
        ("t", "# t", "", 'time = "t"\n'),
        ("stamp", "%stamp", "", 'time = "stamp"\n'),
    ],
)
def test_table_and_command_log_may_have_different_clocks(
    tmp_path: Path, robot: RobotDescription, table: str, log: str, clock: str, commands: str
):
    write_two_clocks(tmp_path, table, log)
    room(tmp_path, robot, TWO_CLOCKS + clock, commands)
    line = ["import", tmp_path / "trial.csv", "--mapping", tmp_path / "room.toml", "--output", tmp_path / "out.csv"]
    run(*line, "--robot", robot.file, "--commands", tmp_path / "log.csv", "--offset=-12")
    assert_motion(read_recording(tmp_path / "out.csv", robot), gaps=False)


def test_time_column_with_a_comment_sign_is_found_by_its_full_name(tmp_path: Path, robot: RobotDescription):
    """A table may have both `time` and `%time`, for example times in the trial and times of the day."""
    write_two_clocks(tmp_path, "%time", "time")
    lines = (tmp_path / "trial.csv").read_text().splitlines()
    body = [f"{1e6 + 5 * row},{line}" for row, line in enumerate(lines[1:])]
    (tmp_path / "trial.csv").write_text("\n".join(["time," + lines[0], *body]))
    found = read_capture(tmp_path / "trial.csv", room(tmp_path, robot, TWO_CLOCKS + 'time = "%time"\n'))
    np.testing.assert_allclose(found.time, TIME, atol=1e-6)


@pytest.mark.parametrize(
    ("commands", "words"),
    [
        # The name exists only in the table. The message says that the table's name belongs under [clock].
        ('time = "stamp"\n', ["log.csv: there is no column 'stamp' of times", "under [commands]", "[clock]"]),
        # The name exists only in the log.
        ('time = "sent"\n', ["trial.csv: there is no column 'sent' of times", "under [clock]"]),
    ],
)
def test_message_says_where_to_name_the_other_file_s_time_column(
    tmp_path: Path, robot: RobotDescription, capsys: pytest.CaptureFixture[str], commands: str, words: list[str]
):
    write_two_clocks(tmp_path, "stamp", "sent")
    room(tmp_path, robot, TWO_CLOCKS, commands)
    line = ["import", tmp_path / "trial.csv", "--mapping", tmp_path / "room.toml", "--output", tmp_path / "out.csv"]
    line += ["--robot", robot.file, "--commands", tmp_path / "log.csv", "--offset=-12"]
    assert record.main([str(each) for each in line]) == 2
    message_text = capsys.readouterr().err
    for part in words:
        assert part in message_text, message_text


def test_map_leaves_unknown_entries_empty_and_import_refuses_them(
    tmp_path: Path, robot: RobotDescription, capsys: pytest.CaptureFixture[str]
):
    path = write_qualisys_bodies(tmp_path)
    text = path.read_text()
    path.write_text(text.replace("tip X", "beak X").replace("hull\ttip", "hull\tbeak"))
    run("map", path, "--output", tmp_path / "room.toml", "--robot", robot.file)
    assert "1 place to complete" in capsys.readouterr().out
    assert 'body = ""  # choose from hull, beak' in (tmp_path / "room.toml").read_text()
    with pytest.raises(InputError, match=r'\[tip\] body: it is ""; write text there'):
        read_mapping(tmp_path / "room.toml", robot)
    assert record.main(["map", str(path), "--output", str(tmp_path / "room.toml")]) == 2
    assert "exists already" in capsys.readouterr().err


def test_map_drafts_lines_for_a_log_with_its_own_clock_and_units(tmp_path: Path, robot: RobotDescription):
    """The file holds no commands. Every key that such a log needs is in the draft, with its default, as a comment."""
    body = rows([1000 * TIME, *(100 * COMMAND.T)], ",", 6, lost=[])
    (tmp_path / "log.csv").write_text("stamp,servo,fan\n" + body)
    change = {'# time = "time"': 'time = "stamp"', '# time_unit = "s"': 'time_unit = "ms"'}
    for name, column, (low, high) in zip(robot.commands, ("servo", "fan"), robot.command_ranges, strict=True):
        change[f'# {name} = "command_{name}"'] = f'{name} = "{column}"'
        change[f"# range_{name} = [{low:g}, {high:g}]"] = f"range_{name} = [{100 * low}, {100 * high}]"
    assert_motion(imported(tmp_path, write_motive(tmp_path), robot, change), gaps=True)


def test_map_quotes_names_with_line_breaks(tmp_path: Path, robot: RobotDescription):
    np.savez(tmp_path / "x.npz", **{'a"\n[hull]\n': HULL.place, "time": TIME})
    contents = find_reader(tmp_path / "x.npz").list(tmp_path / "x.npz")
    from ballu_mjx.recordings.importers.draft import draft_mapping

    (tmp_path / "room.toml").write_text(draft_mapping(contents, robot))
    with pytest.raises(InputError, match=r"\[hull\] position"):
        read_mapping(tmp_path / "room.toml", robot)


@pytest.mark.parametrize("first", ["0", "0.0", "-0.0", "0.25"])
def test_last_comment_may_be_the_header_for_any_first_time(tmp_path: Path, first: str):
    path = tmp_path / "table.csv"
    path.write_text(f"# made by hand\n#time,x\n{first},1\n1.5,2\n")
    table = Table(path)
    assert table.column("time").tolist() == [float(first), 1.5] and table.column("x").tolist() == [1.0, 2.0]


def test_map_leaves_only_positions_empty_if_names_are_unclear(tmp_path: Path, robot: RobotDescription):
    names = "t,arm,push,bx,by,bz,qw,qx,qy,qz,kx,ky,kz"
    values = np.column_stack([TIME, COMMAND, HULL.place, HULL.turn.as_quat(scalar_first=True), TIP.place])
    np.savetxt(tmp_path / "x.csv", values, "%.6f", ",", header=names, comments="")
    run("map", tmp_path / "x.csv", "--output", tmp_path / "room.toml", "--robot", robot.file)
    text = (tmp_path / "room.toml").read_text()
    for stem in ("b", "k"):
        text = text.replace('position = ["", "", ""]', f'position = ["{stem}x", "{stem}y", "{stem}z"]', 1)
    (tmp_path / "room.toml").write_text(text)
    line = ["import", tmp_path / "x.csv", "--mapping", tmp_path / "room.toml", "--output", tmp_path / "out.csv"]
    run(*line, "--robot", robot.file)
    assert_motion(read_recording(tmp_path / "out.csv", robot), gaps=False)


@pytest.mark.parametrize("clock, scale, unit", [("t_ms", 1e3, "ms"), ("Time [us]", 1e6, "us"), ("stamp (s)", 1.0, "s")])
def test_map_finds_time_columns_with_a_unit_in_the_name(
    tmp_path: Path, robot: RobotDescription, clock: str, scale: float, unit: str
):
    names = f"{clock},arm,push,hull_x,hull_y,hull_z,hull_qw,hull_qx,hull_qy,hull_qz,tip_x,tip_y,tip_z"
    values = np.column_stack([scale * TIME, COMMAND, HULL.place, HULL.turn.as_quat(scalar_first=True), TIP.place])
    np.savetxt(tmp_path / "x.csv", values, "%.6f", ",", header=names, comments="")
    assert_motion(imported(tmp_path, tmp_path / "x.csv", robot), gaps=False)
    assert f'time_unit = "{unit}"' in (tmp_path / "room.toml").read_text()


def test_map_suggests_an_increasing_column_as_the_time(tmp_path: Path, robot: RobotDescription):
    values = np.column_stack([TIME, HULL.place])
    np.savetxt(tmp_path / "x.csv", values, "%.6f", ",", header="elapsed,hull_x,hull_y,hull_z", comments="")
    run("map", tmp_path / "x.csv", "--output", tmp_path / "room.toml", "--robot", robot.file)
    line = "rate = 100.0  # Hz; a guess. If one of these is the time, name it under [clock]: elapsed"
    assert line in (tmp_path / "room.toml").read_text().splitlines()


def test_map_includes_the_orientation_of_an_oriented_point(tmp_path: Path):
    names = [
        "time",
        *(f"{site}_{axis}" for site in ("balloon", "base") for axis in ("x", "y", "z", "qw", "qx", "qy", "qz")),
    ]
    values = np.column_stack([TIME, *[HULL.place, HULL.turn.as_quat(scalar_first=True)] * 2])
    np.savetxt(tmp_path / "x.csv", values, "%.6f", ",", header=",".join(names), comments="")
    run("map", tmp_path / "x.csv", "--output", tmp_path / "room.toml")
    text = (tmp_path / "room.toml").read_text()
    assert 'orientation = ["base_qw", "base_qx", "base_qy", "base_qz"]' in text


@pytest.mark.parametrize("write", [write_motive, write_qualisys_bodies])
@pytest.mark.parametrize("given", [False, True])
def test_times_of_a_cropped_take_count_from_its_start(
    tmp_path: Path, robot: RobotDescription, write: Callable[[Path], Path], given: bool
):
    """So they do if the mapping gives the rate."""
    path, missing = write(tmp_path), 50
    lines = path.read_text().splitlines(keepends=True)
    head = len(lines) - SAMPLES
    text = "".join(lines[:head] + lines[head + missing :])
    path.write_text(text.replace(f"NO_OF_FRAMES\t{SAMPLES}", f"NO_OF_FRAMES\t{SAMPLES - missing}"))
    mapping = room(tmp_path, robot, NAMED, commands=NO_COMMANDS)
    found = read_capture(path, dataclasses.replace(mapping, rate=RATE if given else None))
    np.testing.assert_allclose(found.time, TIME[missing:], atol=2e-6)
    assert found.first_frame == missing + 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"rate": 200.0}, "rate: .*a time for each"), ({"clock": Clock(time_unit="ms")}, "time_unit")],
)
def test_keys_that_do_not_apply_to_a_format_are_refused(
    tmp_path: Path, robot: RobotDescription, changes: dict[str, Any], message: str
):
    mapping = dataclasses.replace(room(tmp_path, robot, NAMED, commands=NO_COMMANDS), **changes)
    path = tmp_path / "poses.txt"
    path.write_text("# timestamp tx ty tz qx qy qz qw\n" + "".join(f"{i} 0 0 1 0 0 0 1\n" for i in range(9)))
    with pytest.raises(InputError, match=message):
        read_capture(path, mapping)


def test_the_rate_of_the_mapping_replaces_the_times_of_a_table(tmp_path: Path, robot: RobotDescription):
    text = """[units]
length = "m"
[hull]
position = ["hull_x", "hull_y", "hull_z"]
orientation = ["hull_qw", "hull_qx", "hull_qy", "hull_qz"]
rotation = "quaternion"
[tip]
position = ["tip_x", "tip_y", "tip_z"]
"""
    mapping = room(tmp_path, robot, text, commands=NO_COMMANDS, rate=50.0)
    np.testing.assert_allclose(read_capture(write_table(tmp_path), mapping).time, np.arange(SAMPLES) / 50.0)
