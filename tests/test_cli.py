"""The commands, from the outside: what they write, what they refuse, and that they repeat themselves."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from ballu_mjx import evaluate, runs, train
from ballu_mjx.recording import Recording, bundled, read_recording, write_recording

SIZES = ("--num-envs 8 --batch-size 8 --num-minibatches 2 --unroll-length 5 --num-updates-per-batch 1").split()
STEPS = 80
"""Control steps of a training step of that size."""


def command(module: str, *arguments: object, folder: Path) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", f"ballu_mjx.{module}", *map(str, arguments)]
    return subprocess.run(line, cwd=folder, capture_output=True, text=True, timeout=600)


def first_seconds(recording: Recording, duration: float) -> Recording:
    rows = recording.time - recording.time[0] <= duration
    values = {field.name: getattr(recording, field.name) for field in dataclasses.fields(recording)}
    cut = {name: value[rows] for name, value in values.items() if isinstance(value, np.ndarray)}
    return dataclasses.replace(recording, **cut)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short recordings, with room for runs beside them."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "data").mkdir()
    for path in bundled("validation")[1:3]:
        recording = first_seconds(read_recording(path), 6.0)
        write_recording(recording, folder / "data" / f"{recording.name}.csv")
    return folder


@pytest.fixture(scope="module")
def trained(folder: Path) -> Path:
    """A run of three training steps, validated at each."""
    done = command(
        "train", "envmimic", "--recordings", "data", "--num-timesteps", 3 * STEPS, "--validate-every", STEPS,
        "--seed", 3, "--output", "run", *SIZES, folder=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout.count("position RMSE") == 1
    assert "240 of 240 steps" in done.stderr
    return folder / "run"


def test_run_folder_is_complete(trained: Path):
    for name in ("evaluation.txt", "evaluation.json", "learning_curve.png", "tracking.png"):
        assert (trained / name).stat().st_size > 500, name
    assert list((trained / "tensorboard").glob("events.out.tfevents.*"))
    assert not [path for path in trained.rglob("*") if path.suffix in (".pkl", ".pickle", ".tmp")]
    rows = runs.read_metrics(trained)
    assert [row["step"] for row in rows if "reward" in row] == [STEPS, 2 * STEPS, 3 * STEPS]
    validated = {row["step"]: row["validation_error"] for row in rows if "validation_error" in row}
    assert list(validated) == [0, STEPS, 2 * STEPS, 3 * STEPS]
    assert runs.restore(trained, "last")[0] == 3 * STEPS
    assert runs.restore(trained, "best")[0] == min(validated, key=lambda step: validated[step])
    config = json.loads((trained / "config.json").read_text())
    assert config["ppo"]["seed"] == 3 and config["ppo"]["num_envs"] == 8
    assert [Path(entry["path"]).name for entry in config["recordings"]["test"]] == ["far-2.csv", "near-1.csv"]


def test_evaluate_repeats_the_same_numbers(trained: Path):
    done = command("evaluate", "run", "--output", "again", folder=trained.parent)
    assert done.returncode == 0, done.stderr
    assert (trained / "evaluation.txt").read_text() in done.stdout
    first, second = (json.loads((f / "evaluation.json").read_text()) for f in (trained, trained.parent / "again"))
    assert first == second


def test_resume_goes_on_where_the_run_stopped(trained: Path):
    before = runs.read_metrics(trained)
    refused = command("train", "envmimic", "--resume", "run", folder=trained.parent)
    assert refused.returncode == 2
    assert refused.stderr == "run: is at step 240 already; give a --num-timesteps above that to train for longer.\n"
    done = command("train", "envmimic", "--resume", "run", "--num-timesteps", 5 * STEPS, folder=trained.parent)
    assert done.returncode == 0, done.stderr
    after = runs.read_metrics(trained)
    assert after[: len(before)] == before
    assert [row["step"] for row in after if "reward" in row] == [n * STEPS for n in (1, 2, 3, 4, 5)]
    config = json.loads((trained / "config.json").read_text())
    assert config["ppo"]["seed"] == 3 and config["ppo"]["num_envs"] == 8  # given once, kept
    assert len(config["starts"]) == 2
    steps = sorted(int(path.name) for path in (trained / "checkpoints").iterdir())
    assert set(steps) >= {3 * STEPS, 5 * STEPS} and len(steps) <= runs.KEPT + 1


def test_interrupted_run_can_go_on(trained: Path):
    line = [sys.executable, "-m", "ballu_mjx.train", "envmimic", "--recordings", "data", "--output", "stopped"]
    line += ["--num-timesteps", str(400 * STEPS), "--validate-every", str(400 * STEPS), *SIZES]
    with subprocess.Popen(line, cwd=trained.parent, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        metrics = trained.parent / "stopped" / "metrics.jsonl"
        while process.poll() is None and not (metrics.exists() and '"reward"' in metrics.read_text()):
            time.sleep(0.2)
        os.kill(process.pid, signal.SIGINT)
        error = process.communicate()[1].decode()
    assert process.returncode == 130, error
    assert "--resume stopped" in error and "Traceback" not in error
    step = runs.restore(trained.parent / "stopped", "last")[0]
    assert step == runs.read_metrics(trained.parent / "stopped")[-1]["step"] > 0


def test_help_explains_every_option(folder: Path):
    done = command("train", "envmimic", "--help", folder=folder)
    assert done.returncode == 0
    for option in ("--quick", "--recordings", "--validation", "--test", "--seed", "--output", "--num-timesteps"):
        assert option in done.stdout
    for option in ("--num-envs", "--resume", "--force-limit", "--learning-rate", "Adam's."):
        assert option in done.stdout


def test_wrong_path_is_refused_in_one_sentence(folder: Path):
    done = command("train", "envmimic", "--recordings", "nowhere", folder=folder)
    assert done.returncode == 2
    assert done.stderr == "nowhere: there is no such file or folder; check the path.\n"
    assert done.stdout == ""
    assert not (folder / "runs").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--recordings", "data", "--num-envs", "7"], "--num-envs is 7"),
        (["--recordings", "data", "--test", "data/near-1.csv"], "is among the training and the test recordings"),
        (["--recordings", "{suspended}"], "EnvMimic takes free ones only"),
        (["--recordings", "data", "--output", "data"], "data: the folder is not empty"),
        (["--resume", "data"], "data: there is no run"),
        (["--resume", "run", "--quick"], "--quick does not go with --resume"),
        (["--resume", "run", "--policy-layers", "8"], "--policy-layers does not go with --resume"),
        (["--recordings", "short.csv"], "lasts 3.0 s; validation and test need"),
    ],
)
def test_input_that_cannot_be_used_is_refused(trained, monkeypatch, capsys, arguments, sentence):
    monkeypatch.chdir(trained.parent)
    if "short.csv" in arguments:
        write_recording(first_seconds(read_recording(Path("data/near-1.csv")), 3.0), "short.csv")
    suspended = str(bundled("suspended")[0])
    assert train.main(["envmimic", *(a.format(suspended=suspended) for a in arguments)]) == 2
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1


def test_changed_recording_is_noticed(trained, monkeypatch, capsys):
    monkeypatch.chdir(trained.parent)
    path = Path("data/near-1.csv")
    content = path.read_bytes()
    path.write_bytes(content + b"\n")
    try:
        assert evaluate.main(["run"]) == 2
    finally:
        path.write_bytes(content)
    assert "has changed since run used it" in capsys.readouterr().err
