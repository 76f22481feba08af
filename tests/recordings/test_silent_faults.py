"""Tests of capture faults that single samples do not show: held poses, flipped orientations, jumps and bursts."""

from __future__ import annotations

import dataclasses
import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.csv_format import read_recording, write_recording
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.recordings.summary import summarize_recording
from ballu_mjx.robots.description import RobotDescription, read_description

_MODEL = """
<mujoco><option timestep="0.01"/><worldbody><body name="hull"><freejoint/><geom size="0.1" mass="1"/>
  <site name="hull"/><site name="nose" pos="0.3 0 0"/></body></worldbody>
  <actuator><motor name="m" site="hull" gear="1 0 0 0 0 0" ctrlrange="-1 1"/></actuator></mujoco>
"""
SAMPLES = 300


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    folder = tmp_path_factory.mktemp("hull")
    (folder / "hull.xml").write_text(_MODEL)
    content = {"format": "ballu-robot/1", "name": "hull", "model": "hull.xml", "tracked": "hull", "points": ["nose"]}
    (folder / "hull.robot.json").write_text(json.dumps(content | {"commands": {"push": "m"}}))
    return read_description(folder / "hull.robot.json")


def flight(robot: RobotDescription, seed: int = 0, rate: float = 100.0, noise: float = 2e-4) -> Recording:
    """Return a recording of a free body that moves at walking speed and turns about all axes."""
    rng = np.random.default_rng(seed)
    time = np.arange(SAMPLES) / rate
    phases, speeds = rng.uniform(0, 6, 6), rng.uniform(1.0, 3.0, 6)
    waves = np.sin(speeds * time[:, None] + phases)
    place = waves[:, :3] * [0.8, 0.6, 0.3] + rng.normal(0, noise, (SAMPLES, 3))
    turn = Rotation.from_rotvec(0.8 * waves[:, 3:]) * Rotation.from_rotvec(rng.normal(0, 3 * noise, (SAMPLES, 3)))
    nose = place + turn.apply([0.3, 0, 0]) + rng.normal(0, noise, (SAMPLES, 3))
    return Recording(
        name="flight", kind="free", robot="hull-1", time=time, command=np.zeros((SAMPLES, 1)),
        tracked_position=place, tracked_quaternion=turn.as_quat(scalar_first=True), points={"nose": nose},
    )  # fmt: skip


def write_and_read(recording: Recording, robot: RobotDescription, decimals: int = 5) -> Recording:
    with tempfile.TemporaryDirectory() as folder:
        write_recording(recording, Path(folder) / "flight.csv", robot, decimals=decimals)
        return read_recording(Path(folder) / "flight.csv", robot)


def hold(recording: Recording, start: int, count: int) -> Recording:
    """Return the recording with `count` held samples, as a client that repeats the last pose when tracking is lost."""

    def held(values: np.ndarray) -> np.ndarray:
        values = values.copy()
        values[start : start + count] = values[start - 1]
        return values

    assert recording.tracked_position is not None and recording.tracked_quaternion is not None
    return dataclasses.replace(
        recording,
        tracked_position=held(recording.tracked_position),
        tracked_quaternion=held(recording.tracked_quaternion),
        points={name: held(value) for name, value in recording.points.items()},
    )


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 99), start=st.integers(2, 240), count=st.integers(1, 48))
def test_held_poses_are_interpolated_as_gaps(robot: RobotDescription, seed: int, start: int, count: int):
    whole = flight(robot, seed)
    found = write_and_read(hold(whole, start, count), robot)
    assert found.held == {"hull": count, "nose": count}
    assert found.interpolated["nose_x"] == count
    gaps = {name: value.copy() for name, value in whole.points.items()}
    gaps["nose"][start : start + count] = np.nan
    expected = write_and_read(dataclasses.replace(whole, points=gaps), robot)
    np.testing.assert_allclose(found.points["nose"], expected.points["nose"], atol=2e-5)
    summary_text = summarize_recording(Path("flight.csv"), found, robot, {})
    assert f"hull, nose: {count} samples repeat the one before" in summary_text and "no drop-outs" not in summary_text


@pytest.mark.parametrize("count", [55, 80, 200])
def test_pose_held_for_longer_than_half_a_second_is_refused(robot: RobotDescription, count: int):
    with pytest.raises(InputError, match=r"hull_x, row 62: the pose of hull repeats for 0?\.?\d.* s to the last digit"):
        write_and_read(hold(flight(robot), 60, count), robot)


def test_pose_held_until_the_end_is_trimmed(robot: RobotDescription):
    found = write_and_read(hold(flight(robot), SAMPLES - 30, 30), robot)
    assert found.trimmed == (0, 30) and len(found.time) == SAMPLES - 30


@pytest.mark.parametrize("decimals", [3, 5])
def test_robot_at_rest_is_not_taken_for_held_poses(robot: RobotDescription, decimals: int):
    """A robot at rest repeats its pose for long if there is no noise, or if the file's digits do not resolve it."""
    moving = flight(robot, noise=0.0)
    assert moving.tracked_position is not None and moving.tracked_quaternion is not None
    ease = np.clip((moving.time - 0.7) / 1.5, 0, 1)
    ease = ease**2 * (3 - 2 * ease)  # at rest for 0.7 s at both ends
    which = np.interp(ease, np.linspace(0, 1, SAMPLES), np.arange(SAMPLES))

    def eased(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(which, np.arange(SAMPLES), column) for column in values.T], axis=1)

    quaternion = eased(moving.tracked_quaternion)
    resting = dataclasses.replace(
        moving,
        tracked_position=eased(moving.tracked_position),
        tracked_quaternion=quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        points={"nose": eased(moving.points["nose"])},
    )
    found = write_and_read(resting, robot, decimals)
    assert len(found.time) == SAMPLES
    np.testing.assert_allclose(found.points["nose"], resting.points["nose"], atol=2 * 10.0**-decimals)


