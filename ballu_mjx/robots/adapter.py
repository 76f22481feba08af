"""What a robot adds to its description: hooks for what no general code can know.

A description names its adapter as `"adapter": "module:Class"`. Robots without one get `RobotAdapter`, whose methods
are the general answers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.robots.model import ModelParameters

if TYPE_CHECKING:
    from ballu_mjx.robots.description import RobotDescription


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

    # ---- identified actuators ----

    def nominal_actuators(self, model: mujoco.MjModel) -> ModelParameters | None:
        """Return the actuator parameters that stand in `model`; None where this robot has none to identify."""
        del model

    def read_actuators(self, robot: RobotDescription, path: Path) -> tuple[str, ModelParameters]:
        """Return the robot's name and the parameters in a file of identified actuators.

        **Raises** `InputError` where this robot's actuators cannot be identified, or the file is damaged.
        """
        raise InputError(
            f"{path}: the actuators of {robot.name} cannot be identified yet ({robot.file.name} names no adapter that "
            "does it); leave --actuators out."
        )

    def find_actuators(self, recordings: Iterable[Path], name: str) -> Path | None:
        """Return the file of identified actuators of the robot called `name` beside its recordings; None: none."""
        del recordings, name

    def actuators_to_json(self, parameters: ModelParameters) -> dict[str, Any]:
        """Return identified parameters as JSON's types."""
        raise NotImplementedError

    def actuators_from_json(self, robot: RobotDescription, values: Mapping[str, Any], path: Path) -> ModelParameters:
        """Return the inverse of `actuators_to_json`; `path` is the file that they stand in.

        **Raises** `InputError` naming file, parameter and fix.
        """
        raise InputError(f"{path}: {robot.name} has no actuators to identify; restore the file.")
