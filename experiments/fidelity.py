# %% [markdown]
# # Fidelity of simulators: tables and tracking figure
#
# This experiment belongs to the paper's section "Improved Simulation Fidelity". Recorded commands are replayed open
# loop from recorded states, on recordings that training does not use. The simulators are:
#
# - vanilla, and vanilla with identified actuators (vanilla+sysid);
# - both with EnvMimic's forces; the second also with other loads: a force alone on the balloon, or forces at balloon,
#   base and feet;
# - regression on the forces that explain the recordings (supervised): with full forces, as in the paper, and with the
#   scale of the forces that helps most;
# - forces by gradients through the simulation (analytic);
# - the air's parameters (aerodynamic): all of them, all but the lift, or all but the friction of contacts;
# - networks in addition to the air (aerodynamic+analytic, aerodynamic+EnvMimic);
# - for comparison, the command delay without air (unless the identified actuators have a delay), and the air without
#   delay, centre and friction.
#
# Each method is trained once for each seed. Finished runs are not repeated. Test recordings have gaits, other commands,
# and, as in the paper, the actions of a walking policy that was trained in vanilla.
#
# `python experiments/fidelity.py` takes hours on two cores. `--methods` selects a part. `--robot N` and
# `--robot-family` use another virtual robot; it is recorded, and its actuators are identified, first. `--quick` is a
# short trial run.

# %%
from __future__ import annotations

import argparse
import dataclasses
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import get_args

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import collect_runs
import numpy as np

from ballu_mjx.ballu.model import CONTROL_TIMESTEP
from ballu_mjx.ballu.virtual import dataset
from ballu_mjx.ballu.virtual.hardware import Hardware, RobotFamily, VirtualHardware
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.evaluation.errors import SCORE_HORIZONS, Errors, Evaluation
from ballu_mjx.evaluation.errors_file import read_evaluation
from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator, Replay
from ballu_mjx.identification.actuators import read_actuators
from ballu_mjx.policies.policy import Policy
from ballu_mjx.recordings.csv_format import list_recordings, read_recording
from ballu_mjx.recordings.reconstruct import reconstruct_for_simulator
from ballu_mjx.recordings.recording_groups import OTHER
from ballu_mjx.residuals.aerodynamics import FREE_BY_DEFAULT
from ballu_mjx.residuals.aerodynamics_training import has_delay
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.robots.model import assets
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs.checkpoints import list_checkpoints
from ballu_mjx.runs.metrics import read_column
from ballu_mjx.sim.simulator import Simulator
from ballu_mjx.viz import plots

# %% [markdown]
# ## Training


# %%
@dataclasses.dataclass(frozen=True)
class Method:
    """Method to improve a simulator."""

    label: str
    arguments: tuple[str, ...]
    """Arguments of `python -m ballu_mjx.train`."""
    seeded: bool = True
    """Whether the result depends on a seed."""
    nominal: bool = False
    """Whether to use nominal actuators instead of identified ones."""
    beside: str | None = None
    """Method whose residual acts beside the one to be learned. None if there is no other residual."""


AIR = "aerodynamic"
DELAY = AIR, "--free", "delay"
"""Arguments of a training that identifies the delay alone."""


def _air_without(*names: str) -> tuple[str, ...]:
    """Return the arguments of a training that identifies all parameters of the air but the named ones."""
    return AIR, "--free", *(name for name in FREE_BY_DEFAULT if name not in names)


METHODS = {
    "nominal": Method("EnvMimic on nominal actuators", ("envmimic",), nominal=True),
    "identified": Method("EnvMimic", ("envmimic",)),
    "paper": Method("EnvMimic, the paper's preset", ("envmimic", "--preset", "paper")),
    "force": Method("EnvMimic, a force alone", ("envmimic", "--forces", "force")),
    "multi": Method("EnvMimic, forces at balloon, base and feet", ("envmimic", "--forces", "multi")),
    "regression": Method("supervised, all of its forces", ("supervised", "--force-shares", "1")),
    "supervised": Method("supervised", ("supervised",)),
    "analytic": Method("analytic", ("analytic",)),
    "analytic-wrench": Method("analytic, wrench", ("analytic", "--forces", "wrench")),
    AIR: Method("aerodynamic", (AIR,), seeded=False),
    "air-lift": Method("aerodynamic, the model's lift", _air_without("lift"), seeded=False),
    "air-friction": Method("aerodynamic and friction", (AIR, "--contact-friction"), seeded=False),
    "air-analytic": Method("aerodynamic+analytic", ("analytic",), beside=AIR),
    "air-envmimic": Method("aerodynamic+EnvMimic", ("envmimic",), beside=AIR),
    "delay": Method("vanilla+sysid+delay", DELAY, seeded=False),
    "delay-envmimic": Method("vanilla+sysid+delay+EnvMimic", ("envmimic",), beside="delay"),
    "air-alone": Method("aerodynamic, no delay or centre", _air_without("delay", "centre"), seeded=False),
}
"""Methods by key. The last three isolate the command delay and the balloons' centre, which only the aerodynamic
residual has. The delay is identified from the same recordings, for simulators without air. `air-alone` is the air
without these two."""


