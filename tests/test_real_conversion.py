"""Experiments on public recordings of real robots: conversion of the public files, which made files stand for."""

from __future__ import annotations

import json
import lzma
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
import pytest
import scipy.io
from experiment_modules import EXPERIMENTS, REAL_DATA, experiment_module, needs_real_data

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.robots.description import read_description

REAL = EXPERIMENTS / "real"
PENDULUM_COLUMNS = ("time", "pos_meas1", "pos_meas2", "vel_meas1", "tau_con1", "tau_con2")
BLIMP_COLUMNS = (*(f"{kind}_{k}" for kind in ("p", "e", "rb_series") for k in (1, 2, 3)), "Fl_series", "Fr_series")
WALK_VARIABLES = ("datatime", "hipangle", "innoutst", "stanceangle", "umaxonsatu")


def experiment(script: str) -> Callable[..., Iterator[ModuleType]]:
    """Return a fixture with an experiment as a module."""

    @pytest.fixture(scope="module")
    def loaded() -> Iterator[ModuleType]:
        with experiment_module(REAL / script) as module:
            yield module

    return loaded


pendulum = experiment("double_pendulum/double_pendulum.py")
motor = experiment("go1/go1.py")
walker = experiment("compass_gait/compass_gait.py")
blimp = experiment("rgblimp/rgblimp.py")


def write_table(path: Path, columns: tuple[str, ...], rows: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="")
    return path


def pendulum_rows() -> np.ndarray:
    """Return 1.5 s of a pendulum at uneven times: the shoulder turns at 2 rad/s, the second torque steps at 0.055 s."""
    time = np.cumsum(np.r_[0.0, np.tile([0.002, 0.003], 300)])
    one, zero = np.ones_like(time), np.zeros_like(time)
    return np.stack([time, 2 * time, 0.5 * one, 2 * one, zero, np.where(time < 0.0535, -4.0, 4.0)], axis=1)


def test_a_pendulum_is_resampled_and_its_tip_is_where_the_angles_say(pendulum: ModuleType, tmp_path: Path):
    name = next(iter(pendulum.SOURCES))
    for source in pendulum.SOURCES.values():
        write_table(tmp_path / "public" / source, PENDULUM_COLUMNS, pendulum_rows())
    folder = pendulum.prepare(tmp_path / "public", tmp_path / "made")
    assert folder == tmp_path / "made"
    assert pendulum.swing_ups(folder) == []  # there are none in the public folder
    robot = read_description(REAL / "double_pendulum" / "double_pendulum.robot.json")
    recording = read_recording(folder / f"{name}.csv.gz", robot)
    np.testing.assert_allclose(np.diff(recording.time), 0.002, atol=1e-9)
    shoulder = recording.joint_angles["shoulder"]
    np.testing.assert_allclose(shoulder, 2 * recording.time, atol=1e-5)
    np.testing.assert_allclose(recording.command[:, 0], 0.5, atol=1e-4)
    held = np.where(recording.time < 0.055, 0.3, 0.7)
    np.testing.assert_allclose(recording.command[:, 1], held, atol=1e-4)
    # Links of 0.2 and 0.3 m hang down at angles of 0, in a vertical plane; the elbow's angle is relative.
    position = recording.tracked_position
    assert position is not None
    from_axis = 0.2 * np.sin(shoulder) + 0.3 * np.sin(shoulder + 0.5)
    np.testing.assert_allclose(np.abs(position[:, 0]), np.abs(from_axis), atol=2e-5)
    drop = position[:, 2].max() - position[:, 2]
    height = 0.2 * np.cos(shoulder) + 0.3 * np.cos(shoulder + 0.5)
    np.testing.assert_allclose(drop, height - height.min(), atol=3e-5)
    assert pendulum.prepare(folder, tmp_path / "unused") == folder
    assert not (tmp_path / "unused").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("tau_con2", "torque"), "there is no column tau_con2"),
        (lambda text: text.removesuffix("\n").rpartition(",")[0] + "\n", "different numbers of cells"),
        (lambda text: text.replace("5.000000000000000000e-01", "nan", 1), "column pos_meas2, row 2"),
        (lambda text: text.splitlines()[0] + "\n", "no row below the header"),
    ],
)
def test_damaged_tables_are_refused_with_the_place(
    change: Callable[[str], str], message: str, pendulum: ModuleType, tmp_path: Path
):
    path = write_table(tmp_path / "trajectory.csv", PENDULUM_COLUMNS, pendulum_rows())
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError, match=message):
        pendulum.convert(path, "run")


def test_times_that_go_back_are_refused(pendulum: ModuleType, tmp_path: Path):
    rows = pendulum_rows()
    rows[5, 0] = rows[3, 0]
    with pytest.raises(InputError, match="column time, row 7"):
        pendulum.convert(write_table(tmp_path / "trajectory.csv", PENDULUM_COLUMNS, rows), "run")


def test_data_without_the_files_are_refused(pendulum: ModuleType, tmp_path: Path):
    with pytest.raises(InputError, match=r"has neither sysid-20230629-143339\.csv\.gz nor data/experiment_records"):
        pendulum.prepare(tmp_path, tmp_path / "made")


