"""Shared code of the commands that learn a residual: reading and checking data, the run, and the final evaluation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax

from ballu_mjx.cli._command import load_chosen_robot, open_run, written_to
from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.open_loop import Evaluators
from ballu_mjx.identification.actuator_choice import choose_actuators
from ballu_mjx.identification.stable_time_step import check_stability
from ballu_mjx.recordings.inverse_kinematics import describe_fit
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.residuals.dataset import USES, RecordingsData, ResidualDataset
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.run_config import ResidualReference, describe_run
from ballu_mjx.residuals.scales import describe_scales
from ballu_mjx.residuals.trained_residual import TrainedResidual, describe_residual
from ballu_mjx.rl.resume_point import ResumePoint
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.runs import loggers
from ballu_mjx.runs.folder import new_folder
from ballu_mjx.runs.record import TrainingRecord
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator
from ballu_mjx.viz import artifacts

Config = TypeVar("Config", bound=ForceNetworkConfig)
Resolve = Callable[[Config, AugmentedSimulator, Sequence[Motion]], Config]
"""Function that returns options of a network with numbers for those that training motions determine."""


class EarlierRun(NamedTuple):
    """Run from whose residual a command takes values. It needs the same robot and actuators."""

    folder: Path
    residual: TrainedResidual

    @staticmethod
    def load(folder: Path, robot: RobotDescription) -> EarlierRun:
        """Load the best residual of a run.

        **Raises** `InputError` from `TrainedResidual.load`.
        """
        return EarlierRun(folder, TrainedResidual.load(folder, robot))


def load_earlier(folder: Path | None, robot: RobotDescription, kind: type, task: str) -> EarlierRun | None:
    """Return the run of --fixed-from, whose residual must be of a kind. None if `folder` is None.

    **Raises** `InputError` if it is of another kind than that of the command `task`.
    """
    if folder is None:
        return None
    found = EarlierRun.load(folder, robot)
    if not isinstance(found.residual.model, kind):
        raise InputError(f"{folder}: is no run of `train {task}`; give --fixed-from one of its runs.")
    return found


@dataclasses.dataclass(frozen=True)
class Prepared:
    """Recordings and simulator, ready to learn a residual from.

    **Fields**

    - `motions`: reconstructed recordings by use (training, validation, test).
    - `simulator`: simulator without any residual.
    - `base`: residual that acts beside the one to be learned. None if there is none.
    - `where`: run folder of `base`. None if there is none.
    - `evaluators`: open-loop evaluators of `simulator`.
    """

    task: str
    folder: Path
    dataset: ResidualDataset
    motions: Mapping[str, list[Motion]]
    simulator: Simulator
    base: TrainedResidual | None
    where: Path | None
    evaluators: Evaluators

    @property
    def improved(self) -> AugmentedSimulator:
        """Simulator with the base residual, if there is one."""
        return self.simulator.with_residual(None if self.base is None else self.base.bound)

    def describe(self, sections: Mapping[str, Any]) -> dict[str, Any]:
        """Return the content of `config.json`."""
        devices = [str(device) for device in jax.devices()]
        identified, robot = self.dataset.identified, self.dataset.robot
        content = describe_run(self.task, sections, self.dataset.files, devices, identified, robot)
        return content | describe_residual(self.base, self.where)

    def show_evaluation(self, residual: TrainedResidual, *, quick: bool) -> None:
        """Evaluate the simulator with the residual on the test recordings; write and print the errors."""
        print(f"{self.dataset.replayed}:\n")
        test = self.evaluators.of(residual.model, self.motions["test"])
        print(artifacts.write_evaluation(test, residual.params, self.folder).table())
        if quick:
            print("\nThese numbers mean little: --quick trains for seconds.")


def train_residual(
    task: str,
    data: RecordingsData,
    sections: Callable[[Prepared], Mapping[str, Any]],
    learn: Callable[[Prepared, TrainingRecord], TrainedResidual],
    show: Callable[[Path, TrainedResidual], None],
    *,
    base: ResidualReference | None = None,
    earlier: EarlierRun | None = None,
    start: ResumePoint | None = None,
    first: bool = True,
) -> int:
    """Read and check all inputs, learn a residual in a run's folder, show the result, and return the exit status.

    **Arguments**

    - `sections`: function that returns the options for `config.json`, with values that depend on the recordings set.
    - `learn`: function that learns the residual.
    - `show`: function that takes the run's folder and the residual. It is called before the evaluation is printed.
    - `base`, `earlier`, `first`: see `prepare`.
    - `start`: point from which training resumes. None to start a new training.
    """
    start = start or ResumePoint()
    loggers.check(data.wandb)
    with written_to(first=first) as written:
        prepared = prepare(task, data, base, start.folder, earlier=earlier, first=first)
        folder = written.folder = prepared.folder
        content = prepared.describe(sections(prepared))
        with open_run(folder, content, start.resumed_at, data.wandb, first=first) as run:
            residual = learn(prepared, run)
        if first:
            show(folder, residual)
            prepared.show_evaluation(residual, quick=data.quick)
    return 0


def settle(env: Config, prepared: Prepared, resolve: Resolve[Config], *, first: bool = True) -> Config:
    """Return the network's options with numbers where they depend on the robot or the recordings, and print scales.

    `resolve` is `scales.resolve_scales` or `envmimic.resolve_envmimic`.

    **Raises** `InputError` from `resolve`.
    """
    settled = resolve(env, prepared.improved, prepared.motions["training"])
    if first:
        print(describe_scales(settled, prepared.dataset.robot), flush=True)
    return settled


def show_report(folder: Path, residual: TrainedResidual) -> None:
    """Write the report of the identification to the run's folder, and print it."""
    files.write(folder / "identification.txt", residual.report + "\n")
    print(f"\n{residual.report}\n")


