"""Evaluation from the command line: `python -m ballu_mjx evaluate RUN`.

JAX and modules that need it are imported inside functions: `runtime.prepare` has to come first.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from ballu_mjx.cli._help import parse_options, refuse_without
from ballu_mjx.common import files, runtime
from ballu_mjx.common.errors import InputError

if TYPE_CHECKING:
    from ballu_mjx.evaluation.errors import Errors


@dataclasses.dataclass(frozen=True)
class Options(runtime.CommandOptions):
    """Replay recordings open loop, without and with a run's residual, and print the errors of both."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    recordings: tuple[Path, ...] = ()
    """Recordings to replay, files or folders. Without this option: the run's test recordings."""
    robot: str | None = None
    """Robot to simulate instead of the run's: the name of a robot that comes with the package, or a description file.
    It may differ from the run's robot in masses, lengths and the like, for example by another payload. Requires
    --recordings."""
    last: bool = False
    """Evaluate the last checkpoint instead of the one with the smallest validation error."""
    noise_floor: bool = False
    """Also print the errors that motion-capture noise in the starting states causes. No simulator can be expected to
    have much smaller errors."""
    capture_noise: tuple[float, float] = (0.5, 0.3)
    """Noise of the motion capture for --noise-floor: standard deviations of a position (mm) and of an angle (deg).
    Joints that slide have the noise of a position."""
    output: Path | None = None
    """Folder for evaluation.txt, evaluation.json, tracking.png and replay.npz, for example the run's folder. Without
    this option: the table is only printed."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status (`runtime.exit_status`)."""

    def run() -> None:
        runtime.prepare()
        options = parse_options(Options, arguments, "python -m ballu_mjx evaluate")
        _evaluate(options)

    return runtime.exit_status(run, arguments)


def _evaluate(options: Options) -> None:
    from ballu_mjx.evaluation.open_loop import Evaluators
    from ballu_mjx.recordings.capture_noise import add_capture_noise
    from ballu_mjx.recordings.csv_format import list_recordings, read_recording, recording_name
    from ballu_mjx.recordings.motion import ReconstructionParameters
    from ballu_mjx.recordings.reconstruct import reconstruct
    from ballu_mjx.residuals.dataset import check_recording
    from ballu_mjx.residuals.registry import RESIDUAL_TASKS
    from ballu_mjx.residuals.run_config import find_recordings, run_robot
    from ballu_mjx.residuals.trained_residual import TrainedResidual
    from ballu_mjx.robots.description import check_simulates
    from ballu_mjx.robots.registry import load_robot
    from ballu_mjx.runs.folder import read_config
    from ballu_mjx.sim.simulator import Simulator
    from ballu_mjx.viz.artifacts import write_evaluation

    if not options.noise_floor:
        refuse_without(options, ("capture_noise",), "--noise-floor")
    if not all(0 < noise < math.inf for noise in options.capture_noise):
        raise InputError(f"--capture-noise {options.capture_noise}: give two positive numbers (mm and deg).")
    config = read_config(options.run, *RESIDUAL_TASKS)
    which = "last" if options.last else "best"
    own = run_robot(config, options.run)
    if options.robot is not None and not options.recordings:
        raise InputError("--robot goes with --recordings; give recordings of that robot.")
    robot = own if options.robot is None else load_robot(options.robot)
    check_simulates(robot)
    loaded = TrainedResidual.load(options.run, robot, which, other_model=robot is not own)
    paths = list_recordings(options.recordings) or find_recordings(config, "test", options.run, "--recordings")
    recordings = [read_recording(path, robot) for path in paths]
    for path, recording in zip(paths, recordings, strict=True):
        check_recording(path, recording, robot, long_enough=True)
    if options.output is not None:
        files.check_folder(options.output)
        options.output.mkdir(parents=True, exist_ok=True)

    if loaded.step:
        print(f"The {which} checkpoint of {options.run}: step {loaded.step:,}.", flush=True)
    print("Compiling: half a minute the first time ...", flush=True)
    simulator = Simulator(robot, loaded.actuators)
    restore = partial(reconstruct, robot=robot, model=simulator.mj_model, drivetrain=simulator.drivetrain)
    motions = [restore(recording) for recording in recordings]
    evaluator = Evaluators(simulator).of(loaded.model, motions)
    result = (
        evaluator(loaded.params)
        if options.output is None
        else write_evaluation(evaluator, loaded.params, options.output)
    )
    print(f"{_title(options, config, paths)}: {', '.join(map(recording_name, paths))}\n")
    print(result.table())
    if options.noise_floor:
        distance, angle = options.capture_noise
        noise = ReconstructionParameters(
            position_noise=distance / 1000, rotation_noise=math.radians(angle), joint_noise=math.radians(angle)
        )
        model = simulator.mj_model
        shaken = [add_capture_noise(recording, model, noise, number) for number, recording in enumerate(recordings)]
        floor = evaluator.of_starts([restore(each) for each in shaken], loaded.params)
        print(f"\nErrors that capture noise of {distance:g} mm and {angle:g} deg in the starting states alone causes,")
        print(f"and the errors above (independent errors add in squares):\n{noise_floor(floor, result.residual)}")


def _title(options: Options, config: Mapping[str, Any], paths: Sequence[Path]) -> str:
    """Return the title of the table, which warns of recordings that the run's training or validation used."""
    from ballu_mjx.residuals.dataset import replay_title
    from ballu_mjx.residuals.run_config import describe_recording
    from ballu_mjx.runs.folder import config_section

    uses = config_section(config, "recordings", options.run)
    validation, training = ({each["sha256"] for each in uses.get(use, ())} for use in ("validation", "training"))
    replayed = {describe_recording(path)["sha256"] for path in paths}
    return replay_title(
        replayed, validation, training, "other recordings" if options.recordings else "the test recordings"
    )


def noise_floor(floor: Sequence[Errors], errors: Sequence[Errors]) -> str:
    """Return lines for the terminal: errors due to noise alone and errors of the simulator, by group and horizon."""
    from ballu_mjx.evaluation.errors import mean_by_group

    lines = []
    for noise, ours in zip(mean_by_group(floor), mean_by_group(errors), strict=True):
        for horizon, (position, _) in noise.position.items():
            lines.append(
                f"{noise.group:7}{horizon:>8g} |{position:>14.3f} m of {ours.position[horizon][0]:.3f} m | "
                f"{noise.orientation[horizon][0]:>6.1f} deg of {ours.orientation[horizon][0]:.1f} deg"
            )
    return "\n".join(lines)
