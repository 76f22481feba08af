"""Use of recordings for training, validation and test: warnings and errors."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.residuals.dataset import USES, RecordingsData, ResidualDataset, check_overlap, replay_title
from ballu_mjx.robots.registry import load_robot

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


def test_bundled_recordings_of_different_uses_do_not_overlap() -> None:
    """Recordings of different uses have different commands, so no test repeats a gait of the training recordings."""
    files = {use: list_bundled(use) for use in USES}
    commands = {
        use: {read_recording(path, load_robot()).command.tobytes() for path in paths} for use, paths in files.items()
    }
    assert sum(map(len, commands.values())) >= 12
    for one, other in itertools.combinations(USES, 2):
        assert not commands[one] & commands[other], f"{one} and {other}"
