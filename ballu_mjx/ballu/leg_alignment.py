"""What the legs do on commands, measured and as the nominal robot would: `recordings.clock_alignment` finds the offset
of the clocks at which the two agree."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.model import SIDES, load_model, standing_qpos, suspend
from ballu_mjx.ballu.recordings import base_position, foot_position, knee
from ballu_mjx.recordings.recording import Kind, Recording
from ballu_mjx.robots.model import assets

_SETTLING = 2.0
"""s of rest before the first command."""
_VARIANTS = ((0.65, 0.9), (0.75, 0.8), (0.85, 0.9), (1.0, 0.8))
"""Torque limits over the nominal one, and coefficients of friction."""


def measured_response(recording: Recording) -> Float[np.ndarray, "T 2"] | None:
    """How far each leg is bent: knee angles (rad), or else how near each foot is to the base (m, negative distance).

    None where the recording holds neither.
    """
    if (knees := knee(recording)) is not None:
        return knees
    base, feet = base_position(recording), foot_position(recording)
    return None if base is None or feet is None else -np.linalg.norm(feet - base[:, None], axis=2)


def response(
    recording: Recording, time: Float[np.ndarray, " N"], command: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "T 2"], Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]] | None:
    """Return `measured_response` of a recording and, with its times (s), `nominal_response` to `command` sent at `time`
    (s); None where the recording shows no leg."""
    measured = measured_response(recording)
    if measured is None:
        return None
    return measured, *nominal_response(time, command, recording.kind, knees=knee(recording) is not None)


def nominal_response(
    time: Float[np.ndarray, " N"], command: Float[np.ndarray, "N 2"], kind: Kind, *, knees: bool
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """The same of the nominal robot in C MuJoCo, on `command` sent at `time` (s) from rest.

    Servos, springs and the load on the legs take a good quarter of a second in all; a correlation with the command
    itself would take that for an offset of the clock. The mean over servos of differing strength on floors of differing
    friction, for a single walk's chance is no prediction.

    **Arguments**

    - `knees`: knee angles, or else negative distances.

    **Returns** Times (s), and one column a leg.
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
    """One column a leg, on one row of `command` a time step."""
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
    spec = mujoco.MjSpec.from_file(str(assets() / "ballu.xml"))
    suspend(spec)
    return spec.compile()
