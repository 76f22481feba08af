"""An identification in words: a table, and details beneath it."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.curves import curve_distances
from ballu_mjx.ballu.identification import Identification
from ballu_mjx.ballu.leg_parameters import (
    DEGREE,
    LEG_PARAMETERS,
    Drivetrain,
    IdentificationConfig,
    free_parameters,
    nominal_leg,
)
from ballu_mjx.ballu.model import SIDES
from ballu_mjx.ballu.sweep import Sweep
from ballu_mjx.identification.parameters import Direction

_STRONG = 0.9
"""Correlations beyond this are named."""


_UNITS = {
    "knee_spring_stiffness": ("N m/rad", 1.0),
    "motor_gain": ("N m/rad", 1.0),
    "default_motor_angle": ("deg", 1 / DEGREE),
    "default_knee_angle": ("deg", 1 / DEGREE),
    "torque_limit": ("N m", 1.0),
    "cable_slack": ("mm", 1e3),
}
_DRIVETRAIN_UNITS = {
    "delay": ("s", 1.0),
    "motor_friction": ("N m", 1.0),
    "knee_friction": ("N m", 1.0),
    "backlash": ("deg", 1 / DEGREE),
}


def mean_error(simulated: Float[np.ndarray, "holds 2 2"], sweep: Sweep) -> float:
    """Mean absolute error (deg) of the settled angles."""
    return float(np.mean(np.abs(simulated - sweep.settled)) / DEGREE)


def identification_table(sweep: Sweep, result: Identification) -> str:
    """For the terminal: nominal and identified values with standard errors, errors before and after, and what the data
    leave open."""
    nominal = nominal_leg()
    lines = [f"{'':33}{'nominal':>10}{'identified':>12}{'standard error':>16}"]
    for index, name in enumerate(LEG_PARAMETERS):
        unit, scale = _UNITS[name]
        for side, fit in zip(SIDES, result.fits, strict=True):
            label = f"{name.replace('_', ' ')}, {side}"
            error = f"{fit.standard_errors[index] * scale:.2g}" if fit.standard_errors[index] else "(held)"
            value = f"{fit.vector[index] * scale:.4g}"
            lines.append(f"{label:33}{nominal[index] * scale:>10.4g}{value:>12}{error:>16} {unit}")
    for side, fit in zip(SIDES, result.fits, strict=True):
        for name, value in fit.drivetrain._asdict().items() if fit.drivetrain else ():
            unit, scale = _DRIVETRAIN_UNITS[name]
            label = f"{name.replace('_', ' ')}, {side}"
            lines.append(f"{label:33}{'':10}{value * scale:>12.4g}{'':16} {unit} (reported only)")
    before, after = (mean_error(angles, sweep) for angles in (result.nominal_settled, result.settled))
    lines += ["", f"Mean error of the settled angles: {before:.2f} deg before, {after:.2f} deg after."]
    if (creep := sweep.creep) is not None:
        lines.append(creep)
    if result.with_drivetrain is not None:
        scatter = ", ".join(
            f"{np.rad2deg(fit.residual):.2f} deg ({side})" for side, fit in zip(SIDES, result.fits, strict=True)
        )
        lines.append(
            f"With delay, friction and backlash {mean_error(result.with_drivetrain, sweep):.2f} deg. Of the whole "
            f"motion is left, root mean square: {scatter}; if that is more than your capture's noise, this model lacks "
            "something."
        )
    with jax.enable_x64(True):
        for label, angles in (("before", result.nominal_settled), ("after", result.settled)):
            distances = np.zeros((2, 2))
            for side in range(len(SIDES)):
                pair = angles[:, :, side], sweep.settled[:, :, side]
                distances += np.asarray(curve_distances(sweep.command[:, side], *pair, result.config.degree))
            there, back = distances.sum(axis=1)
            lines.append(f"Curves {label}: Hausdorff distance {there:.4f} simulated to measured, {back:.4f} back.")
    lines.append("Standard errors take the residuals for white noise; what the model lacks is none.")
    for side, fit in zip(SIDES, result.fits, strict=True):
        singular = ", ".join(f"{1 / d.standard_error:.3g}" for d in fit.directions)
        lines.append(f"Singular values, {side} (Jacobian over noise, in units of what robots differ by): {singular}")
        lines += [
            f"Left open, {side}, and held near nominal: {_in_words(d, result.config)}" for d in fit.open_directions
        ]
        weakest = fit.directions[-1]
        if not fit.open_directions:
            lines.append(
                f"Least determined, {side}: {_in_words(weakest, result.config)}, to {weakest.standard_error:.0%} of "
                "what robots differ by."
            )
        names = free_parameters(result.config)
        pairs = [(fit.correlations[i, j], i, j) for i in range(len(names)) for j in range(i)]
        strong = [f"{names[j]} with {names[i]} {r:+.2f}" for r, i, j in pairs if abs(r) > _STRONG]
        if strong:
            lines.append(f"Strongly correlated, {side}: {', '.join(strong).replace('_', ' ')}.")
        same = int(np.sum(fit.losses < 1.01 * fit.losses[0] + 1e-12))
        lines.append(f"Starts, {side}: {same} of {len(fit.losses)} ended within 1 % of the best sum of squares.")
    return "\n".join(lines)


def identification_details(result: Identification) -> dict[str, Any]:
    """What stands beside the parameters in `actuators.json`."""
    return {
        "standard_errors": {
            name: [float(f"{fit.standard_errors[index]:.3g}") for fit in result.fits]
            for index, name in enumerate(LEG_PARAMETERS)
        },
        "correlations": {
            "parameters": list(free_parameters(result.config)),
            **{side: np.round(fit.correlations, 3).tolist() for side, fit in zip(SIDES, result.fits, strict=True)},
        },
        "drivetrain": {
            name: [float(f"{getattr(fit.drivetrain, name):.4g}") if fit.drivetrain else None for fit in result.fits]
            for name in Drivetrain._fields
        },
    }


def _in_words(direction: Direction, config: IdentificationConfig) -> str:
    """The parameters that make up most of a direction, with their signs."""
    parts = [(w, n) for w, n in zip(direction.weights, free_parameters(config), strict=True) if abs(w) > 0.3]
    ordered = sorted(parts, key=lambda part: -abs(part[0]))
    return " ".join(f"{w:+.2f} {name.replace('_', ' ')}" for w, name in ordered)
