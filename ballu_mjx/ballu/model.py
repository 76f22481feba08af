"""BALLU's model: the names of its parts, the whole robot, and a suspended leg.

The world's z axis points up. The robot's x axis points forward and its y axis left. Units are SI units and radians.
Arrays with a pair of entries are ordered (left, right).
"""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.robots.model import ModelParameters, assets
from ballu_mjx.robots.model import load_model as load_model_file

SIDES = ("left", "right")
JOINTS = ("neck", "hip_left", "knee_left", "motor_left", "hip_right", "knee_right", "motor_right")
"""Hinges in the order of `qpos[7:]` and `qvel[6:]`. The entries before these belong to the base's free joint."""
HIPS, KNEES, MOTORS = (slice(1, None, 3), slice(2, None, 3), slice(3, None, 3))
"""Slices of `JOINTS` with the hips, the knees and the motors, each (left, right)."""
CONTROL_TIMESTEP = 0.05
"""Length of a control step (s): commands change at 20 Hz."""


def load_model(actuators: ModelParameters | None = None) -> mujoco.MjModel:
    """Return BALLU's model for C MuJoCo: nominal ("vanilla") or with identified actuators ("vanilla+sysid")."""
    return load_model_file(assets() / "ballu.xml", actuators)


def suspend(spec: mujoco.MjSpec) -> None:
    """Weld the base to the world, upright and with the feet off the ground, as in a sweep.

    The neck is fixed too. `spec` is changed in place.
    """
    spec.body("base").pos = [0, 0, 1.5]
    spec.delete(spec.joint("root"))
    spec.delete(spec.joint("neck"))


def load_suspended_leg(side: str) -> mujoco.MjModel:
    """Return a model of one leg of the nominal robot, suspended from a fixed base, without contacts.

    The other leg is left out, because it does not affect this one.
    """
    spec = mujoco.MjSpec.from_file(str(assets() / "ballu.xml"))
    suspend(spec)
    for other in SIDES:
        if other != side:
            spec.delete(spec.body(f"femur_{other}"))
    spec.delete(spec.body("balloon"))
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return spec.compile()


def buoyancy_ratio(model: mujoco.MjModel) -> float:
    """Return the ratio of the balloons' lift to the weight of the whole robot in `model`."""
    balloon = model.body("balloon").id
    return float(model.body_gravcomp[balloon] * model.body_mass[balloon] / model.body_mass.sum())


def standing_qpos(model: mujoco.MjModel) -> Float[np.ndarray, " nq"]:
    """Return generalized positions with the knees at their stops, the hips at -14 deg and the feet on the floor."""
    qpos = model.qpos0.copy()
    qpos[[model.joint(f"hip_{side}").qposadr[0] for side in SIDES]] = np.deg2rad(-14.0)
    qpos[model.jnt_qposadr[knee_ids(model)]] = model.jnt_range[knee_ids(model), 0]
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    feet = [data.site(f"foot_{side}").xpos[2] for side in SIDES]
    radius = model.geom("foot_left").size[0]
    qpos[2] += radius - min(feet)
    return qpos


def leg_sides(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return the sides of the legs that `model` has."""
    return tuple(side for side in SIDES if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, f"knee_{side}") >= 0)


def knee_ids(model: mujoco.MjModel) -> np.ndarray:
    """Return the ids of the knees among the model's joints, in the order of `leg_sides`."""
    return np.array([model.joint(f"knee_{side}").id for side in leg_sides(model)])
