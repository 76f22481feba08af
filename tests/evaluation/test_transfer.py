"""Transfer of policies: the paper's metrics on paths with known results, and the tables."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping

import numpy as np
import pytest
from jaxtyping import Float

from ballu_mjx.ballu.model import CONTROL_TIMESTEP
from ballu_mjx.evaluation.transfer import (
    PAPER_TURNING,
    PAPER_WALKING,
    Trajectory,
    Transfer,
    compare_trajectories,
    path_length,
    turning_table,
    walking_table,
)

PAPER_SIMULATORS = ("vanilla+sysid", "vanilla+dr", "vanilla+sysid+dr", "envmimic")


def clock(seconds: float) -> Float[np.ndarray, " T"]:
    return np.arange(round(seconds / CONTROL_TIMESTEP) + 1) * CONTROL_TIMESTEP


def without_steps(com: Float[np.ndarray, "T 3"], yaw: Float[np.ndarray, " T"]) -> Trajectory:
    """Return a trajectory without steps."""
    return Trajectory(com, yaw, np.zeros(len(com), int), CONTROL_TIMESTEP)


def straight(seconds: float, speed: float, yaw: float = 0.0) -> Trajectory:
    """Return a path along x from the origin, 1 m high."""
    time = clock(seconds)
    return without_steps(np.stack([speed * time, 0 * time, 0 * time + 1.0], axis=1), np.full(len(time), yaw))


def circle(seconds: float, turns: float, radius: float = 1.0) -> Trajectory:
    """Return a left-hand circle from the origin, with the initial heading along x. Yaw is in [-pi, pi]."""
    angle = 2 * np.pi * turns * clock(seconds) / seconds
    com = radius * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1)
    return without_steps(com, np.arctan2(np.sin(angle), np.cos(angle)))


def trial(value: float) -> Transfer:
    return Transfer(**{field.name: value for field in dataclasses.fields(Transfer)})


def test_straight_walks_have_the_expected_metrics() -> None:
    found = compare_trajectories(straight(10, 0.2), straight(10, 0.1))
    assert found.com_error == pytest.approx(0.5)  # 0 m at the start to 1 m at the end
    assert (found.x_distance, found.total_distance, found.sim_x_distance) == pytest.approx((1.0, 1.0, 2.0))
    assert (found.y_distance, found.sim_y_distance, found.yaw_error, found.yaw_change) == pytest.approx((0, 0, 0, 0))


def test_constant_offset_is_the_com_error_in_three_dimensions() -> None:
    robot = straight(5, 0.1)
    found = compare_trajectories(without_steps(robot.com + np.array([0.2, -0.3, 0.6]), robot.yaw), robot)
    assert found.com_error == pytest.approx(0.7)
    assert found.sim_x_distance == pytest.approx(found.x_distance)


@pytest.mark.parametrize(("simulated", "real"), [(1.25, 1.5), (-0.5, 1.5), (2.0, -1.25)])
def test_yaw_changes_include_full_turns(simulated: float, real: float) -> None:
    found = compare_trajectories(circle(20, simulated), circle(20, real))
    assert found.yaw_change == pytest.approx(360 * real)
    assert found.sim_yaw_change == pytest.approx(360 * simulated)
    assert found.yaw_error == pytest.approx(360 * (simulated - real))
    assert found.y_distance == pytest.approx(1 - np.cos(2 * np.pi * real), abs=1e-12)


def test_yaw_errors_wrap_around_at_180_degrees() -> None:
    found = compare_trajectories(straight(2, 0.1, np.deg2rad(179)), straight(2, 0.1, np.deg2rad(-179)))
    assert found.yaw_error == pytest.approx(-2)
    assert found.yaw_change == 0


def test_comparison_ends_with_the_shorter_path() -> None:
    short, long = straight(4, 0.1), circle(20, 1.0)
    cut = without_steps(long.com[: len(short.com)], long.yaw[: len(short.yaw)])
    assert compare_trajectories(short, long) == compare_trajectories(short, cut)
    assert compare_trajectories(long, short) == compare_trajectories(cut, short)


def test_path_length_ignores_sway_and_keeps_the_last_second() -> None:
    path = straight(24.35, 0.05)
    time = clock(24.35)
    noise = np.random.default_rng(0).normal(scale=0.002, size=path.com.shape)
    swaying = path.com + 0.03 * np.sin(2 * np.pi * 2.1 * time)[:, None] * np.array([0.0, 1.0, 0.3]) + noise
    raw_length = np.linalg.norm(np.diff(swaying[:, :2], axis=0), axis=1).sum()
    assert path_length(path.com, CONTROL_TIMESTEP) == pytest.approx(24.35 * 0.05)
    assert raw_length > 4 * 24.35 * 0.05
    assert path_length(swaying, CONTROL_TIMESTEP) == pytest.approx(24.35 * 0.05, rel=0.1)
    assert path_length(path.com[:2], CONTROL_TIMESTEP) == pytest.approx(0.05 * CONTROL_TIMESTEP)


def test_path_length_of_a_circle_is_the_sum_of_its_chords() -> None:
    """There is one chord per second, of length 2 r sin(angle / 2)."""
    assert path_length(circle(20, 1.0).com, CONTROL_TIMESTEP) == pytest.approx(20 * 2 * np.sin(np.pi / 20))


def test_single_precision_is_accepted() -> None:
    path = straight(10, 0.1)
    single = without_steps(path.com.astype(np.float32), path.yaw.astype(np.float32))
    assert compare_trajectories(single, single).x_distance == pytest.approx(1.0, rel=1e-5)


def test_invalid_trajectories_are_refused() -> None:
    path = straight(1, 0.1)
    point = without_steps(path.com[:1], path.yaw[:1])
    for pair, name in (((point, path), "simulation"), ((path, point), "robot")):
        with pytest.raises(ValueError, match=f"The {name} has 1 states"):
            compare_trajectories(*pair)
    with pytest.raises(ValueError, match="21 centres of mass, but 20 yaws"):
        compare_trajectories(path, Trajectory(path.com, path.yaw[:-1], path.steps, CONTROL_TIMESTEP))


def test_transfer_is_equal_after_a_json_round_trip() -> None:
    found = compare_trajectories(circle(10, 0.3), circle(10, 0.2))
    assert Transfer.from_json(json.loads(json.dumps(found.to_json()))) == found


@pytest.mark.parametrize(
    ("table", "paper", "columns"), [(walking_table, PAPER_WALKING, 8), (turning_table, PAPER_TURNING, 10)]
)
def test_table_has_the_papers_rows_and_numbers(
    table: Callable[..., str], paper: Mapping[str, tuple[float, float, float]], columns: int
) -> None:
    names = (*PAPER_SIMULATORS, "envmimic, other draughts")
    results = {name: [[trial(0.1), trial(0.3)], [trial(0.2), trial(0.4)]] for name in names}
    text, caption = table(results).split("\n\n")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]
    assert "2 seeds" in caption and "95% confidence intervals" in caption
    assert [len(row) for row in rows] == [columns] * 7
    assert [row[0] for row in rows[2:]] == list(names)
    for row in rows[2:6]:
        assert row[2:7:2] == [f"{value:.2f}" for value in paper[row[0]]]
    assert rows[6][2:7:2] == ["-"] * 3
    assert all(cell.startswith(("0.25 [-0.", "0.2 [-0.")) for row in rows[2:] for cell in row[1:6:2])
    assert table(results).isascii()


def test_tables_show_absolute_yaw_errors_and_intervals_over_seeds() -> None:
    """Yaw errors are absolute, so that +10 and -10 deg do not cancel. One seed has no interval."""
    changed = {"com_error": 0.25, "sim_y_distance": 1.5}
    errors = [dataclasses.replace(trial(0.0), yaw_error=x, steps=20 + x, **changed) for x in (10.0, -10.0)]
    row, _, caption = turning_table({"envmimic": [errors]}).splitlines()[-3:]
    assert row == "| envmimic | 10.0 | 3.50 | 0.00 | 0.29 | 0.0 | 36.42 | 0.25 | 1.50 | 20 (10 to 30); 0 |"
    assert caption == "One seed a setting: no interval, and no ranking."
    walk = dataclasses.replace(trial(0.0), com_error=0.5, x_distance=1.234, total_distance=2.0)
    assert walking_table({"vanilla+dr": [[walk]]}).splitlines()[-3] == (
        "| vanilla+dr | 0.50 | 1.24 | 1.23 | 0.32 | 2.00 | 0.60 | 0; 0 |"
    )
    far = dataclasses.replace(walk, com_error=0.7)
    half = 12.706 * 0.1  # Student's t with one degree of freedom, times the standard error of 0.5 and 0.7
    assert f"| 0.60 [{0.6 - half:.2f}, {0.6 + half:.2f}] |" in walking_table({"vanilla+dr": [[walk, walk], [far]]})
