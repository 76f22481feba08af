"""Experiments on public recordings of real robots: each script's short trial run, where the recordings are present."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from experiment_modules import EXPERIMENTS, REAL_DATA, ROOT, needs_real_data
from fast_compilation import FAST

pytestmark = [pytest.mark.slow, needs_real_data]
FRICTION = "nominal", "published friction", "identified"


@pytest.mark.parametrize(
    ("script", "data", "methods"),
    [
        ("double_pendulum/double_pendulum", "double_pendulum/recordings", FRICTION),
        ("double_pendulum/residuals", "double_pendulum/recordings", (*FRICTION, "supervised", "analytic", "EnvMimic")),
        ("compass_gait/compass_gait", "compass_gait/recordings", FRICTION),
        ("go1/go1", ".", ("3 kg",)),
        (
            "rgblimp/rgblimp",
            "rgblimp/recordings",
            ("no air", "published model", "fluid", "EnvMimic", "nearest moments"),
        ),
    ],
)
def test_a_quick_run_writes_a_number_for_every_method(script: str, data: str, methods: tuple[str, ...], tmp_path: Path):
    path = EXPERIMENTS / "real" / f"{script}.py"
    done = subprocess.run(
        [sys.executable, str(path), "--data", str(REAL_DATA / data), "--output", str(tmp_path), "--quick"],
        cwd=ROOT,
        # The blimp's flights are long, so that slow programs cost more time than compiling them well.
        env={**os.environ, **({} if script == "rgblimp/rgblimp" else FAST)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    table = (tmp_path / "table.md").read_text()
    rows = [line.split("|")[1].strip() for line in table.splitlines() if line.startswith("|")]
    assert set(methods) <= set(rows)
    assert "nan" not in table.lower()