def write_motor_logs(folder: Path, motor: ModuleType) -> None:
    folder.mkdir(parents=True)
    for number, (kilograms, trajectory) in enumerate([(k, t) for k in motor.LOADS for t in motor.TRAJECTORIES]):
        entries = [
            {"timestamp": 0.4 + 0.016 * k, "position": 0.01 * k, "goal_position": 0.02 * kilograms, "speed": 0.0}
            for k in range(80)
        ]
        log = {"mass": float(kilograms), "trajectory": trajectory, "entries": entries}
        (folder / f"log-{number}.json").write_text(json.dumps(log))


def test_logs_of_a_motor_are_found_by_payload_and_trajectory(motor: ModuleType, tmp_path: Path):
    write_motor_logs(tmp_path / "public" / motor.PUBLIC, motor)
    folder = motor.prepare(tmp_path / "public", tmp_path / "made")
    robot = read_description(REAL / "go1" / "go1.robot.json")
    for kilograms in motor.LOADS:
        recording = read_recording(folder / f"go1_{kilograms}" / "recordings" / "sin_sin.csv.gz", robot)
        np.testing.assert_allclose(recording.time, 0.016 * np.arange(80), atol=1e-6)
        np.testing.assert_allclose(recording.joint_angles["motor"], 0.01 * np.arange(80), atol=1e-5)
        np.testing.assert_allclose(recording.command[:, 0], 0.5 + 0.02 * kilograms / (2 * np.pi), atol=1e-4)
    (tmp_path / "public" / motor.PUBLIC / "log-0.json").unlink()
    with pytest.raises(InputError, match="neither go1_0/recordings/sin_sin"):
        motor.prepare(tmp_path / "public", tmp_path / "again")


def test_a_damaged_log_of_a_motor_is_refused(motor: ModuleType, tmp_path: Path):
    path = tmp_path / "log.json"
    path.write_text(json.dumps({"entries": [{"timestamp": 0.0, "position": 0.1}]}))
    with pytest.raises(InputError, match="entries must have the numbers timestamp, position and goal_position"):
        motor.convert(path, "run")


