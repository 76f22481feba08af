"""Search for undeclared parameters that would explain the remaining error of a fit.

Standard errors do not show what a model lacks. Dry friction without a parameter is attributed to damping, however many
recordings there are. The remaining error of the fit shows it. The candidates are friction, damping and armature of
joints, gains of actuators, and the drivetrain of commands. Each is tried as one Gauss-Newton step beside the declared
parameters. This is a score test, which needs no search.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
from scipy import special

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.declarations import parameters_of
from ballu_mjx.identification.fit_robot import RobotFit
from ballu_mjx.identification.measured_motion import MeasuredMotion
from ballu_mjx.identification.parameters import Parameter, ParameterSet
from ballu_mjx.identification.window_objective import ReducedResiduals, WindowConfig, WindowObjective
from ballu_mjx.identification.window_simulator import WindowSimulator
from ballu_mjx.robots.description import RobotDescription


class Suggestion(NamedTuple):
    """An undeclared parameter that the description should declare."""

    entry: Mapping[str, Any]
    """Entry for the key `identify` of the description. Bounds and prior are rough."""
    parameter: Parameter
    value: float
    """Estimate to first order, in the parameter's unit."""
    explained: float
    """Share of the remaining sum of squares that it explains, in addition to the suggestions before it."""

    def details(self) -> dict[str, Any]:
        """Return the suggestion as JSON types."""
        name, unit = self.parameter.name, self.parameter.unit
        return {"name": name, "unit": unit, "value": self.value, "explained": self.explained, "entry": dict(self.entry)}


def suggestions_table(suggestions: Sequence[Suggestion]) -> str:
    """Return the suggestions as text, with the lines to add to the description."""
    lines = ["Undeclared parameters that would explain the remaining error:"]
    for each in suggestions:
        unit = "" if each.parameter.unit == "1" else each.parameter.unit
        value = f"{each.value:.2g} {unit}".strip()
        lines.append(f"  {each.parameter.name}, about {value}: {each.explained:.0%} of the sum of squares.")
        lines.append(f'    Add to "identify": {json.dumps(dict(each.entry))}')
    lines.append("Declare these and identify again. Until then other parameters compensate for them.")
    return "\n".join(lines)


SMALL_EFFECT = 0.02
"""Smallest effect of a suggestion: Cohen's f^2, the explained sum of squares over the one that remains. 0.02 is a small
effect (Cohen, "Statistical power analysis for the behavioral sciences", 1988)."""
_CHANCE = 0.003
"""Probability that a candidate without effect passes the test."""


def candidate_entries(robot: RobotDescription, model: mujoco.MjModel) -> list[dict[str, Any]]:
    """Return declarations of effects that robots often have and models often lack."""
    entries: list[dict[str, Any]] = []
    for number in range(model.njnt):
        joint = model.joint(number)
        if joint.name and model.jnt_type[number] in _SCALAR_JOINTS:
            entries += [{"joint": joint.name, "field": field} for field in ("frictionloss", "damping", "armature")]
    for number in range(model.nu):
        if name := model.actuator(number).name:
            entries += [
                {"actuator": name, "field": field} for field in ("kp", "kd", "strength")
            ]  # inapplicable ones are dropped later
    for command in robot.commands:
        entries += [{"command": command, "field": field} for field in ("delay", "backlash", "lag", "scale", "offset")]
    return entries


