"""What happens to a training whose process is killed, whose checkpoint is damaged, or that is started twice?"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator
from pathlib import Path

import campaign
import numpy as np
import pytest
from campaign import Trainer

from ballu_mjx import runs
from ballu_mjx.errors import InputError


@pytest.fixture(scope="module")
def at() -> Iterator[Trainer]:
    with campaign.trainer() as at:
        yield at


@pytest.fixture(scope="module")
def undisturbed(at: Trainer) -> Path:
    at.finish(at.work / "undisturbed")
    return at.work / "undisturbed"


def test_a_killed_training_ends_as_if_nothing_had_happened(at: Trainer, undisturbed: Path):
    folder, random = at.work / "often", np.random.default_rng()
    moments = [(int(random.integers(first, 20)), random.uniform(0.0, 0.2)) for first in (campaign.EVERY + 1, 1, 1)]
    assert all([at.kill(folder, *moment) for moment in moments[:2]]), "the training was over before it was killed"
    at.kill(folder, *moments[2])
    at.finish(folder)
    rows, _ = campaign.outcome(folder)
    steps = [row["step"] for row in rows]
    assert steps == list(range(campaign.STEP, campaign.STEPS * campaign.STEP + 1, campaign.STEP)), moments
    assert campaign.same(folder, undisturbed), moments


def test_a_second_process_is_refused_until_the_first_is_killed(at: Trainer):
    folder = at.work / "twice"
    process = at.start(folder)
    while process.is_alive() and not runs.read_metrics(folder):
        process.join(0.01)
    before = (folder / "config.json").read_bytes()
    content = {"format": runs.FORMAT, "task": campaign.TASK, "starts": []}
    with pytest.raises(InputError, match="another process is writing"):
        runs.Run(folder, content, resumed_at=0)
    assert process.is_alive() and (folder / "config.json").read_bytes() == before
    process.kill()
    process.join()
    with runs.Run(folder, content, resumed_at=0):
        pass


def test_no_damage_to_the_last_checkpoint_passes_for_its_content(undisturbed: Path, tmp_path: Path, capsys):
    """Every file of it, cut off or with a bit turned: what is read is what was written, or the checkpoint before."""
    last, before = (
        runs._read(undisturbed, step, training=True) for step in reversed(runs.checkpoints(undisturbed)[-2:])
    )
    random, fallen = np.random.default_rng(), 0
    for file in campaign.checkpoint_files(undisturbed):
        folder = tmp_path / "copy"
        shutil.copytree(undisturbed / "checkpoints", folder / "checkpoints")
        what = campaign.damage(folder / file.relative_to(undisturbed), random)
        found = runs.last_checkpoint(folder, training=True)
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
    last = runs.checkpoints(folder)[-1]
    (score,) = (
        path for path in (folder / "checkpoints" / str(last) / "metrics").iterdir() if "score" in path.read_text()
    )
    score.write_text("{")  # over which orbax alone would stumble
    at.finish(folder)
    assert campaign.same(folder, undisturbed)
    assert (
        f"checkpoints/{last}/metrics/metrics: the checkpoint is damaged; taking the one before." in at.told.read_text()
    )


def test_when_every_checkpoint_is_damaged_one_sentence_says_so(undisturbed: Path, tmp_path: Path):
    shutil.copytree(undisturbed / "checkpoints", tmp_path / "checkpoints")
    for record in (tmp_path / "checkpoints").glob("*/record.json"):
        record.write_text("{")
    with pytest.raises(InputError, match="all checkpoints of the run are damaged"):
        runs.last_checkpoint(tmp_path)
    with pytest.raises(InputError, match="the checkpoint is damaged"):
        runs.restore(tmp_path, "best")
