"""Tests of recordings of robots other than BALLU, with their own units, rates and limits, in files and importers."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ballu_mjx.cli import record
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.csv_format import read_recording, write_recording
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription, read_description

ARM = """
<mujoco><compiler angle="radian"/><option timestep="0.005"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" range="-2 2"/><geom size="0.01" mass="0.1"/>
    <site name="elbow" pos="0 0 -0.2"/>
    <body name="lower" pos="0 0 -0.2"><joint name="reach" type="slide" axis="0 0 1" range="0 0.1"/>
      <geom size="0.01" mass="0.1"/><site name="tip" pos="0 0 -0.3"/></body></body>
</worldbody><actuator><motor name="turn" joint="shoulder" ctrlrange="-12 12"/>
  <position name="push" joint="reach" ctrlrange="0 0.004"/></actuator></mujoco>
"""


def describe(folder: Path, **keys: Any) -> RobotDescription:
    (folder / "arm.xml").write_text(ARM)
    content: dict[str, Any] = {
        "format": "ballu-robot/1", "name": "arm", "model": "arm.xml", "tracked": "tip", "points": ["elbow"],
        "commands": {"turn": "turn", "push": "push"}, "joints": ["shoulder", "reach"], "oriented_points": ["elbow"],
        "control_timestep": 0.025,
    }  # fmt: skip
    (folder / "arm.robot.json").write_text(json.dumps(content | keys))
    return read_description(folder / "arm.robot.json")


def swing(rate: float = 100.0, seconds: float = 3.0) -> Recording:
    """Return a recording of the arm, which hangs below the model's origin."""
    time = np.arange(round(rate * seconds)) / rate
    angle, reach = 0.8 * np.sin(3 * time), 0.05 + 0.04 * np.sin(2 * time)
    down = -np.stack([np.sin(angle), 0 * time, np.cos(angle)], 1)
    quaternion = np.stack([np.cos(angle / 2), 0 * time, np.sin(angle / 2), 0 * time], 1)
    return Recording(
        name="swing", kind="free", robot="arm-1", time=time,
        command=np.stack([-11.5 + 0 * time, 0.00123 + 0 * time], 1),
        tracked_position=(0.5 - reach)[:, None] * down, tracked_quaternion=quaternion,
        points={"elbow": 0.2 * down}, orientations={"elbow": quaternion},
        joint_angles={"shoulder": angle, "reach": reach},
    )  # fmt: skip


def test_recording_with_all_described_quantities_is_read_back(tmp_path: Path):
    robot, expected = describe(tmp_path), swing()
    write_recording(expected, tmp_path / "swing.csv", robot)
    found = read_recording(tmp_path / "swing.csv", robot)
    np.testing.assert_allclose(found.command, expected.command, atol=1e-7)  # small commands keep their digits
    np.testing.assert_allclose(np.asarray(found.tracked_position), np.asarray(expected.tracked_position), atol=6e-6)
    np.testing.assert_allclose(found.orientations["elbow"], expected.orientations["elbow"], atol=6e-5)
    for joint in robot.joints:
        np.testing.assert_allclose(found.joint_angles[joint], expected.joint_angles[joint], atol=6e-6)


@pytest.mark.parametrize(
    ("low", "high"), [(-0.523599, 0.174533), (-3.14159, 3.14159), (-math.pi / 6, 1 / 3), (0.000123454321, 0.0009)]
)
def test_commands_at_the_bounds_of_their_range_are_read_back(tmp_path: Path, low: float, high: float):
    """The bounds have more decimals than a file keeps, or than a log in single precision has."""
    robot = describe(tmp_path, commands={"turn": {"actuator": "turn", "range": [low, high]}, "push": "push"})
    turn = np.resize([low, high, (low + high) / 2, float(np.float32(low)), float(np.float32(high))], len(swing().time))
    expected = dataclasses.replace(swing(), command=np.stack([turn, swing().command[:, 1]], axis=1))
    write_recording(expected, tmp_path / "swing.csv", robot)
    found = read_recording(tmp_path / "swing.csv", robot)
    np.testing.assert_allclose(found.command[:, 0], turn, atol=1e-4 * (high - low))


def test_free_recordings_need_no_joints_and_suspended_ones_need_only_joints(tmp_path: Path):
    robot = describe(tmp_path)
    write_recording(dataclasses.replace(swing(), orientations={}, joint_angles={}), tmp_path / "free.csv", robot)
    free = read_recording(tmp_path / "free.csv", robot)
    assert not free.joint_angles and not free.orientations and set(free.points) == {"elbow"}
    held = dataclasses.replace(
        swing(), kind="suspended", tracked_position=None, tracked_quaternion=None, points={}, orientations={}
    )
    write_recording(held, tmp_path / "held.csv", robot)
    found = read_recording(tmp_path / "held.csv", robot)
    assert found.tracked_position is None and set(found.joint_angles) == {"shoulder", "reach"}
    angles = {"shoulder": held.joint_angles["shoulder"]}
    write_recording(dataclasses.replace(held, joint_angles=angles), tmp_path / "half.csv", robot)
    with pytest.raises(InputError, match="column reach, row 1: the column is missing, and suspended recordings need"):
        read_recording(tmp_path / "half.csv", robot)


