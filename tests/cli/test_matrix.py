"""Every command on every kind of run, and all pairs of residuals: they work, or are refused in one sentence."""

from __future__ import annotations

import importlib
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ballu_mjx.ballu.leg_parameters import IdentificationConfig
from ballu_mjx.cli import train_policy, view
from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.errors import HORIZONS, Errors, Evaluation
from ballu_mjx.evaluation.errors_file import evaluation_to_json
from ballu_mjx.identification.actuators import ACTUATORS_FILE
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.locomotion_env import num_observations
from ballu_mjx.recordings.csv_format import list_bundled
from ballu_mjx.residuals.aerodynamics import (
    AERODYNAMICS_FILE,
    AERODYNAMICS_FORMAT,
    AirParameters,
    air_parameters_to_json,
)
from ballu_mjx.residuals.aerodynamics_fit import AirConfig
from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.residuals.fluid import FLUID_FILE, FluidEstimate, FluidParameters, terms_of
from ballu_mjx.residuals.fluid_fit import FluidConfig
from ballu_mjx.residuals.network_input import num_inputs
from ballu_mjx.residuals.network_loads import num_loads
from ballu_mjx.residuals.registry import RESIDUAL_TASKS
from ballu_mjx.residuals.run_config import describe_run
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.residuals.training_range import TrainingRange
from ballu_mjx.rl import ppo
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs.folder import Run

BALLU = load_robot()
NETWORK = PPOConfig(policy_layers=(8,), value_layers=(4,))
ONE = list_bundled("test")[0]
INPUTS = num_inputs(EnvMimicConfig(), BALLU)
RUNS = (*RESIDUAL_TASKS, "walk", "sysid", "all")
COMMANDS = (
    "compare RUN OTHER",
    "record check RUN",
    *(f"train {task} --resume RUN --num-timesteps 0" for task in ("envmimic", "walk", "turn")),
    *(f"train {task} --residual RUN --recordings nowhere" for task in ("envmimic", "supervised", "analytic")),
    "train walk --residual RUN --num-envs 0",
    "train envmimic --start-from RUN --recordings nowhere",
    "export check RUN",
    "export policy RUN --output RUN",
    "export simulator RUN --output RUN",
    "train aerodynamic --fixed-from RUN --recordings nowhere",
    "train fluid --fixed-from RUN --recordings nowhere",
    "train supervised --actuators RUN --recordings ONE",
    "train supervised --output RUN --recordings ONE",
)
"""Command lines that end before any long work. If the run suits the command, an invalid option stops it."""


def write_run(folder: Path, task: str, base: Path | None = None) -> Path:
    """Write a run as its command does, with untrained parameters."""
    config: dict[str, Any] = {"residual": None if base is None else str(base)}
    if task == "all":
        folder.mkdir()
        (folder / "table-walk.md").write_text("| a |\n| --- |\n| 1 |\n")
        return folder
    forces = EnvMimicConfig(force_scale=0.05, torque_scale=0.005, force_limit=1.0, force_cost=20.0)
    sections: dict[str, Any] = {"env": forces, "ppo": NETWORK}
    inputs, actions = INPUTS, num_loads(EnvMimicConfig(), BALLU)
    if task == "aerodynamic":
        sections = {"fit": AirConfig()}
    elif task == "fluid":
        sections = {"fit": FluidConfig()}
    elif task == "sysid":
        sections = {"fit": IdentificationConfig()}
    elif task == "walk":
        sections = {"env": LocomotionConfig(), "ppo": NETWORK, "data": train_policy.Data()}
        inputs, actions = num_observations(BALLU), len(BALLU.commands)
    with Run(folder, describe_run(task, sections, {}, []) | config) as run:
        if task in ("envmimic", "walk"):
            run.log(0, {"reward": 1.0})
        if task in RESIDUAL_TASKS:
            TrainingRange.of(np.zeros((2, inputs))).write(run)
        if task == "aerodynamic":
            air = {"format": AERODYNAMICS_FORMAT, "parameters": air_parameters_to_json(AirParameters.none())}
            run.write(AERODYNAMICS_FILE, json.dumps(air))
        elif task == "fluid":
            nothing = FluidParameters.without_added_mass(np.zeros((len(terms_of("drag")), 6)))
            run.write(FLUID_FILE, FluidEstimate("drag", nothing, nothing).to_json())
        elif task == "sysid":
            run.write(ACTUATORS_FILE, "{}")
        else:
            start = ppo.initial_policy(np.random.default_rng(0).normal(size=(4, inputs)), actions, NETWORK)
            run.save(0, ppo.as_tree(start), 1.0)
    if task in RESIDUAL_TASKS:
        each = {horizon: (1.0, 0.1) for horizon in HORIZONS}
        found = (Errors("near-1", "near", each, each, 1.0, 1.0, 0.0),)
        (folder / "evaluation.json").write_text(json.dumps(evaluation_to_json(Evaluation(found, found, name=task))))
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("runs")
    return {task: write_run(folder / task, task) for task in RUNS}


