"""Whether a model holds together by itself: replays of recorded motions in C MuJoCo, which need no compiling."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.guard import physics_commands, simulate_motion
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters, bare_parameters
from ballu_mjx.sim.step import count_substeps

HORIZON = 0.5
"""Seconds that a model must hold together for."""
_STARTS = 16
"""States to start from, over all recordings."""
_TOLERATED = 0.5
"""Share of starts that may break down: single states may be at fault themselves."""
_SHORTER = (2, 4, 8, 16)
"""Parts of the time step that are tried as a cure."""


def check_stability(robot: RobotDescription, motions: Sequence[Motion], parameters: ModelParameters | None) -> None:
    """Replay recorded commands from recorded states, without residual forces.

    **Raises** `InputError` where the model breaks down from most of them, with the time step at which it does not.
    """
    parameters = bare_parameters(parameters)
    model = robot.load_model(parameters)
    lasted = _lasted(robot, model, motions, parameters)
    if np.mean(lasted < HORIZON) <= _TOLERATED:
        return
    problem = (
        f"the model diverges from its recorded states within {max(np.median(lasted), model.opt.timestep):.2g} s, "
        "without any residual forces"
    )
    raise InputError(f"{robot.model}: {problem}; {_cure(robot, model, motions, parameters)}.")


def _cure(
    robot: RobotDescription, model: mujoco.MjModel, motions: Sequence[Motion], parameters: ModelParameters | None
) -> str:
    own = float(model.opt.timestep)
    for parts in _SHORTER:
        finer = copy.copy(model)
        finer.opt.timestep = own / parts
        if np.mean(_lasted(robot, finer, motions, parameters) < HORIZON) <= _TOLERATED:
            return f'write timestep="{own / parts:g}" in place of {own:g} s, at which it does not'
    return "soften its stiffest springs, gains or contacts, or correct masses and inertias that are too small"


def _lasted(
    robot: RobotDescription, model: mujoco.MjModel, motions: Sequence[Motion], parameters: ModelParameters | None
) -> Float[np.ndarray, " starts"]:
    """Seconds until each start breaks down, `HORIZON` at most."""
    substeps = count_substeps(model, robot.control_timestep)
    found = []
    for motion in motions:
        steps = min(max(round(HORIZON / robot.control_timestep), 1), len(motion.command))
        starts = np.unique(np.linspace(0, len(motion.command) - steps, max(_STARTS // len(motions), 1)).astype(int))
        ctrl = physics_commands(parameters, motion.command, substeps, float(model.opt.timestep))
        _, intact = simulate_motion(model, motion, starts, ctrl, steps, substeps)
        whole = np.logical_and.accumulate(intact, axis=1).sum(axis=1)
        found.append(np.where(whole == steps, HORIZON, whole * robot.control_timestep))
    return np.concatenate(found)