def test_description_sets_the_limits_and_the_lowest_sampling_rate(tmp_path: Path):
    """Without limits in the description, a site may be below the origin, 4 m higher, or fast. Each control step of
    25 ms needs at least one sample."""
    robot, path = describe(tmp_path), tmp_path / "swing.csv"
    up = dataclasses.replace(swing(), tracked_position=np.asarray(swing().tracked_position) + [0.0, 0.0, 4.0])
    for each in (swing(), up, swing(rate=41.0)):
        write_recording(each, path, robot)
        read_recording(path, robot)
    write_recording(swing(rate=38.0), path, robot)
    with pytest.raises(InputError, match="38 samples per second are fewer than 40"):
        read_recording(path, robot)
    write_recording(up, path, robot)
    with pytest.raises(InputError, match="column tip_z, row 2: 3.55 m is not a height between -1 and 3 m"):
        read_recording(path, describe(tmp_path, limits={"height": [-1, 3]}))
    elbow = swing().points["elbow"].copy()
    elbow[100:, 0] += 9.0 * (swing().time[100:] - swing().time[100])
    write_recording(dataclasses.replace(swing(), points={"elbow": elbow}), path, robot)
    read_recording(path, robot)
    with pytest.raises(InputError, match="column elbow_x, row 103: jumps by 0.09"):
        read_recording(path, describe(tmp_path, limits={"speed": 3.0}))
    elbow[100:, 0] += 0.5
    write_recording(dataclasses.replace(swing(), points={"elbow": elbow}), path, robot)
    with pytest.raises(InputError, match="column elbow_x, row 102: jumps by 0.5.* m within 10 ms, which no robot does"):
        read_recording(path, robot)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"command": swing().command * [2, 1]}, "column command_turn, row 2: -23 is outside -12 to 12"),
        ({"joint_angles": {"shoulder": np.rad2deg(swing().joint_angles["shoulder"])}}, "convert degrees to radians"),
        ({"joint_angles": {"reach": 1e3 * swing().joint_angles["reach"]}}, "millimetres to metres"),
    ],
)
def test_values_outside_the_model_s_ranges_are_refused(tmp_path: Path, changes: dict[str, Any], message: str):
    robot = describe(tmp_path)
    write_recording(dataclasses.replace(swing(), **changes), tmp_path / "swing.csv", robot)
    with pytest.raises(InputError, match=message):
        read_recording(tmp_path / "swing.csv", robot)


def test_import_and_check_accept_another_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """`import` converts a table of another robot, with its own units. `check` prints its orientations and joints."""
    robot, made = describe(tmp_path), swing()
    assert made.tracked_position is not None and made.tracked_quaternion is not None
    columns = [
        1e3 * made.time, *(1e3 * made.tracked_position.T), *made.tracked_quaternion.T, *(1e3 * made.points["elbow"].T),
        np.rad2deg(made.joint_angles["shoulder"]), 1e3 * made.joint_angles["reach"], made.command[:, 0] / 12 * 100,
        1e3 * made.command[:, 1],
    ]  # fmt: skip
    rows = [",".join(f"{x:.9g}" for x in row) for row in zip(*columns, strict=True)]
    names = "ms,tx,ty,tz,tw,ti,tj,tk,ex,ey,ez,angle,reach,percent,mm"
    (tmp_path / "take.csv").write_text("\n".join([names, *rows]) + "\n")
    (tmp_path / "room.toml").write_text(
        'robot = "arm-1"\n[units]\nlength = "mm"\nangle = "deg"\n[clock]\ntime_unit = "ms"\n'
        '[tip]\nposition = ["tx", "ty", "tz"]\norientation = ["tw", "ti", "tj", "tk"]\nrotation = "quaternion"\n'
        '[elbow]\nposition = ["ex", "ey", "ez"]\n[shoulder]\ncolumn = "angle"\n[reach]\ncolumn = "reach"\n'
        '[commands]\ntime = "ms"\nturn = "percent"\nrange_turn = [-100, 100]\npush = "mm"\nrange_push = [0, 4]\n'
    )
    line = ["import", "take.csv", "--mapping", "room.toml", "--output", "out/take.csv", "--robot", "arm.robot.json"]
    assert record.main([str(tmp_path / each) if "." in each else each for each in line]) == 0
    found = read_recording(tmp_path / "out" / "take.csv", robot)
    np.testing.assert_allclose(found.command, made.command, atol=1e-4)
    # Import does not move the origin of an anchored robot.
    np.testing.assert_allclose(np.asarray(found.tracked_position), made.tracked_position, atol=1e-5)
    np.testing.assert_allclose(found.joint_angles["reach"], made.joint_angles["reach"], atol=1e-5)
    capsys.readouterr()
    figures = ["--output", str(tmp_path / "figures")]
    assert record.main(["check", str(tmp_path / "out"), "--robot", str(robot.file), *figures]) == 0
    printed = capsys.readouterr().out
    assert "tip yaw, pitch, roll (deg): 0.000 to 0.000, -45.8" in printed and "reach (rad or m): 0.010 to" in printed
    assert "command_turn: -11.50 to -11.50" in printed
    assert (tmp_path / "figures" / "take.png").stat().st_size > 2e4
    assert record.main(["check", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr().err
    assert "unknown column" in printed and "--robot" in printed
