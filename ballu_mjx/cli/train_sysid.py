"""Identification of actuators: `python -m ballu_mjx.train sysid`."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from ballu_mjx.ballu import plots as ballu_plots
from ballu_mjx.ballu.identified_legs import IdentifiedLegs
from ballu_mjx.ballu.leg_parameters import IdentificationConfig, check_identification_config
from ballu_mjx.cli._command import TrainCommand, load_chosen_robot, written_to
from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.actuators import ACTUATORS_FILE, declares_parameters, identify_actuators, read_actuators
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.declared import IdentifiedByFit, check_recordings, identify_declared
from ballu_mjx.identification.fit_report import autocorrelation, channel_names, channel_scales
from ballu_mjx.identification.fit_robot import FitConfig, Visibility, check_fit_config
from ballu_mjx.identification.measured_motion import SamplingConfig, check_sampling_config
from ballu_mjx.identification.parameters import IdentifiedParameters
from ballu_mjx.identification.window_objective import WindowConfig
from ballu_mjx.identification.write_back import identified_to_json, identified_xml
from ballu_mjx.recordings.csv_format import list_recordings, read_recording
from ballu_mjx.recordings.load import bundled_recordings
from ballu_mjx.residuals.run_config import describe_recording, describe_run
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.runs import loggers
from ballu_mjx.runs.folder import Run, new_folder
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.viz import identification_plots
from ballu_mjx.viz.report import REPORT_FILE, render
from ballu_mjx.viz.report_content import IDENTIFICATION_FILE, collect

QUICK: Mapping[str, Any] = {"motion": False, "starts": 4}
"""Defaults of `IdentificationConfig` under `--quick`, for BALLU's legs."""
QUICK_DECLARED: Mapping[str, Any] = {"starts": 1, "steps": 5}
"""Defaults of `FitConfig` under `--quick`, for declared parameters."""
IDENTIFIED_MODEL = "identified.xml"
_SHARED = ("starts", "steps", "seed")
"""Options of `IdentificationConfig` that also apply to declared parameters."""
_WINDOWS_DRAWN = 4
_QUICK_NOTE = "These values can be wrong: --quick makes a short search."


@dataclasses.dataclass(frozen=True)
class SysidData(loggers.LoggingOptions):
    """Recordings and folders. A path is a recording (.csv or .csv.gz) or a folder of them."""

    recordings: tuple[Path, ...] = ()
    """Recordings of one robot. BALLU needs suspended recordings, with its legs swept together or one after the other. A
    robot with declared parameters needs any recordings in which its commands vary. Without this option: the bundled
    sweep of BALLU."""
    validation: tuple[Path, ...] = ()
    """Recordings on which the fit of declared parameters is judged; the fit does not use them. Without this option:
    every fourth window of --recordings."""
    actuators: Path | None = None
    """actuators.json of an earlier identification of declared parameters, for example from a sweep on a stand, to
    refine with these recordings. The search starts at its values, and priors are centred there: parameters that these
    recordings do not show keep them. Without this option: nominal values."""
    robot: str | None = None
    """Robot of the recordings: the name of a robot that comes with the package, or a description file
    (docs/own_robot.md). The file's key "identify" declares the parameters to identify (docs/identify.md). Without this
    option: ballu, whose legs have their own method."""
    levels: int = 20
    """Smallest accepted number of command levels for each of BALLU's legs (paper: 20)."""
    output: Path | None = None
    """Folder of the run, new or empty. Without this option: one under runs/, named after the time."""
    quick: bool = False
    """Run within two minutes, compilation included. For BALLU, fit only settled angles, from fewer starts. For declared
    parameters, run one short search, and do not search for parameters that are missing in the declaration."""


def train(
    data: SysidData,
    fit: IdentificationConfig,
    windows: WindowConfig | None = None,
    sampling: SamplingConfig | None = None,
) -> int:
    """Read and check the recordings, identify the actuators, write the results, and return the exit status."""
    windows, sampling = windows or WindowConfig(), sampling or SamplingConfig()
    loggers.check(data.wandb)
    robot = load_chosen_robot(data.robot)
    if declares_parameters(robot):
        return _train_declared(data, fit, windows, sampling, robot)
    if robot.identify:
        raise InputError(
            f'{robot.file}: "identify" has no effect, because {robot.name} has its own method; remove this key, or '
            'leave out "adapter".'
        )
    given = [name for name in ("validation", "actuators") if getattr(data, name)]
    for changed in (*_changed(windows), *_changed(sampling), *given):
        option = changed.replace("_", "-")
        raise InputError(f"--{option} is for declared parameters, but {robot.name} has its own method; leave it out.")
    return _train_by_adapter(data, fit, robot)


def _changed(config: Any, but: Sequence[str] = ()) -> list[str]:
    default = type(config)()
    names = [field.name for field in dataclasses.fields(config)]
    return [name for name in names if name not in but and getattr(config, name) != getattr(default, name)]


