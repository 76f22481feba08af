"""Evaluation from the command line: `python -m ballu_mjx.evaluate RUN`.

JAX, and all that needs it, is imported inside functions: `runtime.prepare` has to come first.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro

from ballu_mjx import files, replay, runtime
from ballu_mjx.errors import InputError
from ballu_mjx.replay import Take

if TYPE_CHECKING:
    from ballu_mjx.evaluation import Errors, Evaluation, OpenLoopEvaluator, Replay
    from ballu_mjx.ppo import Params
    from ballu_mjx.recording import Recording


@dataclasses.dataclass(frozen=True)
class Options(runtime.CommandOptions):
    """Replay recordings open loop, without and with a run's residual forces, and print the errors of both."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    recordings: tuple[Path, ...] = ()
    """Recordings to replay, files or folders. Without this option: the run's own for the test."""
    last: bool = False
    """Take the last checkpoint instead of the best by validation error."""
    noise_floor: bool = False
    """Also tell which errors the noise of motion capture (0.5 mm, 0.3 deg) makes by the starting states alone: no
    simulator can be expected to do much better."""
    output: Path | None = None
    """Folder for evaluation.txt, evaluation.json, tracking.png and replay.npz, the run's own, say. Without this option:
    the table is only printed."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status (`runtime.exit_status`)."""

    def run() -> None:
        runtime.prepare()
        options = tyro.cli(Options, args=arguments, prog="python -m ballu_mjx.evaluate")
        _evaluate(options)

    return runtime.exit_status(run, arguments)


def _evaluate(options: Options) -> None:
    from ballu_mjx import evaluation, residual, runs
    from ballu_mjx.general_reconstruction import reconstruct
    from ballu_mjx.reconstruction import noisier
    from ballu_mjx.recording import read_recording
    from ballu_mjx.recording import recordings as expand

    config = runs.read_config(options.run, *residual.TASKS)
    which = "last" if options.last else "best"
    robot = runs.robot_description(config, options.run)
    loaded = residual.Residual.load(options.run, which, description=robot)
    paths = expand(options.recordings) or runs.find_recordings(config, "test", options.run)
    recordings = [read_recording(path, robot) for path in paths]
    for path, recording in zip(paths, recordings, strict=True):
        check_recording(path, recording, long_enough=True)
    if options.output is not None:
        files.check_folder(options.output)
        options.output.mkdir(parents=True, exist_ok=True)

    if loaded.step:
        print(f"The {which} checkpoint of {options.run}: step {loaded.step:,}.", flush=True)
    print("Compiling: half a minute the first time ...", flush=True)
    model = robot.load_model(loaded.actuators)
    motions = [reconstruct(recording, model, robot) for recording in recordings]
    base = evaluation.base_name(loaded.actuators is not None)
    evaluator = evaluation.OpenLoopEvaluator(model, motions, loaded.model, base, robot)
    result = evaluator(loaded.params) if options.output is None else report(evaluator, loaded.params, options.output)
    print(result.table())
    if options.noise_floor:
        shaken = [noisier(recording, seed=number) for number, recording in enumerate(recordings)]
        floor = evaluator.of_starts([reconstruct(each, model, robot) for each in shaken], loaded.params)
        print(f"\n{noise_floor(floor, result.residual)}")


def noise_floor(floor: Sequence[Errors], errors: Sequence[Errors]) -> str:
    """For the terminal: by group and horizon, what noise alone makes of a simulator's errors, and what these are."""
    from ballu_mjx.evaluation import grouped

    lines = [
        "Of these errors, those that the noise of motion capture (0.5 mm, 0.3 deg) in the starting states makes:",
    ]
    for noise, ours in zip(grouped(floor), grouped(errors), strict=True):
        for horizon, (position, _) in noise.position.items():
            lines.append(
                f"{noise.group:7}{horizon:>8g} |{position:>14.3f} m of {ours.position[horizon][0]:.3f} m | "
                f"{noise.yaw[horizon][0]:>6.1f} deg of {ours.yaw[horizon][0]:.1f} deg"
            )
    return "\n".join(lines)


