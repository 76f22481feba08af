"""What a robot adds to its description: hooks for what no general code can know.

A description names its adapter as `"adapter": "module:Class"`. Robots without one get `RobotAdapter`, whose methods
are the general answers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.robots.model import ModelParameters

if TYPE_CHECKING:
    from ballu_mjx.robots.description import RobotDescription


class DeploymentNotes(NamedTuple):
    """What an exported controller tells of a robot, beyond what its description says."""

    markers: Mapping[str, str] = {}
    """What each name that motion capture sees stands for on the robot."""
    commands: str = ""
    """What the smallest and largest commands do, and why they are limited in rate."""
    measure: tuple[str, ...] = ()
    """What to measure before the first run."""


@dataclasses.dataclass(frozen=True)
class ResidualScales:
    """Sizes of residual forces, for a robot whose own were chosen by experiment; see `residuals.scales`.

    Forces are in N, torques in N m.
    """

    force_scale: float
    """What one unit of a network's output stands for, of a force."""
    torque_scale: float
    """Likewise of a torque."""
    force_limit: float
    """Largest force along each axis."""
    force_cost: float
    """Reward lost per N^2 of force."""
    force_spread: float
    """Standard deviation of the prior on forces in labels."""
    force_change: float
    """Standard deviation of the prior on how they change from one control step to the next."""
    torque_spread: float
    """Standard deviation of what joints pull beyond the model."""


IdentificationProgress = Callable[[str, int, int, float], None]
"""(stage, iteration, most iterations, the lowest loss so far)."""


@dataclasses.dataclass(frozen=True, eq=False)
class IdentifiedActuators:
    """Actuator parameters with what is known of them; `Simulator` takes it for the parameters.

    **Fields**

    - `robot`: the name that the recordings carry.
    - `parameters`: what was identified.
    - `report`: values, standard errors and fit, as text.
    - `details`: the same as JSON's types, to stand beside the parameters in a file.
    """

    robot: str
    parameters: ModelParameters
    report: str
    details: Mapping[str, Any]

    def fields(self, model: mujoco.MjModel) -> dict[str, Array]:
        """Return the fields of `model` that carry the parameters, by name."""
        return self.parameters.fields(model)


class RobotAdapter:
    """The general answers, which serve a robot without specialities. Adapters hold no state."""

    def check(self, robot: RobotDescription, model: mujoco.MjModel) -> str | None:
        """Return what is wrong with a description for this adapter, in words; None where nothing is."""
        del robot, model

    def initial_qpos(self, robot: RobotDescription, model: mujoco.MjModel) -> Float[np.ndarray, " nq"]:
        """Return the pose that simulations start from: the description's keyframe, or the model's reference pose."""
        if robot.keyframe is None:
            return model.qpos0.copy()
        return model.key(robot.keyframe).qpos.copy()

    def rest_command(self, robot: RobotDescription, model: mujoco.MjModel) -> Float[np.ndarray, " commands"]:
        """Return the commands of a robot at rest: those of its keyframe, or as near to 0 as their ranges go."""
        given = np.zeros(model.nu) if robot.keyframe is None else model.key(robot.keyframe).ctrl
        low, high = np.array(robot.command_ranges).T
        return np.clip(given, low, high)

    def residual_scales(self) -> ResidualScales | None:
        """Return sizes of residual forces that were chosen by experiment; None: the recordings tell them."""

    # ---- deployment ----

    def full_travel(self, robot: RobotDescription) -> float:
        """Return the seconds in which a command may go through the whole of its range on the robot; 0: no limit."""
        del robot
        return 0.0

    def deployment_notes(self, robot: RobotDescription) -> DeploymentNotes:
        """Return what an exported controller tells whoever puts it on the robot."""
        del robot
        return DeploymentNotes()

    # ---- rollouts of policies ----

    def rollout_counts(self, features: Float[np.ndarray, "runs states features"]) -> Mapping[str, list[int]]:
        """Return what else is to be counted in rollouts of a policy, such as steps: numbers by name, one a run."""
        del features
        return {}

    def draw_rollout(
        self, folder: Path, qpos: Float[np.ndarray, "states nq"], command: Float[np.ndarray, "steps commands"]
    ) -> None:
        """Draw what only this robot has to show of a rollout into PNG files in `folder`."""
        del folder, qpos, command

    # ---- identified actuators ----

    def nominal_actuators(self, model: mujoco.MjModel) -> ModelParameters | None:
        """Return the actuator parameters that stand in `model`; None where this robot has none to identify."""
        del model

    def identify_actuators(
        self,
        robot: RobotDescription,
        recordings: Mapping[Path, Any],
        config: Any = None,
        levels: int | None = None,
        progress: IdentificationProgress | None = None,
    ) -> IdentifiedActuators:
        """Return the actuators identified from suspended `recordings` (`recordings.recording.Recording`, by file);
        see `identification.actuators.identify_actuators`.

        **Raises** `InputError` where the recordings cannot be used, or this robot's actuators cannot be identified.
        """
        self.check_sweep(robot, recordings, levels)
        raise NotImplementedError

    def check_sweep(self, robot: RobotDescription, recordings: Mapping[Path, Any], levels: int | None = None) -> None:
        """Check that `identify_actuators` can use the recordings.

        **Raises** `InputError` where it cannot, or this robot's actuators cannot be identified.
        """
        del recordings, levels
        raise InputError(
            f"{robot.file}: the actuators of {robot.name} cannot be identified; declare what to identify under "
            '"identify" (docs/identify.md), or give it an adapter with `identify_actuators`.'
        )

    def read_actuators(self, robot: RobotDescription, path: Path) -> tuple[str, ModelParameters]:
        """Return the robot's name and the parameters in a file of identified actuators.

        **Raises** `InputError` where this robot's actuators cannot be identified, or the file is damaged.
        """
        raise InputError(
            f"{path}: the actuators of {robot.name} cannot be identified yet ({robot.file.name} declares no "
            '"identify"); leave --actuators out.'
        )

    def write_actuators(self, path: Path, found: IdentifiedActuators, more: Mapping[str, Any]) -> None:
        """Write a file that `read_actuators` reads, with the details, and `more` keys beside them."""
        raise NotImplementedError

    def actuators_to_json(self, parameters: ModelParameters) -> dict[str, Any]:
        """Return identified parameters as JSON's types."""
        raise NotImplementedError

    def actuators_from_json(self, robot: RobotDescription, values: Mapping[str, Any], path: Path) -> ModelParameters:
        """Return the inverse of `actuators_to_json`; `path` is the file that they stand in.

        **Raises** `InputError` naming file, parameter and fix.
        """
        raise InputError(f"{path}: {robot.name} has no actuators to identify; restore the file.")
