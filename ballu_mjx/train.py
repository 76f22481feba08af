"""Training from the command line: `python -m ballu_mjx.train sysid`, `... envmimic`.

JAX, and all that needs it, is imported inside functions: `runtime.prepare` has to come first.
"""

# Not postponed here: tyro reads the annotations of functions whose names exist only inside `_commands`.
import argparse
import contextlib
import dataclasses
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from ballu_mjx import runtime
from ballu_mjx.errors import InputError

if TYPE_CHECKING:
    from ballu_mjx.envmimic import EnvMimicConfig
    from ballu_mjx.evaluation import OpenLoopEvaluator
    from ballu_mjx.identification import IdentificationConfig
    from ballu_mjx.ppo import Params, PPOConfig
    from ballu_mjx.recording import Recording
    from ballu_mjx.robot import ActuatorParameters
    from ballu_mjx.runs import Progress, Run

USES = ("training", "validation", "test")
QUICK_PPO: Mapping[str, Any] = {"num_timesteps": 120_000, "num_envs": 256, "batch_size": 128}
"""Defaults of `PPOConfig` under `--quick`."""
QUICK_FIT: Mapping[str, Any] = {"transients": False, "draws": 32, "starts": 4, "steps": 12}
"""Defaults of `IdentificationConfig` under `--quick`."""
QUICK_RECORDINGS = 2
"""Recordings of each kind that `--quick` reads."""
_PROGRAM = "python -m ballu_mjx.train"


@dataclasses.dataclass(frozen=True)
class SweepData:
    """Sweeps and folders. A path is a recording (.csv or .csv.gz) or a folder of them."""

    recordings: tuple[Path, ...] = ()
    """Suspended recordings of one robot, its legs swept together or one after the other. Without this option: the
    bundled sweep."""
    levels: int = 20
    """Fewest command levels for each leg (paper: 20)."""
    output: Path | None = None
    """Folder of the run, new or empty. Without this option: one under runs/, named after the time."""
    quick: bool = False
    """Settled angles alone, from fewer starts: within two minutes, compiling included."""


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
    """Go on with the run in this folder, from its last checkpoint's parameters, with its recordings and configuration;
    options given beside it change these. --num-timesteps counts from the run's start."""
    quick: bool = False
    """See everything work within two minutes, on a few recordings; the numbers mean little."""
    validate_every: int = 400_000
    """Control steps between two validations, each of which leaves a checkpoint."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status: 2 for input that cannot be used, 130 when interrupted."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        runtime.prepare()
        return tyro.extras.subcommand_cli_from_dict(
            _commands(arguments),
            args=arguments,
            prog=_PROGRAM,
            description="Learn from recordings of the robot. Each subcommand explains its options with --help.",
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
        )
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        return 130


def _commands(arguments: Sequence[str]) -> dict[str, Callable[..., int]]:
    """Subcommands by name. A function's parameters are its options, their defaults depend on --resume and --quick."""
    from ballu_mjx.envmimic import EnvMimicConfig
    from ballu_mjx.identification import IdentificationConfig
    from ballu_mjx.ppo import PPOConfig

    env_defaults, ppo_defaults = _defaults(arguments)
    fit_defaults = IdentificationConfig(**QUICK_FIT if "--quick" in arguments else {})

    def envmimic(data: Data = Data(), env: EnvMimicConfig = env_defaults, ppo: PPOConfig = ppo_defaults) -> int:  # noqa: B008
        """Learn residual forces from recordings, and measure them on recordings that training never saw."""
        return _envmimic(data, env, ppo)

    def sysid(data: SweepData = SweepData(), fit: IdentificationConfig = fit_defaults) -> int:  # noqa: B008
        """Identify the actuators from a suspended sweep: what `--actuators` of the other commands takes."""
        return _sysid(data, fit)

    return {"envmimic": envmimic, "sysid": sysid}


def _defaults(arguments: Sequence[str]) -> "tuple[EnvMimicConfig, PPOConfig]":
    """Where options stand that are not given: in the run that goes on, or in the configurations' classes."""
    from ballu_mjx import runs
    from ballu_mjx.envmimic import EnvMimicConfig
    from ballu_mjx.ppo import PPOConfig

    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--resume", type=Path)
    parser.add_argument("--quick", action="store_true")
    first, _ = parser.parse_known_args([a for a in arguments if a != "--help"])
    if first.resume is not None:
        config = runs.read_config(first.resume, "envmimic")
        return (
            runs.typed(EnvMimicConfig, config["env"], first.resume),
            runs.typed(PPOConfig, config["ppo"], first.resume),
        )
    return EnvMimicConfig(), PPOConfig(**QUICK_PPO if first.quick else {})


