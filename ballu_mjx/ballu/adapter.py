"""BALLU as a plug-in: what its description's `adapter` names."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu import actuators_file, leg_alignment, reconstruct, recordings
from ballu_mjx.ballu.actuators import ActuatorParameters
from ballu_mjx.ballu.features import foot_positions
from ballu_mjx.ballu.gait import count_steps
from ballu_mjx.ballu.model import JOINTS, SIDES, standing_qpos
from ballu_mjx.ballu.sweep import LEVELS, read_sweep
from ballu_mjx.recordings.hooks import RecordingHooks
from ballu_mjx.recordings.inverse_kinematics import KinematicFit
from ballu_mjx.recordings.motion import MeasurementGrid
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.adapter import (
    DeploymentNotes,
    IdentificationProgress,
    IdentifiedActuators,
    ResidualScales,
    RobotAdapter,
)
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters

_POINTS = ("base", "foot_left", "foot_right")
_ANGLES = ("motor_left", "motor_right", "knee_left", "knee_right")


class Ballu(RobotAdapter, RecordingHooks):
    """A robot with BALLU's legs: hips, knees with springs, and servos on the feet that bend the knees by cables."""

    def check(self, robot: RobotDescription, model: mujoco.MjModel) -> str | None:
        """Return which name of BALLU's the model or the description lacks, or that a slack cable transmits forces."""
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
        for side in SIDES:
            if model.tendon_damping[model.tendon(f"cable_{side}").id] > 0:
                return f'tendon cable_{side} has damping, which acts while it is slack (write damping="0")'
        return None

    def initial_qpos(self, robot: RobotDescription, model: mujoco.MjModel) -> Float[np.ndarray, " nq"]:
        """Return the standing pose: knees at their stops, feet on the floor."""
        del robot
        return standing_qpos(model)

    def residual_scales(self) -> ResidualScales:
        """Return the sizes that the ablation chose (docs/envmimic.md). The forces that close the gap are hundredths of
        a newton: with 1 N a unit, PPO's first steps throw the robot over. Limit: the paper's."""
        return ResidualScales(
            force_scale=0.05,
            torque_scale=0.005,
            force_limit=1.0,
            force_cost=20.0,
            force_spread=0.3,
            force_change=0.1,
            torque_spread=0.05,
        )

    def full_travel(self, robot: RobotDescription) -> float:
        """Return 0.2 s: the servo takes 0.14 s for 60 deg without load, 0.21 s for 90."""
        del robot
        return 0.2

    def deployment_notes(self, robot: RobotDescription) -> DeploymentNotes:
        """Return what markers and commands are on BALLU, and what to measure."""
        del robot
        return DeploymentNotes(
            markers={
                "balloon": "the balloon cluster's centre of mass, 0.38 m above the neck's hinge, on the robot's middle",
                "base": "the middle of the hip axis",
                "foot_left": "the centre of the left foot's sphere",
                "foot_right": "the centre of the right foot's sphere",
            },
            commands=(
                "0 is the servo relaxed (knee at its stop, cable just taut), 1 is 90 deg. The servo's own no-load "
                "speed is 60 deg in 0.14 s (90 deg in 0.21 s), so a faster command would ask for what it cannot do."
            ),
            measure=(
                "Pulse widths at command 0 (cable just taut, knee at its stop) and at 90 deg, of each servo; whether "
                "one runs the other way round. Give them by --pulse-low and --pulse-high, or in send for each servo.",
                "z of the feet standing (the foot sphere's radius, not 0), which foot is left, heights of base and "
                "balloon.",
            ),
        )

    def rollout_counts(self, features: Float[np.ndarray, "runs states features"]) -> Mapping[str, list[int]]:
        """Return the steps of each run."""
        return {"steps": [int(count_steps(feet)[-1]) for feet in foot_positions(features)]}

    def draw_rollout(
        self, folder: Path, qpos: Float[np.ndarray, "states nq"], command: Float[np.ndarray, "steps commands"]
    ) -> None:
        """Draw the gait into `gait.png`."""
        from ballu_mjx.ballu import plots  # brings Matplotlib and the identification

        plots.gait(folder / "gait.png", qpos, command)

    def nominal_actuators(self, model: mujoco.MjModel) -> ActuatorParameters:
        """Return the parameters that stand in `model`."""
        return ActuatorParameters.nominal(model)

    def identify_actuators(
        self,
        robot: RobotDescription,
        recordings: Mapping[Path, Any],
        config: Any = None,
        levels: int | None = None,
        progress: IdentificationProgress | None = None,
    ) -> IdentifiedActuators:
        """Return what `identified_legs.identify_from_sweep` returns."""
        del robot
        from ballu_mjx.ballu.identified_legs import identify_from_sweep  # Optimistix: slow to import

        return identify_from_sweep(recordings, config, levels, progress)

    def check_sweep(self, robot: RobotDescription, recordings: Mapping[Path, Any], levels: int | None = None) -> None:
        """Check that the recordings are a sweep of both legs; see `sweep.read_sweep`."""
        del robot
        read_sweep(recordings, levels=LEVELS if levels is None else levels)

    def read_actuators(self, robot: RobotDescription, path: Path) -> tuple[str, ModelParameters]:
        """Return what `actuators_file.read_actuators` returns."""
        del robot
        return actuators_file.read_actuators(path)

    def write_actuators(self, path: Path, found: IdentifiedActuators, more: Mapping[str, Any]) -> None:
        """Write what `actuators_file.write_actuators` writes."""
        assert isinstance(found.parameters, ActuatorParameters)
        actuators_file.write_actuators(path, found.robot, found.parameters, {**found.details, **more})

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

    # ---- recordings ----

    def check_recording(self, path: Path, recording: Recording) -> None:
        """Check what `recordings.check_recording` does.

        **Raises** `InputError` naming file, column, row and fix.
        """
        recordings.check_recording(path, recording)

    @property
    def completed_joints(self) -> tuple[str, ...]:
        """Return the motors, whose servos follow from the commands."""
        return tuple(f"motor_{side}" for side in SIDES)

    def complete_positions(self, fit: KinematicFit) -> KinematicFit:
        """Return what `reconstruct.complete_positions` returns."""
        return reconstruct.complete_positions(fit)

    def complete_joints(
        self,
        model: mujoco.MjModel,
        grid: MeasurementGrid,
        qpos: Float[np.ndarray, "T nq"],
        qvel: Float[np.ndarray, "T nv"],
    ) -> tuple[Float[np.ndarray, "T nq"], Float[np.ndarray, "T nv"]]:
        """Return what `reconstruct.complete_joints` returns."""
        return reconstruct.complete_joints(model, grid, qpos, qvel)

    @property
    def origin(self) -> str:
        """Return the base, which imported recordings start above the origin with."""
        return "base"

    @property
    def floors(self) -> Mapping[str, Mapping[str, float]]:
        """Return the feet's radius (m): the floor is where the lowest foot stands."""
        return {"feet": {f"foot_{side}": recordings.FOOT_RADIUS for side in SIDES}}

    def response(
        self, recording: Recording, time: Float[np.ndarray, " N"], command: Float[np.ndarray, "N 2"]
    ) -> tuple[Float[np.ndarray, "T 2"], Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]] | None:
        """Return how far each leg is bent, and would be by `leg_alignment.nominal_response`."""
        return leg_alignment.response(recording, time, command)
