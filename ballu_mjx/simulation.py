"""One control step of the robot in MJX."""

from __future__ import annotations

import jax
import mujoco
import numpy as np
from jaxtyping import Array, Float
from mujoco import mjx

from ballu_mjx.robot import CONTROL_TIMESTEP


def substeps(model: mujoco.MjModel) -> int:
    """Physics steps in a control step.

    Raises `ValueError` where the control step is no whole number of them.
    """
    count = CONTROL_TIMESTEP / model.opt.timestep
    if abs(count - round(count)) > 1e-6:
        raise ValueError(
            f"The model's timestep {model.opt.timestep} s does not divide the control step of {CONTROL_TIMESTEP} s."
        )
    return round(count)


def control_step(
    model: mjx.Model,
    data: mjx.Data,
    command: Float[Array, " 2"],
    force: Float[Array, " 3"],
    *,
    balloon: int,
    count: int,
) -> mjx.Data:
    """Advance by `count` physics steps, command and external force held.

    **Arguments**

    - `command`: servo commands (left, right) in [0, 1].
    - `force`: force (N, world frame) at the centre of mass of the body with the id `balloon`.
    """
    data = data.replace(ctrl=command, xfrc_applied=data.xfrc_applied.at[balloon, :3].set(force))  # pyright: ignore
    return jax.lax.fori_loop(0, count, lambda _, d: mjx.step(model, d), data)


def make_data(model: mujoco.MjModel) -> mjx.Data:
    """MJX data of `model` at its reference pose, on the default device."""
    return mjx.make_data(model)


def balloon_id(model: mujoco.MjModel) -> int:
    """Body id of the balloon."""
    return int(np.asarray(model.body("balloon").id))
