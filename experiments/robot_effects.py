# %% [markdown]
# # Effect of each of the virtual robot's properties on a policy
#
# The virtual robot differs from the training simulators in several effects at once: air (drag, lift, added mass), a
# balloon cluster off centre, actuators that differ between left and right, latency, friction of the feet, lift, and
# draughts. Here, policies of a finished `python -m ballu_mjx.train all` walk on robots without one of these effects,
# and on robots with only one of them. The gain without an effect measures the cost of this effect. All trials are in
# still air.
#
# `python experiments/robot_effects.py --output runs/all` takes a few minutes. Missing stages are made first. `--quick`
# is a short trial run.

# %%
from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import numpy as np
import transfer_tables

from ballu_mjx.ballu.actuators import CABLE_SLACK, ActuatorParameters
from ballu_mjx.ballu.model import load_model
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.ballu.virtual.hardware import VirtualHardware
from ballu_mjx.ballu.virtual.robot import TrialConditions, VirtualRobot
from ballu_mjx.ballu.virtual.trials import run_trials
from ballu_mjx.cli import pipeline
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.evaluation.transfer import Transfer
from ballu_mjx.policies import pipeline_layout
from ballu_mjx.policies.policy import Policy

# %% [markdown]
# ## Effects, as functions that remove them

# %%
NOMINAL = ActuatorParameters.nominal(load_model())


def pair(values: object) -> tuple[float, float]:
    """Return the left and the right value as floats."""
    left, right = np.asarray(values, float)
    return float(left), float(right)


def without_actuators(full: VirtualRobot) -> VirtualRobot:
    """Return the robot with nominal springs, stops, servos and cable slack, and without friction and backlash."""
    return dataclasses.replace(
        full,
        knee_spring_stiffness=pair(NOMINAL.knee_spring_stiffness),
        default_knee_angle=pair(NOMINAL.default_knee_angle),
        motor_gain=pair(NOMINAL.motor_gain),
        default_motor_angle=pair(NOMINAL.default_motor_angle),
        torque_limit=pair(NOMINAL.torque_limit),
        knee_friction=(0.0, 0.0),
        motor_friction=(0.0, 0.0),
        backlash=(0.0, 0.0),
        cable_slack=(CABLE_SLACK, CABLE_SLACK),
    )


def without_drag(full: VirtualRobot) -> VirtualRobot:
    """Return the robot without drag and lift. The ellipsoid for fluid forces shrinks to 1 mm; added mass stays."""
    return dataclasses.replace(full, balloon_semi_axes=(1e-3, 1e-3, 1e-3))


EFFECTS: dict[str, Callable[[VirtualRobot], VirtualRobot]] = {
    "added mass": lambda full: dataclasses.replace(full, added_mass=0.0, added_inertia=0.0),
    "drag and lift": without_drag,
    "balloon offset": lambda full: dataclasses.replace(full, balloon_offset=(0.0, 0.0, 0.0)),
    "actuators": without_actuators,
    "latency": lambda full: dataclasses.replace(full, latency=0.0),
    "friction of the feet": lambda full: dataclasses.replace(full, foot_friction=(0.9, 0.9)),
    "lift": lambda full: dataclasses.replace(full, buoyancy=0.84),
}
"""Functions by the name of an effect. Each takes a robot and returns it without this effect."""


def variants(full: VirtualRobot) -> dict[str, VirtualRobot]:
    """Return robots by name: with all effects, without each one, with each one alone, and without any."""
    none = full
    for remove in EFFECTS.values():
        none = remove(none)
    found = {"all effects": full}
    found |= {f"without {name}": remove(full) for name, remove in EFFECTS.items()}
    for name in EFFECTS:
        alone = full
        for other, remove in EFFECTS.items():
            alone = alone if other == name else remove(alone)
        found[f"{name} alone"] = alone
    return found | {"none": none}


# %% [markdown]
# ## Trials


# %%
def measure(policy: Policy, robots: dict[str, VirtualRobot], count: int, folder: Path) -> dict[str, list[Transfer]]:
    """Run `count` trials of a policy on each of the `robots`, and return them by robot.

    Recordings go to `folder`.
    """
    loop = policy.closed_loop()
    numbers = range(5_000_000, 5_000_000 + count)
    results = {}
    for name, variant in robots.items():
        place = folder / name.replace(" ", "-")
        place.mkdir(parents=True, exist_ok=True)
        results[name] = run_trials(policy, VirtualHardware(variant, conditions=still_air), numbers, place, loop)
    return results


def still_air(number: int) -> TrialConditions:
    """Return the conditions of a trial without draught."""
    return virtual_robot.still(virtual_robot.draw_trial(number))


def table(results: dict[str, dict[str, list[Transfer]]], distance: str) -> Table:
    """Return the table of CoM errors between robot and simulation, and of the robot's distance, by robot and setting.

    `distance` is its axis, x or y. Cells have one value for each trial.
    """
    columns = [
        f"{setting}: {called} (m)" for setting in results for called in ("mean CoM error", f"{distance}-distance")
    ]
    rows = []
    for name in next(iter(results.values())):
        cells = [
            Cell(tuple(getattr(transfer, quantity) for transfer in transfers[name]))
            for transfers in results.values()
            for quantity in ("com_error", f"{distance}_distance")
        ]
        rows.append((name, *cells))
    return Table(("robot", *columns), tuple(rows))


# %% [markdown]
# ## Run


# %%
def main() -> None:
    parser = argparse.ArgumentParser(
        description="Measure policies on virtual robots without each of their effects, and with each of them alone."
    )
    parser.add_argument("--robot-seed", type=int, default=0, help="seed of the virtual robot in `train all` (0)")
    parser.add_argument(
        "--robot-family", choices=["default", "paper"], default="default", help="family of the virtual robot (default)"
    )
    parser.add_argument("--seed", type=int, default=0, help="training seed of the policies (0)")
    parser.add_argument("--task", default="walk", choices=("walk", "turn"))
    parser.add_argument(
        "--settings",
        nargs="+",
        default=list(pipeline_layout.PAPER_SIMULATORS),
        choices=pipeline_layout.PAPER_SIMULATORS,
    )
    parser.add_argument("--trials", type=int, default=3, help="trials of each policy on each robot (3)")
    parser.add_argument("--quick", action="store_true", help="train for seconds, one trial; the numbers mean nothing")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    arguments = _setup.parse(parser, transfer_tables.OUTPUT)
    quick = arguments.quick
    output = arguments.output
    options = pipeline.Options(
        output=output, robot_seed=arguments.robot_seed, robot_family=arguments.robot_family, quick=quick
    )
    hardware = VirtualHardware.draw(options.robot_seed, options.robot_family)
    trials = 1 if quick else arguments.trials
    stages, robots = pipeline.PipelineStages(options, arguments.seed, hardware), variants(hardware.robot)
    folder = output / f"effects-{arguments.task}-seed-{arguments.seed}"
    results = {}
    for setting in arguments.settings:
        policy = Policy.load(stages.policy(arguments.task, setting))
        results[setting] = measure(policy, robots, trials, folder / setting)
    plain = {s: {n: [t.to_json() for t in found] for n, found in by.items()} for s, by in results.items()}
    (folder / "effects.json").write_text(json.dumps(plain, indent=2) + "\n")
    seeds = {"training": [arguments.seed], "robot": [arguments.robot_seed]}
    tables = {"effects": table(results, "x" if arguments.task == "walk" else "y")}
    _setup.write_tables(tables, folder, arguments.results, seeds)
    print(f"\nWritten to {folder}.")


if __name__ == "__main__":
    _setup.run(main)
