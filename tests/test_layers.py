"""Tests of the package's layers: folders import only folders below them, and general code depends on no robot."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import ballu_mjx

PACKAGE = Path(ballu_mjx.__file__).parent
LAYERS = (
    "cli",
    "ballu",
    "viz",
    "policies",
    "residuals",
    "evaluation",
    "identification",
    "recordings",
    "rl",
    "sim",
    "runs",
    "robots",
    "common",
)
"""Folders of the package. Each may import itself and those after it."""
ROBOT_WORDS = re.compile(
    r"\b(balloons?|knees?|servos?|foot|feet|legs?)\b|_(balloon|knee|servo|foot|feet|leg)s?\b", re.I
)
"""Pattern of BALLU's parts, which general code must not name."""


def modules() -> Iterator[tuple[str, Path]]:
    """Yield folder and path of each module in a layer."""
    for path in sorted(PACKAGE.rglob("*.py")):
        folder, *rest = path.relative_to(PACKAGE).parts
        if rest:
            yield folder, path


def imported_folders(path: Path) -> Iterator[tuple[str, int]]:
    """Yield the imported folder and the line of each import from this package."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "ballu_mjx":
            parts = node.module.split(".")
            for name in [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]:
                yield name, node.lineno
        elif isinstance(node, ast.Import):
            for alias in node.names:
                parts = alias.name.split(".")
                if parts[0] == "ballu_mjx" and len(parts) > 1:
                    yield parts[1], node.lineno


def test_every_folder_is_a_layer():
    assert {folder for folder, _ in modules()} == set(LAYERS)


def test_folders_import_only_folders_below_them():
    wrong = [
        f"{path.relative_to(PACKAGE)}:{line} imports {other}"
        for folder, path in modules()
        for other, line in imported_folders(path)
        if other in LAYERS and LAYERS.index(other) < LAYERS.index(folder)
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("folder", [layer for layer in LAYERS if layer not in ("ballu", "cli")])
def test_general_code_names_no_parts_of_ballu(folder: str):
    found = []
    for path in sorted((PACKAGE / folder).rglob("*.py")):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if ROBOT_WORDS.search(line):
                found.append(f"{path.relative_to(PACKAGE)}:{number}: {line.strip()}")
    assert not found, "\n".join(found)


def test_general_code_does_not_check_which_robot_it_has():
    pattern = re.compile(r"is_ballu|== *[\"']ballu[\"']|== *[\"']BALLU[\"']|isinstance\([^)]*Ballu\b")
    for folder, path in modules():
        if folder != "ballu":
            assert not pattern.search(path.read_text(encoding="utf-8")), path
