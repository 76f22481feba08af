"""What happens to a training that is killed or started twice, whose checkpoint is damaged, whose disk is full?"""

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


def test_a_killed_training_ends_as_if_nothing_had_happened(at: Trainer, undisturbed: Path):
    random = np.random.default_rng(0)
    moments = [(int(random.integers(first, 20)), random.uniform(0.0, 0.2)) for first in (campaign.EVERY + 1, 1, 1)]
    for attempt in range(10):  # a busy machine may let a training end before it is killed: then anew
        folder = at.work / f"often-{attempt}"
        if all([at.kill(folder, *moment) for moment in moments]):
            break
    else:
        pytest.fail("ten trainings were over before they were killed")
    at.finish(folder)
    rows, _ = campaign.outcome(folder)
    steps = [row["step"] for row in rows if "total_loss" in row]
    assert steps == list(range(campaign.STEP, campaign.STEPS * campaign.STEP + 1, campaign.STEP)), moments
    assert campaign.same(folder, undisturbed), moments


def test_the_same_training_again_gives_the_same_numbers_to_the_bit(at: Trainer, undisturbed: Path):
    at.finish(at.work / "again")
    assert campaign.same(at.work / "again", undisturbed)
    rows, _ = campaign.outcome(undisturbed)
    losses = [row["total_loss"] for row in rows if "total_loss" in row]
    assert len(set(losses)) == len(losses) == campaign.STEPS, "nothing was learned that could differ"


def test_a_second_process_is_refused_until_the_first_is_killed(at: Trainer):
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


def test_no_damage_to_the_last_checkpoint_passes_for_its_content(undisturbed: Path, tmp_path: Path, capsys):
    """Every file of it, cut off or with a bit turned: what is read is what was written, or the checkpoint before."""
    last, before = (_read(undisturbed, step, training=True) for step in reversed(list_checkpoints(undisturbed)[-2:]))
    random, fallen = np.random.default_rng(0), 0
    for file in campaign.checkpoint_files(undisturbed):
        folder = tmp_path / "copy"
        shutil.copytree(undisturbed / "checkpoints", folder / "checkpoints")
        what = campaign.damage(folder / file.relative_to(undisturbed), random)
        found = last_checkpoint(folder, training=True)
        expected = last if found.step == last.step else before
        message = f"{file.name} {what}"
        for name, value in dataclasses.asdict(expected).items():
            np.testing.assert_equal(getattr(found, name), value, err_msg=message)
        said = capsys.readouterr().err
        fallen += found.step == before.step
        assert said.count("\n") == said.count("is damaged; taking the one before") == (found.step == before.step), (
            message
        )
        shutil.rmtree(folder)
    assert fallen > 10


def test_training_goes_on_from_the_checkpoint_before_a_damaged_one(at: Trainer, undisturbed: Path):
    folder = at.work / "damaged"
    shutil.copytree(undisturbed, folder)
    last = list_checkpoints(folder)[-1]
    (score,) = (
        path for path in (folder / "checkpoints" / str(last) / "metrics").iterdir() if "score" in path.read_text()
    )
    score.write_text("{")  # over which orbax alone would stumble
    at.finish(folder)
    assert campaign.same(folder, undisturbed)
    assert (
        f"checkpoints/{last}/metrics/metrics: the checkpoint is damaged; taking the one before." in at.told.read_text()
    )


def test_checkpoints_that_were_exchanged_are_not_taken(undisturbed: Path, tmp_path: Path, capsys):
    """Whole ones: every file of them is as it was written."""
    shutil.copytree(undisturbed / "checkpoints", tmp_path / "checkpoints")
    steps = list_checkpoints(tmp_path)
    one, other, aside = (tmp_path / "checkpoints" / name for name in (str(steps[-1]), str(steps[-2]), "aside"))
    for old, new in ((one, aside), (other, one), (aside, other)):
        old.rename(new)
    assert last_checkpoint(tmp_path).step == steps[-3]
    said = capsys.readouterr().err
    assert f"the checkpoint is that of step {steps[-2]}" in said and said.count("\n") == 2


def test_a_full_disk_ends_training_in_a_sentence_and_loses_nothing(at: Trainer, undisturbed: Path):
    with campaign.small_disk(at.work, campaign.DISK) as disk:
        if disk is None:
            pytest.skip("this process may not mount a small disk")
        assert campaign.full_disk(at, undisturbed, disk, campaign.EVERY + 3, free=3000)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize(("saved", "then"), [(True, "the checkpoint of step 80 is intact"), (False, "start again")])
def test_measurements_that_cannot_be_written_end_a_run_in_a_sentence(tmp_path: Path, saved: bool, then: str):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "metrics.jsonl").symlink_to("/dev/full")
    content = {"format": RUN_FORMAT, "task": campaign.TASK, "starts": []}
    with pytest.raises(InputError) as error, Run(folder, content) as run:
        if saved:
            run.save(80, {"w": np.zeros(3)}, None)
        run.log(160, {"reward": 1.0})
    said = str(error.value)
    assert said.startswith(f"{folder}: its disk is full; make room there, then ") and then in said


def test_when_every_checkpoint_is_damaged_one_sentence_says_so(undisturbed: Path, tmp_path: Path):
    shutil.copytree(undisturbed / "checkpoints", tmp_path / "checkpoints")
    for record in (tmp_path / "checkpoints").glob("*/record.json"):
        record.write_text("{")
    with pytest.raises(InputError, match="all checkpoints of the run are damaged"):
        last_checkpoint(tmp_path)
    with pytest.raises(InputError, match="the checkpoint is damaged"):
        restore_checkpoint(tmp_path, "best")
