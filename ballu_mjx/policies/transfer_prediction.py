"""Prediction of a policy's transfer before it meets the robot: its motion in other simulators of the robot.

A policy is trained in one simulator. Where others follow the robot's recordings about as closely, a policy whose motion
depends on the simulator will likely move differently on the robot too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.closed_loop import ClosedLoop
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.policy import Policy, environment_of
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator

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


class TransferPredictor:
    """Simulators of one robot in which policies of any origin are tried.

    Each simulator is compiled once, for all policies with the same network.
    """

    def __init__(self, simulators: Mapping[str, Simulator | AugmentedSimulator], starts: int = STARTS) -> None:
        """`simulators` are those to compare with, by name. `starts` is the number of trials."""
        self._simulators = {name: simulator.with_residual(None) for name, simulator in simulators.items()}
        self._starts = starts
        self._loops: dict[tuple[str, str, LocomotionConfig, PPOConfig], ClosedLoop] = {}

    def predict(self, policy: Policy) -> dict[str, TransferPrediction]:
        """Return the predictions of each simulator for a policy.

        Trials start from states that are drawn as in training with domain randomization, and last as long as trials of
        the policy's task.

        **Raises** `InputError` if a simulator is of another robot.
        """
        for name, simulator in self._simulators.items():
            if simulator.robot.sha256 != policy.robot.sha256:
                raise InputError(f"{name}: is of the robot {simulator.robot.name}, not of {policy.robot.name}.")
        steps = round(policy.task.trial_seconds / policy.robot.control_timestep)
        qpos, qvel = self._standing(policy)
        own = policy.closed_loop()(policy.params, qpos, qvel, steps)
        found = {}
        for name in self._simulators:
            other = self._loop(policy, name)(policy.params, qpos, qvel, steps)
            way = (other.com[:, -1] - other.com[:, 0]).mean(axis=0)
            error = np.linalg.norm(own.com - other.com, axis=-1).mean()
            found[name] = TransferPrediction(float(error), float(way[0]), float(way[1]), float(own.outside.mean()))
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

    def _standing(self, policy: Policy) -> tuple[Float[np.ndarray, "starts nq"], Float[np.ndarray, "starts nv"]]:
        spread = dataclasses.replace(policy.config, domain_randomization=True)
        env = environment_of(policy.robot, policy.task, spread, policy.actuators)
        return ClosedLoop(env, policy.infer).standing(self._starts)