def _train_by_adapter(data: SysidData, fit: IdentificationConfig, robot: RobotDescription) -> int:
    check_identification_config(fit)
    paths = list_recordings(data.recordings) if data.recordings else bundled_recordings("suspended", robot)
    recordings = {path: read_recording(path, robot) for path in paths}
    robot.adapter.check_sweep(robot, recordings, data.levels)
    folder = new_folder(data.output, "sysid")
    content = describe_run("sysid", {"fit": fit, "data": data}, {"suspended": paths}, [], description=robot)
    stages = PhaseProgress()

    def report(stage: str, iteration: int, steps: int, loss: float) -> None:
        run.log(stages.update(stage, iteration, steps, loss), {stage: loss})

    with written_to() as written, Run(folder, content, wandb=data.wandb) as run:
        written.folder = folder
        print(f"Run folder: {folder}")
        print(f"  sweeps: {', '.join(path.name for path in paths)}")
        found = identify_actuators(recordings, robot, fit, levels=data.levels, progress=report)
        stages.close()
        run.write("identification.txt", found.report + "\n")
        source = [describe_recording(path) for path in paths]
        robot.adapter.write_actuators(folder / ACTUATORS_FILE, found, {"source": source})
        if isinstance(found, IdentifiedLegs):
            ballu_plots.actuator_curves(folder / "actuator_curves.png", found.sweep, found.identification)
        print(f"\n{found.report}")
        if data.quick:
            print(_QUICK_NOTE)
    return 0


def _train_declared(
    data: SysidData,
    fit: IdentificationConfig,
    windows: WindowConfig,
    sampling: SamplingConfig,
    robot: RobotDescription,
) -> int:
    for changed in (*_changed(fit, _SHARED), *(["levels"] if data.levels != SysidData.levels else [])):
        option = changed.replace("_", "-")
        raise InputError(f"--{option} is for BALLU's legs, but {robot.name} declares its parameters; leave it out.")
    config = FitConfig(**dataclasses.asdict(windows), **{name: getattr(fit, name) for name in _SHARED})
    check_fit_config(config)
    check_sampling_config(sampling)
    if not data.recordings:
        raise InputError(f"{robot.file}: there are no bundled recordings of {robot.name}; give some by --recordings.")
    declared = declared_parameters(robot, robot.load_model())
    earlier = None if data.actuators is None else read_actuators(robot, data.actuators)[1]
    assert earlier is None or isinstance(earlier, IdentifiedParameters)
    paths, held = list_recordings(data.recordings), list_recordings(data.validation)
    both = {path.resolve() for path in paths} & {path.resolve() for path in held}
    if both:
        raise InputError(f"{min(both)}: is among --recordings and --validation; remove it from one of them.")
    recordings, validation = ({path: read_recording(path, robot) for path in each} for each in (paths, held))
    specimen = check_recordings(robot, recordings, validation, config.window_seconds, sampling)
    folder = new_folder(data.output, "sysid")
    sections = {"fit": config, "sampling": sampling, "data": data}
    content = describe_run("sysid", sections, {"training": paths, "validation": held}, [], description=robot)
    stages = PhaseProgress()

    def report(stage: str, iteration: int, steps: int, loss: float) -> None:
        count = stages.update(stage, iteration, steps, loss)
        if np.isfinite(loss):
            run.log(count, {stage: loss})

    def checked(seen: Visibility) -> None:
        stages.close()
        print(data_check(seen), flush=True)

    with written_to() as written, Run(folder, content, wandb=data.wandb) as run:
        written.folder = folder
        print(f"Run folder: {folder}")
        print(f"  {specimen}, as {robot.file} describes it: {len(declared)} parameters")
        print(f"  recordings: {', '.join(path.name for path in paths)}")
        print(f"  validation: {', '.join(path.name for path in held) or 'every fourth window of these'}", flush=True)
        found = identify_declared(
            recordings,
            robot,
            config,
            sampling,
            validation,
            progress=report,
            on_data_check=checked,
            suggest=not data.quick,
            earlier=earlier,
        )
        stages.close()
        run.write("identification.txt", found.report + "\n")
        run.write(IDENTIFICATION_FILE, json.dumps(found.details, indent=2, allow_nan=False) + "\n")
        run.write(ACTUATORS_FILE, _actuators_json(robot, found, paths))
        _draw(folder, found)
        print(f"\n{found.report}\n")
        if data.quick:
            print(_QUICK_NOTE)
        _write_model(folder, robot, found)
    _write_page(folder)
    return 0


def data_check(seen: Visibility) -> str:
    """Return a text that says which declared parameters the recordings can identify."""
    if not seen.unseen:
        return f"Data check: these recordings show all {len(seen.names)} parameters."
    return (
        f"Data check: these recordings cannot show {', '.join(seen.unseen)}. A change as large as the spread among "
        "robots is hidden by the noise; these stay near their nominal values, or near those of --actuators."
    )


