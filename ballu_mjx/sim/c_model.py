"""A simulator's model for C MuJoCo, with the numbers that the MJX simulator has changed."""

from __future__ import annotations

import mujoco
import numpy as np

from ballu_mjx.sim.simulator import AugmentedSimulator

DERIVED_FIELDS = ("body_invweight0", "body_subtreemass", "dof_invweight0", "tendon_invweight0")
"""Fields that C MuJoCo derives from the others."""


def improved_model(simulator: AugmentedSimulator) -> mujoco.MjModel:
    """Return the simulator's model for C MuJoCo: with identified actuators, and the residual's fields."""
    plain = simulator.simulator
    model = mujoco.MjModel.from_xml_path(str(simulator.robot.model))
    for name in dir(model):  # a copy, but for what copies forget
        value = None if name.startswith("_") else getattr(plain.mj_model, name, None)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            getattr(model, name)[...] = value
    changed = False
    for name in dir(plain.model):
        own = None if name.startswith("_") or name in DERIVED_FIELDS else getattr(model, name, None)
        if not isinstance(own, np.ndarray) or own.dtype.kind != "f":
            continue
        now = np.asarray(getattr(plain.model, name))
        if now.shape != own.shape or now.dtype.kind != "f":
            continue
        # In MJX's precision, so that what it only rounds stays as it is.
        different = now != own.astype(now.dtype)
        own[different] = now[different]
        changed = changed or bool(different.any())
    if changed:
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
