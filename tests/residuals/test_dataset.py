"""Use of recordings for training, validation and test: warnings and errors."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.recording import cut
from ballu_mjx.residuals.aerodynamics import Aerodynamics
from ballu_mjx.residuals.dataset import (
    USES,
    RecordingsData,
    ResidualDataset,
    check_overlap,
    check_recording,
    replay_title,
)
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.observation import HISTORY
from ballu_mjx.sim.simulator import Simulator

ONE, TWO, THREE, FOUR = list_bundled("training")[:2] + list_bundled("test")[:2]


def prepared(training: list[Path], validation: list[Path], test: list[Path]) -> ResidualDataset:
    data = RecordingsData(recordings=tuple(training), validation=tuple(validation), test=tuple(test))
    return ResidualDataset.read(data, load_robot())


@pytest.mark.parametrize(
    ("validation", "test", "warnings", "replayed"),
    [
        ([THREE], [FOUR], [], "of the test recordings"),
        ([THREE, FOUR], [FOUR, THREE], ["test is on the validation"], "of the validation recordings (they chose the"),
        ([ONE], [FOUR], ["Validation is on the training"], "of the test recordings"),
        ([THREE], [ONE], ["test is on the training"], "of the training recordings"),
        ([ONE], [ONE], ["Validation is on the training", "test is on the training"], "of the training recordings"),
    ],
)
def test_recordings_with_two_uses_give_warnings(
    validation: list[Path], test: list[Path], warnings: list[str], replayed: str
) -> None:
    found = prepared([ONE], validation, test)
    assert len(found.reused) == len(warnings) and all(
        part in line for part, line in zip(warnings, found.reused, strict=True)
    )
    assert replayed in found.replayed


def test_title_of_a_replay_counts_recordings_that_are_not_new() -> None:
    title = replay_title({"a", "b", "c"}, validation={"b", "d"}, training={"e"}, otherwise="other recordings")
    assert title == "Open-loop replay of other recordings (1 of 3 are not new: they chose the checkpoint)"
    assert replay_title({"a"}, {"b"}, {"c"}, "other recordings") == "Open-loop replay of other recordings"


@pytest.mark.parametrize(("one", "other"), list(itertools.combinations(USES, 2)))
def test_two_uses_that_share_only_some_recordings_are_refused(one: str, other: str) -> None:
    files = {use: [path] for use, path in zip(USES, (ONE, THREE, FOUR), strict=True)}
    check_overlap(files)
    files[other] = [*files[one], TWO]
    with pytest.raises(InputError, match=f"among the {one} and the {other} recordings; take it out of one"):
        check_overlap(files)
    files[other] = files[one]
    check_overlap(files)


@pytest.mark.parametrize(("timestep", "shortest"), [(0.05, 5.5), (0.4, 6.2)])
def test_recordings_contain_the_longest_horizon_after_the_first_start(timestep: float, shortest: float) -> None:
    """A start needs a history, which takes longer than half a second if control steps are long."""
    robot = dataclasses.replace(load_robot(), control_timestep=timestep, horizons=(5.0,))
    whole = read_recording(THREE, robot)
    for duration, accepted in ((shortest + 0.05, True), (shortest - 0.05, False)):
        short = cut(whole, slice(int(np.searchsorted(whole.time, whole.time[0] + duration))))
        steps = math.floor((short.time[-1] - short.time[0]) / timestep)
        if accepted:
            check_recording(THREE, short, robot, long_enough=True)
            assert steps - (HISTORY - 1) >= round(5.0 / timestep)
        else:
            with pytest.raises(InputError, match=f"validation and test need {shortest:g} s or more"):
                check_recording(THREE, short, robot, long_enough=True)


@pytest.mark.parametrize(
    ("horizons", "steps", "words"),
    [
        ((), HISTORY + 10, "has 13 control steps.*shortest horizon .1 s. needs 22"),
        ((1.5, 0.5), HISTORY + 10, None),
        ((1.5,), HISTORY + 28, "has 31 control steps.*shortest horizon .1.5 s. needs 32"),
        ((1.5,), HISTORY + 29, None),
    ],
)
def test_a_motion_shorter_than_the_shortest_horizon_is_refused(
    horizons: tuple[float, ...], steps: int, words: str | None
) -> None:
    robot = dataclasses.replace(load_robot(), horizons=horizons)
    model = robot.load_model()
    qpos, command = np.tile(model.qpos0, (steps + 1, 1)), np.zeros((steps, 2))
    motion = Motion("blink", np.arange(steps + 1) * 0.05, command, qpos, np.zeros((steps + 1, model.nv)), {})
    simulator = Simulator(robot)
    long = dataclasses.replace(
        motion, name="long", time=np.arange(41) * 0.05, command=np.zeros((40, 2)), qpos=np.tile(model.qpos0, (41, 1)),
        qvel=np.zeros((41, model.nv)),
    )  # fmt: skip
    residual = Aerodynamics(robot, simulator.mj_model)
    if words is None:
        OpenLoopEvaluator(simulator, [long, motion], residual)
    else:
        with pytest.raises(InputError, match=f"blink: {words}"):
            OpenLoopEvaluator(simulator, [long, motion], residual)


def test_bundled_recordings_of_different_uses_do_not_overlap() -> None:
    """Recordings of different uses have different commands, so no test repeats a gait of the training recordings."""
    files = {use: list_bundled(use) for use in USES}
    commands = {
        use: {read_recording(path, load_robot()).command.tobytes() for path in paths} for use, paths in files.items()
    }
    assert sum(map(len, commands.values())) >= 12
    for one, other in itertools.combinations(USES, 2):
        assert not commands[one] & commands[other], f"{one} and {other}"
