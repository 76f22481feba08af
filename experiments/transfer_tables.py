# %% [markdown]
# # Tables I and II: transfer of policies from simulation to the robot
#
# This experiment belongs to the paper's section "Improved Sim-to-real Transfer". Policies are trained in four
# simulators: with identified actuators (vanilla+sysid), with domain randomization (vanilla+DR), with both
# (vanilla+sysid+DR), and with both and EnvMimic's forces (envmimic). Beyond the paper, a fifth simulator has both and
# the identified air (aerodynamic). Each policy then runs on the robot.
#
# `--task walk` makes Table I. The reward is the velocity along x, and a trial takes 24 s. The table has the mean
# distance between the centres of mass in simulation and on the robot, and the robot's distance along x and in total.
#
# `--task turn` makes Table II. The reward is the velocity along y, to the left of the robot, which starts with its
# heading along x. It must therefore turn and walk. A trial takes 22 s. The table has the difference in final yaw
# between simulation and robot, and the robot's distance along y and change of yaw.
#
# In the paper, the robot is real, each number is from one policy, and yaw errors are signed. Here, the robot is
# virtual. Every policy is trained with several seeds and has five trials, each in another draught. Numbers are means
# with 95 % confidence intervals over seeds (Student's t), beside the paper's numbers. Yaw errors are means of absolute
# values, because signed errors cancel.
#
# `python experiments/transfer_tables.py --task walk` makes the stages of `python -m ballu_mjx.train all` that it needs,
# unless they exist already. This takes hours on two cores. Stages that were made with other options than the defaults
# of `train all` are renamed and made again. For a folder with other options, use `--figure-only`, which draws the
# figure and runs nothing. `--quick` is a short trial run.

# %%
from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ballu_mjx.ballu.recordings import base_position
from ballu_mjx.ballu.virtual.hardware import RobotFamily
from ballu_mjx.cli import pipeline
from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import write_results
from ballu_mjx.evaluation.transfer import Transfer, read_transfer, transfer_table
from ballu_mjx.policies import pipeline_layout
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.viz.style import colour_of, label_of

OUTPUT = Path("runs/all")
"""Folder of the stages of `train all`."""
_SEED_STYLES = ("-", "--", ":", "-.")
_SMALLEST_EXTENT = 0.4
"""Smallest width and height (m) of a panel."""

FIGURES = {"walk": "table_walking.png", "turn": "table_turning.png"}
"""File of the figure, by task."""

Way = Float[np.ndarray, "samples 2"]
"""Horizontal path of the base (m), from its start."""

# %% [markdown]
# ## Figure: paths of all trials, seen from above
#
# The figure shows the trials of which the table has the means. A perfect walking policy goes straight to the right. A
# perfect turning policy ends as far up as possible. The lines are paths of the recorded base. The table is about the
# centre of mass, which is up in the balloons, some centimetres away.


# %%
def finished_trials(folder: Path, task: str, seeds: Sequence[int]) -> dict[str, list[Path]]:
    """Return the folders of finished trials, `[setting][seed]`, for settings that all seeds have.

    **Raises** `InputError` if there is no such setting in `folder`.
    """
    found = {}
    for setting in (
        *pipeline_layout.PAPER_SIMULATORS,
        *pipeline_layout.settings_beyond(folder / f"seed-{seeds[0]}", task),
    ):
        trials = [folder / f"seed-{seed}" / f"trials-{task}-{setting}" for seed in seeds]
        if all(_finished(trial) for trial in trials):
            found[setting] = trials
    if not found:
        numbers = " ".join(map(str, seeds))
        raise InputError(
            f"{folder}: no setting has finished trials of {task!r} for all seeds {numbers}; make them with "
            f"`python -m ballu_mjx.train all --output {folder} --tasks {task} --seeds {numbers}`."
        )
    return found


def read_ways(folder: Path, task: str, seeds: Sequence[int]) -> dict[str, list[list[Way]]]:
    """Read the horizontal paths of the base (m), `[setting][seed][trial]`, from their starts."""
    return {
        setting: [[_way(path) for path in sorted(trial.glob("trial-*.csv.gz"))] for trial in trials]
        for setting, trials in finished_trials(folder, task, seeds).items()
    }


def read_trials(folder: Path, task: str, seeds: Sequence[int]) -> dict[str, list[list[Transfer]]]:
    """Read the figures of the trials, `[setting][seed][trial]`."""
    return {
        setting: [read_transfer(trial / "transfer.json") for trial in trials]
        for setting, trials in finished_trials(folder, task, seeds).items()
    }


def _finished(trials: Path) -> bool:
    """Return whether `trials` is the folder of a finished stage."""
    mark = trials.with_name(trials.name + ".stage.json")
    return mark.is_file() and bool(json.loads(mark.read_text())["done"])


def _way(path: Path) -> Way:
    base = base_position(read_recording(path, load_robot()))
    if base is None:  # only in suspended recordings
        raise InputError(f"{path}: has no base position, so that it is no recording of a trial; remove it.")
    return base[:, :2] - base[0, :2]