def train(folder: Path, *arguments: str, result: str = "evaluation.json") -> None:
    """Run `python -m ballu_mjx.train` into `folder`, unless its result is already there.

    An interrupted EnvMimic training is resumed from its last checkpoint. Other interrupted runs, which take minutes,
    start again.
    """
    if (folder / result).exists():
        return
    options = [*arguments, "--output", str(folder)]
    if arguments[0] == "envmimic" and list_checkpoints(folder):
        options = ["envmimic", "--resume", str(folder)]
    elif (folder / "config.json").exists():
        shutil.rmtree(folder)
    subprocess.run([sys.executable, "-m", "ballu_mjx.train", *options], check=True)


def load(folder: Path) -> Evaluation:
    """Return the evaluation of one run."""
    return read_evaluation(folder / "evaluation.json")


def simulated(folder: Path) -> float:
    """Return the number of control steps that a run simulated for learning, without validations.

    A derivative along one direction counts as one more step.
    """
    counted = read_column(folder, "control_steps")[1]
    return float(counted[-1] if len(counted) else read_column(folder, "reward")[0][-1])


@dataclasses.dataclass(frozen=True)
class Recorded:
    """Recordings of a virtual robot by use, and the file of its identified actuators."""

    training: list[Path]
    validation: list[Path]
    test: list[Path]
    actuators: Path


BUNDLED = VirtualHardware.draw(dataset.ROBOT_SEED)
"""Robot of the bundled recordings."""


def record(robot: Hardware, folder: Path) -> Recorded:
    """Return recordings and identified actuators of a robot.

    For robot `BUNDLED`, they are the bundled ones. For another robot, make them in `folder` unless they are there.
    """
    place = assets() / "recordings"
    if robot != BUNDLED:
        place = folder / "recordings"
        if not (place / "suspended" / "sweep.csv.gz").exists():
            dataset.record_dataset(robot, place)
        if not (place / "actuators.json").exists():
            train(folder / "sysid", "sysid", "--recordings", str(place / "suspended"), result="actuators.json")
            shutil.copy(folder / "sysid" / "actuators.json", place)
    training, validation, test = (list_recordings([place / use]) for use in ("training", "validation", "test"))
    return Recorded(training, validation, test, place / "actuators.json")


def replayed_policy(options: Options) -> Path:
    """Return the recording of the robot under the actions of a walking policy that was trained in vanilla.

    The actions are replayed open loop, as in the paper. Policy and recording are made unless they are already there.
    """
    source, seconds = options.output / "walk-vanilla", dataset.SECONDS["test"]
    train(source, "walk", *(["--quick"] if options.quick else []), result="replay.npz")
    path = options.output / "policy" / "policy.csv.gz"
    if not path.exists():
        policy = Policy.load(source)
        loop = policy.closed_loop()
        actions = loop(policy.params, *loop.initial(), round(seconds / CONTROL_TIMESTEP)).command[0]
        job = dataset.Job(
            path.parent.name, "policy", np.round(actions, 3).astype(float), 300, "Actions of a vanilla policy."
        )
        dataset.record_job(job, options.hardware, options.output)
    return path


def simulator(kind: TrainedResidual, paths: list[Path], *, nominal: bool = False) -> OpenLoopEvaluator:
    """Return an evaluator on recordings for a kind of residual, with its own actuators or with `nominal` ones."""
    plain = Simulator(load_robot(), None if nominal else kind.actuators)
    motions = [reconstruct_for_simulator(read_recording(path, load_robot()), plain) for path in paths]
    return OpenLoopEvaluator(plain, motions, kind.model)


def evaluate(folders: list[Path], paths: list[Path]) -> list[Evaluation]:
    """Evaluate runs on other recordings than their own. The runs must have the same configuration and actuators."""
    robot = load_robot()
    policies = [TrainedResidual.load(folder, robot) for folder in folders]
    evaluator = simulator(policies[0], paths)
    return [evaluator(policy.params) for policy in policies]


def vanilla_errors(folder: Path, paths: list[Path]) -> tuple[Errors, ...]:
    """Return the errors of the nominal robot without residual. `folder` is the run of any residual, which is off."""
    kind = TrainedResidual.load(folder, load_robot())
    evaluator = simulator(kind, paths, nominal=True)
    return evaluator.errors(evaluator.replay(kind.params, scale=0.0))


# %% [markdown]
# ## Tables