def write_walks(path: Path, steps: int) -> None:
    """Write walks with steps of 0.1 s, in which the outer leg stands first. The hip turns at 10 deg/s."""
    path.parent.mkdir(parents=True, exist_ok=True)
    count = steps * 20
    time = 0.005 * np.arange(count)
    stands = (np.arange(count) // 20 + 1) % 2
    values = time, 10 * time, stands, 0.1 * np.ones(count), 5.0 * stands
    scipy.io.savemat(path, {name: np.c_[value] for name, value in zip(WALK_VARIABLES, values, strict=True)})


def test_joined_walks_are_separated(walker: ModuleType, tmp_path: Path):
    write_walks(tmp_path / walker.PUBLIC, walker.WALKS * walker.STEPS)
    table = walker.read_walk(tmp_path, 1)
    time = 0.005 * np.arange(200)
    hip = np.deg2rad(10 * (time + 1.0))  # the second walk begins after 1 s
    np.testing.assert_allclose(table["time"], time, atol=1e-9)
    np.testing.assert_allclose(table["outer"], -hip, atol=1e-9)
    np.testing.assert_allclose(table["inner"], np.where(table["command_inner"] > 0.5, hip, 0) - 0.1, atol=1e-9)
    np.testing.assert_allclose(table["command_motor"], 0.5 + 0.25 * table["command_inner"], atol=1e-9)
    legs = [leg for leg, _ in walker.cut_steps(table, "walk-01")]
    assert legs == ["outer", "inner"] * 5
    write_walks(tmp_path / walker.PUBLIC, 7)
    with pytest.raises(InputError, match="has 7 steps instead of 12 walks of 10"):
        walker.read_walk(tmp_path, 0)
    with pytest.raises(InputError, match=r"has neither walk-00\.csv\.gz nor System Identification"):
        walker.read_walk(tmp_path / "elsewhere", 0)


def test_methods_are_run_after_those_that_they_need(blimp: ModuleType):
    assert blimp.with_earlier(["linear fluid, then supervised", "fluid"]) == [
        "fluid",
        "linear fluid",
        "linear fluid, then supervised",
    ]
    folders = [method.folder for method in blimp.METHODS.values()]
    assert len(set(folders)) == len(folders)
    assert not any(" " in folder for folder in folders)


def test_a_flight_is_turned_upright(blimp: ModuleType, tmp_path: Path):
    time = np.arange(90) / 60
    rows = np.zeros((90, len(BLIMP_COLUMNS)))
    columns = dict(zip(BLIMP_COLUMNS, rows.T, strict=True))
    columns["p_1"][:], columns["p_2"][:], columns["p_3"][:] = time, 2 * time, -1.5
    columns["e_3"][:] = 0.3
    columns["rb_series_1"][:], columns["Fl_series"][:], columns["Fr_series"][:] = 0.08, 0.014, 0.035
    path = write_table(tmp_path / "data_1.csv", BLIMP_COLUMNS, rows)
    packed = tmp_path / "packed" / "data_1.csv.xz"
    packed.parent.mkdir()
    packed.write_bytes(lzma.compress(path.read_bytes()))
    robot = read_description(blimp.DESCRIPTION)
    for folder in (tmp_path, packed.parent):
        (found,) = blimp.find(folder, (1,), robot, folder / "made")
        recording = read_recording(found, robot)
        assert recording.tracked_position is not None and recording.tracked_quaternion is not None
        np.testing.assert_allclose(recording.tracked_position, np.c_[time, -2 * time, 1.5 + 0 * time], atol=1e-5)
        half = 0.15  # yaw is clockwise in the public files
        quaternion = np.array([np.cos(half), 0, 0, -np.sin(half)])
        np.testing.assert_allclose(recording.tracked_quaternion, np.tile(quaternion, (90, 1)), atol=1e-4)
        np.testing.assert_allclose(recording.command, np.tile([0.2, 0.5, 0.306], (90, 1)), atol=1e-4)


# ---- public files ----


@needs_real_data
def test_public_files_become_the_recordings_that_others_made_of_them(
    pendulum: ModuleType, motor: ModuleType, walker: ModuleType, blimp: ModuleType, tmp_path: Path
):
    raw = REAL_DATA / "raw"
    pairs = [
        (
            pendulum.convert(raw / "double_pendulum" / "20230629-143339.csv.xz", "run"),
            REAL_DATA / "double_pendulum" / "recordings" / "sysid-20230629-143339.csv.gz",
            REAL / "double_pendulum" / "double_pendulum.robot.json",
        ),
        (
            motor.convert(raw / "go1" / "2025-05-13_05h08m06.json", "run"),
            REAL_DATA / "go1_2" / "recordings" / "up_and_down.csv.gz",
            REAL / "go1" / "go1.robot.json",
        ),
        (
            blimp.convert(raw / "rgblimp" / "data_83.csv.xz", "flight"),
            REAL_DATA / "rgblimp" / "recordings" / "flight-083.csv.gz",
            blimp.DESCRIPTION,
        ),
    ]
    for made, path, description in pairs:
        known = read_recording(path, read_description(description))
        np.testing.assert_allclose(made.time, known.time, atol=1e-5)
        np.testing.assert_allclose(made.command, known.command, atol=1e-4)
        for joint, angles in made.joint_angles.items():
            np.testing.assert_allclose(angles, known.joint_angles[joint], atol=1e-5)
        assert known.tracked_position is not None
        np.testing.assert_allclose(made.tracked_position, known.tracked_position, atol=2e-5)
    folder = tmp_path / "walks"
    public = folder / walker.PUBLIC
    public.parent.mkdir(parents=True)
    public.symlink_to(raw / "compass_gait" / public.name)
    for walk in (0, 11):
        made, known = (walker.read_walk(data, walk) for data in (folder, REAL_DATA / "compass_gait" / "recordings"))
        for column in walker.COLUMNS:
            np.testing.assert_allclose(made[column], known[column], atol=1e-4)


@needs_real_data
@pytest.mark.parametrize("leg", ["inner", "outer"])
def test_a_leg_swings_as_in_its_motor_test(walker: ModuleType, leg: str):
    test = walker.read_motor_test(
        REAL_DATA / "raw" / "compass_gait" / Path(walker.MOTOR_TESTS.format(leg=leg)).name, leg
    )
    recorded = test.joint_angles["swing"]
    model = walker.model_of_motor_test(leg)
    model.joint("swing").frictionloss = walker.PUBLISHED["hip_frictionloss"]
    model.joint("swing").damping = walker.PUBLISHED["hip_damping"]
    every = round((test.time[1] - test.time[0]) / model.opt.timestep)
    data = mujoco.MjData(model)
    data.qpos[1] = recorded[0]
    angles = []
    played = test.time < 13.0  # it falls, comes to rest, and is held by 5 V from 9 s on
    for command in test.command[played, 0]:
        angles.append(data.qpos.copy())
        data.ctrl[0] = command
        mujoco.mj_step(model, data, nstep=every)
    stance, swing = np.rad2deg(angles).T
    errors = swing - np.rad2deg(recorded[played])
    fall = errors[test.time[played] < 4.0]
    assert np.sqrt(np.mean(fall**2)) < 5.0  # it falls from 90 deg; without friction, the error is 60 deg
    assert abs(errors[-1]) < 2.0 < swing[-1]
    assert np.abs(stance).max() < 0.01


@needs_real_data
def test_a_clone_without_the_motor_tests_is_refused(walker: ModuleType, tmp_path: Path):
    assert walker.load_motor_tests(REAL_DATA / "compass_gait" / "recordings") == []  # a folder of tables
    public = tmp_path / walker.PUBLIC
    public.parent.mkdir(parents=True)
    public.symlink_to(REAL_DATA / "raw" / "compass_gait" / public.name)
    with pytest.raises(InputError, match="innerSW.mat"):
        walker.load_motor_tests(tmp_path)
