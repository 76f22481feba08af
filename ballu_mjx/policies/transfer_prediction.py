"""Prediction of a policy's transfer before it meets the robot: its motion in other simulators of the robot.

A policy is trained in one simulator. Where others follow the robot's recordings about as closely, a policy whose motion
depends on the simulator will likely move differently on the robot too.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.evaluation.errors import mean_com_error
from ballu_mjx.evaluation.errors_file import read_evaluation
from ballu_mjx.policies.closed_loop import ClosedLoop
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.policy import Policy, environment_of
from ballu_mjx.policies.simulator_variants import SimulatorVariant
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.robots.model import ModelParameters, same_parameters
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator

_LOG = logging.getLogger(__name__)

STARTS = 8
"""Number of trials of each policy in each simulator."""


@dataclasses.dataclass(frozen=True)
class TransferPrediction:
    """Trials of a policy in its own simulator, compared with trials from the same states in another."""

    com_error: float
    """Mean distance (m) of the centres of mass, over time and trials, as `Transfer.com_error`."""
    x_distance: float
    """Mean distance along x in the other simulator (m)."""
    y_distance: float
    """Mean distance along y in the other simulator (m)."""
    outside: float
    """Share of control steps in its own simulator outside of the training range of the residual. 0 without one."""


class PredictedErrors(NamedTuple):
    """Predicted mean CoM errors of policies on the robot."""

    reference: str
    """Simulator with the smallest error on recordings of the robot."""
    com_error: dict[str, float]
    """Predicted mean CoM error (m), by the simulator of the policy's training."""

    @property
    def best(self) -> str:
        """Return the simulator of the policy with the smallest predicted error."""
        return min(self.com_error, key=lambda name: self.com_error[name])


def predict_com_errors(
    policies: Mapping[str, Policy],
    simulators: Mapping[str, Simulator | AugmentedSimulator],
    errors: Mapping[str, float],
    starts: int = STARTS,
) -> PredictedErrors:
    """Return the predicted CoM error of each policy on the robot.

    It is sqrt(d^2 + e^2). d is the distance between the policy's motions in its own simulator and in the reference, and
    e is the error of the reference.

    **Arguments**

    - `policies`: policies for one task, by the simulator of their training (`SimulatorVariant.name`).
    - `simulators`: simulators of the robot, by name.
    - `errors`: mean CoM error (m) of each of these simulators in open-loop replays of recordings of the robot.
    """
    reference = min(errors, key=lambda name: errors[name])
    predictor = TransferPredictor(simulators, starts)
    found = {}
    for setting, policy in policies.items():
        distance = predictor.predict(policy, own_simulator(setting, simulators))[reference].com_error
        found[setting] = expected_error(distance, errors[reference])
    return PredictedErrors(reference, found)


def replay_errors(residuals: Mapping[str, Path]) -> dict[str, float]:
    """Return the mean CoM error (m) of vanilla+sysid and of each simulator in open-loop replays, from evaluations.

    `residuals`: runs of residuals on identified actuators, by simulator, evaluated on the same recordings.

    **Raises** `InputError` if a run has no valid evaluation.
    """
    evaluations = {name: read_evaluation(run / "evaluation.json") for name, run in residuals.items()}
    vanilla = mean_com_error(next(iter(evaluations.values())).vanilla)
    return {"vanilla+sysid": vanilla, **{name: mean_com_error(each.residual) for name, each in evaluations.items()}}


def expected_error(distance: float, reference_error: float) -> float:
    """Return the predicted CoM error (m) from a policy's distance to the reference, and the reference's error (m)."""
    return math.hypot(distance, reference_error)


def own_simulator(setting: str, simulators: Mapping[str, object]) -> str | None:
    """Return which of `simulators` a policy was trained in, apart from domain randomization. None if in none."""
    name = dataclasses.replace(SimulatorVariant.parse(setting), randomized=False).name
    return name if name in simulators else None


def write_prediction(path: Path, found: PredictedErrors) -> None:
    """Write predicted errors to a JSON file."""
    files.write(path, json.dumps(found._asdict(), indent=2) + "\n")


