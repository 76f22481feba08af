"""The white-box residual: what the air does to a buoyant body, in sixteen numbers.

The body is the tracked one of the robot, and has `gravcomp` in its model. It drags half its displaced air
along, is slowed by it, and is lifted at a point that need not be where the model has it. Each of these is a textbook's
formula with a constant or two to find; none needs a network.
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
    """What the nominal model leaves out of the air's effect on the tracked body; all 0: nothing.

    Axes are the body's.
    """

    added_mass: Float[Array, ""]
    """Mass of air that the body drags along (kg); weightless."""
    added_inertia: Float[Array, ""]
    """Moment of inertia of that air (kg m^2)."""
    lift: Float[Array, ""]
    """Lift beyond the model's (N)."""
    centre: Float[Array, " 3"]
    """Where mass, lift and drag act, off the model's centre of mass of the body (m)."""
    linear_drag: Float[Array, " 3"]
    """Force for each m/s along each axis (N s/m)."""
    quadratic_drag: Float[Array, " 3"]
    """Force for each m/s along each axis, times the speed (N s^2/m^2): half density times area times coefficient."""
    turning_drag: Float[Array, " 3"]
    """Torque for each rad/s about each axis (N m s)."""
    delay: Float[Array, ""]
    """How late commands reach the actuators (s, at most `longest_delay`). No air, but what moves late passes for heavy:
    left out, it is laid at the added mass's door."""

    @staticmethod
    def none() -> AirParameters:
        """The nominal model's air."""
        zero = jnp.zeros(())
        three = jnp.zeros(3)
        return AirParameters(zero, zero, zero, three, three, three, three, zero)


AERODYNAMICS_FORMAT = "ballu-air/1"
AERODYNAMICS_FILE = "air.json"
AIR_PARAMETERS = tuple(field.name for field in dataclasses.fields(AirParameters))
SIGNED_AIR_PARAMETERS = ("lift", "centre")
"""All others are 0 or more."""
_MOST = 100.0
"""No parameter comes near, in SI units."""


def longest_delay(robot: RobotDescription) -> float:
    """Return the longest delay of commands (s): older commands are not remembered."""
    return (HISTORY - 1) * robot.control_timestep


class Aerodynamics(Residual):
    """The force model (see `residual.Residual`) whose parameters are `AirParameters`."""

    def __init__(self, robot: RobotDescription, model: mujoco.MjModel) -> None:
        """Prepare for `robot`; `model` is its C model without the residual.

        **Raises** `InputError` where the tracked body has no buoyancy.
        """
        self._robot, self._body = robot, int(model.site_bodyid[model.site(robot.tracked).id])
        if not model.body_gravcomp[self._body] > 0:
            name = model.body(self._body).name or "that the tracked site is on"
            raise InputError(
                f"{robot.model}: the body {name} has no buoyancy, which aerodynamics are identified for; give it "
                'gravcomp="LIFT / WEIGHT".'
            )
        self._control_timestep, self._longest_delay = robot.control_timestep, longest_delay(robot)
        self._mass, self._inertia = jnp.asarray(model.body_mass), jnp.asarray(model.body_inertia)
        self._centre, self._gravcomp = jnp.asarray(model.body_ipos), jnp.asarray(model.body_gravcomp)
        self._timestep, self._substeps = float(model.opt.timestep), count_substeps(model, robot.control_timestep)
        self._gravity = float(np.linalg.norm(model.opt.gravity))

    @property
    def name(self) -> str:
        """Return what a simulator improved by it is called."""
        return "aerodynamic"

    def inputs(self, history: History, commands: Commands) -> Float[Array, " inputs"]:
        return network_input(history, commands, ForceNetworkConfig(), self._robot)

    def fields(self, params: AirParameters) -> Fields:
        """Return the tracked body's mass, inertia, centre and lift. The lift carries the added mass."""
        body = self._body
        mass = self._mass.at[body].add(params.added_mass)
        lift = (self._gravcomp[body] * self._mass[body] + params.added_mass) * self._gravity + params.lift
        return {
            "body_mass": mass,
            "body_inertia": self._inertia.at[body].add(params.added_inertia),
            "body_ipos": self._centre.at[body].add(params.centre),
            "body_gravcomp": self._gravcomp.at[body].set(lift / (mass[body] * self._gravity)),
        }

    def command(self, params: AirParameters, commands: Commands) -> Float[Array, "parts commands"]:
        """What has arrived by the start of each physics step, `delay` late.

        Not a mean of old and new command: an actuator that saturates would turn at once as fast as it can.
        """
        late = jnp.clip(params.delay, 0.0, self._longest_delay) - self._timestep * jnp.arange(self._substeps)
        age = jnp.ceil(late / self._control_timestep - _JUST)
        return commands[HISTORY - 1 - jnp.maximum(age, 0).astype(int)]

    def act(self, params: AirParameters, history: History, commands: Commands, key: Array | None = None) -> Action:
        """Return the drag in still air, by the velocities in the middle of the coming control step."""
        del commands, key
        now, velocity, rate = body_motion(history, self._control_timestep)
        speed = smooth_speed(velocity)
        force = -(params.linear_drag + params.quadratic_drag * speed) * velocity
        torque = -params.turning_drag * rate
        return Action(jnp.concatenate([now @ force, now @ torque])[None])


_JUST = 1e-3
"""Of a control step: a delay of just so many physics steps is over when they are."""


def read_air_parameters(path: Path, robot: RobotDescription) -> AirParameters:
    """The parameters in a file of the format `ballu-air/1`, which `train aerodynamic` writes.

    **Raises** `InputError` naming file, key and mend.
    """
    content = files.read_json(path, "restore it or identify again")
    if content.get("format") != AERODYNAMICS_FORMAT or not isinstance(content.get("parameters"), dict):
        raise InputError(f'{path}: is not of the format "{AERODYNAMICS_FORMAT}"; give one that this program wrote.')
    return air_parameters_from_json(content["parameters"], path, robot)


def air_parameters_to_json(params: AirParameters) -> dict[str, Any]:
    """Numbers and lists of three by name."""
    return {name: np.asarray(getattr(params, name), np.float64).round(9).tolist() for name in AIR_PARAMETERS}


def air_parameters_from_json(values: Mapping[str, Any], path: Path, robot: RobotDescription) -> AirParameters:
    """Return the inverse of `air_parameters_to_json`.

    **Raises** `InputError` naming `path`, the parameter and the mend.
    """
    unknown = sorted(set(values) - set(AIR_PARAMETERS))
    if unknown:
        raise InputError(
            f"{path}: there is no parameter {reprlib.repr(unknown[0])}; there are {', '.join(AIR_PARAMETERS)}."
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
        most = longest_delay(robot) if name == "delay" else _MOST
        if max(map(abs, numbers)) > most:
            raise InputError(f"{path}: {name} is {value}; it must be {most:g} or less.")
        read[name] = jnp.asarray(numbers, jnp.float32).reshape(like.shape)
    return AirParameters(**read)
