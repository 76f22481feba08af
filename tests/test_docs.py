"""Tests that README and docs are complete, correct in what they name, and short. `mkdocs build --strict` checks their
links."""

import ast
import pkgutil
import re
from pathlib import Path

import prose  # pyright: ignore[reportMissingImports]  # docs/, on pytest's path
import pytest

import ballu_mjx
from ballu_mjx.__main__ import NAMES
from ballu_mjx.cli import completion, record

ROOT = Path(__file__).parents[1]
API = ROOT / "docs" / "api"
PROGRAMS = {"ballu_mjx.__main__", "ballu_mjx.train"}
"""Modules that are run as processes and never imported."""
FOLDERS = ("", "ballu_mjx", "ballu_mjx/recordings/importers", "ballu_mjx/policies", "benchmarks")
"""Folders to which paths on the pages are relative."""
TO_BE_WRITTEN = {"gp.py", "gp_training.py", "train_gp.py", "test_gp.py", "stroll.py", "trc.py"}
"""Files of CONTRIBUTING's worked examples, which do not exist."""
PLACE = re.compile(r"((?:`[\w.]+`(?:,| and)?\s+)+)in\s+`([\w/]+\.py)`")
"""Pattern of functions and classes, and of the file in which a page says they are defined."""
COMMAND = re.compile(r"(?:ballu_mjx[ .]|`)((?:train|record|export) [\w-]+|evaluate|report|view|compare)\b([^`\n#;]*)")
"""Pattern of a command and the text after it, in a page's code."""
WRITTEN = {"example.py"}
"""Files that `export simulator` writes."""
IMAGINED = {"train gp", "train stroll"}
"""Commands of the worked examples, which do not exist."""


def test_reference_lists_every_module_or_its_package():
    pages = "\n".join(path.read_text() for path in API.glob("*.md"))
    named = re.findall(r"^::: (.*)$", pages, re.MULTILINE)
    assert len(named) == len(set(named))
    modules = {module.name for module in pkgutil.walk_packages(ballu_mjx.__path__, "ballu_mjx.") if not module.ispkg}
    assert not {m for m in modules - PROGRAMS if m not in named and m.rpartition(".")[0] not in named}


def test_files_named_in_the_pages_exist():
    names = {path.name for path in ROOT.glob("ballu_mjx/**/*.py")} | {
        path.name for path in ROOT.glob("benchmarks/*.py")
    }
    missing = set()
    for page in prose.pages():
        for path in re.findall(r"[\w./]*\w\.py\b", page.read_text(encoding="utf-8")):
            path = re.sub(r"^(\.\./|RUN/|tour/walk/export/|[.]*/simulator/)+", "", path)
            there = path in names if "/" not in path else any((ROOT / folder / path).exists() for folder in FOLDERS)
            if not there and Path(path).name not in TO_BE_WRITTEN | WRITTEN:
                missing.add(f"{page.relative_to(ROOT)}: {path}")
    assert not missing


def defined(path: Path) -> set[str]:
    """Return the names that a file defines: functions, classes, constants, and members of classes as `Class.member`."""

    def names(body: list[ast.stmt]) -> set[str]:
        found = set()
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.add(node.name)
            if isinstance(node, ast.ClassDef):
                found |= {f"{node.name}.{member}" for member in names(node.body)}
            if isinstance(node, ast.Assign):
                found |= {target.id for target in node.targets if isinstance(target, ast.Name)}
        return found

    return names(ast.parse(path.read_text(encoding="utf-8")).body)


def test_theory_page_names_functions_that_are_defined_in_the_named_file():
    text = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8")
    missing = set()
    for names, file in PLACE.findall(text):
        there = defined(ROOT / "ballu_mjx" / file)
        missing |= {f"{name} in {file}" for name in re.findall(r"`([\w.]+)`", names) if name not in there}
    assert not missing
    sections = text.split("\n## ")[1:]
    without = [s.splitlines()[0] for s in sections if "$$" in s and not PLACE.search(s.partition("$$")[0])]
    assert not without, "the page does not name the code that computes the equation"


def test_commands_and_options_named_in_the_pages_exist():
    script = completion.completion_script("bash", NAMES)
    spec = next(line for line in script.splitlines() if line.startswith("COMPLETION_SPEC = "))
    top = ast.literal_eval(spec.removeprefix("COMPLETION_SPEC = "))["subcommands"]
    parsers = dict(top)
    for name, command in top.items():
        parsers |= {f"{name} {each}": parser for each, parser in command.get("subcommands", {}).items()}
    options = {
        name: {flag for option in parser["options"] for flag in option["flags"]} for name, parser in parsers.items()
    }
    missing = set()
    for page in prose.pages():
        if page.name == "CHANGELOG.md":  # it names former commands and options
            continue
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        for command, rest in COMMAND.findall(text):
            named = {*re.findall(r"--[a-z][\w-]*", rest)}
            if command not in options and command not in IMAGINED:
                missing.add(f"{page.name}: {command}")
            missing |= {f"{page.name}: {command} {flag}" for flag in named - options.get(command, named)}
    assert not missing


def test_page_on_recordings_shows_the_printed_example_mapping(capsys: pytest.CaptureFixture[str]):
    assert record.main(["example-mapping"]) == 0
    assert f"```toml\n{capsys.readouterr().out}```\n" in (ROOT / "docs" / "data.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", prose.pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_no_sentence_in_a_page_is_too_long(page: Path):
    assert prose.long_sentences(page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("page", prose.pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_state_no_results_of_earlier_versions(page: Path):
    assert "earlier version" not in " ".join(page.read_text(encoding="utf-8").split())


def test_sentences_of_the_pages_are_short_on_average():
    assert prose.mean_words() <= prose.MOST_WORDS_ON_AVERAGE


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= prose.README_LINES


def test_word_counts_ignore_markup_code_and_abbreviations():
    text = """# A heading of several words

One `python -m ballu_mjx.train envmimic` here, e.g. this. Two $a + b$ *here*.
- An item without an end
- *Another* item
  that goes on. It has [a link](https://example.org/a.b), i.e. one.

```sh
no sentence. Here.
```

| a cell. Another | |
| --- | --- |
"""
    counts = [prose.count_words(sentence) for sentence in prose.sentences(text)]
    assert counts == [5, 3, 5, 5, 6]
    assert [prose.count_words(s) for s in prose.cell_sentences(text)] == [2, 1]
    assert prose.long_sentences("word " * 36 + "end.") and not prose.long_sentences("word " * 34 + "end.")
