"""The choice between nominal and identified actuators, and its report."""

import dataclasses

import numpy as np
import pytest
from servo_arm import TRUTH, identified, true_path, wandering, write_arm

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.actuator_choice import Choice, ReplayErrors, ReplayRow, _summaries, choose_actuators
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.robots.description import RobotDescription


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def motions(robot: RobotDescription) -> list[Motion]:
    found = []
    for name, seed, steps in (("near-1", 0, 60), ("far-1", 1, 110)):
        commands = wandering(seed, steps)
        qpos, qvel = true_path(robot, identified(robot, **TRUTH), commands)
        states = (np.concatenate([np.zeros((1, 2)), x[9::10]]) for x in (qpos, qvel))
        found.append(Motion(name, np.arange(steps + 1) * 0.05, commands, *states, fit_error_mm={}, joints=robot.joints))
    return found


def test_actuators_that_replay_better_are_chosen(robot: RobotDescription, motions: list[Motion]):
    truth = identified(robot, **TRUTH)
    choice = choose_actuators(robot, truth, motions)
    assert choice.improves and choice.actuators is truth and choice.ratio < 0.1
    assert choice.decides == "joints" and not choice.worse
    assert [(row.group, row.horizon, row.starts) for row in choice.rows] == [
        ("near", 1.0, 3),
        ("far", 1.0, 5),
        ("far", 5.0, 1),
    ]
    # With the true actuators only the drivetrain's unknown state at later starts leaves an error.
    assert choice.rows[2].identified.joints < 0.01 * choice.rows[2].nominal.joints
    assert "better than nominal" in choice.table() and "WORSE" not in choice.table()


def test_actuators_that_replay_worse_are_reported_and_not_chosen(robot: RobotDescription, motions: list[Motion]):
    choice = choose_actuators(robot, identified(robot, shoulder_scale=1.4, mass=0.08), motions)
    assert not choice.improves and choice.actuators is None and choice.ratio > 1.2
    assert any(text.startswith("joint angles of near recordings over 1 s") for text in choice.worse)
    assert "WORSE than nominal" in choice.table()


def test_actuators_with_more_diverged_replays_are_not_chosen(robot: RobotDescription, motions: list[Motion]):
    choice = choose_actuators(robot, identified(robot, **TRUTH), motions)
    diverged = [row._replace(identified=row.identified._replace(diverged=1)) for row in choice.rows]
    assert not dataclasses.replace(choice, rows=tuple(diverged)).improves


def test_actuators_are_chosen_if_only_nominal_ones_diverge(robot: RobotDescription, motions: list[Motion]):
    choice = choose_actuators(robot, identified(robot, **TRUTH), motions)
    lost = [row._replace(nominal=ReplayErrors(np.inf, np.inf, row.starts)) for row in choice.rows]
    assert dataclasses.replace(choice, rows=tuple(lost)).improves
    both = [row._replace(identified=row.nominal) for row in lost]
    assert dataclasses.replace(choice, rows=tuple(both)).ratio == 1.0


def test_errors_are_compared_over_starts_that_both_simulators_survive():
    # The first simulator loses the two starts that are difficult for the second one.
    first = np.array([[0.1, 0.1], [np.inf, np.inf], [0.3, 0.5], [np.inf, np.inf]])
    second = np.array([[0.1, 0.2], [5.0, 4.0], [0.2, 0.4], [5.0, 4.0]])
    one, other = _summaries(first, second)
    assert (one.position, one.joints, one.diverged) == pytest.approx((0.2, 0.3, 2))
    assert (other.position, other.joints, other.diverged) == pytest.approx((0.15, 0.3, 0))


def test_choice_refuses_recordings_that_are_too_short(robot: RobotDescription, motions: list[Motion]):
    motion = motions[0]
    short = dataclasses.replace(motion, command=motion.command[:10], qpos=motion.qpos[:11], qvel=motion.qvel[:11])
    with pytest.raises(InputError, match=r"near-1: no validation recording lasts 1 s"):
        choose_actuators(robot, identified(robot, **TRUTH), [short])


def test_quantities_that_were_not_recorded_decide_nothing():
    """An anchored robot without recorded hinges is compared by position, and no joint angles are called worse."""
    first = np.array([[0.1, np.nan], [np.inf, np.nan]])
    one, other = _summaries(first, first[::-1])
    assert np.isinf(one.position) and np.isnan(one.joints) and np.isnan(other.joints)
    row = ReplayRow("near", 1.0, 2, one._replace(position=0.1), other._replace(position=0.2, diverged=2))
    choice = Choice(None, (row,), "position")  # pyright: ignore[reportArgumentType]
    assert len(choice.worse) == 1 and choice.worse[0].startswith("position")
