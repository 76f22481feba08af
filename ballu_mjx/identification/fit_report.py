"""Reports of a fit of declared parameters: as text, as JSON types, and as arrays for figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from scipy import special

from ballu_mjx.common.files import finite_or_none
from ballu_mjx.identification.fit_robot import HeldOut, RobotFit
from ballu_mjx.sim.coordinates import translations


def intervals(fit: RobotFit) -> Float[np.ndarray, "parameters 2"]:
    """Return 95 % intervals (Student's t over windows) from the robust standard errors, clipped to the bounds.

    One window has no interval but the bounds.
    """
    windows = len(fit.windows.motion)
    half = float(special.stdtrit(windows - 1, 0.975)) * fit.standard_errors if windows > 1 else np.inf
    both = np.stack([fit.values - half, fit.values + half], axis=1)
    return np.clip(both, fit.parameters.lower[:, None], fit.parameters.upper[:, None])


def channel_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return the names of a motion's channels: one for each entry of `qvel`."""
    names = []
    for number in range(model.njnt):
        joint = model.joint(number)
        if model.jnt_type[number] == mujoco.mjtJoint.mjJNT_FREE:
            names += [f"root {axis}" for axis in ("x", "y", "z", "rotation x", "rotation y", "rotation z")]
        else:
            names.append(joint.name)
    return tuple(names)


def angular_channels(model: mujoco.MjModel) -> Bool[np.ndarray, " channels"]:
    """Return a mask of the channels in rad. The others are in m."""
    return ~translations(model)


def channel_scales(model: mujoco.MjModel) -> tuple[Float[np.ndarray, " channels"], tuple[str, ...]]:
    """Return the factors that convert position channels to degrees or millimetres, and these units."""
    angular = angular_channels(model)
    return np.where(angular, 180 / np.pi, 1e3), tuple("deg" if each else "mm" for each in angular)


def autocorrelation(errors: Float[np.ndarray, "windows samples channels"]) -> Float[np.ndarray, "lags channels"]:
    """Return the autocorrelation of errors within a window, for lags from 0 to half a window.

    The mean of the errors is not subtracted, so that a constant error is fully correlated. Windows that diverged are
    left out.
    """
    kept = errors[np.isfinite(errors).all(axis=(1, 2))]
    samples = errors.shape[1]
    power = np.mean(kept**2, axis=(0, 1)) + np.finfo(float).tiny
    lags = range(samples // 2 + 1)
    return np.stack([np.mean(kept[:, : samples - lag] * kept[:, lag:], axis=(0, 1)) / power for lag in lags])


def fit_table(fit: RobotFit, model: mujoco.MjModel, window_seconds: float, held_out: str) -> str:
    """Return a text with values, standard errors, undetermined combinations, and errors on held-out windows.

    - `held_out`: recordings that the windows are cut from, in words.
    """
    parameters = fit.parameters
    width = max(map(len, (*parameters.names, "parameter"))) + 2
    earlier = f"{'earlier':>10}" if parameters.refines else ""
    heads = f"{'nominal':>10}{earlier}{'identified':>12}{'standard error':>16}{'95 % interval':>24}"
    lines = [f"{'parameter':{width}}{heads}  unit"]
    for place, (one, (low, high)) in enumerate(zip(parameters.parameters, intervals(fit), strict=True)):
        notes = [
            note
            for note, names in (("not shown by the data", fit.unseen), ("at a bound", fit.at_bounds))
            if one.name in names
        ]
        earlier = f"{parameters.expected[place]:>10.4g}" if parameters.refines else ""
        cells = f"{one.nominal:>10.4g}{earlier}{fit.values[place]:>12.4g}{fit.standard_errors[place]:>16.2g}"
        interval = f"{low:.4g} to {high:.4g}"
        lines.append(f"{one.name:{width}}{cells}{interval:>24}  {one.unit or '1'} {'; '.join(notes)}".rstrip())
    lines.append("")
    lines += [f"Not determined: {direction}." for direction in fit.unidentified]
    lines += [
        f"{one} and {other} are strongly correlated ({r:.2f}): the data hardly distinguish their effects."
        for one, other, r in fit.strong_correlations
    ]
    median = float(np.median(fit.scatter))
    lines.append(
        f"The remaining error on training windows is {median:.1f} times the assumed noise (median over channels)."
    )
    if len(fit.windows.motion) == 1:
        lines.append("One training window: standard errors assume white noise. Give more or longer recordings.")
    if median > _MUCH:
        lines.append("The model lacks an effect, or the assumed noise is too small.")
    lines += ["", *_held_out_table(fit, model, window_seconds, held_out)]
    return "\n".join(lines)


_MUCH = 2.0
"""Error, in units of noise, above which the report warns of a missing effect."""


def _held_out_table(fit: RobotFit, model: mujoco.MjModel, window_seconds: float, held_out: str) -> list[str]:
    scales, units = channel_scales(model)
    lines = [
        f"Median error after {window_seconds:g} s on {len(fit.nominal.motion)} held-out windows of {held_out}:",
        f"{'':22}" + "".join(f"{name:>12}" for name in _by_values(fit)),
    ]
    errors = [each.final_median[: model.nv] * scales for each in _by_values(fit).values()]
    for name, unit, *row in zip(channel_names(model), units, *errors, strict=True):
        lines.append(f"{name:22}" + "".join(f"{error:>12.3g}" for error in row) + f" {unit}")
    for name, other in _by_values(fit).items():
        if other is not fit.identified:
            verdict = "better" if fit.identified.score < other.score else "WORSE"
            scores = f"{fit.identified.score:.3g} and {other.score:.3g} times the noise"
            lines.append(f"Identified values replay them {verdict} than {name} ones: errors are {scores}.")
    if fit.identified.score > _MUCH:
        lines.append(
            f"The error is more than {_MUCH:g} times the noise, so the model may lack a force. Identified values can "
            "compensate for it, and their intervals do not include that error."
        )
    return lines


def fit_details(fit: RobotFit, model: mujoco.MjModel) -> dict[str, Any]:
    """Return a fit as JSON types: parameters with intervals, undetermined combinations, errors on held-out windows.

    An infinite number is None: the nominal value of a rate limit that the model lacks, or the error of windows most of
    which diverged.
    """
    rows = []
    for place, (one, (low, high)) in enumerate(zip(fit.parameters.parameters, intervals(fit), strict=True)):
        rows.append(
            {
                "name": one.name,
                "unit": one.unit,
                "nominal": finite_or_none(one.nominal),
                "expected": float(fit.parameters.expected[place]),
                "value": float(fit.values[place]),
                "standard_error": float(fit.standard_errors[place]),
                "white_noise_error": float(fit.white_noise_errors[place]),
                "interval": [float(low), float(high)],
                "bounds": list(one.bounds),
                "seen": one.name not in fit.unseen,
                "at_bound": one.name in fit.at_bounds,
            }
        )
    return {
        "parameters": rows,
        "not_determined": list(fit.unidentified),
        "correlations": [list(pair) for pair in fit.strong_correlations],
        "scatter": [float(x) for x in fit.scatter],
        "held_out": {name: _held_out(each, model) for name, each in _by_values(fit).items()},
        "improves": fit.improves,
    }


def _by_values(fit: RobotFit) -> Mapping[str, HeldOut]:
    """Return errors on held-out windows by the values that caused them."""
    earlier = {} if fit.earlier is None else {"earlier": fit.earlier}
    return {"nominal": fit.nominal, **earlier, "identified": fit.identified}


def _held_out(found: HeldOut, model: mujoco.MjModel) -> dict[str, Any]:
    medians = (finite_or_none(float(x)) for x in found.final_median[: model.nv])
    final = dict(zip(channel_names(model), medians, strict=True))
    return {"score": finite_or_none(found.score), "windows": len(found.motion), "final_median": final}
