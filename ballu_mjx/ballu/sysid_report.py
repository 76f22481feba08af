"""Report of an identification as text: a table with details below it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.curves import curve_distances
from ballu_mjx.ballu.leg_parameters import (
    DEGREE,
    LEG_PARAMETERS,
    NOMINAL_DYNAMICS,
    RICHER_PARAMETERS,
    LegDynamics,
    nominal_leg,
)
from ballu_mjx.ballu.leg_results import Identification
from ballu_mjx.ballu.model import SIDES
from ballu_mjx.ballu.sweep import Sweep
from ballu_mjx.identification.parameters import Direction

_STRONG = 0.9
"""Magnitude of a correlation above which the report names it."""


_UNITS = {
    "knee_spring_stiffness": ("N m/rad", 1.0),
    "motor_gain": ("N m/rad", 1.0),
    "default_motor_angle": ("deg", 1 / DEGREE),
    "default_knee_angle": ("deg", 1 / DEGREE),
    "torque_limit": ("N m", 1.0),
    "cable_slack": ("mm", 1e3),
    "motor_travel": ("1", 1.0),
    "cable_stiffness": ("N/m", 1.0),
    "knee_spring_reference": ("deg", 1 / DEGREE),
}
_DYNAMICS_UNITS = {
    "delay": ("s", 1.0),
    "motor_friction": ("N m", 1.0),
    "knee_friction": ("N m", 1.0),
    "backlash": ("deg", 1 / DEGREE),
    "lag": ("s", 1.0),
    "knee_damping": ("N m s/rad", 1.0),
}


def mean_error(simulated: Float[np.ndarray, "holds 2 2"], sweep: Sweep) -> float:
    """Return the mean absolute error (deg) of the settled angles."""
    return float(np.mean(np.abs(simulated - sweep.settled)) / DEGREE)


def identification_table(sweep: Sweep, result: Identification) -> str:
    """Return the report for the terminal.

    It has the nominal and identified values with standard errors, the errors before and after, and the directions that
    the data leave open.
    """
    nominal = nominal_leg()
    lines = [f"{'':33}{'nominal':>10}{'identified':>12}{'standard error':>16}"]
    for index, name in enumerate(LEG_PARAMETERS):
        unit, scale = _UNITS[name]
        for side, fit in zip(SIDES, result.fits, strict=True):
            label = f"{name.replace('_', ' ')}, {side}"
            value = f"{fit.vector[index] * scale:.4g}"
            error = f"{fit.standard_errors[index] * scale:.2g}{'' if name in result.fitted else ' (held)'}"
            lines.append(f"{label:33}{nominal[index] * scale:>10.4g}{value:>12}{error:>16} {unit}")
    for side, fit in zip(SIDES, result.fits, strict=True):
        if fit.dynamics is None or fit.dynamics_errors is None:
            continue
        for name, found, deviation in zip(LegDynamics._fields, fit.dynamics, fit.dynamics_errors, strict=True):
            unit, scale = _DYNAMICS_UNITS[name]
            label = f"{name.replace('_', ' ')}, {side}"
            before = NOMINAL_DYNAMICS.get(name, 0.0)
            held = result.keeps_simpler and name in RICHER_PARAMETERS
            value = f"{(before if held else found) * scale:.4g}"
            error = "(held)" if held else f"{deviation * scale:.2g}"
            lines.append(f"{label:33}{before * scale:>10.4g}{value:>12}{error:>16} {unit}")
    simulated = result.settled if result.simulated is None else result.simulated
    before, after = (mean_error(angles, sweep) for angles in (result.nominal_settled, simulated))
    lines += ["", f"Mean error of the settled angles: {before:.2f} deg before, {after:.2f} deg after."]
    if (creep := sweep.creep) is not None:
        lines.append(creep)
    if result.simulated is not None:
        scatter = ", ".join(
            f"{np.rad2deg(fit.residual):.2f} deg ({side})" for side, fit in zip(SIDES, result.fits, strict=True)
        )
        lines.append(
            f"Root mean square error of the whole motion: {scatter}. If it exceeds the noise of your motion capture, "
            "the model lacks an effect."
        )
    with jax.enable_x64(True):
        for label, angles in (("before", result.nominal_settled), ("after", result.settled)):
            distances = np.zeros((2, 2))
            for side in range(len(SIDES)):
                pair = angles[:, :, side], sweep.settled[:, :, side]
                distances += np.asarray(curve_distances(sweep.command[:, side], *pair, result.config.degree))
            there, back = distances.sum(axis=1)
            lines.append(f"Curves {label}: Hausdorff distance {there:.4f} simulated to measured, {back:.4f} reverse.")
    if (selection := result.selection) is not None:
        reason = "They are therefore identified" if selection.richer else "They therefore stay nominal"
        lines.append(
            "Travel, cable stiffness, spring reference, lag and knee damping reduce the sum of squares by "
            f"{selection.effect:.1%} of what is left (2 % are required), with F = {selection.statistic:.1f} "
            f"(5 % level: {selection.threshold:.1f}). {reason}."
        )
    lines.append(
        "Standard errors take all free parameters as unknown, also those that stay nominal, and include the priors."
    )
    for side, fit in zip(SIDES, result.fits, strict=True):
        singular = ", ".join(f"{1 / d.standard_error:.3g}" for d in fit.directions)
        lines.append(f"Singular values, {side} leg (Jacobian over noise, in units of the priors): {singular}")
        lines += [
            f"Not determined, {side} leg, and held near nominal: {_in_words(d, result.fitted)}"
            for d in fit.open_directions
        ]
        weakest = fit.directions[-1]
        if not fit.open_directions:
            lines.append(
                f"Least determined, {side} leg: {_in_words(weakest, result.fitted)}, with a standard error of "
                f"{weakest.standard_error:.0%} of its prior."
            )
        names = result.free
        pairs = [(fit.correlations[i, j], i, j) for i in range(len(names)) for j in range(i)]
        strong = [f"{names[j]} with {names[i]} {r:+.2f}" for r, i, j in pairs if abs(r) > _STRONG]
        if strong:
            lines.append(f"Strongly correlated, {side} leg: {', '.join(strong).replace('_', ' ')}.")
        same = int(np.sum(fit.losses < 1.01 * fit.losses[0] + 1e-12))
        lines.append(f"Starts, {side} leg: {same} of {len(fit.losses)} ended within 1 % of the best sum of squares.")
    return "\n".join(lines)


def identification_details(result: Identification) -> dict[str, Any]:
    """Return the keys beside the parameters in `actuators.json`: standard errors and correlations."""
    errors = {name: [fit.standard_errors[i] for fit in result.fits] for i, name in enumerate(LEG_PARAMETERS)}
    dynamics = [fit.dynamics_errors for fit in result.fits if fit.dynamics_errors is not None]
    for name in LegDynamics._fields if dynamics else ():
        if not (result.keeps_simpler and name in RICHER_PARAMETERS):
            errors[name] = [getattr(each, name) for each in dynamics]
    return {
        "standard_errors": {name: [float(f"{x:.3g}") for x in pair] for name, pair in errors.items()},
        "correlations": {
            "parameters": list(result.free),
            **{side: np.round(fit.correlations, 3).tolist() for side, fit in zip(SIDES, result.fits, strict=True)},
        },
    }


def _in_words(direction: Direction, names: Sequence[str]) -> str:
    """Return the parameters with the largest weights in a direction, with these weights."""
    parts = [(w, n) for w, n in zip(direction.weights, names, strict=True) if abs(w) > 0.3]
    ordered = sorted(parts, key=lambda part: -abs(part[0]))
    return " ".join(f"{w:+.2f} {name.replace('_', ' ')}" for w, name in ordered)
