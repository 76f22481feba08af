"""The experiments on public recordings of real robots, where these lie beside the repository."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from ballu_mjx.identification.guard import physics_commands, simulate_motion
from ballu_mjx.identification.residuals import held_motion
from ballu_mjx.robots.description import read_description

ROOT = Path(__file__).parents[1]
REAL = ROOT.parent / "shared" / "real"
SCRIPTS = {
    "double_pendulum": REAL / "double_pendulum" / "recordings",
    "go1": REAL,
    "compass_gait": REAL / "raw" / "compass_gait",
}
"""Folder of its data, by experiment."""


def data_of(name: str) -> Path:
    if not SCRIPTS[name].is_dir():
        pytest.skip(f"{SCRIPTS[name]} is missing: the public recordings of {name} are not here")
    return SCRIPTS[name]


@pytest.fixture(scope="module")
def compass_gait() -> ModuleType:
    sys.path[:0] = [str(ROOT / "experiments" / "real" / "compass_gait")]
    import compass_gait  # pyright: ignore[reportMissingImports]

    return compass_gait


def test_the_walker_s_steps_are_converted_and_its_friction_explains_the_swing(compass_gait: ModuleType, tmp_path: Path):
    """Ten steps a walk, half of them on each leg. Errors are root mean squares, after 0.2 s, of both legs."""
    steps = compass_gait.convert(data_of("compass_gait") / compass_gait.FILE)
    assert {key: len(each) for key, each in steps.items()} == {
        (walk, outer): 5 for walk in range(12) for outer in (True, False)
    }
    robots = {True: read_description(compass_gait.FOLDER / "compass_gait.robot.json")}
    robots[False] = compass_gait.other_leg(tmp_path)
    for outer, robot in robots.items():
        errors = []
        for friction in (False, True):
            model, horizon, apart = robot.load_model(), 20, []
            if friction:
                model.dof_frictionloss[1], model.dof_damping[1] = compass_gait.PUBLISHED.values()
            for walk in compass_gait.TRAINING:
                for step in steps[walk, outer]:
                    motion = held_motion(step, robot, robot.load_model(), compass_gait.SAMPLING)
                    ctrl = physics_commands(None, motion.command, 2, 0.005)
                    qpos, _ = simulate_motion(model, motion, np.array([2]), ctrl, horizon, 2)
                    apart.append(np.cumsum(qpos[0, -1] - motion.qpos[2 + horizon]))
            errors.append(np.rad2deg(np.sqrt(np.mean(np.square(apart), axis=0))))
        (_, without), (stance, swing) = errors
        assert stance < 1.5 and swing < 0.6 * without


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_the_quick_form_of_each_experiment_ends_with_its_table(name: str):
    script = ROOT / "experiments" / "real" / name / f"{name}.py"
    line = [sys.executable, str(script), "--data", str(data_of(name)), "--quick"]
    done = subprocess.run(line, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    table = [row for row in done.stdout.splitlines() if row.startswith("| published friction + supervised |")]
    assert len(table) == 1 and "nan" not in done.stdout.lower()