def read_prediction(path: Path) -> PredictedErrors:
    """Return the predicted errors in a file that `write_prediction` wrote.

    **Raises** `InputError` if the file holds none.
    """
    fix = "delete its folder, and `train all` will make it again"
    content = files.read_json(path, fix)
    errors = content.get("com_error")
    if not (isinstance(content.get("reference"), str) and isinstance(errors, dict) and errors):
        raise InputError(f"{path}: holds no predicted errors; {fix}.")
    if not all(is_number(value) for value in errors.values()):
        raise InputError(f"{path}: has a predicted error that is not a number; {fix}.")
    return PredictedErrors(content["reference"], {name: float(value) for name, value in errors.items()})


_States = tuple[Float[np.ndarray, "starts nq"], Float[np.ndarray, "starts nv"]]
"""Generalized positions and velocities."""


class TransferPredictor:
    """Simulators of one robot in which policies of any origin are tried.

    Each simulator is compiled once, for all policies with the same network.
    """

    def __init__(self, simulators: Mapping[str, Simulator | AugmentedSimulator], starts: int = STARTS) -> None:
        """`simulators` are those to compare with, by name. `starts` is the number of trials."""
        self._simulators = {name: simulator.with_residual(None) for name, simulator in simulators.items()}
        self._starts = starts
        self._loops: dict[tuple[str, str, LocomotionConfig, PPOConfig], ClosedLoop] = {}
        self._starting: list[tuple[tuple[str, LocomotionConfig], ModelParameters | None, _States]] = []

    def predict(self, policy: Policy, own: str | None = None) -> dict[str, TransferPrediction]:
        """Return the predictions of each simulator for a policy.

        `own` is the policy's own simulator, if it is among these. Naming it saves the compilation of another program.

        Trials start from states that are drawn as in training with domain randomization, and last as long as trials of
        the policy's task.

        **Raises** `InputError` if a simulator is of another robot.
        """
        for name, simulator in self._simulators.items():
            if simulator.robot.sha256 != policy.robot.sha256:
                raise InputError(f"{name}: is of the robot {simulator.robot.name}, not of {policy.robot.name}.")
        steps = round(policy.task.trial_seconds / policy.robot.control_timestep)
        qpos, qvel = self._standing(policy)
        loop = policy.closed_loop() if own is None else self._loop(policy, own)
        motion = loop(policy.params, qpos, qvel, steps)
        others = {
            name: motion if name == own else self._loop(policy, name)(policy.params, qpos, qvel, steps)
            for name in self._simulators
        }
        for name, rollout in {"the policy's own simulator": motion, **others}.items():
            if rollout.divergence is not None:
                _LOG.warning("In %s: %s", name, rollout.divergence)
        outside = float(motion.outside.mean())
        found = {}
        for name, other in others.items():
            way = (other.com[:, -1] - other.com[:, 0]).mean(axis=0)
            error = np.linalg.norm(motion.com - other.com, axis=-1).mean()
            found[name] = TransferPrediction(float(error), float(way[0]), float(way[1]), outside)
        return found

    def _loop(self, policy: Policy, name: str) -> ClosedLoop:
        """Return the closed loop in a simulator, for policies with the network and task of `policy`."""
        simulator = self._simulators[name]
        plain = dataclasses.replace(policy.config, domain_randomization=False, outside_cost=0.0)
        key = name, policy.task.name, plain, dataclasses.replace(policy.network, seed=0)
        if key not in self._loops:
            env = environment_of(policy.robot, policy.task, plain, simulator.actuators, TrainedResidual.of(simulator))
            self._loops[key] = ClosedLoop(env, policy.infer)
        return self._loops[key]

    def _standing(self, policy: Policy) -> _States:
        """Return starting states. Policies of one task with equal actuators and options share them."""
        spread = dataclasses.replace(policy.config, domain_randomization=True)
        key = policy.task.name, spread
        for other, actuators, states in self._starting:
            if other == key and same_parameters(actuators, policy.actuators):
                return states
        env = environment_of(policy.robot, policy.task, spread, policy.actuators)
        states = ClosedLoop(env, policy.infer).standing(self._starts)
        self._starting.append((key, policy.actuators, states))
        return states
