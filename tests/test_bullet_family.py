"""Tests of the second family of virtual robots, in PyBullet: draws, recordings, standing and walking."""

from __future__ import annotations

import ast
import dataclasses
from pathlib import Path

import numpy as np
import pytest

import ballu_mjx
from ballu_mjx.ballu.sweep import read_sweep
from ballu_mjx.ballu.virtual.robot import open_loop
from ballu_mjx.policies.deploy.estimator import Capture
from ballu_mjx.recordings.csv_format import read_recording, write_recording
from ballu_mjx.robots.registry import load_robot

pytest.importorskip("pybullet")

import bullet_family as family  # pyright: ignore[reportMissingImports]


def test_drawn_robots_are_reproducible_and_differ_from_each_other() -> None:
    robots = [family.draw(seed) for seed in family.ROBOTS]
    assert robots == [family.draw(seed) for seed in family.ROBOTS]
    assert len({dataclasses.astuple(robot)[1:] for robot in robots}) == len(robots)


def test_recordings_are_reproducible_and_readable(tmp_path: Path) -> None:
    robot, commands = family.draw(0), family.walking_commands(1.0)["near-1"]
    for name in ("one", "other"):
        recording = family.record_walking(robot, commands, name)
        write_recording(recording, tmp_path / f"{name}.csv", load_robot())
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "other.csv").read_bytes()
    assert read_recording(tmp_path / "one.csv", load_robot()).robot == robot.name


@pytest.mark.parametrize("seed", family.ROBOTS)
def test_robot_loads_the_floor_with_weight_less_lift_and_walks(seed: int) -> None:
    robot = family.draw(seed)
    world = family.World(robot)
    world.run(np.zeros(2), 4.0)
    assert world.total_mass() == pytest.approx(0.28679, abs=1e-5)
    forces = []
    for _ in range(100):
        world.run(np.zeros(2), 0.01)
        forces.append(world.floor_force())
    assert np.mean(forces) == pytest.approx((1 - robot.buoyancy) * 0.28679 * 9.81, rel=0.05)
    before, balloon, _ = world.look()
    assert balloon.as_matrix()[2, 2] > 0.98
    assert before[1, 2] == pytest.approx(0.70, abs=0.05)
    for command in family.walking_commands(5.0)["near-1"]:
        world.run(command, 0.05)
    after, balloon, _ = world.look()
    world.close()
    assert np.linalg.norm(after[0] - before[0]) > 0.2
    assert balloon.as_matrix()[2, 2] > 0.9


def test_settled_angles_increase_with_the_command() -> None:
    recording = family.record_sweep(family.draw(1), family.sweep_commands(), "sweep")
    settled = read_sweep({Path("sweep.csv"): recording}).settled
    assert np.all(np.diff(settled[:, 0], axis=0) > 0), "arms"
    assert np.all(np.diff(settled[:, 1], axis=0) > -np.deg2rad(0.3)), "knees, within noise"
    assert np.rad2deg(settled[-1, 1] - settled[0, 1]).min() > 15


def test_package_does_not_import_the_bullet_family() -> None:
    for file in Path(ballu_mjx.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any("bullet" in name for name in names), file


def test_trials_with_equal_numbers_are_equal_and_the_draught_moves_the_robot() -> None:
    hardware = family.BulletHardware.draw(0)
    commands = np.zeros((40, 2))
    first, same, other = (hardware.record(trial, open_loop(commands), 2.0, "trial", "") for trial in (1, 1, 2))
    assert first.tracked_position is not None and same.tracked_position is not None
    np.testing.assert_array_equal(first.tracked_position, same.tracked_position)
    assert not np.array_equal(first.tracked_position, other.tracked_position)


def test_draught_leans_the_standing_robot_downwind() -> None:
    robot, leans = family.draw(0), []
    for speed in (0.0, 0.5):
        world = family.World(robot, dataclasses.replace(family.STILL, draught=(0.0, speed, 0.0)))
        world.run(np.zeros(2), 2.0)
        world.begin_trial()
        places, *_ = world.look()
        leans.append(places[0, 1] - places[1, 1])  # balloons relative to the base
        world.close()
    assert leans[1] - leans[0] > 0.01


def test_controllers_see_the_frames_so_far_and_command_twenty_times_a_second() -> None:
    seen = []

    def controller(capture: Capture) -> np.ndarray:
        seen.append((len(capture.time), capture.time[-1]))
        return np.array([1.5, 0.25])

    recording = family.BulletHardware.draw(0).record(3, controller, 0.5, "trial", "")
    assert [frames for frames, _ in seen] == list(range(1, 51, 5))
    assert [time for _, time in seen] == pytest.approx(np.arange(0.0, 0.5, 0.05))
    np.testing.assert_array_equal(recording.command, np.tile([1.0, 0.25], (51, 1)))
