"""The pages leave nothing out; `mkdocs build --strict` finds what they name in vain."""

import pkgutil
import re
from pathlib import Path

import ballu_mjx

API = Path(__file__).parents[1] / "docs" / "api"
PROGRAMS = {"ballu_mjx.__main__", "ballu_mjx.train", "ballu_mjx.recordings.importers.c3d_process"}
"""Run as processes, imported by nobody."""


def test_every_module_or_its_package_stands_in_the_reference():
    pages = "\n".join(path.read_text() for path in API.glob("*.md"))
    named = re.findall(r"^::: (.*)$", pages, re.MULTILINE)
    assert len(named) == len(set(named))
    modules = {module.name for module in pkgutil.walk_packages(ballu_mjx.__path__, "ballu_mjx.") if not module.ispkg}
    assert not {m for m in modules - PROGRAMS if m not in named and m.rpartition(".")[0] not in named}
