"""BALLU as a plug-in: what its description's `adapter` names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu import actuators_file
from ballu_mjx.ballu.model import JOINTS, SIDES, ActuatorParameters, standing_qpos
from ballu_mjx.robots.adapter import RobotAdapter
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters

_POINTS = ("base", "foot_left", "foot_right")
_ANGLES = ("motor_left", "motor_right", "knee_left", "knee_right")


class Ballu(RobotAdapter):
    """A robot with BALLU's legs: hips, knees with springs, and servos on the feet that bend the knees by cables."""

    def check(self, robot: RobotDescription, model: mujoco.MjModel) -> str | None:
        """Return which name of BALLU's the model or the description lacks."""
        kinds = mujoco.mjtObj
        needed = [(kinds.mjOBJ_BODY, name) for name in ("base", "balloon")]
        needed += [(kinds.mjOBJ_BODY, f"{part}_{side}") for part in ("femur", "tibia", "arm") for side in SIDES]
        needed += [(kinds.mjOBJ_SITE, f"cable_{part}_{side}") for part in ("femur", "arm") for side in SIDES]
        needed += [(kinds.mjOBJ_TENDON, f"cable_{side}") for side in SIDES]
        needed += [(kinds.mjOBJ_ACTUATOR, f"servo_{side}") for side in SIDES]
        missing = [name for kind, name in needed if mujoco.mj_name2id(model, kind, name) < 0]
        hinges = tuple(model.joint(index).name for index in range(1, model.njnt))
        own = (robot.tracked, robot.points, robot.commands, robot.joints)
        if robot.anchored or hinges != JOINTS or missing or own != ("balloon", _POINTS, SIDES, _ANGLES):
            return f"it has other {missing[0] if missing else 'names'} than BALLU"
        return None

    def initial_qpos(self, robot: RobotDescription, model: mujoco.MjModel) -> Float[np.ndarray, " nq"]:
        """Return the standing pose: knees at their stops, feet on the floor."""
        del robot
        return standing_qpos(model)

    def nominal_actuators(self, model: mujoco.MjModel) -> ActuatorParameters:
        """Return the parameters that stand in `model`."""
        return ActuatorParameters.nominal(model)

    def read_actuators(self, robot: RobotDescription, path: Path) -> tuple[str, ModelParameters]:
        """Return what `actuators_file.read_actuators` returns."""
        del robot
        return actuators_file.read_actuators(path)

    def find_actuators(self, recordings: Iterable[Path], name: str) -> Path | None:
        """Return what `actuators_file.find_actuators` returns."""
        return actuators_file.find_actuators(recordings, name)

    def actuators_to_json(self, parameters: ModelParameters) -> dict[str, Any]:
        """Return pairs [left, right] by name."""
        assert isinstance(parameters, ActuatorParameters)
        return actuators_file.actuators_to_json(parameters)

    def actuators_from_json(self, robot: RobotDescription, values: Mapping[str, Any], path: Path) -> ModelParameters:
        """Return the inverse of `actuators_to_json`.

        **Raises** `InputError` naming file, parameter and fix.
        """
        del robot
        return actuators_file.actuators_from_json(values, path)