@pytest.mark.parametrize("turns", [256, 4096])
def test_poses_from_encoders_are_not_taken_for_held_poses(robot: RobotDescription, turns: int):
    """Coarse angles repeat while a joint is slow, and return to earlier values."""
    time = np.arange(SAMPLES) / 100
    angle = np.round(0.3 * np.sin(4 * time) * turns / (2 * np.pi)) * 2 * np.pi / turns
    arm = np.stack([np.sin(angle), 0 * time, -np.cos(angle)], axis=1)
    quaternion = np.stack([np.cos(angle / 2), 0 * time, np.sin(angle / 2), 0 * time], axis=1)
    swing = Recording(
        name="flight", kind="free", robot="hull-1", time=time, command=np.zeros((SAMPLES, 1)),
        tracked_position=0.5 * arm, tracked_quaternion=quaternion, points={"nose": 0.8 * arm},
    )  # fmt: skip
    found = write_and_read(swing, robot)
    assert not found.held and not found.interpolated


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 99),
    start=st.integers(2, SAMPLES - 1),
    count=st.integers(1, 60),
    angle=st.sampled_from([60.0, 72.0, 90.0, 120.0, 180.0]),
    axis=st.sampled_from(["x", "y", "z"]),
)
def test_flipped_orientations_are_refused(
    robot: RobotDescription, seed: int, start: int, count: int, angle: float, axis: str
):
    """Tracking confuses the orientations of a symmetric marker set, while the position stays correct."""
    whole = flight(robot, seed)
    turned = Rotation.from_quat(np.asarray(whole.tracked_quaternion), scalar_first=True)
    flip = Rotation.from_euler(axis, angle, degrees=True)
    quaternion = turned.as_quat(scalar_first=True)
    rows = slice(start, start + count)
    quaternion[rows] = (turned * flip).as_quat(scalar_first=True)[rows]
    with pytest.raises(InputError, match=rf"hull_qw, row {start + 2}: turned by \d+ deg within 10 ms"):
        write_and_read(dataclasses.replace(whole, tracked_quaternion=quaternion), robot)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 99), start=st.integers(1, SAMPLES - 1), count=st.integers(1, 60))
def test_jumps_of_a_position_are_refused_without_described_limits(
    robot: RobotDescription, seed: int, start: int, count: int
):
    whole = flight(robot, seed)
    nose = whole.points["nose"].copy()
    nose[start : start + count] += [0.12, -0.1, 0.05]
    with pytest.raises(InputError, match=rf"nose_x, row {start + 2}: jumps by 0\.\d+ m within 10 ms"):
        write_and_read(dataclasses.replace(whole, points={"nose": nose}), robot)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 99), rate=st.sampled_from([20.0, 50.0, 100.0, 240.0, 1000.0]), hit=st.booleans())
def test_fast_motion_and_impacts_are_accepted(robot: RobotDescription, seed: int, rate: float, hit: bool):
    """The body spins at 15 rad/s and moves at 9 m/s, or stops from 4 m/s within one sample at an impact."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(2 * rate) + 1) / rate
    going = np.minimum(time, 1.0) if hit else time
    speed, spin = rng.normal(size=3), rng.normal(size=3)
    place = (4.0 if hit else 9.0) / np.linalg.norm(speed) * going[:, None] * speed + rng.normal(0, 5e-4, (len(time), 3))
    turn = Rotation.from_rotvec(15.0 / np.linalg.norm(spin) * going[:, None] * spin)
    turn = turn * Rotation.from_rotvec(rng.normal(0, 5e-3, (len(time), 3)))
    recording = Recording(
        name="flight", kind="free", robot="hull-1", time=time, command=np.zeros((len(time), 1)),
        tracked_position=place, tracked_quaternion=turn.as_quat(scalar_first=True),
        points={"nose": place + turn.apply([0.3, 0, 0]) + rng.normal(0, 5e-4, (len(time), 3))},
    )  # fmt: skip
    found = write_and_read(recording, robot)
    assert len(found.time) == len(time) and not found.held


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 99), burst=st.integers(4, 8), quick=st.floats(0.0003, 0.001))
def test_bursts_of_time_stamps_are_refused(robot: RobotDescription, seed: int, burst: int, quick: float):
    """Stamps of arrival have several samples at once, then a pause. Their median step looks like a high rate."""
    whole = flight(robot, seed)
    number = np.arange(SAMPLES)
    time = (number // burst) * burst * 0.01 + (number % burst) * quick
    with pytest.raises(InputError, match="column time, row .*: samples come in bursts"):
        write_and_read(dataclasses.replace(whole, time=time), robot)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 99), jitter=st.floats(0.0, 0.004))
def test_jitter_and_missing_samples_are_not_taken_for_bursts(robot: RobotDescription, seed: int, jitter: float):
    rng = np.random.default_rng(seed)
    whole = flight(robot, seed)
    time = np.sort(whole.time + rng.uniform(0, jitter, SAMPLES))
    kept = rng.uniform(size=SAMPLES) > 0.1
    kept[[0, -1]] = True
    assert whole.tracked_position is not None and whole.tracked_quaternion is not None
    some = dataclasses.replace(
        whole, time=time[kept], command=whole.command[kept], tracked_position=whole.tracked_position[kept],
        tracked_quaternion=whole.tracked_quaternion[kept], points={"nose": whole.points["nose"][kept]},
    )  # fmt: skip
    assert len(write_and_read(some, robot).time) == kept.sum()