def draw(ways: dict[str, list[list[Way]]], seeds: Sequence[int], path: Path) -> None:
    """Draw one panel for each setting, all to one scale.

    Each trial is a line with a dot at its end. Seeds have different dash patterns.
    """
    low, high = _limits(np.concatenate([way for runs in ways.values() for trials in runs for way in trials]))
    width, height = high - low
    columns = len(ways)
    if len(ways) > 2 and width > 1.3 * height:
        columns = 2 if len(ways) <= 4 else 3
    rows = -(-len(ways) // columns)
    panel = 12.0 / max(columns, 3)
    size = (panel * columns + 0.4, ((panel - 0.2) * height / width + 0.65) * rows + (0.75 if len(seeds) > 1 else 0.4))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    styles = [_SEED_STYLES[index % len(_SEED_STYLES)] for index in range(len(seeds))]
    for axis in axes.flat[len(ways) :]:
        axis.set_axis_off()
    for axis, (setting, runs) in zip(axes.flat, ways.items(), strict=False):
        axis.axhline(0.0, color="grey", linewidth=0.8)
        axis.axvline(0.0, color="grey", linewidth=0.8)
        for style, trials in zip(styles, runs, strict=True):
            for way in trials:
                axis.plot(*way.T, style, color=colour_of(setting), linewidth=1.2, alpha=0.85)
                axis.plot(*way[-1], "o", color=colour_of(setting), markersize=4)
        axis.plot(0.0, 0.0, "o", color="black", markersize=5)
        axis.set(title=label_of(setting), xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axis.set_aspect("equal")
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(ways) - columns : len(ways)]:  # the lowest panel of each column
        axis.set_xlabel("x (m)")
        axis.tick_params(labelbottom=True)
    for axis in axes[:, 0]:
        axis.set_ylabel("y (m)")
    if len(seeds) > 1:
        for seed, style in zip(seeds, styles, strict=True):
            axes[0, 0].plot([], [], style, color="black", label=f"seed {seed}")
        figure.legend(loc="outside lower center", ncols=len(seeds))
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=120)


def _limits(points: Way) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """Return two corners (m) of the shown area: all points with a margin.

    Its sides are `_SMALLEST_EXTENT` or more, and the shorter one is at least 0.4 of the longer one.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(1.1 * (high - low), _SMALLEST_EXTENT)
    size = np.maximum(size, 0.4 * size.max())
    middle = (low + high) / 2
    return middle - size / 2, middle + size / 2


# %% [markdown]
# ## Run
#
# The package does the training, the trials and the table: `ballu_mjx.cli.pipeline` has the stages, and
# `ballu_mjx.evaluation.transfer` computes the figures of a trial.


# %%
def main() -> None:
    parser = argparse.ArgumentParser(
        description="Make Tables I and II of the paper: transfer of policies to the robot, by training simulator."
    )
    parser.add_argument("--task", choices=list(FIGURES), required=True, help="walk: Table I; turn (left): Table II")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="training seeds (0 1 2)")
    parser.add_argument("--robot-seed", type=int, default=0, help="seed of the virtual robot (0)")
    parser.add_argument(
        "--robot-family", choices=get_args(RobotFamily), default="default", help="family of the virtual robot (default)"
    )
    parser.add_argument("--rounds", type=int, default=1, help="rounds of EnvMimic; see `train all --help` (1)")
    parser.add_argument(
        "--also",
        nargs="+",
        choices=pipeline_layout.OPTIONAL_SIMULATORS,
        default=[],
        help="further simulators; see `train all --help` (none)",
    )
    parser.add_argument("--quick", action="store_true", help="train for seconds; the numbers mean nothing")
    parser.add_argument("--figure-only", action="store_true", help="draw finished trials; run nothing")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    given = _setup.parse(parser, OUTPUT)
    if given.figure_only and given.results is not None:
        parser.error("--figure-only runs nothing, so that there are no results; leave out --results.")
    output = given.output
    written = []
    if not given.figure_only:
        pipeline.run(
            pipeline.Options(
                output=output,
                robot_seed=given.robot_seed,
                robot_family=given.robot_family,
                seeds=tuple(given.seeds),
                tasks=(given.task,),
                quick=given.quick,
                rounds=given.rounds,
                also=tuple(given.also),
            )
        )
        written.append(pipeline_layout.table_file(output, given.task))
        if given.results is not None:
            table = transfer_table(given.task, read_trials(output, given.task, given.seeds))
            seeds = {"training": given.seeds, "robot": [given.robot_seed]}
            write_results(given.results, {given.task: table}, "Development data", seeds=seeds)
            written.append(given.results)
    written.append(output / FIGURES[given.task])
    draw(read_ways(output, given.task, given.seeds), given.seeds, written[-1])
    print(f"Written: {', '.join(map(str, written))}.")


if __name__ == "__main__":
    _setup.run(main)