# %%
Rows = Mapping[str, list[tuple[Errors, ...]]]
"""Errors on a set of recordings, by the label of a simulator and by seed. Vanilla comes first."""


def rows_of(vanilla: tuple[Errors, ...], results: Mapping[str, list[Evaluation]]) -> Rows:
    """Return the rows of the tables, given vanilla's errors and the evaluations of all seeds by key in `METHODS`."""
    rows = {"vanilla": [vanilla], "vanilla+sysid": [results["identified"][0].vanilla]}
    return rows | {METHODS[name].label: [run.residual for run in found] for name, found in results.items()}


def groups_of(rows: Rows) -> list[str]:
    """Return the groups of the recordings in reverse alphabetical order, so that near comes before far."""
    return sorted({errors.group for errors in rows["vanilla"][0]}, reverse=True)


def comparison(rows: Rows, effort: Mapping[str, Cell], horizon: float) -> Table:
    """Return the table of ratios of the simulators' RMSE to vanilla's over `horizon` (s).

    The row of vanilla has its errors themselves. The last column is `effort`, the simulated control steps in thousands.
    """
    columns = [(group, quantity) for group in groups_of(rows) for quantity in ("position", "orientation")]
    called = {"position": "position", "orientation": "yaw"}
    head = [called[q] if group == OTHER else f"{group}: {called[q]}" for group, q in columns]
    others = {label: runs for label, runs in rows.items() if label != "vanilla"}
    cells = collect_runs.remaining_errors(rows["vanilla"][0], others, columns, horizon)
    made = tuple((label, *left, effort.get(label, "")) for label, left in cells.items())
    return Table((f"{horizon:g} s", *head, "thousand control steps"), made)


def final_yaw(rows: Rows) -> Table:
    """Return the table of absolute final yaw errors (deg) after whole recordings, averaged over each group."""
    groups = groups_of(rows)
    made = []
    for row, found in rows.items():
        cells = []
        for group in groups:
            errors = [[abs(e.final_orientation_error) for e in run if e.group == group] for run in found]
            cells.append(Cell(tuple(float(np.mean(each)) for each in errors), ".0f"))
        made.append((row, *cells))
    return Table(("final yaw error (deg)", *groups), tuple(made))


# %% [markdown]
# ## Figure of whole recordings, with mean and range over seeds


# %%
DRAWN = ("regression", "identified", "analytic", AIR)
"""Methods in the figure if they were run, in addition to vanilla with and without identified actuators."""


def figure(folders: Mapping[str, list[Path]], paths: list[Path], path: Path) -> None:
    """Replay recordings in every simulator, with the residuals of all seeds, and draw the tracking."""
    robot = load_robot()
    found = {
        name: [TrainedResidual.load(folder, robot) for folder in folders[name]] for name in DRAWN if name in folders
    }
    evaluators = {name: simulator(kinds[0], paths) for name, kinds in found.items()}
    curves = {
        kinds[0].model.name: [evaluators[name].replay(kind.params) for kind in kinds] for name, kinds in found.items()
    }
    identified, first = evaluators["identified"], found["identified"][0]
    still = identified.replay(first.params, scale=0.0)
    vanilla = simulator(first, paths, nominal=True).replay(first.params, scale=0.0)
    every = {"vanilla": [vanilla], "vanilla+sysid": [still], **curves}
    panels = []
    for motion, run in zip(identified.motions, identified.first_runs, strict=True):
        position, yaw = identified.recorded(run)
        states = len(yaw)

        def curve(replay: Replay, run: int = run, states: int = states) -> np.ndarray:
            return np.column_stack([replay.position[run, :states, :2], replay.yaw[run, :states]])

        panels.append(
            plots.TrackingPanel(
                title=motion.name,
                time=np.arange(states) * CONTROL_TIMESTEP,
                recording=np.column_stack([position[:, :2], yaw]),
                simulations={name: np.stack([curve(replay) for replay in replays]) for name, replays in every.items()},
            )
        )
    plots.tracking(path, panels)


# %% [markdown]
# ## Run