@pytest.mark.parametrize("line", COMMANDS)
@pytest.mark.parametrize("task", RUNS)
def test_every_command_succeeds_or_refuses_a_run_in_one_sentence(
    task: str, line: str, runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    other = runs["envmimic" if task in RESIDUAL_TASKS else task]
    substitutions = {"RUN": str(runs[task]), "OTHER": str(other), "OUT": str(tmp_path), "ONE": str(ONE)}
    command, *arguments = line.split()
    for name, value in substitutions.items():
        arguments = [argument.replace(name, value) for argument in arguments]
    status = importlib.import_module(f"ballu_mjx.cli.{command}").main(arguments)
    error = capsys.readouterr().err
    assert "fault of ballu_mjx" not in error
    assert status == 0 or (status == 2 and error.count("\n") == 1 and error.endswith(".\n")), error


@pytest.mark.parametrize(
    ("line", "suitable"),
    [
        ("report RUN --output OUT/page.html", RUNS),
        ("compare RUN", (*RESIDUAL_TASKS, "walk")),
        ("export policy RUN --output OUT/robot --no-open-loop", ("walk",)),
        ("export simulator RUN --output OUT/simulator --check-seconds 0", (*RESIDUAL_TASKS, "walk")),
    ],
)
def test_commands_succeed_on_suitable_runs_only(
    line: str, suitable: tuple[str, ...], runs: dict[str, Path], tmp_path: Path
):
    for task in RUNS:
        out = tmp_path / task
        out.mkdir()
        command, *arguments = line.replace("RUN", str(runs[task])).replace("OUT", str(out)).split()
        status = importlib.import_module(f"ballu_mjx.cli.{command}").main(arguments)
        assert status == (0 if task in suitable else 2), task


@pytest.mark.parametrize("task", RUNS)
def test_viewing_a_run_without_a_replay_is_refused(task: str, runs: dict[str, Path]):
    with pytest.raises(InputError, match=r"\.$"):
        view.load(runs[task])


def test_evaluate_refuses_runs_that_are_not_residuals(runs: dict[str, Path], capsys: pytest.CaptureFixture[str]):
    evaluate = importlib.import_module("ballu_mjx.cli.evaluate")
    for task in ("walk", "sysid", "all"):
        assert evaluate.main([str(runs[task])]) == 2
        assert "fault" not in capsys.readouterr().err


@pytest.mark.parametrize(("base", "task"), [*itertools.product(RESIDUAL_TASKS, ("envmimic", "supervised", "analytic"))])
def test_every_residual_can_act_on_top_of_every_other(base: str, task: str, runs: dict[str, Path], tmp_path: Path):
    """The combined residual has both names. A third residual on top of it is loaded too."""
    both = write_run(tmp_path / "both", task, runs[base])
    assert TrainedResidual.load(both, BALLU).model.name == f"{base}+{task}"
    three = write_run(tmp_path / "three", "supervised", both)
    assert TrainedResidual.load(three, BALLU).model.name == f"{base}+{task}+supervised"
