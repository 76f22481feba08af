"""Aerodynamic residual: a physical model of the air around a buoyant body, with seventeen parameters.

The body is the tracked body of the robot and has `gravcomp` in its model. It drags along half of the air that it
displaces (added mass), and drag slows it. The lift may act at another point than in the model. Each effect is a
textbook formula with one or two unknown constants.
"""

from __future__ import annotations

import dataclasses
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.residuals.added_mass import DraggingBody
from ballu_mjx.residuals.body_motion import body_motion, smooth_speed
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_input import network_input
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.observation import HISTORY
from ballu_mjx.sim.residual import Action, Commands, Fields, History, Residual
from ballu_mjx.sim.step import count_substeps


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class AirParameters:
    """Parameters of the air's effect on the tracked body that the nominal model lacks. 0 means no effect.

    Vectors are in the body frame.
    """

    added_mass: Float[Array, ""]
    """Added mass: mass of the air that the body drags along (kg). It has no weight."""
    added_inertia: Float[Array, ""]
    """Moment of inertia of this air (kg m^2)."""
    lift: Float[Array, ""]
    """Lift in addition to the model's (N)."""
    centre: Float[Array, " 3"]
    """Offset of the point at which mass, lift and drag act from the body's centre of mass in the model (m)."""
    linear_drag: Float[Array, " 3"]
    """Linear drag: force per velocity along each axis (N s/m)."""
    quadratic_drag: Float[Array, " 3"]
    """Quadratic drag: force per velocity along each axis and per speed (N s^2/m^2). It is half the density times area
    times drag coefficient."""
    turning_drag: Float[Array, " 3"]
    """Rotary drag: torque per angular velocity about each axis (N m s)."""
    delay: Float[Array, ""]
    """Delay between commands and actuators (s), at most `longest_delay`. It is no effect of the air. But a late motion
    looks like that of a heavier body, so a fit without the delay would overestimate the added mass."""
    friction: Float[Array, ""]
    """Sliding friction of all contacts in addition to the model's, as a share of the model's (1). It is no effect of
    the air. But drag and sliding contacts both slow a walking robot, so a fit without it would put errors of the
    friction into the drag."""

    @staticmethod
    def none() -> AirParameters:
        """Return the parameters of the nominal model: all are 0."""
        zero = jnp.zeros(())
        three = jnp.zeros(3)
        return AirParameters(zero, zero, zero, three, three, three, three, zero, zero)


AERODYNAMICS_FORMAT = "ballu-air/2"
_READ = ("ballu-air/1", AERODYNAMICS_FORMAT)
"""Formats that can be read. Files of the first one have no friction, which is then 0."""
AERODYNAMICS_FILE = "air.json"
AIR_PARAMETERS = tuple(field.name for field in dataclasses.fields(AirParameters))
FREE_BY_DEFAULT = tuple(name for name in AIR_PARAMETERS if name != "friction")
"""Parameters that are fitted unless others are named."""
SIGNED_AIR_PARAMETERS = ("lift", "centre", "friction")
"""Parameters that may be negative."""
LEAST_FRICTION = -0.95
"""Smallest friction parameter. Contacts keep a twentieth of the model's friction."""
_LARGEST = 100.0
"""Largest magnitude of a parameter other than the delay (SI units), far above all realistic values."""
_SINGLE_PRECISION = 1e-6
"""Relative tolerance of the largest magnitudes, because numbers in files are rounded to single precision."""


def longest_delay(robot: RobotDescription) -> float:
    """Return the longest possible delay of commands (s). The history of a rollout has no older commands."""
    return (HISTORY - 1) * robot.control_timestep


