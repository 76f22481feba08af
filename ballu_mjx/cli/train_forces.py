"""Residual forces without reinforcement learning: `python -m ballu_mjx.train supervised` and `... analytic`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ballu_mjx.cli._command import TrainCommand, load_chosen_robot
from ballu_mjx.cli._residual import Prepared, settle, train_residual
from ballu_mjx.residuals.dataset import RecordingsData
from ballu_mjx.residuals.force_gradients import AnalyticConfig, check_analytic_config, resolve_windows
from ballu_mjx.residuals.force_regression import SupervisedConfig, check_supervised_config
from ballu_mjx.residuals.force_training import fit_analytic, fit_supervised, network_layers
from ballu_mjx.residuals.network_config import ForceNetworkConfig, check_network_config
from ballu_mjx.residuals.network_loads import check_load_options
from ballu_mjx.residuals.network_mirror import network_mirror
from ballu_mjx.residuals.run_config import ResidualReference
from ballu_mjx.residuals.scales import resolve_scales
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.runs.metrics import read_column
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.runs.record import TrainingRecord
from ballu_mjx.viz import plots

QUICK: Mapping[str, Mapping[str, Any]] = {
    "supervised": {"updates": 400},
    "analytic": {"window_seconds": 0.5, "relinearizations": 1, "updates": 50},
}
"""Defaults of the methods' configurations under `--quick`."""
_CURVES = {
    "supervised": ("force_error", "error of validation forces (ratio)"),
    "analytic": ("validation_error", "validation error (ratio)"),
}
"""Metric that chooses the checkpoint, and its label in the figure."""


@dataclasses.dataclass(frozen=True)
class ForcesData(RecordingsData):
    """Recordings and folders. A path is a recording (.csv or .csv.gz) or a folder of them."""

    residual: Path | None = None
    """Run folder of another residual, which acts in addition to the forces to be learned. Both must have the same
    actuators. Without this option: none."""


def train_supervised(data: ForcesData, env: ForceNetworkConfig, fit: SupervisedConfig) -> int:
    """Read and check all inputs, label forces, fit the network to them, evaluate it, and return the exit status."""
    check_supervised_config(fit)
    return _train("supervised", data, env, fit, fit_supervised, _robot(data))


def train_analytic(data: ForcesData, env: ForceNetworkConfig, fit: AnalyticConfig) -> int:
    """Read and check all inputs, learn, evaluate the result, and return the exit status."""
    robot = _robot(data)
    fit = resolve_windows(fit, robot)
    check_analytic_config(fit, robot.control_timestep)
    return _train("analytic", data, env, fit, fit_analytic, robot)


def _robot(data: ForcesData) -> RobotDescription:
    return load_chosen_robot(data.robot, residual=data.residual)


def _train(
    task: str,
    data: ForcesData,
    env: ForceNetworkConfig,
    fit: SupervisedConfig | AnalyticConfig,
    method: Callable[..., TrainedResidual],
    robot: RobotDescription,
) -> int:
    check_network_config(env)
    check_load_options(env, robot)
    network_mirror(env, robot)

    def learn(prepared: Prepared, run: TrainingRecord) -> TrainedResidual:
        return method(
            prepared.improved,
            prepared.motions["training"],
            fit,
            forces=env,
            validation=prepared.motions["validation"],
            run=run,
            progress=PhaseProgress(),
            evaluators=prepared.evaluators,
        )

    def show(folder: Path, residual: TrainedResidual) -> None:
        names = [name for name in ("loss", "linear_loss") if len(read_column(folder, name)[0])]
        losses = {name.replace("_", " "): read_column(folder, name) for name in names}
        metric, label = _CURVES[task]
        validated = read_column(folder, metric)
        noises = fit.observation_noise if isinstance(fit, SupervisedConfig) else ()
        lasts = {f"noise {noise:g}": (place + 1) * fit.updates for place, noise in enumerate(noises)}
        networks = lasts if len(lasts) > 1 else None
        plots.fit_curve(folder / "learning_curve.png", losses, validated, label, task, residual.step, networks)
        if residual.report:
            print(residual.report)
        print(f"Best checkpoint: gradient step {residual.step:,}. ", end="")

    def sections(prepared: Prepared) -> Mapping[str, Any]:
        nonlocal env
        env = settle(env, prepared, resolve_scales)
        return {"env": env, "ppo": network_layers(fit.seed), "fit": fit, "data": data}

    return train_residual(task, data, sections, learn, show, base=ResidualReference.chosen(data.residual))


SUPERVISED = TrainCommand(
    "Learn residual forces by regression on the forces that explain the recordings (the paper's baseline). Evaluate "
    "them on test recordings.",
    {"data": ForcesData(), "env": ForceNetworkConfig(), "fit": SupervisedConfig()},
    train_supervised,
    {"fit": QUICK["supervised"]},
)
ANALYTIC = TrainCommand(
    "Learn residual forces by gradients of the tracking error through the simulation. Evaluate them on test "
    "recordings.",
    {"data": ForcesData(), "env": ForceNetworkConfig(), "fit": AnalyticConfig()},
    train_analytic,
    {"fit": QUICK["analytic"]},
)
