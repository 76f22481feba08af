"""Motions that C MuJoCo simulates, for tests of what is learned from recordings."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.recordings.motion import Motion


def simulate_motion(
    name: str,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    command: Float[np.ndarray, "steps commands"],
    control_timestep: float,
) -> Motion:
    """Return the motion from the state in `data` under commands of `control_timestep` (s). Forces in `data` act."""
    qpos, qvel = [data.qpos.copy()], [data.qvel.copy()]
    for now in command:
        data.ctrl[:] = now
        mujoco.mj_step(model, data, round(control_timestep / model.opt.timestep))
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
    time = np.arange(len(command) + 1) * control_timestep
    return Motion(name, time, command, np.array(qpos), np.array(qvel), {})