def _envmimic(data: Data, env_config: "EnvMimicConfig", ppo_config: "PPOConfig") -> int:
    """Read and check everything, train, evaluate; returns the exit status."""
    import jax

    from ballu_mjx import evaluate, evaluation, ppo, robot, runs
    from ballu_mjx.envmimic import EnvMimicEnv
    from ballu_mjx.reconstruction import reconstruct

    started = time.perf_counter()
    devices = [str(device) for device in jax.local_devices()]
    ppo.check(ppo_config, len(devices))
    if data.validate_every < 1:
        raise InputError(f"--validate-every is {data.validate_every}: it must be 1 or more.")
    first_step, restored = _restored(data, ppo_config)
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
    if restored is not None and restored.normalizer.mean["state"].shape != env.observation_size["state"]:
        raise InputError(
            f"{data.resume}: its policy was trained on other observations; leave the options of env as they were."
        )
    policy = ppo.make_inference(env.observation_size, env.action_size, ppo_config)

    def evaluator(use: str) -> "OpenLoopEvaluator":
        return evaluation.OpenLoopEvaluator(model, motions[use], env_config, policy)

    config = runs.describe("envmimic", {"env": env_config, "ppo": ppo_config, "data": data}, files, devices, identified)
    resumed_at = None if restored is None else first_step
    validation = evaluator("validation")
    with runs.Run(folder, config, resumed_at=resumed_at) as run:
        print("Compiling: about a minute the first time ...", flush=True)
        remaining = dataclasses.replace(ppo_config, num_timesteps=ppo_config.num_timesteps - first_step)
        progress = runs.Progress(first_step + ppo.total_timesteps(remaining), first_step)
        session = _Session(run, progress, validation, data.validate_every, resumed_at)
        try:
            with _interrupts_noted(session):
                ppo.train(env, remaining, session.step_done, restore=restored, first_step=first_step)
                session.finish()
        except KeyboardInterrupt:
            step = session.keep()
            progress.close()
            print(f"Interrupted at step {step:,}. To go on: {_PROGRAM} envmimic --resume {folder}", file=sys.stderr)
            return 130
        progress.close()

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


def _sysid(data: SweepData, config: "IdentificationConfig") -> int:
    """Read and check the sweep, identify, write; returns the exit status."""
    from ballu_mjx import actuators, identification, plots, runs
    from ballu_mjx.recording import bundled, read_recording
    from ballu_mjx.recording import recordings as expand
    from ballu_mjx.sweep import read_sweep

    started = time.perf_counter()
    identification.check(config)
    paths = expand(data.recordings) if data.recordings else bundled("suspended")
    sweep = read_sweep({path: read_recording(path) for path in paths}, levels=data.levels)
    folder = runs.new_folder(data.output, "sysid")
    print(f"Run folder: {folder}")
    print(f"  sweep of {sweep.robot}: {len(sweep.command)} holds, {', '.join(path.name for path in paths)}")
    with runs.Run(folder, runs.describe("sysid", {"fit": config, "data": data}, {"suspended": paths}, [])) as run:
        stages = runs.Stages()

        def report(stage: str, iteration: int, steps: int, loss: float) -> None:
            run.log(stages.update(stage, iteration, steps, loss), {stage: loss})

        result = identification.identify(sweep, config, report)
        stages.close()
        text = identification.table(sweep, result)
        run.write("identification.txt", text + "\n")
        source = [runs.describe_recording(path) for path in paths]
        actuators.write(folder / actuators.NAME, sweep.robot, result.parameters, identification.details(result, source))
        plots.actuator_curves(folder / "actuator_curves.png", sweep, result)
    print(f"\n{text}\n\nWritten to {folder}. {time.perf_counter() - started:.0f} s in all.")
    return 0


