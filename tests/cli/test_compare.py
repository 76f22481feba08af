"""Comparison of runs: grouping by options, confidence intervals over seeds, tables and refused input."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from ballu_mjx.cli import compare
from ballu_mjx.evaluation.errors import HORIZONS, Errors, Evaluation, quotient
from ballu_mjx.evaluation.errors_file import evaluation_to_json
from ballu_mjx.evaluation.seed_intervals import t_interval
from ballu_mjx.runs.folder import Run
from ballu_mjx.runs.layout import RUN_FORMAT

REWARD = {"a0": 1.0, "a1": 1.2, "a2": 1.1, "b0": 0.5, "b1": 0.7}


def write(folder: Path, seed: int, scale: float, reward: float, task: str = "envmimic") -> Path:
    config = {
        "format": RUN_FORMAT,
        "task": task,
        "env": {"force_scale": scale},
        "ppo": {"seed": seed, "num_timesteps": 100 + seed},
        "actuators": None,
        "recordings": {"training": [{"path": "x", "sha256": "1"}]},
        "starts": [],
    }
    with Run(folder, config) as run:
        run.log(0, {"validation_error": 1.0})
        for step in range(0, 101, 5):
            run.log(step, {"reward": reward if step > 90 else 0.0})
        run.log(100, {"validation_error": reward / 2})
    errors = [
        Errors(name, name[:4].strip("-"), {h: (x * h, 0.1) for h in HORIZONS}, {h: (x, 0.1) for h in HORIZONS}, 0, 0, 0)
        for name, x in (("near-1", 1.0), ("far-1", 2.0))
    ]
    half = [
        Errors(e.recording, e.group, {h: (v / 2, s) for h, (v, s) in e.position.items()}, e.orientation, 0, 0, 0)
        for e in errors
    ]
    content = evaluation_to_json(Evaluation(tuple(errors), tuple(half)))
    (folder / "evaluation.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def folders(tmp_path: Path) -> list[Path]:
    return [
        write(tmp_path / name, int(name[1]), 0.05 if name[0] == "a" else 1.0, reward) for name, reward in REWARD.items()
    ]


def test_seeds_share_a_row_with_students_confidence_interval(folders: list[Path]):
    found = compare.rows(folders)
    assert [(row.label, len(row.folders)) for row in found] == [("force_scale 0.05", 3), ("force_scale 1.0", 2)]
    figures = [compare.figures(folder) for folder in found[0].folders]
    values = [each["reward at the end"] for each in figures]
    assert values == pytest.approx([1.0, 1.2, 1.1])
    found_interval = t_interval(values)
    expected = stats.t.interval(0.95, 2, loc=np.mean(values), scale=stats.sem(values))
    assert (found_interval.low, found_interval.high) == pytest.approx(expected)
    assert figures[0]["near position, 5 s (ratio)"] == pytest.approx(0.5)
    assert figures[0]["far yaw, 10 s (ratio)"] == pytest.approx(1.0)


def test_compare_writes_a_table_and_a_plot(folders: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert compare.main([*map(str, folders), "--output", str(tmp_path / "out")]) == 0
    text = (tmp_path / "out" / "compare.md").read_text()
    assert text.strip() in capsys.readouterr().out
    assert "| force_scale 0.05 | 3 | 1.100 ± 0.248 |" in text
    assert "± is half the 95% confidence interval" in text
    assert (tmp_path / "out" / "compare.png").stat().st_size > 10_000


def test_fits_without_a_reward_are_compared_without_a_plot(folders: list[Path], tmp_path: Path, capsys):
    fits = []
    for number, folder in enumerate(folders[:2]):
        config = {
            "format": RUN_FORMAT,
            "task": "aerodynamic",
            "fit": {"windows": number},
            "actuators": None,
            "starts": [],
        }
        with Run(tmp_path / f"air-{number}", config) as run:
            run.log(0, {"cost": 2.0})
            run.log(1, {"cost": 1.0})
        fits.append(run.folder)
        (run.folder / "evaluation.json").write_bytes((folder / "evaluation.json").read_bytes())
    assert compare.main([*map(str, fits), "--output", str(tmp_path / "out")]) == 0
    assert "| windows 0 |" in (tmp_path / "out" / "compare.md").read_text()
    assert "have no learning curves" in capsys.readouterr().out and not (tmp_path / "out" / "compare.png").exists()


def test_only_runs_of_equal_length_and_different_seeds_share_a_row(folders: list[Path], tmp_path: Path):
    again = write(tmp_path / "again", 0, 0.05, 1.3)
    assert [row.label for row in compare.rows([folders[0], again])] == ["envmimic", f"envmimic ({again})"]
    longer = write(tmp_path / "longer", 3, 0.05, 1.3)
    with (longer / "metrics.jsonl").open("a") as metrics:
        metrics.write(json.dumps({"step": 500, "reward": 1.4}) + "\n")
    assert [row.label for row in compare.rows([*folders[:3], longer])] == ["steps 100", "steps 500"]


def test_runs_that_differ_in_method_or_robot_have_rows_of_their_own(folders: list[Path], tmp_path: Path):
    description = {"path": "/one/arm.robot.json", "sha256": "a" * 64}
    sections = {"start_from": None, "quick": False, "output": "x"}
    for folder in folders[:3]:
        altered(folder, data=sections | {"output": str(folder)}, robot_description=description)
    assert len(compare.rows(folders[:3])) == 1  # places of results do not distinguish runs
    altered(folders[1], data=sections | {"start_from": "runs/supervised"})
    altered(folders[2], data={"start_from": None, "quick": True})
    assert [row.folders for row in compare.rows(folders[:3])] == [(folder,) for folder in folders[:3]]
    altered(folders[1], data=sections, robot_description=description | {"path": "/two/arm.robot.json"})
    assert [row.folders for row in compare.rows(folders[:2])] == [tuple(folders[:2])]
    altered(folders[1], robot_description=description | {"sha256": "b" * 64})
    assert len(compare.rows(folders[:2])) == 2


def test_an_option_that_a_run_lacks_distinguishes_it(folders: list[Path], tmp_path: Path):
    config = json.loads((folders[1] / "config.json").read_text())
    altered(folders[1], env=config["env"] | {"force_cost": 0.1})
    assert len(compare.rows(folders[:2])) == 2


def test_a_single_run_has_no_interval(folders: list[Path], capsys: pytest.CaptureFixture[str]):
    assert compare.main([str(folders[0])]) == 0
    out = capsys.readouterr().out
    assert "| envmimic | 1 | 1.000 |" in out and "±" not in out and "nan" not in out


def test_runs_that_cannot_be_compared_are_refused(
    folders: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    walk = write(tmp_path / "walk", 0, 0.05, 1.0, task="walk")
    (folders[1] / "evaluation.json").write_text('{"vanilla": [{"recording": 3}]}')
    (folders[2] / "metrics.jsonl").write_text("")
    for given, sentence in (
        ([folders[0], walk], "compare runs of one task"),
        ([folders[0], folders[0]], "given twice"),
        ([tmp_path / "nothing"], "there is no run"),
        ([folders[1]], "evaluation.json: is no evaluation"),
        ([folders[2]], "has not trained yet"),
    ):
        assert compare.main([str(folder) for folder in given]) == 2
        error = capsys.readouterr().err
        assert sentence in error and error.count("\n") == 1


def test_ratio_of_errors_is_finite_if_an_error_is_zero() -> None:
    assert quotient(0.0, 0.0) == 1.0
    assert quotient(0.2, 0.1) == pytest.approx(2.0)
    assert 1.0 < quotient(0.1, 0.0) < np.inf


def altered(folder: Path, **changed: object) -> Path:
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changed))
    return folder


def test_methods_and_robots_have_separate_rows(tmp_path: Path):
    one, other = write(tmp_path / "one", 0, 0.05, 1.0), write(tmp_path / "other", 0, 0.05, 1.0)
    altered(other, robot_description={"path": "somewhere/rover.robot.json", "sha256": "2"})
    assert [row.label for row in compare.rows([one, other])] == ["robot ballu", "robot rover"]
    fitted = altered(write(tmp_path / "fitted", 0, 0.05, 1.0), task="fluid", fit={"steps": 3})
    assert [row.label for row in compare.rows([one, fitted])] == ["task envmimic", "task fluid"]
    found = [compare.figures(folder) for folder in (one, fitted)]
    assert "near position, 5 s (ratio)" in compare.table({"envmimic": [found[0]], "fluid": [found[1]]})


def test_tables_show_values_that_some_rows_lack_as_missing():
    near, flight = "near position, 5 s (ratio)", "flight position, 2 s (ratio)"
    rows = {"ballu": [{"mean ratio": 0.4, near: 0.5}], "blimp": [{flight: 0.25, "mean ratio": 0.2}]}
    header, _, one, other, *notes = compare.table(rows).splitlines()
    assert header == f"| | runs | mean ratio | {near} | {flight} |"
    assert one == "| ballu | 1 | 0.400 | 0.500 | - |" and other == "| blimp | 1 | 0.200 | - | 0.250 |"
    assert "Figures of all rows: mean ratio." in "\n".join(notes)
    partly = compare.table({"ballu": [{near: 0.5}, {near: 0.7, "mean ratio": 0.2}]})
    assert "0.600" in partly and "| - |" in partly and "0.200" not in partly
    assert "not measured" not in compare.table({"ballu": [{near: 0.5}], "blimp": [{near: 0.7}]})
