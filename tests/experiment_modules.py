"""Experiments as modules, for tests that call their functions."""

from __future__ import annotations

import contextlib
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
EXPERIMENTS = ROOT / "experiments"
REAL_DATA = ROOT.parent / "shared" / "real"
"""Public recordings of real robots, which are not part of the repository."""
needs_real_data = pytest.mark.skipif(not REAL_DATA.is_dir(), reason=f"no recordings of real robots in {REAL_DATA}")


@contextlib.contextmanager
def experiment_module(script: Path) -> Iterator[ModuleType]:
    """Import an experiment from its script, with the modules that experiments share on the path meanwhile."""
    spec = importlib.util.spec_from_file_location(script.stem, script)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXPERIMENTS))
        patch.setitem(sys.modules, script.stem, module)  # dataclasses look up their module there
        spec.loader.exec_module(module)
        yield module