def _restored(data: Data, ppo_config: "PPOConfig") -> "tuple[int, Params | None]":
    """Step and parameters that training starts from."""
    from ballu_mjx import evaluate, runs
    from ballu_mjx.ppo import PPOConfig

    if data.resume is None:
        return 0, None
    for option, given in (("--output", data.output is not None), ("--quick", data.quick)):
        if given:
            raise InputError(f"{option} does not go with --resume, which keeps folder and sizes; leave one out.")
    stored = runs.typed(PPOConfig, runs.read_config(data.resume, "envmimic")["ppo"], data.resume)
    for name in ("policy_layers", "value_layers", "activation", "normalize_observations"):
        if getattr(stored, name) != getattr(ppo_config, name):
            raise InputError(
                f"--{name.replace('_', '-')} does not go with --resume: the stored parameters have "
                f"{getattr(stored, name)}; leave it out or start a new run."
            )
    step, params = evaluate.load_params(data.resume, "last")
    if step >= ppo_config.num_timesteps:
        raise InputError(
            f"{data.resume}: is at step {step:,} already; give a --num-timesteps above that to train for longer."
        )
    return step, params


def _choose(data: Data) -> dict[str, list[Path]]:
    """The files for each use."""
    from ballu_mjx import runs
    from ballu_mjx.recording import bundled
    from ballu_mjx.recording import recordings as expand

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
    data: Data, files: Sequence[Path], recordings: "Sequence[Recording]"
) -> "tuple[ActuatorParameters | None, str]":
    """The simulator's actuators (None: nominal), and where they come from, for the user to read."""
    from ballu_mjx import actuators, runs

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
    from ballu_mjx.evaluation import group_of

    first = {group_of(path.name): path for path in reversed(paths)}
    return sorted(first.values())[:QUICK_RECORDINGS]


def _read(files: Mapping[str, Sequence[Path]]) -> "dict[str, list[Recording]]":
    """All recordings, read and found fit for their use."""
    from ballu_mjx import evaluate
    from ballu_mjx.recording import read_recording

    seen = {path.resolve() for path in files["training"]}
    for use in ("validation", "test"):
        for path in files[use]:
            if path.resolve() in seen and files[use] != files["training"]:
                raise InputError(f"{path}: is among the training and the {use} recordings; take it out of one of them.")
    read = {path: read_recording(path) for paths in files.values() for path in paths}
    for path, recording in read.items():
        evaluate.check_recording(path, recording, long_enough=path in files["validation"] or path in files["test"])
    return {use: [read[path] for path in paths] for use, paths in files.items()}


@contextlib.contextmanager
def _interrupts_noted(session: "_Session") -> Iterator[None]:
    """Let the first Ctrl-C end training after its current step; the second interrupts at once, as ever.

    An exception raised wherever Python happens to be can land in a callback of JAX's that swallows it.
    """
    before = signal.getsignal(signal.SIGINT)
    if before != signal.default_int_handler:
        yield  # somebody else's, or ignored in the background of a shell
        return

    def note(*_: Any) -> None:
        if session.interrupted:
            raise KeyboardInterrupt
        session.interrupted = True

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class _Session:
    """Between PPO and the run's folder: measurements, validations, checkpoints, progress."""

    interrupted = False
    """Set by a signal handler: the next finished training step is the last."""

    def __init__(
        self,
        run: "Run",
        progress: "Progress",
        evaluator: "OpenLoopEvaluator",
        validate_every: int,
        validated_at: int | None,
    ) -> None:
        self._run, self._progress, self._evaluator = run, progress, evaluator
        self._every, self._validated_at = validate_every, validated_at
        self._score: float | None = None
        self._last: tuple[int, Any] | None = None
        self._started = time.perf_counter()

    def step_done(self, step: int, params: "Params", metrics: dict[str, float]) -> None:
        """What PPO calls."""
        self._last = (step, params)
        if metrics:
            self._run.log(step, metrics | {"seconds": time.perf_counter() - self._started})
        if self._validated_at is None or step - self._validated_at >= self._every:
            self._validate(step, params)
        if metrics:
            self._progress.update(step, metrics["steps_per_second"], metrics["reward"], self._score)
        if self.interrupted:
            raise KeyboardInterrupt

    def finish(self) -> None:
        """Validate the last parameters."""
        assert self._last is not None
        if self._last[0] != self._validated_at:
            self._validate(*self._last)

    def keep(self) -> int:
        """Save the last parameters without validating them; returns their step."""
        from ballu_mjx import ppo

        if self._last is None:
            return 0
        self._run.save(self._last[0], ppo.as_tree(self._last[1]), None)
        return self._last[0]

    def _validate(self, step: int, params: "Params") -> None:
        from ballu_mjx import ppo

        self._score, self._validated_at = self._evaluator(params).score, step
        self._run.log(step, {"validation_error": self._score})
        self._run.save(step, ppo.as_tree(params), self._score)


if __name__ == "__main__":
    sys.exit(main())
