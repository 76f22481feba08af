"""Tests that no reader crashes, hangs, accepts invalid content or runs code when a file is damaged."""

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


@pytest.mark.slow
def test_damaged_files_are_refused_by_name_or_valid_for_their_format():
    table, wrong = mutations.campaign(250, seed=1)
    assert not wrong, "\n".join(wrong)
    refused, accepted = (sum(row[outcome] for row in table.values()) for outcome in ("refused", "accepted"))
    assert len(table) >= 22 and refused > 150 and accepted > 30, (
        "both outcomes must occur often, or the damage tests little"
    )


def test_campaign_detects_a_reader_that_hangs(tmp_path: Path):
    def read() -> None:
        while True:
            pass

    path = tmp_path / "file"
    path.write_bytes(b"x")
    form = mutations.Format("endless", path, mutations.BYTES, read, lambda found: None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mutations, "LONGEST", 0.2)
        assert mutations.judge(form) == ("hung", "")


class CreatesFile:
    """Object that creates a file when it is unpickled."""

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
    """Return the list of names that unpickling in this process looks up. Any pickle that calls a function adds one."""
    global watched
    sys.addaudithook(_watch)  # audit hooks cannot be removed
    watched = []
    yield watched
    watched = None


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Return the folder of a valid run."""
    (form,) = (form for form in mutations.formats(tmp_path) if form.name == "config.json of a run")
    return form.file.parent


def resume(folder: Path) -> None:
    with Run(folder, {"format": RUN_FORMAT, "task": "envmimic", "starts": []}, resumed_at=300):
        pass


def read_all(folder: Path) -> None:
    """Read all parts of a run's folder that commands read, also after a refusal."""
    for read in (
        lambda: last_checkpoint(folder, training=True),
        lambda: restore_checkpoint(folder, "best"),
        lambda: report_content.collect(folder),
        lambda: compare.figures(folder),
        lambda: resume(folder),
    ):
        try:
            read()
        except InputError:
            continue


@pytest.mark.slow
def test_no_file_in_a_run_s_folder_runs_code(run: Path, tmp_path: Path, found_classes: list[str]):
    """Each file of a received folder in turn is replaced by a pickle, or by a NumPy file that contains pickles."""
    created = tmp_path / "created"
    pickled = pickle.dumps(CreatesFile(created))
    pickle.loads(pickled)
    assert created.exists() and found_classes, "loading the pickle must create the file"
    created.unlink()
    found_classes.clear()
    archive, array = io.BytesIO(), io.BytesIO()
    np.savez(archive, format=np.array([CreatesFile(created)], object), names=np.array([CreatesFile(created)], object))
    np.save(array, np.array([CreatesFile(created)], object))
    read_all(run)
    files = sorted(path.relative_to(run) for path in run.rglob("*") if path.is_file())
    assert len(files) > 40
    chosen = [path for path in files if "checkpoints" not in path.parts or "300" in path.parts]
    for place in chosen:
        for number, content in enumerate((pickled, archive.getvalue(), array.getvalue())):
            if number and place.suffix != ".npz":
                continue
            folder = shutil.copytree(run, tmp_path / "sent")
            (folder / place).write_bytes(content)
            read_all(folder)
            shutil.rmtree(folder)
            assert not created.exists() and not found_classes, f"{place} ran code"


def test_no_checkpoint_with_the_right_checksums_runs_code(run: Path, tmp_path: Path, found_classes: list[str]):
    """A sender of a folder can also adapt its checksums. Therefore Orbax itself must not unpickle."""
    created = tmp_path / "created"
    place = run / "checkpoints" / "300"
    for file in sorted(path for path in place.rglob("*") if path.is_file() and path.name != "record.json"):
        content = file.read_bytes()
        file.write_bytes(pickle.dumps(CreatesFile(created)))
        record_path = place / "record.json"
        kept = record_path.read_bytes()
        stored = json.loads(kept)
        stored.pop("sha256")
        stored["files"] = file_checksums(place)
        record_path.write_text(json.dumps({**stored, "sha256": record_checksum(stored)}))
        read_all(run)
        file.write_bytes(content)
        record_path.write_bytes(kept)
        assert not created.exists() and not found_classes, f"{file.name} ran code"


def test_no_recording_runs_code(tmp_path: Path, found_classes: list[str]):
    created = tmp_path / "created"
    for name in ("walk.csv", "walk.csv.gz", "walk.json"):
        for ending in (".csv.gz", ".json"):
            shutil.copy(str(list_bundled("test")[0]).removesuffix(".csv.gz") + ending, tmp_path / f"walk{ending}")
        (tmp_path / name).write_bytes(pickle.dumps(CreatesFile(created)))
        path = tmp_path / ("walk.csv" if name == "walk.csv" else "walk.csv.gz")
        with pytest.raises(InputError):
            read_recording(path, load_robot())
        assert record.main(["check", str(path)]) == 2
    assert not created.exists() and not found_classes
