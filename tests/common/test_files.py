"""Files that are written to the end or not at all."""

import multiprocessing
from pathlib import Path

import pytest

from ballu_mjx.common import files

ROUNDS = 200


def write_often(path: Path, letter: str) -> None:
    for _ in range(ROUNDS):
        files.write(path, letter * 4096)


def test_two_processes_that_write_one_file_leave_it_whole(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=write_often, args=(path, letter)) for letter in "ab"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert path.read_text() in ("a" * 4096, "b" * 4096)
    assert [each.name for each in tmp_path.iterdir()] == ["result.json"]


def test_what_cannot_be_written_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space"):
        files.write(tmp_path / "result.json", "text")
    assert not list(tmp_path.iterdir())
