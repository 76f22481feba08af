"""Tests of the final evaluation's seeds. They are drawn once, from a tagged commit."""

from __future__ import annotations

import importlib.util
import json
import subprocess
from pathlib import Path

import pytest

from ballu_mjx.common.errors import InputError

ROOT = Path(__file__).parents[1]
_spec = importlib.util.spec_from_file_location("draw_final", ROOT / "experiments" / "draw_final.py")
assert _spec is not None and _spec.loader is not None
draw_final = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(draw_final)


def git(repository: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    done = subprocess.run(
        ["git", "-C", str(repository), *identity, *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    folder = tmp_path / "repository"
    folder.mkdir()
    git(folder, "init", "-q")
    (folder / "code.py").write_text("x = 1\n")
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", "First")
    git(folder, "tag", "-a", "final-1", "-m", "annotated")
    return folder


def test_seeds_depend_only_on_the_tagged_commit(repository: Path, tmp_path: Path) -> None:
    output = tmp_path / "results" / "final.json"
    found = draw_final.draw_final("final-1", output, repository)
    assert json.loads(output.read_text()) == found
    assert found["commit"] == git(repository, "rev-parse", "HEAD")
    assert found["seeds"] == draw_final.draw_seeds(found["commit"]) != draw_final.draw_seeds("0" * 40)
    seeds = [seed for drawn in found["seeds"].values() for seed in drawn]
    assert len(set(seeds)) == len(seeds) == sum(draw_final.COUNTS.values())
    assert all(10_000 <= seed < 2**31 for seed in seeds), "seeds below 10,000 are those of development"
    assert found["versions"]["jax"] and found["machine"]["cores"]


def test_second_draw_is_refused(repository: Path, tmp_path: Path) -> None:
    output = tmp_path / "final.json"
    draw_final.draw_final("final-1", output, repository)
    before = output.read_bytes()
    with pytest.raises(InputError, match="a final run is made once"):
        draw_final.draw_final("final-1", output, repository)
    assert output.read_bytes() == before


@pytest.mark.parametrize(
    ("tag", "change", "message"),
    [
        ("final-2", "", "there is no such tag"),
        ("final-1", "edit", "has changes .*code.py"),
        ("final-1", "new file", "has changes .*more.py"),
        ("final-1", "commit", "is not the commit that is checked out"),
    ],
)
def test_draw_is_refused_unless_the_tagged_commit_is_checked_out_unchanged(
    repository: Path, tmp_path: Path, tag: str, change: str, message: str
) -> None:
    if change == "new file":
        (repository / "more.py").write_text("y = 2\n")
    elif change:
        (repository / "code.py").write_text("x = 2\n")
    if change == "commit":
        git(repository, "commit", "-q", "-a", "-m", "Second")
    with pytest.raises(InputError, match=message):
        draw_final.draw_final(tag, tmp_path / "final.json", repository)
    assert not (tmp_path / "final.json").exists()


# `final_KIND.json` are tables.
SEEDS = [path for path in sorted((ROOT / "results").glob("final*.json")) if not path.name.startswith("final_")]


@pytest.mark.parametrize("path", SEEDS, ids=lambda path: path.name)
def test_published_seeds_are_those_of_their_commit(path: Path) -> None:
    stored = json.loads(path.read_text())
    assert stored["format"] == draw_final.FORMAT
    assert stored["seeds"] == draw_final.draw_seeds(stored["commit"])
    tagged = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", "--verify", "--quiet", f"refs/tags/{stored['tag']}^{{commit}}"],
        capture_output=True,
        text=True,
    )  # empty in a checkout without tags
    assert tagged.stdout.strip() in ("", stored["commit"])
