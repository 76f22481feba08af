"""The whole story in one command, on a virtual robot: `python -m ballu_mjx.train all`.

Stages, in the paper's order: an actuator sweep and its identification; vanilla policies; their actions replayed on the
robot, several times each; one EnvMimic a task, and beyond the paper the air identified from the same recordings;
policies in all simulators; trials on the robot; tables. With `--rounds`, EnvMimic learns again from the robot under its
own policies, and they in the simulator that this makes; `--also` adds simulators. Every stage is a folder, and beside
it stands the key of what it was made from (options, and the keys of the stages it needs): an interrupted run goes on
where it was, and a changed option redoes what depends on it and nothing else.
"""

from __future__ import annotations

import dataclasses
import functools
import gc
import hashlib
import itertools
import json
import re
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from ballu_mjx import (
    actuator_fit,
    actuators,
    air_fit,
    files,
    force_fit,
    locomotion,
    loggers,
    plots,
    policy_training,
    residual_training,
    robot,
    runs,
    transfer,
    trials,
    virtual_robot,
)
from ballu_mjx.air_identification import AirConfig
from ballu_mjx.analytic import AnalyticConfig
from ballu_mjx.deployment import PolicyController
from ballu_mjx.envmimic import EnvMimicConfig
from ballu_mjx.errors import InputError
from ballu_mjx.forces import ForceSet
from ballu_mjx.identification import IdentificationConfig
from ballu_mjx.locomotion import LocomotionConfig
from ballu_mjx.policy import Policy
from ballu_mjx.ppo import PPOConfig
from ballu_mjx.recording import write_recording
from ballu_mjx.supervised import SupervisedConfig
from ballu_mjx.tasks import TASKS
from ballu_mjx.transfer import Transfer, turning_table, walking_table
from ballu_mjx.virtual_robot import Controller

TABLES = {"walk": walking_table, "turn": turning_table}
"""The paper's tables, by task."""
SETTINGS = ("vanilla+sysid", "vanilla+dr", "vanilla+sysid+dr", "envmimic", "aerodynamic")
"""The paper's four simulators, and one with the identified air instead of EnvMimic's forces."""
SHARED = "envmimic-shared"
"""The setting of one EnvMimic for all tasks."""
NEAR = "envmimic-near"
"""The setting with EnvMimic's forces whose policies pay for leaving what these were learned from."""
WRENCH = "envmimic-wrench"
"""The setting of an EnvMimic that pushes with a torque too."""
MORE_SETTINGS = (NEAR, SHARED, WRENCH, "supervised", "analytic")
"""Settings that are run on request; the last two are networks that regression and gradients learn."""
ROUNDS = "envmimic"
"""The setting that `Options.rounds` repeats. Nothing of an earlier round is replaced: later ones have their number
behind the name."""
_DECIMALS = 4
_KEY = re.compile("[0-9a-f]{16}")


@dataclasses.dataclass(frozen=True)
class Options(loggers.LoggingOptions):
    """What to run, and how long to train."""

    output: Path = Path("runs/all")
    """Folder of all stages. What is there already and was made with the same options is kept."""
    robot: int = 0
    """Which virtual robot of the family stands in for the hardware."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the trainings: each trains every policy and residual anew."""
    tasks: tuple[Literal["walk", "turn"], ...] = ("walk", "turn")
    """The paper's two tasks."""
    trials: int = 5
    """Trials on the robot for each policy, each in a draught of its own."""
    takes: int = 2
    """Recordings of each sequence of actions, each in a draught of its own."""
    policy_steps: int = 3_000_000
    """Control steps to train each policy for."""
    residual_steps: int = 3_000_000
    """Control steps to train each EnvMimic for."""
    rounds: int = 1
    """How often EnvMimic learns. From the second time on, its recordings are joined by the robot's motion under the
    policies trained the time before, in closed loop; then policies are trained anew: `envmimic-2`, and so on."""
    also: tuple[Literal["envmimic-near", "envmimic-shared", "envmimic-wrench", "supervised", "analytic"], ...] = ()
    """Further simulators to train policies in: with EnvMimic's forces, and policies that pay for leaving what these
    were learned from; with one EnvMimic that learns from the recordings of both tasks, instead of one a task; with one
    that pushes with a torque too; with the forces that regression (all of them, the paper's baseline), and that
    gradients through the simulation, learn from the task's."""
    outside_cost: float = 0.5
    """What they pay in `envmimic-near`; see `train walk --help`."""
    quick: bool = False
    """Every stage within five minutes in all, for one task and two simulators; the tables mean nothing."""


