"""A simulator's model for C MuJoCo, with the values that the MJX simulator has changed, and poses of its sites."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.sim.simulator import AugmentedSimulator

DERIVED_FIELDS = ("body_invweight0", "body_subtreemass", "dof_invweight0", "tendon_invweight0")
"""Fields that C MuJoCo derives from other fields."""


def improved_model(simulator: AugmentedSimulator) -> mujoco.MjModel:
    """Return the simulator's model for C MuJoCo, with the identified actuators and the residual's model fields."""
    plain = simulator.simulator
    model = _copy(plain.mj_model)
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
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _copy(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of a model, with all of its options. `copy.copy` loses part of it."""
    content = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return mujoco.MjModel.from_binary_path("copy.mjb", {"copy.mjb": content.tobytes()})


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
