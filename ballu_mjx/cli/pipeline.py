"""All experiments of the paper in one command: `python -m ballu_mjx.train all`.

The command uses a virtual robot. `measure_transfer` takes any `Hardware`.

The stages are, in the paper's order:

1. Record an actuator sweep, and identify the actuators.
2. Train vanilla policies.
3. Replay their actions on the robot, several times each.
4. Learn one EnvMimic for each task. Beyond the paper, identify the air from the same recordings.
5. Train policies in all simulators, and predict how well each transfers.
6. Run the policies on the robot, and write tables.

With `--rounds`, EnvMimic learns again from the robot's motion under its own policies, and policies are trained again in
the resulting simulator. `--also` adds simulators. Every stage has a folder, and beside it a file with the stage's key:
a hash of its options and of the keys of the stages that it needs. An interrupted run therefore resumes at the
unfinished stage, and a changed option repeats only the stages that depend on it.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from ballu_mjx.ballu.leg_parameters import IdentificationConfig
from ballu_mjx.ballu.model import CONTROL_TIMESTEP
from ballu_mjx.ballu.virtual.hardware import Hardware, RobotFamily, VirtualHardware
from ballu_mjx.ballu.virtual.robot import CaptureController, open_loop
from ballu_mjx.ballu.virtual.trials import ExportedPolicy, run_trials
from ballu_mjx.cli import train_aerodynamics, train_envmimic, train_forces, train_policy, train_sysid
from ballu_mjx.cli._command import TrainCommand, written_to
from ballu_mjx.cli._help import refuse_without
from ballu_mjx.cli.cached_stages import SET_ASIDE, cached_stage, check_is_stage
from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.evaluation import transfer
from ballu_mjx.evaluation.transfer import Transfer
from ballu_mjx.identification.actuators import ACTUATORS_FILE
from ballu_mjx.policies.deploy.export import weights
from ballu_mjx.policies.load_simulator import load_simulator
from ballu_mjx.policies.locomotion_config import LocomotionConfig, check_locomotion_config
from ballu_mjx.policies.pipeline_layout import (
    NEAR,
    PAPER_PRESET,
    PAPER_SIMULATORS,
    SHARED,
    TABLES,
    WRENCH,
    prediction_file,
    residual_folder,
    table_file,
)
from ballu_mjx.policies.policy import Policy
from ballu_mjx.policies.simulator_variants import ROUNDS, SimulatorVariant
from ballu_mjx.policies.tasks import TASKS
from ballu_mjx.policies.training import locomotion_ppo
from ballu_mjx.policies.transfer_prediction import predict_com_errors, read_prediction, replay_errors, write_prediction
from ballu_mjx.recordings.csv_format import write_recording
from ballu_mjx.residuals.aerodynamics_fit import AirConfig
from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.residuals.force_gradients import AnalyticConfig
from ballu_mjx.residuals.force_regression import SupervisedConfig
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.presets import preset_configs
from ballu_mjx.rl.ppo import PPOConfig
from ballu_mjx.rl.resume_point import is_finished
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs import loggers
from ballu_mjx.runs.checkpoints import list_checkpoints
from ballu_mjx.runs.layout import CHECKPOINTS_KEPT
from ballu_mjx.sim.force_sets import ForceSet

_DECIMALS = 4
_REFERENCES = (ROUNDS, "aerodynamic")
"""Simulators with a residual that may be the reference of a prediction. They are learned from the same recordings."""


@dataclasses.dataclass(frozen=True)
class Options(loggers.LoggingOptions):
    """Experiments to run, and lengths of training."""

    output: Path = Path("runs/all")
    """Folder of all stages. A stage that is already there and was made with the same options is kept."""
    robot_seed: int = 0
    """Seed of the virtual robot that replaces the hardware."""
    robot_family: RobotFamily = "default"
    """Family of the virtual robot. On robots of the family paper, policies of unimproved simulators do about as badly
    as the paper's did on its hardware. Robots of the family flexible have other masses, a soft neck, balloons that
    wobble and cables of another law."""
    seeds: tuple[int, ...] = (0,)
    """Training seeds. Every policy and residual is trained once for each."""
    tasks: tuple[Literal["walk", "turn"], ...] = ("walk", "turn")
    """Tasks of the paper to run."""
    trials: int = 5
    """Number of trials of each policy on the robot. The draught differs between trials."""
    takes: int = 2
    """Number of recordings of each action sequence. The draught differs between recordings."""
    policy_steps: int = 3_000_000
    """Number of control steps for which each policy is trained."""
    residual_steps: int = 3_000_000
    """Number of control steps for which each EnvMimic is trained."""
    rounds: int = 1
    """Number of times that EnvMimic is learned. From the second round on, it also learns from the robot's closed-loop
    motion under the policies of the previous round. Policies are then trained again; their simulators are called
    `envmimic-2` and so on."""
    also: tuple[
        Literal["envmimic-near", "envmimic-shared", "envmimic-wrench", "envmimic-paper", "supervised", "analytic"], ...
    ] = ()
    """Further simulators in which to train policies. envmimic-near: EnvMimic's forces, with a cost (--outside-cost) for
    leaving their training range. envmimic-shared: one EnvMimic learned from the recordings of both tasks.
    envmimic-wrench: an EnvMimic with a force and a torque. envmimic-paper: an EnvMimic with --preset paper. supervised:
    forces by regression, at full scale (the paper's baseline). analytic: forces by gradients through the simulation."""
    outside_cost: float = 0.5
    """Cost of leaving the residual's training range in `envmimic-near`. See `train walk --help`."""
    push_force: float = 0.0
    """Standard deviation of the random constant forces (N) under which policies are trained in simulators with a
    residual. See `train walk --help`."""
    push_torque: float = 0.0
    """Standard deviation of the random constant torques (N m), like --push-force."""
    quick: bool = False
    """Run every stage for one task and two simulators, in two minutes with a full cache of compiled programs and
    five with an empty one (two cores). The tables then mean nothing."""


def run(options: Options) -> int:
    """Run the missing stages, print the tables, and return the exit status."""
    with written_to() as written:
        written.folder = options.output
        for task, result in measure_transfer(options).items():
            text = f"{TABLES[task](result)}\n\n{_predictions_text(options, task)}"
            table_file(options.output, task).write_text(text + "\n", encoding="utf-8")
            print(f"\n### {task}\n\n{text}\n")
        if options.quick:
            print("These numbers mean nothing: --quick trains for seconds.")
    return 0


def _predictions_text(options: Options, task: str) -> str:
    """Return a table of the predicted errors of each seed's policies (Markdown), and which policy to try first."""
    found = [read_prediction(prediction_file(options.output, seed, task)) for seed in options.seeds]
    settings = found[0].com_error
    rows = tuple((setting, Cell(tuple(each.com_error[setting] for each in found))) for setting in settings)
    table = Table(("setting", "predicted mean CoM error (m), before the trials"), rows)
    best = ", ".join(f"{each.best} (seed {seed})" for seed, each in zip(options.seeds, found, strict=True))
    return f"{table.to_markdown()}\n\nSmallest predicted error: {best}. Try this policy first on the robot."


def measure_transfer(options: Options, hardware: Hardware | None = None) -> dict[str, dict[str, list[list[Transfer]]]]:
    """Run the missing stages and return the trials, `[task][setting][seed][trial]`.

    `hardware` is the robot. None for the virtual robot of `options`.

    **Raises** `InputError` if options are out of range.
    """
    _check(options)
    hardware = VirtualHardware.draw(options.robot_seed, options.robot_family) if hardware is None else hardware
    settings = settings_of(options)
    if options.quick:
        options = dataclasses.replace(options, trials=min(options.trials, 2), takes=1, tasks=options.tasks[:1])
    results: dict[str, dict[str, list[list[Transfer]]]] = {
        task: {setting: [] for setting in settings} for task in options.tasks
    }
    for seed in options.seeds:
        stages = PipelineStages(options, seed, hardware)
        for task in options.tasks:
            stages.prediction(task)
            for setting in settings:
                results[task][setting].append(stages.transfers(task, setting))
    return results


def settings_of(options: Options) -> tuple[str, ...]:
    """Return the names of the simulators in which policies are trained, in the order of the tables."""
    first = ("vanilla+dr", ROUNDS) if options.quick else PAPER_SIMULATORS
    return (*first, *(_again(number) for number in range(2, options.rounds + 1)), *options.also)


def _again(number: int) -> str:
    """Return the name of the simulator with EnvMimic of a round."""
    return SimulatorVariant(ROUNDS, round=number).name


class _Job(NamedTuple):
    """Recording to be made on the robot."""

    use: str
    """Name of its folder: training or validation."""
    name: str
    controller: CaptureController
    seconds: float


class PipelineStages:
    """Stages of one seed. Each method makes its stage, and the stages that it needs, unless they exist already."""

    def __init__(self, options: Options, seed: int, hardware: Hardware) -> None:
        self.options, self.seed = options, seed
        self._robot = hardware
        self._shared, self._own = options.output, options.output / f"seed-{seed}"

    def sweep(self) -> Path:
        """Return the folder of an actuator sweep of the robot."""

        def make(folder: Path) -> None:
            sweep = self._robot.record_sweep("sweep")
            write_recording(sweep, folder / "sweep.csv.gz", load_robot(), decimals=_DECIMALS)

        return cached_stage(self._shared / "sweep", {"robot": self._robot.name}, [], make)

    def identified(self) -> Path:
        """Return the run folder of the identification."""
        sweep = self.sweep()
        config = IdentificationConfig(**train_sysid.QUICK if self.options.quick else {})

        def make(folder: Path) -> None:
            recordings = (sweep / "sweep.csv.gz",)
            data = train_sysid.SysidData(recordings=recordings, output=folder, wandb=self.options.wandb)
            train_sysid.train(data, config)

        return cached_stage(self._shared / "sysid", config, [sweep], make)

    def policy(self, task: str, setting: str) -> Path:
        """Return the run folder of a policy that is trained for `task` in the simulator `setting`."""
        variant = SimulatorVariant.parse(setting)
        learned = variant.residual is not None
        config = LocomotionConfig(
            domain_randomization=learned or variant.randomized,
            outside_cost=self.options.outside_cost if setting == NEAR else 0.0,
        )
        if learned:
            config = dataclasses.replace(
                config, push_force=self.options.push_force, push_torque=self.options.push_torque
            )
        quick = train_policy.QUICK if self.options.quick else {"num_timesteps": self.options.policy_steps}
        ppo = locomotion_ppo(seed=self.seed, **quick)
        needs = []
        # At most six checkpoints, one for each training step if there are fewer. The last three are replayed on the
        # robot.
        data = train_policy.Data(keep_every=max(ppo.num_timesteps // 6, 1), wandb=self.options.wandb)
        if learned:
            needs = [self.residual(task, setting)]
            data = dataclasses.replace(data, residual=needs[0])
        elif variant.identified:
            needs = [self.identified()]
            data = dataclasses.replace(data, actuators=needs[0] / ACTUATORS_FILE)
        return train_stage(self._own / f"{task}-{setting}", needs, task, data, config, ppo)

    def recordings(self, task: str) -> Path:
        """Return the folder of recordings of the robot under the actions of vanilla policies, replayed open loop.

        The policies are the last checkpoints of two trainings, without and with domain randomization. As in the paper,
        each action sequence is replayed several times.
        """
        settings = ("vanilla+dr",) if self.options.quick else ("vanilla", "vanilla+dr")
        sources = [self.policy(task, setting) for setting in settings]

        def jobs(seconds: float) -> Iterator[_Job]:
            sequences = [commands for source in sources for commands in self._actions(source, seconds + 5.0)]
            for index, commands in enumerate(sequences):
                # The last sequence of the randomized training is for validation; it is a little longer than the others.
                use = "validation" if index == len(sequences) - 1 else "training"
                played = commands if use == "validation" else commands[: round(seconds / CONTROL_TIMESTEP)]
                for take in range(self.options.takes):
                    name, length = f"actions-{index}-take-{take + 1}", len(played) * CONTROL_TIMESTEP
                    yield _Job(use, name, open_loop(played), length)

        notes = f"Actions of a vanilla policy for {task}."
        return self._recorded(f"recordings-{task}", sources, task, "recordings", jobs, notes)

    def trained_last(self, task: str, number: int) -> Path:
        """Return the folder of closed-loop recordings of the robot under the policies of the round before `number`.

        The policies are the last checkpoints, each recorded several times for training. The very last one is recorded
        once more for validation, a little longer.
        """
        source = self.policy(task, _again(number - 1))

        def jobs(seconds: float) -> Iterator[_Job]:
            policies = {step: weights(Policy.load(source, step)) for step in _last_steps(source)}
            takes = [("training", step, take, seconds) for step in policies for take in range(self.options.takes)]
            takes.append(("validation", max(policies), self.options.takes, seconds + 5.0))
            for use, step, take, length in takes:
                name = f"round-{number}-policy-{step}-take-{take + 1}"
                yield _Job(use, name, ExportedPolicy(policies[step]), length)

        notes = f"A policy for {task}, closed loop."
        return self._recorded(f"recordings-{task}-{number}", [source], task, f"round {number}", jobs, notes)

    def _recorded(
        self,
        stage: str,
        sources: Sequence[Path],
        task: str,
        draws: str,
        jobs: Callable[[float], Iterable[_Job]],
        notes: str,
    ) -> Path:
        """Make the recordings that `jobs` returns for a length of training recordings (s), and return their folder.

        `draws` enters the seed of the trial conditions, so that these differ between stages.
        """
        seconds = 6.0 if self.options.quick else 20.0

        def make(folder: Path) -> None:
            listed = list(jobs(seconds))
            for number, job in enumerate(listed):
                trial = _draw(self.seed, task, draws, number)
                recording = self._robot.record(trial, job.controller, job.seconds, job.name, notes)
                where = folder / job.use
                where.mkdir(exist_ok=True)
                write_recording(recording, where / f"{job.name}.csv.gz", load_robot(), decimals=_DECIMALS)
                print(f"Recorded {job.name} ({job.use}), {number + 1} of {len(listed)}", flush=True)

        made = {"robot": self._robot.name, "seed": self.seed, "takes": self.options.takes, "seconds": seconds}
        return cached_stage(self._own / stage, made, sources, make)

    def residual(self, task: str, setting: str) -> Path:
        """Return the run folder of the residual of a simulator.

        It is learned from the recordings of the task in all rounds up to its own. `envmimic-shared` is learned from the
        recordings of both tasks.
        """
        variant = SimulatorVariant.parse(setting)
        method, number = variant.residual or "", variant.round
        if method == SHARED:
            recordings = [self.recordings(each) for each in TABLES]
        else:
            recordings = [self.recordings(task), *(self.trained_last(task, n) for n in range(2, number + 1))]
        identified = self.identified()
        fits = {"aerodynamic": self._air, "supervised": self._supervised, "analytic": self._analytic}
        options: Any = fits[method]() if method in fits else self._envmimic(method)

        def make(folder: Path) -> None:
            sources: dict[str, Any] = {
                "recordings": tuple(each / "training" for each in recordings),
                "validation": tuple(each / "validation" for each in recordings),
                "actuators": identified / ACTUATORS_FILE,
                "output": folder,
                "wandb": self.options.wandb,
            }
            if isinstance(options, AirConfig):
                train_aerodynamics.train(train_aerodynamics.AirData(**sources), options)
            elif isinstance(options, SupervisedConfig):
                train_forces.train_supervised(train_forces.ForcesData(**sources), ForceNetworkConfig(), options)
            elif isinstance(options, AnalyticConfig):
                train_forces.train_analytic(train_forces.ForcesData(**sources), ForceNetworkConfig(), options)
            else:
                data = train_envmimic.Data(**sources, preset="paper" if method == PAPER_PRESET else None)
                if started := list_checkpoints(folder):
                    if is_finished(folder, started[-1], options[1]):  # resumed by `train envmimic --resume`
                        return
                    data = train_envmimic.Data(resume=folder, wandb=data.wandb)
                train_envmimic.train(data, *options)

        needs = [*recordings, identified]
        return cached_stage(residual_folder(self._own, task, setting), options, needs, make, goes_on=method not in fits)

    def _supervised(self) -> SupervisedConfig:
        # Full forces, as in the paper's baseline. Other scales would reduce them where they do not help.
        return SupervisedConfig(
            force_shares=(1.0,), seed=self.seed, **train_forces.QUICK["supervised"] if self.options.quick else {}
        )

    def _analytic(self) -> AnalyticConfig:
        return AnalyticConfig(seed=self.seed, **train_forces.QUICK["analytic"] if self.options.quick else {})

    def _air(self) -> AirConfig:
        return AirConfig(**train_aerodynamics.QUICK if self.options.quick else {})

    def _envmimic(self, method: str) -> tuple[EnvMimicConfig, PPOConfig]:
        quick = train_envmimic.QUICK if self.options.quick else {"num_timesteps": self.options.residual_steps}
        if method == PAPER_PRESET:  # its sizes match each other, so that only the length changes
            return preset_configs("paper", seed=self.seed, num_timesteps=quick["num_timesteps"])
        # A force alone, as in the paper: policies exploited a wrench (docs/transfer.md).
        forces: ForceSet = "wrench" if method == WRENCH else "force"
        return EnvMimicConfig(forces=forces), PPOConfig(seed=self.seed, **quick)

    def prediction(self, task: str) -> Path:
        """Return the folder with the predicted errors of the policies for a task, before their trials.

        The simulators of the prediction are vanilla+sysid, and those of EnvMimic (the first round) and of the
        identified air, as far as policies are trained in them.
        """
        settings = settings_of(self.options)
        residuals = {each: self.residual(task, each) for each in _REFERENCES if each in settings}
        runs = {"vanilla+sysid": self.identified(), **residuals}
        policies = {setting: self.policy(task, setting) for setting in settings}

        def make(folder: Path) -> None:
            simulators = {name: load_simulator(run) for name, run in runs.items()}
            loaded = {setting: Policy.load(run) for setting, run in policies.items()}
            write_prediction(place, predict_com_errors(loaded, simulators, replay_errors(residuals)))

        needs = [*runs.values(), *policies.values()]
        place = prediction_file(self.options.output, self.seed, task)
        return cached_stage(place.parent, {"simulators": list(runs)}, needs, make)

    def transfers(self, task: str, setting: str) -> list[Transfer]:
        """Return the trials of a policy on the robot, each compared with the same policy in its own simulator."""
        source = self.policy(task, setting)
        count = self.options.trials
        numbers = [_draw(self.seed, task, "trials", number) for number in range(count)]
        options = {"robot": self._robot.name, "seed": self.seed, "trials": count}
        return trials_stage(self._own / f"trials-{task}-{setting}", source, self._robot, numbers, options)

    def _actions(self, run: Path, seconds: float) -> list[np.ndarray]:
        """Return the commands of each kept checkpoint of a policy, over `seconds` in its own simulator, from standing.

        Commands are rounded to 3 decimals.
        """
        policies = [Policy.load(run, step) for step in _last_steps(run)]
        loop = policies[0].closed_loop()
        start, count = loop.initial(), round(seconds / CONTROL_TIMESTEP)
        return [np.round(loop(p.params, *start, count).command[0], 3).astype(float) for p in policies]


def train_stage(
    folder: Path, needs: Sequence[Path], task: str, data: train_policy.Data, config: LocomotionConfig, ppo: PPOConfig
) -> Path:
    """Return the run folder of a policy, and train it unless the stage is finished. An interrupted training resumes.

    `needs` are the stages on which it depends, and `data` its simulator.
    """

    def make(folder: Path) -> None:
        started = list_checkpoints(folder)
        if started and is_finished(folder, started[-1], ppo):  # resumed by `train TASK --resume`
            return
        where = train_policy.Data(resume=folder, keep_every=data.keep_every, wandb=data.wandb)
        where = where if started else dataclasses.replace(data, output=folder)
        train_policy.train(TASKS[task], where, config, ppo)

    return cached_stage(folder, (config, ppo), needs, make)


def trials_stage(
    folder: Path, source: Path, hardware: Hardware, numbers: Sequence[int], options: Mapping[str, Any]
) -> list[Transfer]:
    """Return the trials of the policy in the stage `source` on a robot, and run them unless the stage is finished.

    `numbers` are those of the trials for `Hardware.record`, and `options` what determines them, for the stage's key.
    """

    def make(folder: Path) -> None:
        found = run_trials(Policy.load(source), hardware, numbers, folder, tell=functools.partial(print, flush=True))
        transfer.write_transfer(folder / "transfer.json", found)

    made = cached_stage(folder, dict(options), [source], make)
    return transfer.read_transfer(made / "transfer.json")


def _last_steps(run: Path) -> list[int]:
    """Return the steps of a run's last checkpoints, without the untrained one at step 0."""
    return [step for step in list_checkpoints(run)[-CHECKPOINTS_KEPT:] if step > 0]


def _draw(seed: int, task: str, use: str, number: int) -> int:
    """Return the seed of a trial's conditions. It is the same for all simulators, so that their draughts are equal."""
    digest = hashlib.sha256(f"{seed} {task} {use} {number}".encode()).digest()
    return int.from_bytes(digest[:4], "big")


def _repeated(given: Sequence[object]) -> object:
    """Return the first entry that occurs more than once."""
    return next(each for place, each in enumerate(given) if each in given[:place])


def _check(options: Options) -> None:
    for name in ("trials", "takes", "policy_steps", "residual_steps", "rounds"):
        if getattr(options, name) < 1:
            raise InputError(f"--{name.replace('_', '-')} is {getattr(options, name)}: it must be 1 or more.")
    if not options.seeds or min(options.seeds) < 0 or options.robot_seed < 0:
        raise InputError("--seeds and --robot-seed take numbers of 0 or more; give at least one seed.")
    if not options.tasks:
        raise InputError("--tasks is empty; name walk, turn, or both.")
    for name in ("seeds", "tasks", "also"):
        given = getattr(options, name)
        if len(set(given)) < len(given):
            raise InputError(f"--{name} names {_repeated(given)} twice; a repetition is no other sample.")
    config = LocomotionConfig(
        outside_cost=options.outside_cost, push_force=options.push_force, push_torque=options.push_torque
    )
    check_locomotion_config(config, CONTROL_TIMESTEP)
    if NEAR not in options.also:
        refuse_without(options, ("outside_cost",), f"--also {NEAR}")
    if options.output.exists() and not options.output.is_dir():
        raise InputError(f"{options.output}: is a file; give --output a folder.")
    files.check_folder(options.output)
    own = [each for seed in options.seeds for each in (options.output / f"seed-{seed}").glob("*")]
    for stage in (options.output / "sweep", options.output / "sysid", *own):
        if stage.is_dir() and not SET_ASIDE.search(stage.name):
            check_is_stage(stage)


COMMAND = TrainCommand(
    "Run all experiments of the paper on a virtual robot: recordings, actuators, residuals, policies in five "
    "simulators, and trials.",
    {"pipeline": Options()},
    lambda pipeline: run(pipeline),
)
