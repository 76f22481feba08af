"""Does any reader crash, hang or take nonsense for content where a file is damaged? The campaign's small sister."""

from __future__ import annotations

import io
import json
import pickle
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mutations
import numpy as np
import pytest

from ballu_mjx.cli import compare, record
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs.checkpoints import file_checksums, last_checkpoint, record_checksum, restore_checkpoint
from ballu_mjx.runs.folder import Run
from ballu_mjx.runs.layout import RUN_FORMAT
from ballu_mjx.viz import report_content


def test_damaged_files_are_refused_by_name_or_keep_their_format_s_promises():
    table, wrong = mutations.campaign(250, seed=1)
    assert not wrong, "\n".join(wrong)
    refused, accepted = (sum(row[outcome] for row in table.values()) for outcome in ("refused", "accepted"))
    assert len(table) >= 22 and refused > 150 and accepted > 30, (
        "damage that changes nothing, or everything, tests little"
    )


def test_no_damage_passes_for_a_hang(tmp_path: Path):
    """The campaign sees a reader that does not come to an end."""

    def read() -> None:
        while True:
            pass

    path = tmp_path / "file"
    path.write_bytes(b"x")
    form = mutations.Format("endless", path, mutations.BYTES, read, lambda found: None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mutations, "LONGEST", 0.2)
        assert mutations.judge(form) == ("hung", "")


class Bomb:
    """Loading it leaves a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


watched: list[str] | None = None


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if watched is not None and event == "pickle.find_class":
        watched.append(".".join(map(str, arguments)))


@pytest.fixture
def found_classes() -> Iterator[list[str]]:
    """What unpickling in this process looks for: no pickle that names a function gets by unseen."""
    global watched
    sys.addaudithook(_watch)  # for good: there is no taking it off
    watched = []
    yield watched
    watched = None


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run's folder that is whole."""
    (form,) = (form for form in mutations.formats(tmp_path) if form.name == "config.json of a run")
    return form.file.parent


def go_on(folder: Path) -> None:
    with Run(folder, {"format": RUN_FORMAT, "task": "envmimic", "starts": []}, resumed_at=300):
        pass


def read_all(folder: Path) -> None:
    """Everything that commands read of a run's folder, one after the other whatever is refused."""
    for read in (
        lambda: last_checkpoint(folder, training=True),
        lambda: restore_checkpoint(folder, "best"),
        lambda: report_content.collect(folder),
        lambda: compare.figures(folder),
        lambda: go_on(folder),
    ):
        try:
            read()
        except InputError:
            continue


def test_no_file_of_a_run_s_folder_runs_code(run: Path, tmp_path: Path, found_classes: list[str]):
    """Whatever stands in a folder that somebody sent: each of its files in turn is a pickle, or an archive of them."""
    mark = tmp_path / "exploded"
    bomb = pickle.dumps(Bomb(mark))
    pickle.loads(bomb)
    assert mark.exists() and found_classes, "the bomb is none"
    mark.unlink()
    found_classes.clear()
    archive, array = io.BytesIO(), io.BytesIO()
    np.savez(archive, format=np.array([Bomb(mark)], object), names=np.array([Bomb(mark)], object))
    np.save(array, np.array([Bomb(mark)], object))
    read_all(run)
    files = sorted(path.relative_to(run) for path in run.rglob("*") if path.is_file())
    assert len(files) > 40
    chosen = [path for path in files if "checkpoints" not in path.parts or "300" in path.parts]
    for place in chosen:
        for number, content in enumerate((bomb, archive.getvalue(), array.getvalue())):
            if number and place.suffix != ".npz":
                continue
            folder = shutil.copytree(run, tmp_path / "sent")
            (folder / place).write_bytes(content)
            read_all(folder)
            shutil.rmtree(folder)
            assert not mark.exists() and not found_classes, f"{place} ran code"


def test_no_checkpoint_with_the_right_checksums_runs_code(run: Path, tmp_path: Path, found_classes: list[str]):
    """Somebody who sends a folder can fix its checksums too: orbax itself must not unpickle."""
    mark = tmp_path / "exploded"
    place = run / "checkpoints" / "300"
    for file in sorted(path for path in place.rglob("*") if path.is_file() and path.name != "record.json"):
        content = file.read_bytes()
        file.write_bytes(pickle.dumps(Bomb(mark)))
        record_path = place / "record.json"
        kept = record_path.read_bytes()
        stored = json.loads(kept)
        stored.pop("sha256")
        stored["files"] = file_checksums(place)
        record_path.write_text(json.dumps({**stored, "sha256": record_checksum(stored)}))
        read_all(run)
        file.write_bytes(content)
        record_path.write_bytes(kept)
        assert not mark.exists() and not found_classes, f"{file.name} ran code"


def test_no_recording_runs_code(tmp_path: Path, found_classes: list[str]):
    mark = tmp_path / "exploded"
    for name in ("walk.csv", "walk.csv.gz", "walk.json"):
        for ending in (".csv.gz", ".json"):
            shutil.copy(str(list_bundled("test")[0]).removesuffix(".csv.gz") + ending, tmp_path / f"walk{ending}")
        (tmp_path / name).write_bytes(pickle.dumps(Bomb(mark)))
        path = tmp_path / ("walk.csv" if name == "walk.csv" else "walk.csv.gz")
        with pytest.raises(InputError):
            read_recording(path, load_robot())
        assert record.main(["check", str(path)]) == 2
    assert not mark.exists() and not found_classes