_SCALAR_JOINTS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def suggest_parameters(
    robot: RobotDescription,
    fit: RobotFit,
    motions: Sequence[MeasuredMotion],
    config: WindowConfig | None = None,
) -> tuple[Suggestion, ...]:
    """Return undeclared parameters that would explain the remaining error of `fit`.

    The candidate that explains most comes first. The next ones explain the remainder (forward selection). A candidate
    is suggested if it differs significantly from nominal over the fitted windows, whose errors are independent
    (Student's t). Held-out windows have no influence. The candidate's step must also be allowed (friction is not
    negative), and its effect must be at least small (`SMALL_EFFECT`). A single window supports no suggestion.

    **Arguments**

    - `motions`, `config`: training motions and options of the fit.
    """
    config, model = config or WindowConfig(), motions[0].model
    taken = {target[:2] for parameter in fit.parameters.parameters for target in parameter.targets}
    entries, candidates = [], []
    for entry in candidate_entries(robot, model):
        parameter = _candidate(robot, model, entry)
        if parameter is not None and not taken & {target[:2] for target in parameter.targets}:
            taken |= {target[:2] for target in parameter.targets}
            entries.append(entry)
            candidates.append(parameter)
    if not candidates or len(fit.windows.motion) < 2:
        return ()
    extended = ParameterSet([*fit.parameters.parameters, *candidates], fit.parameters.commands)
    values = np.concatenate([fit.values, [candidate.nominal for candidate in candidates]])
    with jax.enable_x64(True):
        objective = WindowObjective(WindowSimulator(extended, motions, fit.windows), config)
        objective.scale = fit.scatter
        start = objective.measured_start()
        reduced, _ = objective(values, start)
        for _ in range(_SETTLING):
            reduced, _ = objective(values, reduced.start)
    chosen = _select(reduced, fit.parameters, candidates)
    return tuple(
        Suggestion(_bounded(entries[c], candidates[c], value), candidates[c], value, explained)
        for c, value, explained in chosen
    )


_SETTLING = 3
"""Number of evaluations in which starting states converge to their optimum."""


def _candidate(robot: RobotDescription, model: mujoco.MjModel, entry: Mapping[str, Any]) -> Parameter | None:
    """Return the parameter of an entry, with the bounds 0 to 1 if its nominal value gives no default. None if the
    element does not have it."""
    for bounds in ({}, {"bounds": [0, 1]}):
        try:
            return parameters_of(robot, model, [{**entry, **bounds}])[0]
        except InputError:
            continue
    return None


def _bounded(entry: Mapping[str, Any], candidate: Parameter, value: float) -> dict[str, Any]:
    """Return an entry that can be declared, with bounds if its nominal value gives no default."""
    if candidate.nominal or "command" in entry:
        return dict(entry)
    return {**entry, "bounds": [0, float(f"{_ROOM * value:.1g}")]}


_ROOM = 4.0
"""Upper bound of a suggestion, relative to its estimate."""


def _select(
    reduced: ReducedResiduals, declared: ParameterSet, candidates: Sequence[Parameter]
) -> list[tuple[int, float, float]]:
    """Return index, estimated value and explained share of the sum of squares of each selected candidate, in the order
    of selection. Errors that earlier candidates can explain are not credited to later ones."""
    size, windows = len(declared), len(reduced.values)
    known, tried, left = reduced.slopes[..., :size], reduced.slopes[..., size:], reduced.values
    prior = declared.prior**-2.0
    critical = special.stdtrit(windows - 1, 1 - _CHANCE / 2)
    chosen: list[tuple[int, float, float]] = []
    while len(chosen) < len(candidates):
        flat = known.reshape(-1, known.shape[-1])
        taken = np.linalg.lstsq(flat.T @ flat + np.diag(prior), flat.T @ tried.reshape(flat.shape[0], -1), rcond=None)
        own = tried - known @ taken[0]
        pulls = -np.einsum("wr,wrc->wc", left, own)
        curvature = np.sum(own**2, axis=(0, 1)) + np.finfo(float).tiny
        steps = pulls.sum(axis=0) / curvature
        gained = steps**2 * curvature
        spread = np.sqrt(windows) * np.std(pulls, axis=0, ddof=1) + np.finfo(float).tiny
        sure = np.abs(pulls.sum(axis=0)) > critical * spread
        for number, candidate in enumerate(candidates):
            blocked = steps[number] < 0 and candidate.nominal <= candidate.bounds[0]
            small = gained[number] < SMALL_EFFECT * (np.sum(left**2) - gained[number])
            if blocked or small or not sure[number] or any(number == c for c, _, _ in chosen):
                gained[number] = 0.0
        best = int(np.argmax(gained))
        if gained[best] == 0:
            break
        value = max(candidates[best].nominal + float(steps[best]), candidates[best].bounds[0])
        chosen.append((best, value, float(gained[best]) / reduced.loss))
        left = left + own[..., best] * steps[best]
        known, prior = np.concatenate([known, tried[..., best, None]], axis=2), np.append(prior, 0.0)
    return chosen
