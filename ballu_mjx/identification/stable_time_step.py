"""Check that a model does not diverge by itself: replays of recorded motions in C MuJoCo, which need no compilation."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.actuator_choice import physics_commands, simulate_motion
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters, bare_parameters
from ballu_mjx.sim.step import count_substeps

HORIZON = 0.5
"""Time in which a model must not diverge (s)."""
_STARTS = 16
"""Number of starts over all recordings."""
_TOLERATED = 0.5
"""Share of starts that may diverge, because single recorded states may be wrong."""
_SHORTER = (2, 4, 8, 16)
"""Divisors of the time step that are tried as a fix."""


def check_stability(robot: RobotDescription, motions: Sequence[Motion], parameters: ModelParameters | None) -> None:
    """Check that replays of recorded commands from recorded states do not diverge, without residual forces.

    **Raises** `InputError` if the model diverges from most of these states, with a time step at which it does not.
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
    raise InputError(f"{robot.model}: {problem}; {_fix(robot, model, motions, parameters)}.")


def _fix(
    robot: RobotDescription, model: mujoco.MjModel, motions: Sequence[Motion], parameters: ModelParameters | None
) -> str:
    """Return a fix of a model that diverges, in words: a shorter time step, or else changes of the model."""
    own = float(model.opt.timestep)
    for parts in _SHORTER:
        finer = copy.copy(model)
        finer.opt.timestep = own / parts
        if np.mean(_lasted(robot, finer, motions, parameters) < HORIZON) <= _TOLERATED:
            return f'write timestep="{own / parts:g}", at which it does not, in place of {own:g} s'
    return "soften its stiffest springs, gains or contacts, or correct masses and inertias that are too small"


def _lasted(
    robot: RobotDescription, model: mujoco.MjModel, motions: Sequence[Motion], parameters: ModelParameters | None
) -> Float[np.ndarray, " starts"]:
    """Return the time until each start diverges (s), at most `HORIZON`."""
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
