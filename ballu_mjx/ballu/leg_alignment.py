"""Responses of the legs to commands, as measured and for the nominal robot.

`recordings.clock_alignment` finds the offset between two clocks at which both responses agree.
"""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.model import SIDES, load_model, standing_qpos, suspend
from ballu_mjx.ballu.recordings import base_position, foot_position, knee
from ballu_mjx.recordings.recording import Kind, Recording
from ballu_mjx.robots.model import assets

_SETTLING = 2.0
"""Time (s) of rest before the first command."""
_VARIANTS = ((0.65, 0.9), (0.75, 0.8), (0.85, 0.9), (1.0, 0.8))
"""Torque limits as a fraction of the nominal one, and coefficients of friction of the feet."""


def measured_response(recording: Recording) -> Float[np.ndarray, "T 2"] | None:
    """Return how far each leg is bent: the knee angle (rad), or else the negative distance (m) from base to foot.

    None if the recording has neither.
    """
    if (knees := knee(recording)) is not None:
        return knees
    base, feet = base_position(recording), foot_position(recording)
    return None if base is None or feet is None else -np.linalg.norm(feet - base[:, None], axis=2)


def response(
    recording: Recording, time: Float[np.ndarray, " N"], command: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "T 2"], Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]] | None:
    """Return the measured response of a recording, and the nominal response to `command` sent at `time` (s).

    None if the recording does not show the legs.

    **Returns** `measured_response`, then the times (s) and the values of `nominal_response`.
    """
    measured = measured_response(recording)
    if measured is None:
        return None
    return measured, *nominal_response(time, command, recording.kind, knees=knee(recording) is not None)


def nominal_response(
    time: Float[np.ndarray, " N"], command: Float[np.ndarray, "N 2"], kind: Kind, *, knees: bool
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """Return how far the nominal robot's legs bend in C MuJoCo, for `command` sent at `time` (s) from rest.

    Servos, springs and the load on the legs take slightly more than a quarter of a second to respond. A correlation
    with the command itself would mistake this for an offset between the clocks. The response is a mean over servos of
    different strength and floors of different friction, because a single walk depends too much on chance.

    **Arguments**

    - `knees`: whether to return knee angles (rad), as opposed to negative distances (m) from base to foot.

    **Returns** Times (s), and responses with one column for each leg.
    """
    model = _suspended() if kind == "suspended" else load_model()
    strongest = model.actuator_forcerange.copy()
    grid = time[0] + model.opt.timestep * np.arange(int((time[-1] - time[0]) / model.opt.timestep) + 1)
    sent = command[np.searchsorted(time, grid + 1e-9, side="right") - 1]
    legs = np.zeros((len(grid), 2))
    for strength, friction in _VARIANTS:
        model.actuator_forcerange[:] = strength * strongest
        for side in SIDES:
            model.geom(f"foot_{side}").friction[0] = friction
        legs += _simulate(model, sent, kind, knees=knees)
    return grid, legs / len(_VARIANTS)


def _simulate(
    model: mujoco.MjModel, command: Float[np.ndarray, "n 2"], kind: Kind, *, knees: bool
) -> Float[np.ndarray, "n 2"]:
    """Return responses with one column for each leg, for one row of `command` at each time step."""
    data = mujoco.MjData(model)
    if kind == "free":
        data.qpos[:] = standing_qpos(model)
    mujoco.mj_step(model, data, round(_SETTLING / model.opt.timestep))
    joints = [model.joint(f"knee_{side}").qposadr[0] for side in SIDES]
    base, feet = model.site("base").id, [model.site(f"foot_{side}").id for side in SIDES]
    legs = np.empty((len(command), 2))
    for step, row in enumerate(command):
        if knees:
            legs[step] = data.qpos[joints]
        else:
            legs[step] = -np.linalg.norm(data.site_xpos[feet] - data.site_xpos[base], axis=1)
        data.ctrl[:] = row
        mujoco.mj_step(model, data)
    return legs


def _suspended() -> mujoco.MjModel:
    """Return the model of the nominal robot, suspended."""
    spec = mujoco.MjSpec.from_file(str(assets() / "ballu.xml"))
    suspend(spec)
    return spec.compile()
