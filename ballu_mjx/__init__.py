"""Sim-to-real transfer in MJX and Brax for BALLU, a 0.29 kg biped under helium balloons, and for similar robots.

The package has the stages of Sontakke et al., "Residual Physics Learning and System Identification for Sim-to-real
Transfer of Policies on Buoyancy Assisted Legged Robots": recording, identification, residual, policy, evaluation.
A stage imports from earlier stages only.

The public names below are imported at their first use. JAX's start-up options must be set before JAX is imported
(`common.runtime.prepare`).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ballu_mjx.common.errors import InputError
    from ballu_mjx.evaluation.errors import Evaluation
    from ballu_mjx.evaluation.open_loop import evaluate
    from ballu_mjx.identification.actuator_choice import choose_actuators
    from ballu_mjx.identification.actuators import identify_actuators
    from ballu_mjx.policies.deploy.check import check_policy
    from ballu_mjx.policies.environments.brax_env import brax_env
    from ballu_mjx.policies.environments.gym_env import gym_env, gym_vector_env
    from ballu_mjx.policies.load_simulator import load_simulator
    from ballu_mjx.policies.locomotion_config import LocomotionConfig
    from ballu_mjx.policies.policy import Policy
    from ballu_mjx.policies.training import locomotion_ppo, train_policy
    from ballu_mjx.recordings.load import load_recordings
    from ballu_mjx.recordings.motion import Motion
    from ballu_mjx.recordings.reconstruct import reconstruct, reconstruct_for_simulator
    from ballu_mjx.recordings.recording import Recording
    from ballu_mjx.residuals.aerodynamics_fit import AirConfig
    from ballu_mjx.residuals.aerodynamics_training import fit_aerodynamics
    from ballu_mjx.residuals.deploy.export import export_simulator
    from ballu_mjx.residuals.envmimic import EnvMimicConfig
    from ballu_mjx.residuals.envmimic_training import train_envmimic
    from ballu_mjx.residuals.fluid_fit import FluidConfig
    from ballu_mjx.residuals.fluid_training import fit_fluid
    from ballu_mjx.residuals.force_gradients import AnalyticConfig
    from ballu_mjx.residuals.force_regression import SupervisedConfig
    from ballu_mjx.residuals.force_training import fit_analytic, fit_supervised
    from ballu_mjx.residuals.network_config import ForceNetworkConfig
    from ballu_mjx.residuals.trained_residual import TrainedResidual
    from ballu_mjx.rl.ppo import PPOConfig
    from ballu_mjx.robots.adapter import IdentifiedActuators
    from ballu_mjx.robots.description import RobotDescription
    from ballu_mjx.robots.registry import load_robot
    from ballu_mjx.runs.folder import Run
    from ballu_mjx.runs.progress import PhaseProgress, Progress
    from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator

__version__ = "0.1.0"

_MODULES = {
    "AirConfig": "residuals.aerodynamics_fit",
    "AnalyticConfig": "residuals.force_gradients",
    "AugmentedSimulator": "sim.simulator",
    "EnvMimicConfig": "residuals.envmimic",
    "Evaluation": "evaluation.errors",
    "IdentifiedActuators": "robots.adapter",
    "InputError": "common.errors",
    "LocomotionConfig": "policies.locomotion_config",
    "Motion": "recordings.motion",
    "PPOConfig": "rl.ppo",
    "PhaseProgress": "runs.progress",
    "Policy": "policies.policy",
    "Progress": "runs.progress",
    "Recording": "recordings.recording",
    "RobotDescription": "robots.description",
    "Run": "runs.folder",
    "Simulator": "sim.simulator",
    "SupervisedConfig": "residuals.force_regression",
    "TrainedResidual": "residuals.trained_residual",
    "brax_env": "policies.environments.brax_env",
    "check_policy": "policies.deploy.check",
    "choose_actuators": "identification.actuator_choice",
    "evaluate": "evaluation.open_loop",
    "export_simulator": "residuals.deploy.export",
    "fit_aerodynamics": "residuals.aerodynamics_training",
    "FluidConfig": "residuals.fluid_fit",
    "ForceNetworkConfig": "residuals.network_config",
    "fit_fluid": "residuals.fluid_training",
    "fit_analytic": "residuals.force_training",
    "fit_supervised": "residuals.force_training",
    "gym_env": "policies.environments.gym_env",
    "gym_vector_env": "policies.environments.gym_env",
    "identify_actuators": "identification.actuators",
    "load_recordings": "recordings.load",
    "load_robot": "robots.registry",
    "load_simulator": "policies.load_simulator",
    "locomotion_ppo": "policies.training",
    "reconstruct": "recordings.reconstruct",
    "reconstruct_for_simulator": "recordings.reconstruct",
    "train_envmimic": "residuals.envmimic_training",
    "train_policy": "policies.training",
}
"""Module in which each public name is defined, relative to this package."""

__all__ = [
    "AirConfig",
    "AnalyticConfig",
    "AugmentedSimulator",
    "EnvMimicConfig",
    "Evaluation",
    "IdentifiedActuators",
    "InputError",
    "LocomotionConfig",
    "Motion",
    "PPOConfig",
    "PhaseProgress",
    "Policy",
    "Progress",
    "Recording",
    "RobotDescription",
    "Run",
    "Simulator",
    "SupervisedConfig",
    "TrainedResidual",
    "brax_env",
    "check_policy",
    "choose_actuators",
    "evaluate",
    "export_simulator",
    "fit_aerodynamics",
    "fit_fluid",
    "FluidConfig",
    "ForceNetworkConfig",
    "fit_analytic",
    "fit_supervised",
    "gym_env",
    "gym_vector_env",
    "identify_actuators",
    "load_recordings",
    "load_robot",
    "load_simulator",
    "locomotion_ppo",
    "reconstruct",
    "reconstruct_for_simulator",
    "train_envmimic",
    "train_policy",
]


def __getattr__(name: str) -> Any:
    """Import a public name of the package at its first use."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    runtime = importlib.import_module(f"{__name__}.common.runtime")
    runtime.prepare()
    found = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