class Aerodynamics(Residual):
    """Aerodynamic residual (`sim.residual.Residual`). Its parameters are `AirParameters`."""

    def __init__(self, robot: RobotDescription, model: mujoco.MjModel) -> None:
        """Prepare the residual for `robot`, whose C model without the residual is `model`.

        **Raises** `InputError` if the tracked body has no buoyancy.
        """
        self._robot, self._body = robot, DraggingBody(robot, model)
        if not model.body_gravcomp[self._body.id] > 0:
            name = model.body(self._body.id).name or "of the tracked site"
            raise InputError(
                f"{robot.model}: the body {name} has no buoyancy, but the aerodynamic residual is for buoyant bodies; "
                'give the body gravcomp="LIFT / WEIGHT".'
            )
        self._control_timestep, self._longest_delay = robot.control_timestep, longest_delay(robot)
        self._centre = jnp.asarray(model.body_ipos)
        self._timestep, self._substeps = float(model.opt.timestep), count_substeps(model, robot.control_timestep)
        self._gravity = float(np.linalg.norm(model.opt.gravity))
        self._friction, self._pair_friction = jnp.asarray(model.geom_friction), jnp.asarray(model.pair_friction)

    @property
    def name(self) -> str:
        """Return the name of a simulator with this residual."""
        return "aerodynamic"

    def inputs(self, history: History, commands: Commands) -> Float[Array, " inputs"]:
        """Return `network_input` with default options. It only serves for the training range; loads do not use it."""
        return network_input(history, commands, ForceNetworkConfig(), self._robot)

    def fields(self, params: AirParameters) -> Fields:
        """Return model fields with the tracked body's mass, inertia, centre of mass and lift, and with the friction.

        The lift compensates the weight of the added mass.
        """
        centre = self._centre.at[self._body.id].add(params.centre)
        friction = self._friction.at[:, 0].multiply(1 + params.friction)
        # Both tangential directions of contacts between explicit pairs of geoms.
        pairs = {"pair_friction": self._pair_friction.at[:, :2].multiply(1 + params.friction)}
        pairs = pairs if len(self._pair_friction) else {}
        lifted = params.lift / self._gravity
        return {
            "body_ipos": centre,
            "geom_friction": friction,
            **pairs,
            **self._body.fields(params.added_mass, params.added_inertia, lifted),
        }

    def command(self, params: AirParameters, commands: Commands) -> Float[Array, "parts commands"]:
        """Return the command that has arrived at the start of each physics step, after the delay.

        Commands are not interpolated. A saturated actuator would otherwise move at full speed too early.
        """
        late = jnp.clip(params.delay, 0.0, self._longest_delay) - self._timestep * jnp.arange(self._substeps)
        age = jnp.ceil(late / self._control_timestep - _ROUNDING)
        return commands[HISTORY - 1 - jnp.maximum(age, 0).astype(int)]

    def act(self, params: AirParameters, history: History, commands: Commands, key: Array | None = None) -> Action:
        """Return the drag in still air, for the velocities in the middle of the coming control step."""
        del commands, key
        now, velocity, rate = body_motion(history, self._control_timestep)
        speed = smooth_speed(velocity)
        force = -(params.linear_drag + params.quadratic_drag * speed) * velocity
        torque = -params.turning_drag * rate
        return Action(jnp.concatenate([now @ force, now @ torque])[None])


_ROUNDING = 1e-3
"""Tolerance for rounding errors of a delay (control steps). Without it, a command whose delay is a whole number of
physics steps could arrive one physics step late."""


def read_air_parameters(path: Path, robot: RobotDescription) -> AirParameters:
    """Read parameters from a file that `train aerodynamic` writes (`AERODYNAMICS_FILE`).

    **Raises** `InputError` if the file is damaged. The message names file, parameter and fix.
    """
    content = files.read_json(path, "restore it or identify again")
    written, parameters = content.get("format"), content.get("parameters")
    if written not in _READ or not isinstance(parameters, dict):
        raise InputError(f'{path}: is not of the format "{AERODYNAMICS_FORMAT}"; give one that this program wrote.')
    if written != AERODYNAMICS_FORMAT:
        parameters = {"friction": 0.0, **parameters}
    return air_parameters_from_json(parameters, path, robot)


def air_parameters_to_json(params: AirParameters) -> dict[str, Any]:
    """Return parameters as JSON types: numbers and lists of three numbers, by name."""
    return {name: _shortest(np.asarray(getattr(params, name), np.float32)) for name in AIR_PARAMETERS}


def _shortest(values: np.ndarray) -> Any:
    """Return numbers with the fewest digits that give the same values in single precision."""
    return [float(str(value)) for value in values] if values.ndim else float(str(values))


def air_parameters_from_json(values: Mapping[str, Any], path: Path, robot: RobotDescription) -> AirParameters:
    """Return the parameters that `air_parameters_to_json` has turned into JSON types. `path` is their file.

    **Raises** `InputError` for a wrong value. The message names file, parameter and allowed values.
    """
    unknown = sorted(set(values) - set(AIR_PARAMETERS))
    if unknown:
        raise InputError(
            f"{path}: there is no parameter {reprlib.repr(unknown[0])}; parameters are {', '.join(AIR_PARAMETERS)}."
        )
    read = {}
    for name, like in AirParameters.none().__dict__.items():
        value = values.get(name)
        numbers: list[Any] = value if isinstance(value, list) else [value]
        if len(numbers) != max(like.size, 1) or not all(is_number(x) for x in numbers):
            needed = "three numbers" if like.size == 3 else "a number"
            raise InputError(f"{path}: {name} must be {needed}, not {reprlib.repr(value)}.")
        if name not in SIGNED_AIR_PARAMETERS and min(numbers) < 0:
            raise InputError(f"{path}: {name} is {value}; it must be 0 or more.")
        if name == "friction" and min(numbers) < LEAST_FRICTION * (1 + _SINGLE_PRECISION):
            raise InputError(f"{path}: friction is {value}; it must be {LEAST_FRICTION} or more.")
        largest = longest_delay(robot) if name == "delay" else _LARGEST
        if max(map(abs, numbers)) > largest * (1 + _SINGLE_PRECISION):
            raise InputError(f"{path}: {name} is {value}; its magnitude must be {largest:g} or less.")
        read[name] = jnp.asarray(numbers, jnp.float32).reshape(like.shape)
    return AirParameters(**read)
