"""Files of results: writing, reading, and rendering of their tables in the pages of the documentation."""

from __future__ import annotations

import json
import math
import shlex
from pathlib import Path

import prose  # pyright: ignore[reportMissingImports]  # docs/, on pytest's path
import pytest
import render  # pyright: ignore[reportMissingImports]

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import Cell, Table, command_line, read_results, write_results

TABLE = Table(("method", "error (m)"), (("one", Cell((0.5, 0.25, 0.75), ".3f")), ("two", Cell((1.0,), ".0f", "m"))))
MARK = "before\n<!-- results: measured errors -->\n| old |\n<!-- /results -->\nafter\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_results(tmp_path / "measured.json", {"errors": TABLE}, "Development data", seeds={"training": [3, 4]})
    return tmp_path


def test_cells_show_mean_range_and_number_of_diverged_values():
    assert Cell((0.5, 0.25, 0.75), ".1f").to_text() == "0.5 [0.2, 0.8]"
    assert Cell((0.5, 0.25, 0.75), ".2f", "m", spread=False).to_text() == "0.50 m"
    assert Cell((5e-7,), ".0e", "mm").to_text() == "5e-07 mm"
    assert Cell((1.0, math.inf)).to_text() == "diverged in 1 of 2"
    assert Cell(()).to_text() == ""
    assert Cell((-0.4, -3.0, 2.0), ".0f").to_text() == "0 [-3, 2]"
    assert Cell((1.0, 3.0), ".1f", bounds=(0.5, 3.5)).to_text() == "2.0 [0.5, 3.5]"
    assert Cell((-1.26,), ".1f", "mm", standard_error=0.34).to_text() == "-1.3 (0.3) mm"
    with pytest.raises(ValueError, match="2 cells"):
        Table(("a", "b"), (("one",),))


def test_results_are_read_as_written_with_their_origin(folder: Path):
    found = read_results(folder / "measured.json")
    assert found.tables == {"errors": TABLE}
    assert found.machine["cores"] > 0 and found.versions["jax"]
    assert found.caption().startswith("Development data. `python ")
    assert found.caption().endswith("Training seeds: 3, 4.")
    infinite = Table(("a",), ((Cell((1.0, math.inf), standard_error=0.5),),))
    write_results(folder / "infinite.json", {"a": infinite}, "Data")
    assert read_results(folder / "infinite.json").tables["a"] == infinite
    assert json.loads((folder / "infinite.json").read_text())["tables"]["a"]["rows"][0][0]["values"] == [1.0, None]


def test_rendering_a_page_twice_changes_nothing(folder: Path):
    page = render.render_page(MARK, folder)
    assert "| one | 0.500 [0.250, 0.750] |" in page and "old" not in page
    assert page.startswith("before\n") and page.endswith("after\n")
    assert render.render_page(page, folder) == page
    captioned = render.render_page(MARK.replace("errors", "errors caption"), folder)
    assert "| one | 0.500" in captioned and "Training seeds: 3, 4." in " ".join(captioned.split())


def test_invalid_marks_and_files_are_refused(folder: Path):
    with pytest.raises(InputError, match="no table 'other'; it has errors"):
        render.render_page(MARK.replace("errors", "other"), folder)
    with pytest.raises(InputError, match="missing.json"):
        render.render_page(MARK.replace("measured", "missing"), folder)
    with pytest.raises(InputError, match="no end"):
        render.render_page(MARK.replace("<!-- /results -->", ""), folder)
    (folder / "measured.json").write_text('{"format": "ballu-results/1"}')
    with pytest.raises(InputError, match="lacks a part"):
        render.render_page(MARK, folder)


@pytest.mark.parametrize("page", prose.pages(), ids=lambda page: str(page.relative_to(prose.ROOT)))
def test_pages_show_the_tables_of_the_results_files(page: Path):
    text = page.read_text(encoding="utf-8")
    assert render.render_page(text) == text, "the page is out of date; run python docs/render.py"


def test_every_results_file_is_shown_in_a_page():
    shown = set().union(*(render.rendered_names(page.read_text(encoding="utf-8")) for page in prose.pages()))
    assert {path.stem for path in render.RESULTS.glob("*.json")} - {"final"} == shown


def test_a_recorded_command_runs_in_a_shell_with_the_same_arguments():
    arguments = ["experiments/x.py", "--methods", "fluid, then supervised", "supervised", "--output", "my runs"]
    assert shlex.split(command_line(arguments)) == ["python", *arguments]
