"""Training residual forces: `python -m ballu_mjx.train envmimic`."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from ballu_mjx import actuators, evaluate, evaluation, learner, ppo, residual, robot, runs
from ballu_mjx.envmimic import EnvMimicConfig, EnvMimicEnv
from ballu_mjx.errors import InputError
from ballu_mjx.evaluation import OpenLoopEvaluator, group_of
from ballu_mjx.ppo import PPOConfig
from ballu_mjx.reconstruction import reconstruct
from ballu_mjx.recording import Recording, bundled, read_recording
from ballu_mjx.recording import recordings as expand
from ballu_mjx.robot import ActuatorParameters
from ballu_mjx.session import Session, start_from

USES = ("training", "validation", "test")
QUICK: Mapping[str, Any] = {"num_timesteps": 120_000, "num_envs": 256, "batch_size": 128}
"""Defaults of `PPOConfig` under `--quick`."""
QUICK_RECORDINGS = 2
"""Recordings of each kind that `--quick` reads."""


@dataclasses.dataclass(frozen=True)
class Data:
    """Recordings and folders. A path is a recording (.csv or .csv.gz) or a folder of them."""

    recordings: tuple[Path, ...] = ()
    """Recordings to learn from. Without this option: the bundled ones, for validation and test too."""
    validation: tuple[Path, ...] = ()
    """Recordings that measure progress and choose the best checkpoint. Without this option, where --recordings are
    your own: those."""
    test: tuple[Path, ...] = ()
    """Recordings for the final table. Without this option, where --recordings are your own: those for validation."""
    actuators: Path | None = None
    """File of identified actuators (`train sysid` writes it), or the word nominal. Without this option: actuators.json
    beside the recordings or in the folder above, if it names their robot; else nominal."""
    output: Path | None = None
    """Folder of the run, new or empty. Without this option: one under runs/, named after the time."""
    resume: Path | None = None
    """Go on with the run in this folder, from its last checkpoint, with its recordings and configuration; options
    given beside it change these. --num-timesteps counts from the run's start."""
    quick: bool = False
    """See everything work within two minutes, on a few recordings; the numbers mean little."""
    validate_every: int = 400_000
    """Control steps between two validations, each of which leaves a checkpoint."""


def train(data: Data, env_config: EnvMimicConfig, ppo_config: PPOConfig) -> int:
    """Read and check everything, train, evaluate; returns the exit status."""
    started = time.perf_counter()
    devices = [str(device) for device in jax.local_devices()]
    ppo.check(ppo_config, len(devices))
    if data.validate_every < 1:
        raise InputError(f"--validate-every is {data.validate_every}: it must be 1 or more.")
    start = start_from("envmimic", data.resume, ppo_config, output=data.output, quick=data.quick)
    files = _choose(data)
    recordings = _read(files)
    identified, where = _actuators(data, files["training"], recordings["training"])
    folder = data.resume or runs.new_folder(data.output, "envmimic")

    print(f"Run folder: {folder}")
    for use in USES:
        print(f"  {use}: {', '.join(recording.name for recording in recordings[use])}")
    print(f"  actuators: {where}")
    if files["validation"] == files["training"]:
        print("  Validation is on the training recordings: it will not show how well the forces generalize.")
    if data.quick:
        print("  --quick: sizes so small that the numbers mean little.")
    print("Reconstructing the recorded states ...", flush=True)
    model = robot.load_model(identified)
    motions = {use: [reconstruct(recording, model) for recording in recordings[use]] for use in USES}
    env = EnvMimicEnv(model, motions["training"], env_config)
    if start.params is not None and start.params.normalizer.mean["state"].shape != env.observation_size["state"]:
        raise InputError(
            f"{data.resume}: its policy was trained on other observations; leave the options of env as they were."
        )
    policy = ppo.make_inference(env.observation_size, env.action_size, ppo_config)

    def evaluator(use: str) -> OpenLoopEvaluator:
        return evaluation.OpenLoopEvaluator(model, motions[use], env_config, policy)

    config = runs.describe("envmimic", {"env": env_config, "ppo": ppo_config, "data": data}, files, devices, identified)
    validation = evaluator("validation")
    with runs.Run(folder, config, resumed_at=start.resumed_at) as run:
        print("Compiling: about a minute the first time ...", flush=True)
        progress = runs.Progress(learner.total_timesteps(ppo_config, start.step), start.step)
        residual.write_observed(run, env.recorded_inputs())
        session = Session(run, progress, data.validate_every, lambda params: validation(params).score)
        try:
            session.train(env, ppo_config, start, config)
        except KeyboardInterrupt:
            print(f"To go on: python -m ballu_mjx.train envmimic --resume {folder}", file=sys.stderr)
            return session.exit_status

    best_step, params = evaluate.load_params(folder, "best")
    evaluate.learning_curve(folder, best_step)
    test = validation if files["test"] == files["validation"] else evaluator("test")
    print(f"Best checkpoint: step {best_step:,}. Open-loop replay of the test recordings:\n")
    base = evaluation.base_name(identified is not None)
    print(evaluate.report(test, params, folder, base).table(base))
    if data.quick:
        print("\nThese numbers mean little: --quick trains for seconds.")
    print(f"\nWritten to {folder}. {time.perf_counter() - started:.0f} s in all.")
    return 0


