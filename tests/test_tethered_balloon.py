"""Tests of the experiment with another robot: every residual method trains on it, and every command reads its runs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from experiment_modules import experiment_module

from ballu_mjx.cli import compare, evaluate, export, report, view
from ballu_mjx.evaluation.errors_file import read_evaluation
from ballu_mjx.robots.description import read_description
from ballu_mjx.viz.viser_scene import serve

SCRIPT = Path(__file__).parents[1] / "experiments" / "tethered_balloon" / "tethered_balloon.py"
METHODS = ("envmimic", "envmimic-force", "envmimic-multi", "supervised", "analytic", "aerodynamic", "fluid")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def experiment() -> Iterator[ModuleType]:
    with experiment_module(SCRIPT) as module:
        yield module


@pytest.fixture(scope="module")
def recordings(experiment: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    experiment.record_all(read_description(experiment.DESCRIPTION), folder, quick=True)
    return folder


def test_these_tests_cover_all_methods_of_the_experiment(experiment: ModuleType):
    assert tuple(experiment.METHODS) == METHODS


@pytest.mark.parametrize("method", METHODS)
def test_every_command_reads_the_run_of_each_method(
    method: str, experiment: ModuleType, recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    run = tmp_path / method
    found = experiment.learn(recordings, run, method, seed=0, quick=True)
    assert found.name == experiment.METHODS[method][0]
    assert all(np.isfinite(error.position[1.0][0]) for error in (*found.vanilla, *found.residual))

    assert evaluate.main([str(run), "--output", str(tmp_path / "again")]) == 0
    again = read_evaluation(tmp_path / "again" / "evaluation.json")
    np.testing.assert_allclose(again.score, found.score, rtol=1e-5)

    assert report.main([str(run)]) == 0
    assert "flight-test-0" in (run / "report.html").read_text(encoding="utf-8")

    takes = view.load(run)
    assert [take.name for take in takes] == ["flight-test-0", "turned-test-0"]
    server = serve(0)
    try:
        player = view.Player(server, takes)
        player.advance(1.0)
        assert takes[0].time[player.state] - takes[0].time[0] == pytest.approx(1.0, abs=0.05)
    finally:
        server.stop()

    capsys.readouterr()
    checked = method == "fluid"  # once, because the check compiles another program in double precision
    assert export.main(["simulator", str(run), "--check-seconds", "0.5" if checked else "0"]) == 0
    assert ("C MuJoCo differs from the simulator by" in capsys.readouterr().out) == checked
    assert (run / "simulator" / "identified.xml").exists()
    assert compare.main([str(run)]) == 0
    assert "flight position, 5 s (ratio)" in capsys.readouterr().out