# %%
@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the command line."""

    methods: list[str]
    seeds: list[int]
    robot: int
    robot_family: RobotFamily
    fresh: int
    output: Path
    quick: bool
    results: Path | None

    @property
    def hardware(self) -> VirtualHardware:
        """Robot that is measured."""
        return VirtualHardware.draw(self.robot, self.robot_family)


def parse() -> Options:
    parser = argparse.ArgumentParser(description="Measure the fidelity of simulators, with tables and a figure.")
    always = ("identified", AIR)  # the long tables need these
    parser.add_argument(
        "--methods",
        nargs="*",
        choices=[name for name in METHODS if name not in always],
        default=[name for name in METHODS if name not in always],
        help=f"methods in addition to {', '.join(always)} (all)",
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="training seeds (0 1 2)")
    parser.add_argument("--robot", type=int, default=dataset.ROBOT_SEED, help="seed of the virtual robot")
    parser.add_argument("--robot-family", choices=get_args(RobotFamily), default="default", help="family of this robot")
    parser.add_argument("--fresh", type=int, default=2026, help="seed of the larger test set")
    parser.add_argument("--quick", action="store_true", help="train for seconds; the numbers mean nothing")
    parser.add_argument("--results", type=Path, help="JSON file to write the tables to")
    arguments = _setup.parse(parser, Path("runs/fidelity"))
    needed = {*always, *arguments.methods, *(METHODS[name].beside for name in arguments.methods)}
    arguments.methods = [name for name in METHODS if name in needed]
    return Options(**vars(arguments))


def arguments_of(method: Method, recorded: Recorded, training: list[Path], quick: bool) -> list[str]:
    """Return the arguments of `python -m ballu_mjx.train` for a method and training recordings."""
    arguments = [*method.arguments, *(["--quick"] if quick else [])]
    for use, paths in (("recordings", training), ("validation", recorded.validation), ("test", recorded.test)):
        arguments += [f"--{use}", *map(str, paths)]
    return [*arguments, "--actuators", "nominal" if method.nominal else str(recorded.actuators)]


def without_known_delay(methods: Sequence[str], actuators: Path) -> list[str]:
    """Return the methods that have a parameter to identify in a simulator with the actuators of this file.

    If the actuators have a delay, it is known. The methods that identify the delay alone, and those whose residual acts
    beside theirs, are then left out.
    """
    robot = load_robot()
    if not has_delay(Simulator(robot, read_actuators(robot, actuators)[1])):
        return list(methods)
    alone = {name for name in methods if METHODS[name].arguments == DELAY}
    return [name for name in methods if name not in alone and METHODS[name].beside not in alone]


def learn(
    methods: Sequence[str], seeds: Sequence[int], output: Path, recorded: Recorded, *, quick: bool
) -> dict[str, list[Path]]:
    """Run methods with all seeds into folders in `output`, and return the run folders by method.

    Methods whose residuals others need run first.
    """
    folders = {}
    for name in sorted(methods, key=lambda name: METHODS[name].beside is not None):
        method = METHODS[name]
        # By default, a quick run tests on its validation recordings, but the tables need the test recordings.
        training = recorded.training[:2] if quick else recorded.training
        arguments = arguments_of(method, recorded, training, quick)
        arguments += [] if method.beside is None else ["--residual", str(output / method.beside)]
        runs = [(output / f"{name}-seed-{seed}", ["--seed", str(seed)]) for seed in seeds]
        for folder, seed in runs if method.seeded else [(output / name, [])]:
            train(folder, *arguments, *seed)
            folders.setdefault(name, []).append(folder)
    return {name: folders[name] for name in methods}


def main() -> None:
    options = parse()
    _setup.reserve(
        options.output,
        robot=options.robot,
        robot_family=options.robot_family,
        fresh=options.fresh,
        quick=options.quick,
    )
    recorded = record(options.hardware, options.output)
    methods = without_known_delay(options.methods, recorded.actuators)
    if left_out := [METHODS[name].label for name in options.methods if name not in methods]:
        print(f"Left out, because the actuators in {recorded.actuators} have a delay: {', '.join(left_out)}.")
    folders = learn(methods, options.seeds, options.output, recorded, quick=options.quick)
    effort = {
        METHODS[name].label: Cell(tuple(simulated(folder) / 1e3 for folder in members), ",.0f", spread=False)
        for name, members in folders.items()
    }
    each = 1 if options.quick else 6
    fresh = dataset.record_fresh(options.fresh, options.hardware, options.output, each)
    policy = replayed_policy(options)
    sets = {"bundled": recorded.test, "fresh": fresh, "policy": [policy]}
    tables: dict[str, Table] = {}
    for title, paths in sets.items():
        known = paths is recorded.test and not options.quick  # quick runs evaluate fewer recordings
        found = {
            name: [load(folder) for folder in members] if known else evaluate(members, paths)
            for name, members in folders.items()
        }
        rows = rows_of(vanilla_errors(folders["identified"][0], paths), found)
        tables |= {f"{title}-{horizon:g}": comparison(rows, effort, horizon) for horizon in SCORE_HORIZONS}
        tables[f"{title}-yaw"] = final_yaw(rows)
        for name in ("identified", AIR):
            tables[f"{title}-{name}"] = collect_runs.errors_table(found[name])
    figure(folders, [*recorded.test, policy], options.output / "tracking.png")
    seeds = {"training": options.seeds, "robot": [options.robot], "recording": [options.fresh]}
    _setup.write_tables(tables, options.output, options.results, seeds)
    print(f"\nWritten to {options.output}.")


if __name__ == "__main__":
    _setup.run(main)