def check_recording(path: Path, recording: Recording, *, long_enough: bool) -> None:
    """Refuse, with an `InputError`, a recording that EnvMimic cannot use: `long_enough` for an evaluation or not."""
    from ballu_mjx.evaluation import SCORE_HORIZONS

    if recording.kind != "free":
        raise InputError(f"{path}: is a {recording.kind} recording; EnvMimic takes free ones only, leave it out.")
    shortest = min(SCORE_HORIZONS) + 0.5
    duration = recording.time[-1] - recording.time[0]
    if long_enough and duration < shortest:
        raise InputError(
            f"{path}: lasts {duration:.1f} s; validation and test need {shortest:g} s or more, use it for training."
        )


def load_params(folder: Path, which: Literal["best", "last"]) -> tuple[int, Params]:
    """Step and parameters of a run's checkpoint; `InputError` where there is none."""
    from ballu_mjx import ppo, runs

    step, tree = runs.restore(folder, which)
    return step, ppo.from_tree(tree)


def report(evaluator: OpenLoopEvaluator, params: Any, folder: Path) -> Evaluation:
    """Evaluate, and write `evaluation.txt`, `evaluation.json`, `tracking.png` and, of BALLU, which alone can be drawn,
    `replay.npz` into `folder`."""
    from ballu_mjx.evaluation import Evaluation

    names = evaluator.base, evaluator.name
    replays = dict(zip(names, (evaluator.replay(params, scale=0.0), evaluator.replay(params)), strict=True))
    result = Evaluation(*(evaluator.errors(each) for each in replays.values()), *names)  # pyright: ignore[reportCallIssue]
    files.write(folder / "evaluation.txt", result.table() + "\n")
    files.write(folder / "evaluation.json", json.dumps(result.to_json(), indent=2) + "\n")
    tracking(evaluator, replays, folder / "tracking.png")
    if evaluator.robot.is_ballu:
        replay.write(folder / replay.NAME, takes(evaluator, replays))
    return result


def tracking(evaluator: OpenLoopEvaluator, replays: Mapping[str, Replay], path: Path) -> None:
    """Draw whole-recording replays, by simulator: of the first recording of each group."""
    from ballu_mjx import plots, robot
    from ballu_mjx.evaluation import group_of

    shown: dict[str, plots.TrackingPanel] = {}
    for motion, run in zip(evaluator.motions, evaluator.first_runs, strict=True):
        if group_of(motion.name) in shown:
            continue
        position, yaw = evaluator.recorded(run)
        states = len(yaw)
        simulations = {
            simulator: np.column_stack([replay.position[run, :states, :2], replay.yaw[run, :states]])
            for simulator, replay in replays.items()
        }
        shown[group_of(motion.name)] = plots.TrackingPanel(
            title=motion.name,
            time=np.arange(states) * robot.CONTROL_TIMESTEP,
            recording=np.column_stack([position[:, :2], yaw]),
            simulations=simulations,
        )
    plots.tracking(path, list(shown.values()))


def takes(evaluator: OpenLoopEvaluator, replays: Mapping[str, Replay]) -> list[Take]:
    """Whole-recording replays of every recording, by simulator, to be looked at; the force is the last simulator's."""
    found = []
    for index, motion in enumerate(evaluator.motions):
        run = evaluator.first_runs[index]
        first = evaluator.starts[run][1]
        states = len(motion.qpos) - first
        *_, last = replays.values()
        simulated = {simulator: replay.qpos[index, :states] for simulator, replay in replays.items()}
        found.append(
            Take(
                name=motion.name,
                robot=motion.robot,
                time=motion.time[first:],
                qpos={"recording": motion.qpos[first:], **simulated},
                command=motion.command[first:],
                force=last.force[run, : states - 1],
            )
        )
    return found


def learning_curve(folder: Path, best_step: int) -> None:
    """Draw `learning_curve.png` from the run's `metrics.jsonl`."""
    from ballu_mjx import plots, runs

    plots.learning_curve(
        folder / "learning_curve.png",
        *runs.column(folder, "reward"),
        *runs.column(folder, "validation_error"),
        best_step=best_step,
    )


if __name__ == "__main__":
    sys.exit(main())
