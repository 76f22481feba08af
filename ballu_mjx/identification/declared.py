"""Identification of the parameters that a robot description declares, from recordings to a report."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.actuator_choice import HORIZONS, Choice, choose_actuators
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.fit_report import fit_details, fit_table
from ballu_mjx.identification.fit_robot import FitConfig, RobotFit, Visibility, check_fit_config, fit_robot
from ballu_mjx.identification.measured_motion import (
    MeasuredMotion,
    SamplingConfig,
    check_sampling_config,
    held_motion,
    measure,
    measured_from_motion,
)
from ballu_mjx.identification.parameters import IdentifiedParameters
from ballu_mjx.identification.undeclared import Suggestion, suggest_parameters, suggestions_table
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.recordings.validation import TIME_TOLERANCE
from ballu_mjx.robots.adapter import IdentificationProgress, IdentifiedActuators
from ballu_mjx.robots.description import RobotDescription


@dataclasses.dataclass(frozen=True, eq=False)
class IdentifiedByFit(IdentifiedActuators):
    """Identified values of declared parameters, with the whole fit.

    **Fields**

    - `fit`: values, standard errors, and errors on held-out windows.
    - `held_out`: motions that the held-out windows are cut from.
    - `choice`: replay of the validation recordings with nominal and with identified values. None if no validation
      recording lasts a second.
    - `suggestions`: undeclared parameters that would explain the remaining error.
    """

    fit: RobotFit
    held_out: tuple[MeasuredMotion, ...]
    choice: Choice | None
    suggestions: tuple[Suggestion, ...]


def check_recordings(
    robot: RobotDescription,
    recordings: Mapping[Path, Recording],
    validation: Mapping[Path, Recording],
    window_seconds: float,
    sampling: SamplingConfig,
) -> str:
    """Check that the recordings can be used, and return the name of their specimen (individual robot).

    They must be of one specimen. One of `recordings` must be as long as a window, and one of `validation`, if there are
    any. Either all or none of them must have all joints. If none has, `sampling` must have its defaults.

    **Raises** `InputError` naming the file and the fix.
    """
    every = {**recordings, **validation}
    specimens = {recording.robot: path for path, recording in every.items()}
    if len(specimens) != 1:
        named = ", ".join(f"{path} is of {specimen}" for specimen, path in specimens.items())
        raise InputError(f"The recordings are of several robots ({named}); give recordings of one robot.")
    for path, recording in every.items():
        if recording.kind != "free" and not robot.anchored:
            raise InputError(
                f"{path}: this recording is suspended, but {robot.model.name} has a free joint; give free recordings, "
                "or a model without the free joint."
            )
    for option, group in (("--recordings", recordings), ("--validation", validation)):
        shortest = window_seconds * (1 - TIME_TOLERANCE)
        if group and all(recording.time[-1] - recording.time[0] < shortest for recording in group.values()):
            raise InputError(
                f"{next(iter(group))}: none of {option} lasts {window_seconds:g} s; give longer recordings, or a "
                "shorter --window-seconds."
            )
    model = robot.load_model()
    measured = {path: _is_measured(recording, model) for path, recording in every.items()}
    if any(measured.values()) and not all(measured.values()):
        complete, lacking = (next(path for path, own in measured.items() if own == which) for which in (True, False))
        missing = ", ".join(sorted(_joints(model) - set(every[lacking].joint_angles)))
        raise InputError(
            f"{lacking}: has no columns for {missing}, but {complete} has all joints; add them, or give either kind "
            "alone."
        )
    if not any(measured.values()) and sampling != SamplingConfig():
        raise InputError(
            f"{next(iter(every))}: lacks joint angles, so that states are reconstructed at control steps; leave out "
            "the options of sampling."
        )
    return next(iter(specimens))


def recorded_motion(
    recording: Recording, robot: RobotDescription, model: mujoco.MjModel, sampling: SamplingConfig | None = None
) -> Motion:
    """Return a recording's states at control steps.

    They are measured if the recording has all joints of an anchored robot. Otherwise they are reconstructed.
    """
    if _is_measured(recording, model):
        return held_motion(recording, robot, model, sampling)
    return reconstruct(recording, robot, model)


def measure_recording(
    recording: Recording, robot: RobotDescription, model: mujoco.MjModel, sampling: SamplingConfig | None = None
) -> MeasuredMotion:
    """Return a recording in the form that identification takes.

    States are measured if the recording has all joints of an anchored robot. Otherwise they are reconstructed.

    **Raises** `InputError` naming the joint that was not recorded, or a recording that is too short.
    """
    if _is_measured(recording, model):
        return measure(recording, robot, model, sampling)
    return measured_from_motion(reconstruct(recording, robot, model), model)


def _is_measured(recording: Recording, model: mujoco.MjModel) -> bool:
    """Return whether a recording has all joints of the model, or must have them because it is suspended."""
    return _joints(model) <= set(recording.joint_angles) or recording.kind == "suspended"


def _joints(model: mujoco.MjModel) -> set[str]:
    return {model.joint(number).name for number in range(model.njnt)}


def identify_declared(
    recordings: Mapping[Path, Recording],
    robot: RobotDescription,
    config: FitConfig | None = None,
    sampling: SamplingConfig | None = None,
    validation: Mapping[Path, Recording] | None = None,
    progress: IdentificationProgress | None = None,
    on_data_check: Callable[[Visibility], None] | None = None,
    suggest: bool = True,
    earlier: IdentifiedParameters | None = None,
) -> IdentifiedByFit:
    """Identify the parameters that `robot` declares.

    **Arguments**

    - `recordings`, `validation`: recordings by file. The fit does not use validation recordings. If there are none,
      every fourth window is held out.
    - `sampling`: sampling of recordings of an anchored robot.
    - `progress`: called at every iteration.
    - `on_data_check`: called before the search, with the parameters that the data can show.
    - `suggest`: whether to search for undeclared parameters that would explain the remaining error.
    - `earlier`: values that other recordings of the same robot identified. Searches start there, and priors are centred
      there, so that parameters which these recordings do not show keep these values. None for the nominal values.

    **Raises** `InputError` if an option is out of range, a recording cannot be used, or a declaration does not fit the
    model.
    """
    config, sampling, validation = config or FitConfig(), sampling or SamplingConfig(), validation or {}
    check_fit_config(config)
    check_sampling_config(sampling)
    specimen = check_recordings(robot, recordings, validation, config.window_seconds, sampling)
    model = robot.load_model()
    parameters = declared_parameters(robot, model)
    if earlier is not None:
        parameters = parameters.expecting(np.asarray(earlier.values, float))
    training, held = (
        [measure_recording(each, robot, model, sampling) for each in group.values()]
        for group in (recordings, validation)
    )
    fit = fit_robot(parameters, training, held or None, config, progress, on_data_check)
    identified = IdentifiedParameters(jnp.asarray(fit.values), parameters)
    motions = [recorded_motion(each, robot, model, sampling) for each in validation.values()]
    long_enough = [motion for motion in motions if motion.time[-1] >= min(HORIZONS)]
    choice = choose_actuators(robot, identified, long_enough) if long_enough else None
    suggestions: tuple[Suggestion, ...] = ()
    if suggest:
        tell = progress or (lambda stage, iteration, steps, value: None)
        tell("undeclared parameters", 0, 1, float("nan"))
        suggestions = suggest_parameters(robot, fit, training, config)
        tell("undeclared parameters", 1, 1, float("nan"))
    report = fit_table(fit, model, config.window_seconds, "validation recordings" if held else "the same recordings")
    if suggestions:
        report += f"\n\n{suggestions_table(suggestions)}"
    if choice is not None:
        report += f"\n\nOpen-loop replay of the validation recordings:\n{choice.table()}"
    return IdentifiedByFit(
        robot=specimen,
        parameters=identified,
        report=report,
        details={**fit_details(fit, model), "undeclared": [each.details() for each in suggestions]},
        fit=fit,
        held_out=tuple(held or training),
        choice=choice,
        suggestions=suggestions,
    )
