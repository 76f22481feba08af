"""Training and evaluation from the command line: files, refused input, resumption and reproducibility."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fast_compilation import BRIEF

from ballu_mjx.ballu.actuators import CABLE_SLACK, ActuatorParameters
from ballu_mjx.ballu.actuators_file import read_actuators
from ballu_mjx.ballu.sweep import read_sweep
from ballu_mjx.cli import evaluate, train, train_envmimic
from ballu_mjx.identification.actuators import ACTUATORS_FILE
from ballu_mjx.recordings.csv_format import list_bundled, read_recording, write_recording
from ballu_mjx.recordings.recording import Recording, cut
from ballu_mjx.residuals.dataset import _choose, _read
from ballu_mjx.residuals.run_config import describe_recording
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.model import assets
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs.checkpoints import restore_checkpoint
from ballu_mjx.runs.folder import Run
from ballu_mjx.runs.layout import RUN_FORMAT
from ballu_mjx.runs.metrics import read_metrics
from ballu_mjx.runs.progress import Progress

SIZES = {name: value for name, value in train_envmimic.QUICK.items() if name != "num_timesteps"}
"""Sizes of --quick."""
OPTIONS = [text for name, value in SIZES.items() for text in (f"--{name.replace('_', '-')}", str(value))]
_PPO = PPOConfig(**SIZES)
STEPS = _PPO.batch_size * _PPO.unroll_length * _PPO.num_minibatches
"""Number of control steps in a training step with these sizes."""


def command(module: str, *arguments: object, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "ballu_mjx", module, *map(str, arguments)]
    variables = {**os.environ, **BRIEF, **environment}
    return subprocess.run(line, cwd=folder, env=variables, capture_output=True, text=True, timeout=600)


def first_seconds(recording: Recording, duration: float) -> Recording:
    return cut(recording, slice(int((recording.time - recording.time[0] <= duration).sum())))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with two short recordings and their robot's actuators, to which runs are written."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "data").mkdir()
    for path in list_bundled("validation")[1:3]:
        recording = first_seconds(read_recording(path, load_robot()), 6.0)
        write_recording(recording, folder / "data" / f"{recording.name}.csv", load_robot())
    shutil.copy(assets() / "recordings" / ACTUATORS_FILE, folder / "data")
    return folder


@dataclasses.dataclass(frozen=True)
class Stopped:
    """State of a run when it was interrupted."""

    folder: Path
    step: int
    rows: list[dict]
    error: str


@pytest.fixture(scope="module")
def stopped(folder: Path) -> Stopped:
    """Return a run that was interrupted after its first training step, with a validation at every training step."""
    line = [sys.executable, "-m", "ballu_mjx.train", "envmimic", "--recordings", "data", "--output", "run"]
    line += ["--num-timesteps", str(400 * STEPS), "--validate-every", str(STEPS), "--seed", "3", *OPTIONS]
    # Background jobs of a shell ignore SIGINT. If the tests are one, their child processes would ignore it too.
    launcher = (
        "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL); os.execv(sys.argv[1], sys.argv[1:])"
    )
    line = [sys.executable, "-c", launcher, *line]
    metrics = folder / "run" / "metrics.jsonl"
    environment = {**os.environ, **BRIEF}
    with subprocess.Popen(
        line, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as process:
        while process.poll() is None and not (metrics.exists() and '"reward"' in metrics.read_text()):
            time.sleep(0.1)
        os.kill(process.pid, signal.SIGINT)
        error = process.communicate()[1].decode()
    assert process.returncode == 130, error
    step = restore_checkpoint(folder / "run", "last")[0]
    return Stopped(folder / "run", step, read_metrics(folder / "run"), error)


@pytest.fixture(scope="module")
def trained(stopped: Stopped) -> Path:
    """Return the same run after two more training steps."""
    total = stopped.step + 2 * STEPS
    beside = stopped.folder.parent / "data" / ACTUATORS_FILE
    hidden = beside.rename(beside.with_suffix(".hidden"))  # a resumed run keeps its actuators
    done = command("train", "envmimic", "--resume", "run", "--num-timesteps", total, folder=stopped.folder.parent)
    hidden.rename(beside)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout.count("position RMSE") == 1
    assert f"{total:,} of {total:,} steps" in done.stderr
    return stopped.folder


@pytest.mark.slow
def test_interrupted_run_prints_how_to_resume_it(stopped: Stopped):
    assert "--resume run" in stopped.error and "Traceback" not in stopped.error
    assert stopped.step == stopped.rows[-1]["step"] > 0


@pytest.mark.slow
def test_resumed_run_continues_at_the_interrupted_step(stopped: Stopped, trained: Path):
    rows, total = read_metrics(trained), stopped.step + 2 * STEPS
    assert rows[: len(stopped.rows)] == stopped.rows
    assert [row["step"] for row in rows if "reward" in row] == list(range(STEPS, total + STEPS, STEPS))
    config = json.loads((trained / "config.json").read_text())
    # Options and actuators of the first command are kept.
    assert config["ppo"]["seed"] == 3 and config["ppo"]["num_envs"] == SIZES["num_envs"]
    beside = trained.parent / "data" / ACTUATORS_FILE
    assert config["actuators"] == json.loads(beside.read_text())["parameters"]
    assert len(config["starts"]) == 2
    assert restore_checkpoint(trained, "last")[0] == total


@pytest.mark.slow
def test_run_folder_is_complete(trained: Path):
    for name in ("evaluation.txt", "evaluation.json", "learning_curve.png", "tracking.png", "replay.npz"):
        assert (trained / name).stat().st_size > 500, name
    assert list((trained / "tensorboard").glob("events.out.tfevents.*"))
    assert not [path for path in trained.rglob("*") if path.suffix in (".pkl", ".pickle", ".tmp")]
    last = restore_checkpoint(trained, "last")[0]
    rows = read_metrics(trained)
    validated = {row["step"]: row["validation_error"] for row in rows if "validation_error" in row}
    assert list(validated) == list(range(0, last + STEPS, STEPS))
    assert restore_checkpoint(trained, "best")[0] == min(validated, key=lambda step: validated[step])
    config = json.loads((trained / "config.json").read_text())
    assert [Path(entry["path"]).name for entry in config["recordings"]["test"]] == ["far-2.csv", "near-1.csv"]


@pytest.mark.slow
def test_evaluate_reproduces_the_errors_of_the_training_run(trained: Path):
    done = command("evaluate", "run", "--noise-floor", "--output", "again", folder=trained.parent)
    assert done.returncode == 0, done.stderr
    assert "capture noise of 0.5 mm and 0.3 deg" in done.stdout
    assert (trained / "evaluation.txt").read_text() in done.stdout
    assert "replay of the training recordings (the residual was learned from them): far-2, near-1\n" in done.stdout
    floors = re.findall(r"([\d.]+) m of ([\d.]+) m", done.stdout)
    # Only the errors over 1 s are compared. Over 5 s, there is a single start here, and the order is random.
    assert len(floors) == 6 and all(0 < float(floor) < float(error) for floor, error in floors[::3])
    stored, repeated = (
        json.loads((run / "evaluation.json").read_text()) for run in (trained, trained.parent / "again")
    )
    assert stored == repeated


@pytest.fixture(scope="module")
def identified(folder: Path) -> Path:
    """Return a quick run of sysid on the bundled sweep."""
    done = command("train", "sysid", "--quick", "--output", "identified", folder=folder)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert (folder / "identified" / "identification.txt").read_text().strip() in done.stdout
    return folder / "identified"


@pytest.mark.slow
def test_sysid_reduces_the_error_on_the_sweep_and_writes_actuators(identified: Path):
    assert (identified / "actuator_curves.png").stat().st_size > 10_000
    name, parameters = read_actuators(identified / ACTUATORS_FILE)
    assert name == "virtual-ballu-0"
    # The sweep shows these values directly: the knee stops, and the motor angles at command 0.
    assert np.rad2deg(parameters.default_knee_angle) == pytest.approx([32.2, 26.0], abs=1.0)
    assert np.rad2deg(parameters.default_motor_angle) == pytest.approx([1.4, -5.9], abs=2.5)
    text = (identified / "identification.txt").read_text()
    before, after = (float(x) for x in re.findall(r"([0-9.]+) deg (?:before|after)", text))
    assert after < before / 4


def test_bundled_actuators_come_from_the_bundled_sweep():
    path = assets() / "recordings" / ACTUATORS_FILE
    sweep = read_sweep({p: read_recording(p, load_robot()) for p in list_bundled("suspended")})
    name, _ = read_actuators(path)
    assert name == sweep.robot
    sources = json.loads(path.read_text())["source"]
    assert sources == [describe_recording(p) for p in list_bundled("suspended")]


@pytest.mark.slow
def test_envmimic_uses_identified_actuators_beside_the_recordings(trained: Path):
    stored = json.loads((trained / "config.json").read_text())["actuators"]
    assert stored == json.loads((trained.parent / "data" / ACTUATORS_FILE).read_text())["parameters"]
    loaded = TrainedResidual.load(trained, load_robot(), "last").actuators
    assert isinstance(loaded, ActuatorParameters) and np.asarray(loaded.motor_gain) == pytest.approx(
        stored["motor_gain"]
    )
    assert "vanilla+sysid" in (trained / "evaluation.txt").read_text()


def test_actuators_files_without_cable_slack_get_the_nominal_slack(tmp_path: Path):
    content = json.loads((assets() / "recordings" / ACTUATORS_FILE).read_text())
    del content["parameters"]["cable_slack"]
    (tmp_path / "old.json").write_text(json.dumps(content))
    assert read_actuators(tmp_path / "old.json")[1].cable_slack == pytest.approx(CABLE_SLACK)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "other"}, '"format" is not'),
        ({"robot": "virtual-ballu-9"}, "are the actuators of 'virtual-ballu-9'"),
        ({"parameters": None}, '"parameters" is missing'),
        ({"motor_gain": [0.5]}, "motor_gain must be two numbers"),
        ({"motor_gain": [0.5, -0.5]}, "must be greater than 0"),
        ({"default_knee_angle": [27.0, 27.0]}, "give it in radians"),
        ({"cable_slack": [1.0, 1.0]}, "in metres"),
        ({"knee_damping": [5e3, 5e3]}, "knee_damping is [5000.0, 5000.0]; it must be 1000 or less"),
        ({"gain": [1.0, 1.0]}, "there is no parameter 'gain'"),
    ],
)
def test_damaged_actuators_are_refused(tmp_path: Path, folder: Path, change: dict, message: str):
    content = json.loads((assets() / "recordings" / ACTUATORS_FILE).read_text())
    for key, value in change.items():
        (content if key in content else content["parameters"])[key] = value
    (tmp_path / "bad.json").write_text(json.dumps(content))
    arguments = ["envmimic", "--recordings", str(folder / "data"), "--actuators", str(tmp_path / "bad.json")]
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors):
        assert train.main([*arguments, "--output", str(tmp_path / "run")]) == 2
    assert message in errors.getvalue() and "bad.json" in errors.getvalue() and errors.getvalue().count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_quick_validates_on_training_recordings_if_no_others_are_given(folder: Path):
    files = _choose(train_envmimic.Data(recordings=(folder / "data",), quick=True), load_robot(), None)
    assert len(files["training"]) == 2 and files["validation"] == files["training"] == files["test"]
    _read(files, load_robot())
    data = train_envmimic.Data(recordings=(folder / "data",), test=(files["training"][0],), quick=True)
    assert _choose(data, load_robot(), None)["test"] == files["training"][:1]


def test_help_lists_the_options_of_envmimic(folder: Path):
    done = command("train", "envmimic", "--help", folder=folder, PYTHONPROFILEIMPORTTIME="1")
    assert done.returncode == 0
    # Packages that take a second to import, and that this command needs later or never.
    imported = {line.split("|")[-1].strip() for line in done.stderr.splitlines() if line.startswith("import time:")}
    assert "ballu_mjx.residuals.envmimic" in imported
    assert not imported & {"matplotlib", "optimistix", "scipy.signal", "scipy.stats", "ballu_mjx.ballu.virtual"}
    for option in ("--quick", "--recordings", "--validation", "--test", "--seed", "--output", "--num-timesteps"):
        assert option in done.stdout
    for option in ("--num-envs", "--resume", "--force-limit", "--learning-rate", "of Adam"):
        assert option in done.stdout


def test_wrong_path_is_refused_in_one_sentence(folder: Path):
    done = command("train", "envmimic", "--recordings", "nowhere", folder=folder)
    assert done.returncode == 2
    assert done.stderr == "nowhere: there is no such file or folder; check the path.\n"
    assert done.stdout == ""
    assert not (folder / "runs").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--recordings", "data", "--num-envs", "7"], "--num-envs is 7"),
        (["--recordings", "data", "--test", "data/near-1.csv"], "is among the training and the test recordings"),
        (["--recordings", "{suspended}"], "residuals need free recordings"),
        (["--recordings", "data", "--output", "data"], "data: the folder is not empty"),
        (["--resume", "data"], "data: there is no run"),
        (["--resume", "run"], " already"),
        (["--resume", "run", "--quick"], "--quick does not go with --resume"),
        (["--resume", "run", "--policy-layers", "8"], "--policy-layers does not go with --resume"),
        (["--recordings", "short.csv"], "lasts 3.0 s; validation and test need"),
    ],
)
def test_unsuitable_input_is_refused_in_one_sentence(trained, monkeypatch, capsys, arguments, sentence):
    monkeypatch.chdir(trained.parent)
    if "short.csv" in arguments:
        write_recording(
            first_seconds(read_recording(Path("data/near-1.csv"), load_robot()), 3.0), "short.csv", load_robot()
        )
    suspended = str(list_bundled("suspended")[0])
    assert train.main(["envmimic", *(a.format(suspended=suspended) for a in arguments)]) == 2
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1


@pytest.mark.slow
def test_evaluate_refuses_a_changed_recording(trained, monkeypatch, capsys):
    monkeypatch.chdir(trained.parent)
    path = Path("data/near-1.csv")
    content = path.read_bytes()
    path.write_bytes(content + b"\n")
    try:
        assert evaluate.main(["run"]) == 2
    finally:
        path.write_bytes(content)
    assert "has changed since run/config.json was written" in capsys.readouterr().err


def test_last_three_scored_checkpoints_the_best_and_the_last_are_kept(tmp_path: Path):
    with Run(tmp_path / "run", {"format": RUN_FORMAT, "task": "envmimic", "starts": []}) as run:
        for step, score in enumerate([0.9, 0.5, 0.7, 0.8, float("nan"), 0.6]):
            run.save(step, {"x": np.full(3, step)}, score)
        run.save(6, {"x": np.full(3, 6)}, None)
    assert sorted(int(path.name) for path in (tmp_path / "run" / "checkpoints").iterdir()) == [1, 3, 4, 5, 6]
    for (step, tree), expected in (
        (restore_checkpoint(tmp_path / "run", "best"), 1),
        (restore_checkpoint(tmp_path / "run", "last"), 6),
    ):
        assert step == expected
        np.testing.assert_array_equal(tree["x"], np.full(3, expected))


def test_progress_is_readable_in_a_file(monkeypatch):
    clock = iter(np.arange(0.0, 1000.0, 4.0))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(clock)))
    stream = io.StringIO()
    progress = Progress(1000, stream=stream)
    for step in range(100, 1100, 100):
        progress.update(step, 25.0, f"reward {step / 1000:.3f}")
    lines = stream.getvalue().splitlines()
    assert [line.split()[0] for line in lines] == ["100", "400", "700", "1,000"]
    assert lines[1] == "400 of 1,000 steps, 25 steps/s, 0:00:24 left, reward 0.400"
