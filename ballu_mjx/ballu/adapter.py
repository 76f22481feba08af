"""BALLU's adapter, which the key `adapter` of its description names."""

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
from ballu_mjx.common.errors import InputError
from ballu_mjx.recordings.inverse_kinematics import KinematicFit
from ballu_mjx.recordings.motion import MeasurementGrid
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.recordings.recording_hooks import RecordingHooks
from ballu_mjx.robots.adapter import (
    DeploymentNotes,
    IdentificationProgress,
    IdentifiedActuators,
    RobotAdapter,
)
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters, assets

_POINTS = ("base", "foot_left", "foot_right")
_ANGLES = ("motor_left", "motor_right", "knee_left", "knee_right")


class Ballu(RobotAdapter, RecordingHooks):
    """Adapter of robots with BALLU's legs.

    Each leg has a hip, a knee with a spring, and a servo near the foot that bends the knee by a cable.
    """

    def check(self, robot: RobotDescription, model: mujoco.MjModel) -> str | None:
        """Return what is wrong with the model or the description, or None if nothing is.

        Names must be BALLU's, and cables must have no damping, because it would act while they are slack.
        """
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
        """Return the standing pose, with the knees at their stops and the feet on the floor."""
        del robot
        return standing_qpos(model)

    def full_travel(self, robot: RobotDescription) -> float:
        """Return 0.2 s, because the servo takes 0.14 s for 60 deg and 0.21 s for 90 deg without load."""
        del robot
        return 0.2

    def deployment_notes(self, robot: RobotDescription) -> DeploymentNotes:
        """Return the places of the markers, the meaning of the commands, and what to measure before the first run."""
        del robot
        return DeploymentNotes(
            markers={
                "balloon": "the balloon cluster's centre of mass, 0.38 m above the neck's hinge, in the robot's middle",
                "base": "the middle of the hip axis",
                "foot_left": "the centre of the left foot's sphere",
                "foot_right": "the centre of the right foot's sphere",
            },
            commands=(
                "0 relaxes the servo (knee at its stop, cable just taut), 1 turns it by 90 deg. Without load, the "
                "servo turns by 60 deg in 0.14 s (90 deg in 0.21 s), so it cannot follow a faster command."
            ),
            measure=(
                "The pulse widths of each servo at command 0 (cable just taut, knee at its stop) and at 90 deg, and "
                "whether a servo turns in the opposite direction. Give the pulse widths by --pulse-low and "
                "--pulse-high, or for each servo in send.",
                "z of the feet while standing (the radius of the foot's sphere, not 0), which foot is left, and the "
                "heights of base and balloon.",
            ),
        )

    def rollout_counts(self, features: Float[np.ndarray, "runs states features"]) -> Mapping[str, list[int]]:
        """Return the number of steps in each run."""
        return {"steps": [int(count_steps(feet)[-1]) for feet in foot_positions(features)]}

    def draw_rollout(
        self, folder: Path, qpos: Float[np.ndarray, "states nq"], command: Float[np.ndarray, "steps commands"]
    ) -> None:
        """Draw the gait in a file `gait.png` in `folder`."""
        from ballu_mjx.ballu import plots  # imports Matplotlib and the identification

        plots.gait(folder / "gait.png", qpos, command)

    def nominal_actuators(self, model: mujoco.MjModel) -> ActuatorParameters:
        """Return the actuator parameters of `model`."""
        return ActuatorParameters.nominal(model)

    def identify_actuators(
        self,
        robot: RobotDescription,
        recordings: Mapping[Path, Any],
        config: Any = None,
        levels: int | None = None,
        progress: IdentificationProgress | None = None,
    ) -> IdentifiedActuators:
        """Return both legs' actuators, identified from a sweep; see `identified_legs.identify_from_sweep`."""
        self._check_bundled(robot)
        from ballu_mjx.ballu.identified_legs import identify_from_sweep  # Optimistix: slow to import

        return identify_from_sweep(recordings, config, levels, progress)

    def check_sweep(self, robot: RobotDescription, recordings: Mapping[Path, Any], levels: int | None = None) -> None:
        """Check that the recordings are a sweep of both legs; see `sweep.read_sweep`.

        **Raises** `InputError` if they are not, or if the robot's model is not the bundled one.
        """
        self._check_bundled(robot)
        read_sweep(recordings, levels=LEVELS if levels is None else levels)

    @staticmethod
    def _check_bundled(robot: RobotDescription) -> None:
        """Check that the robot has the bundled model, which the fit of the legs simulates.

        **Raises** `InputError` if it does not.
        """
        if robot.model.read_bytes() != (assets() / "ballu.xml").read_bytes():
            raise InputError(
                f"{robot.file}: the fit of BALLU's legs needs the bundled model, but {robot.model.name} differs from "
                'it; declare parameters under "identify" and leave out "adapter".'
            )

    def read_actuators(self, robot: RobotDescription, path: Path) -> tuple[str, ModelParameters]:
        """Return the robot's name and its parameters from a file; see `actuators_file.read_actuators`."""
        del robot
        return actuators_file.read_actuators(path)

    def write_actuators(self, path: Path, found: IdentifiedActuators, more: Mapping[str, Any]) -> None:
        """Write a file with the parameters, their details and the keys of `more`; see `actuators_file`."""
        assert isinstance(found.parameters, ActuatorParameters)
        actuators_file.write_actuators(path, found.robot, found.parameters, {**found.details, **more})

    def actuators_to_json(self, parameters: ModelParameters) -> dict[str, Any]:
        """Return the parameters by name, as pairs [left, right]."""
        assert isinstance(parameters, ActuatorParameters)
        return actuators_file.actuators_to_json(parameters)

    def actuators_from_json(self, robot: RobotDescription, values: Mapping[str, Any], path: Path) -> ModelParameters:
        """Return the inverse of `actuators_to_json`.

        **Raises** `InputError` that names the file, the parameter and the fix.
        """
        del robot
        return actuators_file.actuators_from_json(values, path)

    # ---- recordings ----

    def check_recording(self, path: Path, recording: Recording) -> None:
        """Check BALLU's requirements on a recording; see `recordings.check_recording`.

        **Raises** `InputError` that names the file, the column, the row and the fix.
        """
        recordings.check_recording(path, recording)

    @property
    def completed_joints(self) -> tuple[str, ...]:
        """Return the motor joints, whose angles are simulated from the commands."""
        return tuple(f"motor_{side}" for side in SIDES)

    def complete_positions(self, fit: KinematicFit) -> KinematicFit:
        """Return the fit with the base's pitch completed; see `reconstruct.complete_positions`."""
        return reconstruct.complete_positions(fit)

    def complete_joints(
        self,
        model: mujoco.MjModel,
        grid: MeasurementGrid,
        qpos: Float[np.ndarray, "T nq"],
        qvel: Float[np.ndarray, "T nv"],
    ) -> tuple[Float[np.ndarray, "T nq"], Float[np.ndarray, "T nv"]]:
        """Return the states with knees and motors completed; see `reconstruct.complete_joints`."""
        return reconstruct.complete_joints(model, grid, qpos, qvel)

    @property
    def origin(self) -> str:
        """Return the site that is above the origin at the start of an imported recording: the base."""
        return "base"

    @property
    def floors(self) -> Mapping[str, Mapping[str, float]]:
        """Return the heights (m) of the feet's centres above the floor when they touch it.

        The lowest foot then defines the floor.
        """
        return {"feet": {f"foot_{side}": recordings.FOOT_RADIUS for side in SIDES}}

    def response(
        self, recording: Recording, time: Float[np.ndarray, " N"], command: Float[np.ndarray, "N 2"]
    ) -> tuple[Float[np.ndarray, "T 2"], Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]] | None:
        """Return how far each leg is bent, as measured and for the nominal robot; see `leg_alignment.response`."""
        return leg_alignment.response(recording, time, command)
