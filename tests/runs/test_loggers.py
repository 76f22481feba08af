"""Logging of metrics to JSON lines, TensorBoard, and Weights & Biases."""

import importlib.util
import json
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]

from ballu_mjx.cli import train
from ballu_mjx.runs.folder import Run
from ballu_mjx.runs.layout import RUN_FORMAT
from ballu_mjx.runs.loggers import Logger
from ballu_mjx.runs.metrics import read_metrics

LOGGED = [(20, {"reward": 0.25, "loss": float("nan")}), (20, {"validation_error": 0.5}), (40, {"reward": 0.75})]
FINITE = {("reward", 20): 0.25, ("validation_error", 20): 0.5, ("reward", 40): 0.75}
has_wandb = pytest.mark.skipif(importlib.util.find_spec("wandb") is None, reason="wandb is not installed")


def open_run(folder: Path, **options) -> Run:
    config = {"format": RUN_FORMAT, "task": "walk", "ppo": {"seed": 7}, "starts": []}
    return Run(folder, config, **options)


def log(logger: Logger | Run, logged=LOGGED) -> None:
    for step, metrics in logged:
        logger.log(step, metrics)


def tensorboard_values(folder: Path) -> dict[tuple[str, int], float]:
    """Return the values in event files. Their records consist of length, checksum, event and checksum."""
    found = {}
    for path in folder.glob("events.out.tfevents.*"):
        content, offset = path.read_bytes(), 0
        while offset < len(content):
            (length,) = struct.unpack_from("<Q", content, offset)
            event = Event.FromString(content[offset + 12 : offset + 12 + length])
            found |= {(value.tag, event.step): value.simple_value for value in event.summary.value}
            offset += length + 16
    return found


def wandb_records(folder: Path) -> Iterator:
    """Yield the records that would be uploaded, from all parts of an offline run."""
    import wandb
    from wandb.proto.wandb_internal_pb2 import Record  # pyright: ignore[reportAttributeAccessIssue]
    from wandb.sdk.internal.datastore import DataStore

    wandb.teardown()  # makes its process write the last records
    for path in sorted(folder.glob("wandb/offline-run-*/*.wandb")):
        store = DataStore()
        store.open_for_scan(str(path))
        while (data := store.scan_data()) is not None:
            yield Record.FromString(data)
        store.close()


def wandb_history(folder: Path) -> dict[tuple[str, int], float]:
    found = {}
    for record in wandb_records(folder):
        items = {item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.history.item}
        step = items.get("_step")
        found |= {(name, step): value for name, value in items.items() if not name.startswith("_")}
    return found


def test_json_lines_and_tensorboard_hold_the_same_metrics(tmp_path: Path):
    with open_run(tmp_path / "run") as run:
        log(run)
    assert tensorboard_values(tmp_path / "run" / "tensorboard") == FINITE
    rows = read_metrics(tmp_path / "run")
    assert rows == [{"step": 20, "reward": 0.25, "loss": None}, {"step": 20, "validation_error": 0.5},
                    {"step": 40, "reward": 0.75}]  # fmt: skip


@has_wandb
def test_weights_and_biases_receives_the_metrics_on_request(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    with open_run(tmp_path / "run", wandb="balloons") as run:
        log(run, LOGGED[:2])
    with open_run(tmp_path / "run", wandb="balloons", resumed_at=20) as run:
        log(run, LOGGED[2:])
    assert wandb_history(tmp_path / "run") == FINITE
    runs = [record.run for record in wandb_records(tmp_path / "run") if record.HasField("run")]
    assert len({run.run_id for run in runs}) == 1, "a resumed run must be the same run in Weights & Biases"
    assert runs[0].project == "balloons" and runs[0].display_name == "run"
    config = {item.key or item.nested_key[0]: json.loads(item.value_json) for item in runs[0].config.update}
    assert config["ppo"] == {"seed": 7}
    exits = [record.exit.exit_code for record in wandb_records(tmp_path / "run") if record.HasField("exit")]
    assert exits == [0, 0]


@has_wandb
def test_weights_and_biases_receives_the_exit_code_of_a_failed_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    with pytest.raises(ZeroDivisionError), open_run(tmp_path / "run", wandb="balloons"):
        raise ZeroDivisionError
    exits = [record.exit.exit_code for record in wandb_records(tmp_path / "run") if record.HasField("exit")]
    assert exits == [1]


@pytest.mark.parametrize("task", ["sysid", "envmimic", "walk"])
def test_missing_wandb_package_is_reported_before_training(task, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "wandb", None)  # as if it were not installed
    output = tmp_path / "run"
    assert train.main([task, "--quick", "--wandb", "balloons", "--output", str(output)]) == 2
    error = capsys.readouterr().err
    assert "--wandb balloons: the package wandb is not installed" in error and error.count("\n") == 1
    assert not output.exists()