def run(options: Options) -> int:
    """Run what is missing, print the tables; returns the exit status."""
    started = time.perf_counter()
    _check(options)
    settings = settings_of(options)
    if options.quick:
        options = dataclasses.replace(options, trials=min(options.trials, 2), takes=1, tasks=options.tasks[:1])
    results: dict[str, dict[str, list[list[Transfer]]]] = {
        task: {setting: [] for setting in settings} for task in options.tasks
    }
    for seed in options.seeds:
        story = Story(options, seed)
        for task in options.tasks:
            for setting in settings:
                results[task][setting].append(story.transfers(task, setting))
    for task in options.tasks:
        text = TABLES[task](results[task])
        table_file(options.output, task).write_text(text + "\n", encoding="utf-8")
        print(f"\n### {task}\n\n{text}\n")
    if options.quick:
        print("These numbers mean nothing: --quick trains for seconds.")
    print(f"Written to {options.output}. {time.perf_counter() - started:.0f} s in all.")
    return 0


def settings_of(options: Options) -> tuple[str, ...]:
    """The simulators that policies are trained in, in the tables' order."""
    first = ("vanilla+dr", ROUNDS) if options.quick else SETTINGS
    return (*first, *(_again(number) for number in range(2, options.rounds + 1)), *options.also)


def settings_beyond(folder: Path, task: str) -> tuple[str, ...]:
    """The settings beyond `SETTINGS` that a seed's folder has policies of: of later rounds, and on request."""

    def there(name: str) -> bool:
        return (folder / f"{task}-{name}").is_dir()

    return (*itertools.takewhile(there, map(_again, itertools.count(2))), *filter(there, MORE_SETTINGS))


def _again(number: int) -> str:
    """What EnvMimic's setting is called in a round."""
    return f"{ROUNDS}-{number}" if number > 1 else ROUNDS


def residual_folder(seed: Path, task: str, setting: str) -> Path:
    """Where, in a seed's folder, the residual of a setting is learned."""
    if setting == SHARED:
        return seed / SHARED
    method, number = plots.round_of(ROUNDS if setting == NEAR else setting)
    return seed / (f"{method}-{task}" if number == 1 else f"{method}-{task}-{number}")


def table_file(output: Path, task: str) -> Path:
    """Where the table of a task is written."""
    return output / f"table-{task}.md"


