"""Tests of trainings that are killed or started twice, that have damaged checkpoints, or whose disk is full."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator
from pathlib import Path

import campaign
import numpy as np
import pytest
from campaign import Trainer

from ballu_mjx.common.errors import InputError
from ballu_mjx.runs.checkpoints import _read, last_checkpoint, list_checkpoints, restore_checkpoint
from ballu_mjx.runs.folder import Run
from ballu_mjx.runs.layout import RUN_FORMAT
from ballu_mjx.runs.metrics import read_metrics


@pytest.fixture(scope="module")
def at() -> Iterator[Trainer]:
    with campaign.trainer() as at:
        yield at


@pytest.fixture(scope="module")
def undisturbed(at: Trainer) -> Path:
    at.finish(at.work / "undisturbed")
    return at.work / "undisturbed"


@pytest.mark.slow
def test_killed_and_resumed_training_equals_an_undisturbed_one(at: Trainer, undisturbed: Path):
    random = np.random.default_rng(0)
    moments = [(int(random.integers(first, 20)), random.uniform(0.0, 0.2)) for first in (campaign.EVERY + 1, 1, 1)]
    for attempt in range(10):  # on a busy machine a training may end before it is killed
        folder = at.work / f"often-{attempt}"
        if all([at.kill(folder, *moment) for moment in moments]):
            break
    else:
        pytest.fail("ten trainings ended before they were killed")
    at.finish(folder)
    rows, _ = campaign.outcome(folder)
    steps = [row["step"] for row in rows if "total_loss" in row]
    assert steps == list(range(campaign.STEP, campaign.STEPS * campaign.STEP + 1, campaign.STEP)), moments
    assert campaign.same(folder, undisturbed), moments


@pytest.mark.slow
def test_repeated_training_is_equal_to_the_bit(at: Trainer, undisturbed: Path):
    at.finish(at.work / "again")
    assert campaign.same(at.work / "again", undisturbed)
    rows, _ = campaign.outcome(undisturbed)
    losses = [row["total_loss"] for row in rows if "total_loss" in row]
    assert len(set(losses)) == len(losses) == campaign.STEPS, "every training step must have another loss"


def test_second_process_is_refused_until_the_first_has_ended(at: Trainer):
    folder = at.work / "twice"
    process = at.start(folder)
    while process.is_alive() and not read_metrics(folder):
        process.join(0.01)
    before = (folder / "config.json").read_bytes()
    content = {"format": RUN_FORMAT, "task": campaign.TASK, "starts": []}
    with pytest.raises(InputError, match="another process is writing"):
        Run(folder, content, resumed_at=0)
    assert process.is_alive() and (folder / "config.json").read_bytes() == before
    process.kill()
    process.join()
    with Run(folder, content, resumed_at=0):
        pass


@pytest.mark.slow
def test_damaged_last_checkpoint_is_detected(undisturbed: Path, tmp_path: Path, capsys):
    """Each file of it in turn is truncated, or one of its bits is flipped. The reader returns the checkpoint as it was
    written, or the one before it."""
    last, before = (_read(undisturbed, step, training=True) for step in reversed(list_checkpoints(undisturbed)[-2:]))
    random, detected = np.random.default_rng(0), 0
    for file in campaign.checkpoint_files(undisturbed):
        folder = tmp_path / "copy"
        shutil.copytree(undisturbed / "checkpoints", folder / "checkpoints")
        what = campaign.damage(folder / file.relative_to(undisturbed), random)
        found = last_checkpoint(folder, training=True)
        expected = last if found.step == last.step else before
        message = f"{file.name} {what}"
        for name, value in dataclasses.asdict(expected).items():
            np.testing.assert_equal(getattr(found, name), value, err_msg=message)
        message_text = capsys.readouterr().err
        detected += found.step == before.step
        assert (
            message_text.count("\n")
            == message_text.count("is damaged; taking the one before")
            == (found.step == before.step)
        ), message
        shutil.rmtree(folder)
    assert detected > 10


@pytest.mark.slow
def test_training_resumes_from_the_checkpoint_before_a_damaged_one(at: Trainer, undisturbed: Path):
    folder = at.work / "damaged"
    shutil.copytree(undisturbed, folder)
    last = list_checkpoints(folder)[-1]
    (score,) = (
        path for path in (folder / "checkpoints" / str(last) / "metrics").iterdir() if "score" in path.read_text()
    )
    score.write_text("{")  # Orbax itself would fail to read this file
    at.finish(folder)
    assert campaign.same(folder, undisturbed)
    assert (
        f"checkpoints/{last}/metrics/metrics: the checkpoint is damaged; taking the one before." in at.told.read_text()
    )


@pytest.mark.slow
def test_exchanged_checkpoints_are_not_restored(undisturbed: Path, tmp_path: Path, capsys):
    """The folders of the checkpoints are exchanged, but none of their files is changed."""
    shutil.copytree(undisturbed / "checkpoints", tmp_path / "checkpoints")
    steps = list_checkpoints(tmp_path)
    one, other, aside = (tmp_path / "checkpoints" / name for name in (str(steps[-1]), str(steps[-2]), "aside"))
    for old, new in ((one, aside), (other, one), (aside, other)):
        old.rename(new)
    assert last_checkpoint(tmp_path).step == steps[-3]
    message_text = capsys.readouterr().err
    assert f"the checkpoint is that of step {steps[-2]}" in message_text and message_text.count("\n") == 2


@pytest.mark.slow
def test_full_disk_ends_training_with_a_message_and_loses_nothing(at: Trainer, undisturbed: Path):
    with campaign.small_disk(at.work, campaign.DISK) as disk:
        if disk is None:
            pytest.skip("this process may not mount a small disk")
        assert campaign.full_disk(at, undisturbed, disk, campaign.EVERY + 3, free=3000)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize(("saved", "then"), [(True, "the checkpoint of step 80 is intact"), (False, "start again")])
def test_run_ends_with_a_message_if_measurements_cannot_be_written(tmp_path: Path, saved: bool, then: str):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "metrics.jsonl").symlink_to("/dev/full")
    content = {"format": RUN_FORMAT, "task": campaign.TASK, "starts": []}
    with pytest.raises(InputError) as error, Run(folder, content) as run:
        if saved:
            run.save(80, {"w": np.zeros(3)}, None)
        run.log(160, {"reward": 1.0})
    message_text = str(error.value)
    assert message_text.startswith(f"{folder}: its disk is full; make room there, then ") and then in message_text


@pytest.mark.slow
def test_message_says_that_every_checkpoint_is_damaged(undisturbed: Path, tmp_path: Path):
    shutil.copytree(undisturbed / "checkpoints", tmp_path / "checkpoints")
    for record in (tmp_path / "checkpoints").glob("*/record.json"):
        record.write_text("{")
    with pytest.raises(InputError, match="all checkpoints of the run are damaged"):
        last_checkpoint(tmp_path)
    with pytest.raises(InputError, match="the checkpoint is damaged"):
        restore_checkpoint(tmp_path, "best")