def _choose(data: Data) -> dict[str, list[Path]]:
    """The files for each use."""
    own = dict(zip(USES, (data.recordings, data.validation, data.test), strict=True))
    files = {use: expand(paths) for use, paths in own.items() if paths}
    if data.resume is not None:
        config = runs.read_config(data.resume, "envmimic")
        files = {use: runs.find_recordings(config, use, data.resume) for use in USES if use not in files} | files
    elif data.recordings:
        files.setdefault("validation", files["training"])
        files.setdefault("test", files["validation"])
    else:
        files = {use: bundled(use) for use in USES if use not in files} | files
    if data.quick:
        files = {"training": files["training"][:QUICK_RECORDINGS], "validation": _one_a_group(files["validation"])}
        files["test"] = files["validation"]  # a second set would be a second program to compile
    return files


def _actuators(
    data: Data, files: Sequence[Path], recordings: Sequence[Recording]
) -> tuple[ActuatorParameters | None, str]:
    """The simulator's actuators (None: nominal), and where they come from, for the user to read."""
    if data.actuators is None and data.resume is not None:
        identified = runs.actuators(runs.read_config(data.resume, "envmimic"), data.resume)
        return identified, f"{'nominal' if identified is None else 'identified'}, as before"
    if data.actuators == Path("nominal"):
        return None, "nominal"
    robots = {recording.robot for recording in recordings}
    path = data.actuators
    if path is None and len(robots) == 1:
        path = actuators.find(files, next(iter(robots)))
    if path is None:
        return None, "nominal (the recordings' robot has no actuators.json; `train sysid` identifies one from a sweep)"
    robot, identified = actuators.read(path)
    if robots != {robot}:
        raise InputError(
            f"{path}: these are the actuators of {robot!r}, the recordings are of {', '.join(sorted(robots))}; give "
            "the file of the same robot, or --actuators nominal."
        )
    return identified, str(path)


def _one_a_group(paths: Sequence[Path]) -> list[Path]:
    first = {group_of(path.name): path for path in reversed(paths)}
    return sorted(first.values())[:QUICK_RECORDINGS]


def _read(files: Mapping[str, Sequence[Path]]) -> dict[str, list[Recording]]:
    """All recordings, read and found fit for their use."""
    seen = {path.resolve() for path in files["training"]}
    for use in ("validation", "test"):
        for path in files[use]:
            if path.resolve() in seen and files[use] != files["training"]:
                raise InputError(f"{path}: is among the training and the {use} recordings; take it out of one of them.")
    read = {path: read_recording(path) for paths in files.values() for path in paths}
    for path, recording in read.items():
        evaluate.check_recording(path, recording, long_enough=path in files["validation"] or path in files["test"])
    return {use: [read[path] for path in paths] for use, paths in files.items()}
