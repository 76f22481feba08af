"""Experiments on the fidelity of simulators: folders of their results, methods that apply, and starting states."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from experiment_modules import EXPERIMENTS, experiment_module

from ballu_mjx.ballu.actuators import ActuatorParameters
from ballu_mjx.ballu.actuators_file import actuators_to_json
from ballu_mjx.ballu.model import CONTROL_TIMESTEP, load_model
from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.actuators import ACTUATORS_FILE
from ballu_mjx.recordings.csv_format import list_bundled
from ballu_mjx.residuals.aerodynamics import Aerodynamics
from ballu_mjx.robots.model import assets
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.simulator import Simulator

LATE = dataclasses.replace(ActuatorParameters.nominal(load_model()), delay=jnp.full(2, CONTROL_TIMESTEP))
"""Nominal actuators whose commands have a delay of one control step."""
SCRIPTS = {
    "ablation.py": "ablation",
    "actuator_curves.py": "actuator-curves",
    "air_bias.py": "air-bias",
    "air_slopes.py": "air-slopes",
    "deflation.py": "deflation",
    "fidelity.py": "fidelity",
    "fidelity_limits.py": "fidelity-limits",
    "foot_friction.py": "foot-friction",
    "friction_transfer.py": "foot-friction",
    "real/compass_gait/compass_gait.py": "compass_gait",
    "real/double_pendulum/double_pendulum.py": "double_pendulum",
    "real/double_pendulum/residuals.py": "double_pendulum_residuals",
    "real/go1/go1.py": "go1",
    "real/quadrotor/quadrotor.py": "quadrotor",
    "real/rgblimp/rgblimp.py": "rgblimp",
    "recording_counts.py": "recording_counts",
    "robot_effects.py": "all",
    "tethered_balloon/tethered_balloon.py": "tethered-balloon",
    "transfer_tables.py": "all",
}
"""Experiments with `--quick` that need no extra, and the names of their default folders."""


@pytest.fixture(scope="module")
def fidelity() -> Iterator[ModuleType]:
    with experiment_module(EXPERIMENTS / "fidelity.py") as module:
        yield module


@pytest.mark.parametrize(("script", "folder"), SCRIPTS.items())
def test_quick_runs_have_their_own_folder(
    script: str, folder: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    with experiment_module(EXPERIMENTS / script) as module:
        monkeypatch.setattr(sys, "argv", [script, "--help"])
        monkeypatch.setenv("COLUMNS", "200")
        with pytest.raises(SystemExit) as ended:
            module.main()
    assert ended.value.code == 0
    assert f"(runs/{folder}, or runs/{folder}-quick under --quick)" in capsys.readouterr().out


def test_these_tests_cover_every_experiment_with_quick_runs():
    scripts = {str(path.relative_to(EXPERIMENTS)) for path in EXPERIMENTS.rglob("*.py") if "_" != path.name[0]}
    quick = {name for name in scripts if "--quick" in (EXPERIMENTS / name).read_text(encoding="utf-8")}
    # The first needs an extra, and the second only names the option.
    assert quick - {"final_tier.py", "collect_runs.py"} == set(SCRIPTS)


@pytest.mark.parametrize(
    ("given", "folder"),
    [([], "runs/fidelity"), (["--quick"], "runs/fidelity-quick"), (["--quick", "--output", "mine"], "mine")],
)
def test_a_given_folder_is_used(fidelity: ModuleType, given: list[str], folder: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["fidelity.py", *given])
    assert fidelity.parse().output == Path(folder)


def test_results_of_other_settings_are_not_taken_over(tmp_path: Path):
    with experiment_module(EXPERIMENTS / "_setup.py") as setup:
        setup.reserve(tmp_path / "new", steps=3, robot="a")
        setup.reserve(tmp_path / "new", steps=3, robot="a")
        with pytest.raises(InputError, match="results with steps 3; choose another folder with --output"):
            setup.reserve(tmp_path / "new", steps=4, robot="a")
        (tmp_path / "old").mkdir()
        (tmp_path / "old" / "00-seed-0.json").touch()
        with pytest.raises(InputError, match="has files but no settings.json"):
            setup.reserve(tmp_path / "old", steps=3, robot="a")


def test_methods_that_identify_a_known_delay_are_left_out(fidelity: ModuleType, tmp_path: Path):
    methods = list(fidelity.METHODS)
    assert fidelity.without_known_delay(methods, assets() / "recordings" / ACTUATORS_FILE) == methods
    content = {"format": "ballu-actuators/2", "robot": "late", "parameters": actuators_to_json(LATE)}
    (tmp_path / "late.json").write_text(json.dumps(content))
    kept = fidelity.without_known_delay(methods, tmp_path / "late.json")
    assert kept == [name for name in methods if name not in ("delay", "delay-envmimic")]


@pytest.mark.parametrize("place", ["fidelity", "force_labels"])
def test_starting_states_include_the_delay_of_the_motors(place: str, monkeypatch: pytest.MonkeyPatch):
    """The angles of motors are not recorded. They follow from the commands that have arrived."""
    path, robot = list_bundled("test")[0], load_robot()

    def motor_angles(actuators: ActuatorParameters) -> np.ndarray:
        simulator = Simulator(robot, actuators)
        with experiment_module(EXPERIMENTS / f"{place}.py") as module:
            if place == "fidelity":
                kind: Any = SimpleNamespace(actuators=actuators, model=Aerodynamics(robot, simulator.mj_model))
                (motion,) = module.simulator(kind, [path]).motions
            else:
                monkeypatch.setattr(module, "list_bundled", lambda split: [path])
                (motion,) = module.reconstruct_split("test", simulator).values()
        return motion.qpos[:, [simulator.mj_model.joint(f"motor_{side}").qposadr[0] for side in ("left", "right")]]

    prompt, late = motor_angles(dataclasses.replace(LATE, delay=None)), motor_angles(LATE)
    same, shifted = (np.sqrt(np.mean((late[1:] - other) ** 2)) for other in (prompt[1:], prompt[:-1]))
    assert shifted < 0.3 * same