def _actuators_json(robot: RobotDescription, found: IdentifiedByFit, paths: Sequence[Path]) -> str:
    assert isinstance(found.parameters, IdentifiedParameters)
    more: dict[str, Any] = {"source": [describe_recording(path) for path in paths]}
    if found.choice is not None:
        ratio = found.choice.ratio  # infinite if more replays diverged, which JSON cannot express
        more["validation"] = {"ratio": ratio if np.isfinite(ratio) else None, "improves": found.choice.improves}
    errors = found.fit.standard_errors
    return identified_to_json(robot, found.parameters, errors, specimen=found.robot, more=more)


def _draw(folder: Path, found: IdentifiedByFit) -> None:
    """Draw held-out windows, the autocorrelation of their residuals, and the parameters' intervals."""
    fit, model = found.fit, found.held_out[0].model
    scales, units = channel_scales(model)
    nv, timestep = model.nv, found.held_out[0].sample_timestep
    shown = np.array([not name.startswith("root rotation") for name in channel_names(model)])
    labels = [f"{n} ({u})" for n, u, s in zip(channel_names(model), units, shown, strict=True) if s]
    samples = fit.nominal.errors.shape[1]
    count = len(fit.nominal.motion)
    panels = []
    for window in np.unique(np.linspace(0, count - 1, min(_WINDOWS_DRAWN, count)).astype(int)):
        motion, first = found.held_out[fit.nominal.motion[window]], int(fit.nominal.first[window])
        states = motion.qpos[first : first + samples]
        measured = states if model.nq == nv else np.concatenate([states[:, :3], states[:, :3], states[:, 7:]], axis=1)
        curves = {"measured": measured}
        for name, errors in (("nominal", fit.nominal.errors), ("identified", fit.identified.errors)):
            curves[name] = measured + errors[window, :, :nv]
        curves = {name: (values * scales)[:, shown] for name, values in curves.items()}
        title = f"{motion.name}, from {first * timestep:.2f} s"
        panels.append(identification_plots.HeldOutPanel(title, np.arange(samples) * timestep, curves))
    identification_plots.held_out_windows(folder / "held_out.png", panels, labels)
    pair = {"nominal": fit.nominal, "identified": fit.identified}
    correlations = {name: autocorrelation(each.errors[..., :nv]) for name, each in pair.items()}
    lag = np.arange(samples // 2 + 1) * timestep
    path = folder / "residual_autocorrelation.png"
    identification_plots.residual_autocorrelation(path, lag, correlations, channel_names(model))
    declared = fit.parameters
    change = (fit.values - declared.nominal) / declared.unit
    errors = fit.standard_errors / declared.unit, fit.white_noise_errors / declared.unit
    identification_plots.parameter_intervals(folder / "parameters.png", declared.names, change, *errors)


def _write_model(folder: Path, robot: RobotDescription, found: IdentifiedByFit) -> None:
    """Write the MJCF with the identified values, and print its path and how to load it."""
    assert isinstance(found.parameters, IdentifiedParameters)
    path = folder / IDENTIFIED_MODEL
    try:
        files.write(path, identified_xml(robot, found.parameters))
    except InputError as error:
        print(f"There is no {IDENTIFIED_MODEL}: {error}")
        return
    try:
        mujoco.MjModel.from_xml_path(str(path))
        print(f"{path}: the model with the identified values, for plain MuJoCo.")
    except ValueError:  # a mesh or texture is missing beside the file
        print(f"{path}: the model with the identified values. Copy it beside {robot.model}, whose files it names.")


def _write_page(folder: Path) -> None:
    try:
        files.write(folder / REPORT_FILE, render(collect(folder)))
    except InputError as error:
        print(error, file=sys.stderr)


def _defaults(data: SysidData) -> Mapping[str, Mapping[str, Any]]:
    """Return the defaults that the robot and --quick imply, by section."""
    if not declares_parameters(load_chosen_robot(data.robot)):
        return {"fit": QUICK} if data.quick else {}
    usual = {name: getattr(FitConfig(), name) for name in _SHARED}
    return {"fit": {**usual, **(QUICK_DECLARED if data.quick else {})}}


_DECLARED = ", ".join(f"--{name} {getattr(FitConfig, name)}" for name in _SHARED[:2])

COMMAND = TrainCommand(
    "Identify a robot's actuators from recordings, and write the file that `--actuators` of other commands takes. "
    'BALLU needs a suspended sweep. A robot whose description declares parameters under "identify" may use any '
    "recordings; for it, the command also writes identified.xml, the model with the identified values, and the "
    f"defaults are {_DECLARED}.",
    {"data": SysidData(), "fit": IdentificationConfig(), "windows": WindowConfig(), "sampling": SamplingConfig()},
    train,
    {"fit": QUICK},
    _defaults,
)