def prepare(
    task: str,
    data: RecordingsData,
    base: ResidualReference | None = None,
    resume: Path | None = None,
    *,
    earlier: EarlierRun | None = None,
    first: bool = True,
) -> Prepared:
    """Read and check all inputs of residual learning, and print the use of each.

    **Arguments**

    - `base`: residual that acts beside the one to be learned. None if there is none.
    - `resume`: run folder to resume. None for a new run.
    - `earlier`: run from whose residual values are taken. None if there is none.
    - `first`: whether this process writes and prints.

    **Raises** `InputError` for recordings, actuators or a base residual that cannot be used. The message names them.
    """
    where = None if base is None else base.folder
    robot = load_chosen_robot(data.robot, resume, task, where or (None if earlier is None else earlier.folder))
    residual = None if base is None else TrainedResidual.load_reference(base, robot)
    before = {} if residual is None or where is None else {where: residual}
    if earlier is not None:
        before[earlier.folder] = earlier.residual
    dataset = ResidualDataset.read(data, robot, resume)
    for run, learned in before.items():
        if dataset.undecided:
            dataset = dataset.with_actuators(learned.actuators, f"those of {run}")
        dataset.check_learned_with(learned.actuators, run)
    folder = resume or new_folder(data.output if first else None, task)
    if first:
        _announce(dataset, folder, data.quick)
    simulator = Simulator(robot, dataset.identified)
    motions = dataset.reconstruct(simulator)
    notice = describe_fit([motion for use in USES for motion in motions[use]])
    if first and notice is not None:
        print(notice, flush=True)
    if dataset.identified is not None and resume is None:
        choice = choose_actuators(robot, dataset.identified, motions["validation"])
        if first:
            print(f"Open-loop replay of the validation recordings by actuators:\n\n{choice.table()}\n", flush=True)
        if dataset.undecided and not choice.improves:
            if first:
                print("Nominal actuators are taken; --actuators FILE selects the identified ones.", flush=True)
            dataset, simulator = dataset.with_actuators(None, "nominal"), Simulator(robot)
            motions = dataset.reconstruct(simulator)
    if resume is None:
        check_stability(robot, motions["training"], dataset.identified)
    return Prepared(task, folder, dataset, motions, simulator, residual, where, Evaluators(simulator))


def _announce(dataset: ResidualDataset, folder: Path, quick: bool) -> None:
    print(f"Run folder: {folder}")
    for use in USES:
        print(f"  {use}: {', '.join(recording.name for recording in dataset.recordings[use])}")
    print(f"  actuators: {dataset.where}")
    for sentence in dataset.reused:
        print(f"  {sentence}")
    if quick:
        print("  --quick: sizes so small that the numbers mean little.")
    print("Reconstructing the recorded states ...", flush=True)
