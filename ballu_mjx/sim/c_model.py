"""A simulator's model for C MuJoCo, with the values that the MJX simulator has changed, and poses of its sites."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.robots.model import load_without_simple_bodies
from ballu_mjx.sim.simulator import AugmentedSimulator

DERIVED_FIELDS = ("body_invweight0", "body_subtreemass", "dof_invweight0", "tendon_invweight0")
"""Fields that C MuJoCo derives from other fields."""


def improved_model(simulator: AugmentedSimulator) -> mujoco.MjModel:
    """Return the simulator's model for C MuJoCo, with the identified actuators and the residual's model fields."""
    plain = simulator.simulator
    model = load_without_simple_bodies(simulator.robot.model)
    for name in dir(model):  # instead of copy.copy, which loses part of a model
        value = None if name.startswith("_") else getattr(plain.mj_model, name, None)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            getattr(model, name)[...] = value
    model.opt.iterations = plain.mj_model.opt.iterations
    for name in dir(plain.model):
        own = None if name.startswith("_") or name in DERIVED_FIELDS else getattr(model, name, None)
        if not isinstance(own, np.ndarray) or own.dtype.kind != "f":
            continue
        now = np.asarray(getattr(plain.model, name))
        if now.shape != own.shape or now.dtype.kind != "f":
            continue
        # Compare in MJX's precision, so that values that it merely rounds stay unchanged.
        different = now != own.astype(now.dtype)
        own[different] = now[different]
    # Also if only actuators were identified: the fresh model takes a body's inertial frame for the body's own frame.
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def site_poses(
    model: mujoco.MjModel, name: str, qpos: Float[np.ndarray, "*states nq"]
) -> tuple[Float[np.ndarray, "*states 3"], Float[np.ndarray, "*states 4"]]:
    """Return the position of a site (m, world frame) and the quaternion (w, x, y, z) of its body.

    `qpos` are generalized positions of any number of states.
    """
    data, site = mujoco.MjData(model), model.site(name).id
    states = qpos.shape[:-1]
    positions, quaternions = np.zeros((*states, 3)), np.zeros((*states, 4))
    for index in np.ndindex(*states):
        data.qpos[:] = qpos[index]
        mujoco.mj_kinematics(model, data)
        positions[index], quaternions[index] = data.site_xpos[site], data.xquat[model.site_bodyid[site]]
    return positions, quaternions
