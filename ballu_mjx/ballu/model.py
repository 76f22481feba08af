"""BALLU's model: the names in it, the whole robot and a suspended leg.

Frames: world z up; the robot's x forward, y left. SI units and radians throughout. Arrays with a pair of entries
are ordered (left, right).
"""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.robots.model import ModelParameters, assets
from ballu_mjx.robots.model import load_model as load_model_file

SIDES = ("left", "right")
JOINTS = ("neck", "hip_left", "knee_left", "motor_left", "hip_right", "knee_right", "motor_right")
"""Hinges in the order of `qpos[7:]` and `qvel[6:]`; the first seven (six) entries are the base's free joint."""
HIPS, KNEES, MOTORS = (slice(1, None, 3), slice(2, None, 3), slice(3, None, 3))
"""Places of the left and right hip, knee and motor within `JOINTS`."""
CONTROL_TIMESTEP = 0.05
"""Seconds between two commands (20 Hz)."""


def load_model(actuators: ModelParameters | None = None) -> mujoco.MjModel:
    """Return BALLU for C MuJoCo: the nominal one ("vanilla"), or with identified actuators ("vanilla+sysid")."""
    return load_model_file(assets() / "ballu.xml", actuators)


def suspend(spec: mujoco.MjSpec) -> None:
    """Weld the base to the world, upright and with the feet off the ground, as in an actuator sweep; in place."""
    spec.body("base").pos = [0, 0, 1.5]
    spec.delete(spec.joint("root"))
    spec.delete(spec.joint("neck"))


def load_suspended_leg(side: str) -> mujoco.MjModel:
    """The nominal robot's leg on one side, alone, hanging from a base that is held still: what the other leg does
    changes nothing for it."""
    spec = mujoco.MjSpec.from_file(str(assets() / "ballu.xml"))
    suspend(spec)
    for other in SIDES:
        if other != side:
            spec.delete(spec.body(f"femur_{other}"))
    spec.delete(spec.body("balloon"))
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return spec.compile()


def buoyancy_ratio(model: mujoco.MjModel) -> float:
    """Lift over the whole robot's weight, as it stands in `model`."""
    balloon = model.body("balloon").id
    return float(model.body_gravcomp[balloon] * model.body_mass[balloon] / model.body_mass.sum())


def standing_qpos(model: mujoco.MjModel) -> Float[np.ndarray, " nq"]:
    """Generalized position with the knees at their stops, the hips at -14 deg and the feet on the floor."""
    qpos = model.qpos0.copy()
    hinges = qpos[7:]
    hinges[HIPS] = np.deg2rad(-14.0)
    hinges[KNEES] = model.jnt_range[knee_ids(model), 0]
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    feet = [data.site(f"foot_{side}").xpos[2] for side in SIDES]
    radius = model.geom("foot_left").size[0]
    qpos[2] += radius - min(feet)
    return qpos


def leg_sides(model: mujoco.MjModel) -> tuple[str, ...]:
    """The legs that `model` has."""
    return tuple(side for side in SIDES if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, f"knee_{side}") >= 0)


def knee_ids(model: mujoco.MjModel) -> np.ndarray:
    """Places of the knees among the model's joints, left and right."""
    return np.array([model.joint(f"knee_{side}").id for side in leg_sides(model)])
