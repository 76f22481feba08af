"""Robot adapters: hooks for code that only one robot needs.

A description names its adapter as `"adapter": "module:Class"`. A robot without an adapter uses `RobotAdapter`, whose
methods are general defaults.
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
    """Notes on a robot that an exported controller contains, beyond the robot's description."""

    markers: Mapping[str, str] = {}
    """Location on the robot of each site that motion capture measures, by the site's name."""
    commands: str = ""
    """Effect of the smallest and of the largest command, and the reason for their rate limit."""
    measure: tuple[str, ...] = ()
    """Quantities to measure before the first run."""


IdentificationProgress = Callable[[str, int, int, float], None]
"""Callback with the arguments (stage, iteration, maximum number of iterations, lowest loss so far)."""


@dataclasses.dataclass(frozen=True, eq=False)
class IdentifiedActuators:
    """Identified actuator parameters with a report. `Simulator` accepts them in place of the bare parameters.

    **Fields**

    - `robot`: the robot's name in the recordings.
    - `parameters`: the identified parameters.
    - `report`: values, standard errors and quality of the fit, as text.
    - `details`: the same as JSON types, for the file of the parameters.
    """

    robot: str
    parameters: ModelParameters
    report: str
    details: Mapping[str, Any]

    def fields(self, model: mujoco.MjModel) -> dict[str, Array]:
        """Return the fields of `model` that carry the parameters, by name."""
        return self.parameters.fields(model)


class RobotAdapter:
    """General defaults of the hooks, for a robot without code of its own. Adapters hold no state."""

    def check(self, robot: RobotDescription, model: mujoco.MjModel) -> str | None:
        """Return a description's first problem with this adapter, in words. None if there is no problem."""
        del robot, model

    def initial_qpos(self, robot: RobotDescription, model: mujoco.MjModel) -> Float[np.ndarray, " nq"]:
        """Return the initial pose of simulations: the description's keyframe, or the model's reference pose."""
        if robot.keyframe is None:
            return model.qpos0.copy()
        return model.key(robot.keyframe).qpos.copy()

    def rest_command(self, robot: RobotDescription, model: mujoco.MjModel) -> Float[np.ndarray, " commands"]:
        """Return the commands of a robot at rest: those of its keyframe, or 0, clipped to their ranges."""
        given = np.zeros(model.nu) if robot.keyframe is None else model.key(robot.keyframe).ctrl
        low, high = np.array(robot.command_ranges).T
        return np.clip(given, low, high)

    # ---- deployment ----

    def full_travel(self, robot: RobotDescription) -> float:
        """Return the shortest time (s) in which a command may pass through its range on the robot. 0: no limit."""
        del robot
        return 0.0

    def deployment_notes(self, robot: RobotDescription) -> DeploymentNotes:
        """Return notes on the robot for the users of an exported controller."""
        del robot
        return DeploymentNotes()

    # ---- rollouts of policies ----

    def rollout_counts(self, features: Float[np.ndarray, "runs states features"]) -> Mapping[str, list[int]]:
        """Return further counts in a policy's rollouts, such as steps, by name. Each has one number per run."""
        del features
        return {}

    def draw_rollout(
        self, folder: Path, qpos: Float[np.ndarray, "states nq"], command: Float[np.ndarray, "steps commands"]
    ) -> None:
        """Draw figures of a rollout that are specific to this robot, as PNG files in `folder`."""
        del folder, qpos, command

    # ---- identified actuators ----

    def nominal_actuators(self, model: mujoco.MjModel) -> ModelParameters | None:
        """Return the actuator parameters of `model`. None if this robot has no actuators to identify."""
        del model

    def identify_actuators(
        self,
        robot: RobotDescription,
        recordings: Mapping[Path, Any],
        config: Any = None,
        levels: int | None = None,
        progress: IdentificationProgress | None = None,
    ) -> IdentifiedActuators:
        """Identify the actuators from suspended `recordings` (`recordings.recording.Recording`, by file); see
        `identification.actuators.identify_actuators`.

        **Raises** `InputError` if the recordings cannot be used, or if this robot's actuators cannot be identified.
        """
        self.check_sweep(robot, recordings, levels)
        raise NotImplementedError

    def check_sweep(self, robot: RobotDescription, recordings: Mapping[Path, Any], levels: int | None = None) -> None:
        """Check that `identify_actuators` can use the recordings.

        **Raises** `InputError` if it cannot, or if this robot's actuators cannot be identified.
        """
        del recordings, levels
        raise InputError(
            f"{robot.file}: the actuators of {robot.name} cannot be identified; declare parameters under "
            '"identify" (docs/identify.md), or write an adapter with `identify_actuators`.'
        )

    def read_actuators(self, robot: RobotDescription, path: Path) -> tuple[str, ModelParameters]:
        """Read a file of identified actuators, and return the robot's name and the parameters.

        **Raises** `InputError` if this robot's actuators cannot be identified, or if the file is damaged.
        """
        raise InputError(
            f"{path}: the actuators of {robot.name} cannot be identified yet ({robot.file.name} declares no "
            '"identify"); remove --actuators.'
        )

    def write_actuators(self, path: Path, found: IdentifiedActuators, more: Mapping[str, Any]) -> None:
        """Write a file that `read_actuators` reads, with the details and the further keys `more`."""
        raise NotImplementedError

    def actuators_to_json(self, parameters: ModelParameters) -> dict[str, Any]:
        """Return identified parameters as JSON types."""
        raise NotImplementedError

    def actuators_from_json(self, robot: RobotDescription, values: Mapping[str, Any], path: Path) -> ModelParameters:
        """Return the parameters from the `values` that `actuators_to_json` made; `path` is the file with the values.

        **Raises** `InputError` naming the file, the parameter and the fix.
        """
        raise InputError(f"{path}: {robot.name} has no actuators to identify; restore the file.")