class Story:
    """The stages of one seed. Each method makes its stage, and the ones before, unless they are there."""

    def __init__(self, options: Options, seed: int) -> None:
        self.options, self.seed = options, seed
        self._robot = virtual_robot.draw_robot(options.robot)
        self._shared, self._own = options.output, options.output / f"seed-{seed}"

    def sweep(self) -> Path:
        """An actuator sweep of the robot."""

        def make(folder: Path) -> None:
            sweep = virtual_robot.record_sweep(self._robot, seed=self.options.robot, name="sweep")
            write_recording(sweep, folder / "sweep.csv.gz", decimals=_DECIMALS)

        return _stage(self._shared / "sweep", {"robot": self.options.robot}, [], make)

    def identified(self) -> Path:
        """The run of the identification."""
        sweep = self.sweep()
        config = IdentificationConfig(**actuator_fit.QUICK if self.options.quick else {})

        def make(folder: Path) -> None:
            recordings = (sweep / "sweep.csv.gz",)
            data = actuator_fit.SweepData(recordings=recordings, output=folder, wandb=self.options.wandb)
            actuator_fit.fit(data, config)

        return _stage(self._shared / "sysid", config, [sweep], make)

    def policy(self, task: str, setting: str) -> Path:
        """The run of a policy's training."""
        method, _ = plots.round_of(setting)
        learned = method in ("envmimic", "aerodynamic", *MORE_SETTINGS)
        config = LocomotionConfig(
            domain_randomization=learned or setting.endswith("+dr"),
            outside_cost=self.options.outside_cost if setting == NEAR else 0.0,
        )
        quick = policy_training.QUICK if self.options.quick else {"num_timesteps": self.options.policy_steps}
        ppo = policy_training.defaults(seed=self.seed, **quick)
        needs = []
        # Six checkpoints in all, or one a training step: the last three are what is replayed on the robot.
        data = policy_training.Data(keep_every=max(ppo.num_timesteps // 6, 1), wandb=self.options.wandb)
        if learned:
            needs = [self.residual(task, setting)]
            data = dataclasses.replace(data, residual=needs[0])
        elif "+sysid" in setting:
            needs = [self.identified()]
            data = dataclasses.replace(data, actuators=needs[0] / actuators.NAME)

        def make(folder: Path) -> None:
            started = runs.checkpoints(folder)
            where = policy_training.Data(resume=folder, keep_every=data.keep_every, wandb=data.wandb)
            where = where if started else dataclasses.replace(data, output=folder)
            _stop_unless_done(policy_training.train(TASKS[task], where, config, ppo))

        return _stage(self._own / f"{task}-{setting}", (config, ppo), needs, make)

    def recordings(self, task: str) -> Path:
        """The robot's motion under the actions of vanilla policies, replayed open loop (paper: several of them, several
        times each): those of the last checkpoints of two trainings, without and with domain randomization."""
        settings = ("vanilla+dr",) if self.options.quick else ("vanilla", "vanilla+dr")
        sources = [self.policy(task, setting) for setting in settings]
        takes, seconds = self.options.takes, 6.0 if self.options.quick else 20.0

        def make(folder: Path) -> None:
            sequences = [commands for source in sources for commands in self._actions(source, seconds + 5.0)]
            jobs = []
            for index, commands in enumerate(sequences):
                # The last of the randomized training's sequences validates, a little longer than the others.
                use = "validation" if index == len(sequences) - 1 else "training"
                played = commands if use == "validation" else commands[: round(seconds / robot.CONTROL_TIMESTEP)]
                for take in range(takes):
                    jobs.append((use, f"actions-{index}-take-{take + 1}", played))
            for number, (use, name, commands) in enumerate(jobs):
                controller, length = virtual_robot.open_loop(commands), len(commands) * robot.CONTROL_TIMESTEP
                draw, notes = _draw(self.seed, task, "recordings", number), f"Actions of a vanilla policy for {task}."
                self._record(folder / use, name, controller, length, draw, notes)
                print(f"Recorded {name} ({use}), {number + 1} of {len(jobs)}", flush=True)

        options = {"robot": self.options.robot, "seed": self.seed, "takes": takes, "seconds": seconds}
        return _stage(self._own / f"recordings-{task}", options, sources, make)

    def trained_last(self, task: str, number: int) -> Path:
        """The robot's motion under the policies of the round before, in closed loop: those of the last checkpoints,
        each several times; and the last one's once more, a little longer, which validates."""
        source = self.policy(task, _again(number - 1))
        takes, seconds = self.options.takes, 6.0 if self.options.quick else 20.0

        def make(folder: Path) -> None:
            act = {step: Policy.load(source, step).act() for step in _last_steps(source)}
            jobs = [("training", step, take, seconds) for step in act for take in range(takes)]
            jobs.append(("validation", max(act), takes, seconds + 5.0))
            for job, (use, step, take, length) in enumerate(jobs):
                name = f"round-{number}-policy-{step}-take-{take + 1}"
                controller = PolicyController(act[step])
                draw, notes = _draw(self.seed, task, f"round {number}", job), f"A policy for {task}, closed loop."
                self._record(folder / use, name, controller, length, draw, notes)
                print(f"Recorded {name} ({use}), {job + 1} of {len(jobs)}", flush=True)

        options = {"robot": self.options.robot, "seed": self.seed, "takes": takes, "seconds": seconds}
        return _stage(self._own / f"recordings-{task}-{number}", options, [source], make)

    def _record(self, folder: Path, name: str, controller: Controller, seconds: float, draw: int, notes: str) -> None:
        recording = virtual_robot.record(self._robot, virtual_robot.draw_trial(draw), controller, seconds, name, notes)
        folder.mkdir(exist_ok=True)
        write_recording(recording, folder / f"{name}.csv.gz", decimals=_DECIMALS)

    def residual(self, task: str, setting: str) -> Path:
        """The run of a setting's residual, learned from the recordings of the task, those of all rounds up to its
        own."""
        method, number = plots.round_of(setting)
        if method == SHARED:
            recordings = [self.recordings(each) for each in TABLES]
        else:
            recordings = [self.recordings(task), *(self.trained_last(task, n) for n in range(2, number + 1))]
        identified = self.identified()
        fits = {"aerodynamic": self._air, "supervised": self._supervised, "analytic": self._analytic}
        envmimic = functools.partial(self._envmimic, "wrench" if method == WRENCH else "force")
        options = fits.get(method, envmimic)()

        def make(folder: Path) -> None:
            sources: dict[str, Any] = {
                "recordings": tuple(each / "training" for each in recordings),
                "validation": tuple(each / "validation" for each in recordings),
                "actuators": identified / actuators.NAME,
                "output": folder,
                "wandb": self.options.wandb,
            }
            if isinstance(options, AirConfig):
                air_fit.fit(air_fit.AirData(**sources), options)
            elif isinstance(options, SupervisedConfig):
                force_fit.fit_supervised(force_fit.ForcesData(**sources), options)
            elif isinstance(options, AnalyticConfig):
                force_fit.fit_analytic(force_fit.ForcesData(**sources), options)
            else:
                data = residual_training.Data(**sources)
                if runs.checkpoints(folder):
                    data = residual_training.Data(resume=folder, wandb=data.wandb)
                _stop_unless_done(residual_training.train(data, *options))

        needs = [*recordings, identified]
        return _stage(residual_folder(self._own, task, setting), options, needs, make, goes_on=method not in fits)

    def _supervised(self) -> SupervisedConfig:
        # All of its forces: the paper's baseline, not what is left of it where they do not help.
        return SupervisedConfig(
            shares=(1.0,), seed=self.seed, **force_fit.QUICK["supervised"] if self.options.quick else {}
        )

    def _analytic(self) -> AnalyticConfig:
        return AnalyticConfig(seed=self.seed, **force_fit.QUICK["analytic"] if self.options.quick else {})

    def _air(self) -> AirConfig:
        return AirConfig(**air_fit.QUICK if self.options.quick else {})

    def _envmimic(self, forces: ForceSet) -> tuple[EnvMimicConfig, PPOConfig]:
        quick = residual_training.QUICK if self.options.quick else {"num_timesteps": self.options.residual_steps}
        return EnvMimicConfig(forces=forces), PPOConfig(seed=self.seed, **quick)

    def transfers(self, task: str, setting: str) -> list[Transfer]:
        """How the policy's trials on the robot compare with its own simulator."""
        source = self.policy(task, setting)
        count = self.options.trials

        def make(folder: Path) -> None:
            policy = Policy.load(source)
            draws = [virtual_robot.draw_trial(_draw(self.seed, task, "trials", number)) for number in range(count)]
            found = trials.run(policy, self._robot, draws, folder)
            transfer.write(folder / "transfer.json", found)

        options = {"robot": self.options.robot, "seed": self.seed, "trials": count}
        folder = _stage(self._own / f"trials-{task}-{setting}", options, [source], make)
        return transfer.read(folder / "transfer.json")

    def _actions(self, run: Path, seconds: float) -> list[np.ndarray]:
        """Commands of each of a policy's kept checkpoints over `seconds`, in its own simulator from standing."""
        policies = [Policy.load(run, step) for step in _last_steps(run)]
        loop = policies[0].closed_loop()
        start, count = loop.standing(), round(seconds / robot.CONTROL_TIMESTEP)
        return [np.round(loop(p.params, *start, count).command[0], 3).astype(float) for p in policies]


def _last_steps(run: Path) -> list[int]:
    """Of a run's last checkpoints; the best may be an earlier one, and the first is of no training at all."""
    return [step for step in runs.checkpoints(run)[-runs.KEPT :] if step > 0]


def _draw(seed: int, task: str, use: str, number: int) -> int:
    """The seed of a trial's circumstances. The same for all settings, which so meet the same draughts."""
    digest = hashlib.sha256(f"{seed} {task} {use} {number}".encode()).digest()
    return int.from_bytes(digest[:4], "big")


def _stage(
    folder: Path, options: Any, needs: Sequence[Path], make: Callable[[Path], None], *, goes_on: bool = True
) -> Path:
    """`folder` as `make` leaves it, made unless it is there with the key of `options` and `needs`.

    A folder with another key is set aside. One with the same key that was not finished is handed to `make` as it is, if
    that `goes_on` from checkpoints and there are any.
    """
    content = {
        "options": options if isinstance(options, dict) else _plain(options),
        "needs": [_read_mark(_mark(need))["key"] for need in needs],
    }
    key = hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]
    mark = _mark(folder)
    found = _read_mark(mark) if mark.exists() else None
    if found is not None and found["key"] == key and found["done"]:
        return folder
    if found is not None and found["key"] != key:
        aside = folder.with_name(f"{folder.name}.{found['key']}")
        shutil.rmtree(aside, ignore_errors=True)
        if folder.exists():
            folder.rename(aside)
        print(f"{folder}: made with other options; set aside as {aside.name}.")
        found = None
    print(f"\n== {folder.name}" + (" (goes on)" if goes_on and found is not None else ""), flush=True)
    if folder.exists() and not (goes_on and found is not None and runs.checkpoints(folder)):
        shutil.rmtree(folder)  # a beginning of nothing
    folder.mkdir(parents=True, exist_ok=True)
    _write_mark(mark, key, content, done=False)
    make(folder)
    _write_mark(mark, key, content, done=True)
    # Programs of a stage stay mapped otherwise, until the process has no map left.
    jax.clear_caches()
    gc.collect()
    return folder


def _mark(folder: Path) -> Path:
    """Where a stage's key stands: beside its folder, which is its maker's."""
    return folder.with_name(folder.name + ".stage.json")


def _write_mark(path: Path, key: str, content: dict[str, Any], *, done: bool) -> None:
    files.write(path, json.dumps({"key": key, "done": done, **content}, indent=2, default=str) + "\n")


def _read_mark(path: Path) -> dict[str, Any]:
    """The content of a stage's file.

    **Raises** `InputError` where it is damaged.
    """
    mend = "delete it, and its stage will be made anew"
    content = files.read_json(path, mend)
    key = content.get("key")
    if not (isinstance(key, str) and _KEY.fullmatch(key) and isinstance(content.get("done"), bool)):
        raise InputError(f'{path}: "key" and "done" are not as this program writes them; {mend}.')
    return content


def _plain(options: Any) -> Any:
    if isinstance(options, tuple):
        return [_plain(option) for option in options]
    return dataclasses.asdict(options) | {"kind": type(options).__name__}


def _stop_unless_done(status: int) -> None:
    """What a training's exit status means for the story."""
    if status:
        raise KeyboardInterrupt


def _check(options: Options) -> None:
    for name in ("trials", "takes", "policy_steps", "residual_steps", "rounds"):
        if getattr(options, name) < 1:
            raise InputError(f"--{name.replace('_', '-')} is {getattr(options, name)}: it must be 1 or more.")
    if not options.seeds or min(options.seeds) < 0 or options.robot < 0:
        raise InputError("--seeds and --robot take numbers of 0 or more; give at least one seed.")
    if not options.tasks:
        raise InputError("--tasks is empty; name walk, turn, or both.")
    locomotion.check(LocomotionConfig(outside_cost=options.outside_cost))
    if options.output.exists() and not options.output.is_dir():
        raise InputError(f"{options.output}: is a file; give --output a folder.")
    files.check_folder(options.output)
