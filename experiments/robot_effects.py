# %% [markdown]
# # Which of the robot's effects cost a policy its way?
#
# The virtual robot differs from the training simulators in several ways at once: air (drag, lift, added mass), a
# balloon cluster off centre, actuators that differ left to right, latency, draughts. Here policies of a finished
# `python -m ballu_mjx.train all` walk on robots that lack one of these effects at a time, and on robots that have that
# one alone. What a setting gains where an effect is missing is what this effect costs it.
#
# `python experiments/robot_effects.py --output runs/all` takes a few minutes; stages that are missing are made first.
# `--quick` shows that it works.

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
from ballu_mjx.ballu.virtual.robot import VirtualRobot
from ballu_mjx.ballu.virtual.trials import run_trials
from ballu_mjx.cli import pipeline
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.evaluation.transfer import Transfer
from ballu_mjx.policies import pipeline_layout
from ballu_mjx.policies.policy import Policy

# %% [markdown]
# ## The effects, each as what takes it away

# %%
NOMINAL = ActuatorParameters.nominal(load_model())


def pair(values: object) -> tuple[float, float]:
    """Left and right."""
    left, right = np.asarray(values, float)
    return float(left), float(right)


def without_actuators(full: VirtualRobot) -> VirtualRobot:
    """Nominal springs, stops and servos, without friction, backlash or slack."""
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
    """No fluid forces but added mass: the ellipsoid that the air sees shrinks to nothing."""
    return dataclasses.replace(full, balloon_semi_axes=(1e-3, 1e-3, 1e-3))


EFFECTS: dict[str, Callable[[VirtualRobot], VirtualRobot]] = {
    "added mass": lambda full: dataclasses.replace(full, added_mass=0.0, added_inertia=0.0),
    "drag and lift": without_drag,
    "balloon offset": lambda full: dataclasses.replace(full, balloon_offset=(0.0, 0.0, 0.0)),
    "actuators": without_actuators,
    "latency": lambda full: dataclasses.replace(full, latency=0.0),
    "floor": lambda full: dataclasses.replace(full, foot_friction=(0.9, 0.9), buoyancy=0.84),
}
"""By what they are called: a robot, to the same robot without the effect. The floor's friction and the exact lift,
which differ little, go together."""


def variants(full: VirtualRobot) -> dict[str, VirtualRobot]:
    """The whole robot, each effect taken away, each effect alone, and none."""
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
    """Trials of a policy on every variant."""
    loop = policy.closed_loop()
    draws = [virtual_robot.still(virtual_robot.draw_trial(5_000_000 + number)) for number in range(count)]
    results = {}
    for name, variant in robots.items():
        place = folder / name.replace(" ", "-")
        place.mkdir(parents=True, exist_ok=True)
        results[name] = run_trials(policy, variant, draws, place, loop)
    return results


def table(results: dict[str, dict[str, list[Transfer]]], distance: str) -> Table:
    """Return errors between robot and simulation and how far the robot came along `distance`, by setting; cells have
    one value a trial."""
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
# ## All of it


# %%
def main() -> None:
    parser = argparse.ArgumentParser(description="Which of the virtual robot's effects cost a policy its way.")
    parser.add_argument(
        "--output",
        type=Path,
        help=f"folder of `train all` ({transfer_tables.OUTPUT}, or {transfer_tables.QUICK_OUTPUT} under --quick)",
    )
    parser.add_argument("--robot-seed", type=int, default=0, help="the robot that `train all` ran on")
    parser.add_argument("--seed", type=int, default=0, help="whose policies")
    parser.add_argument("--task", default="walk", choices=("walk", "turn"))
    parser.add_argument(
        "--settings", nargs="+", default=list(pipeline_layout.SETTINGS), choices=pipeline_layout.SETTINGS
    )
    parser.add_argument("--trials", type=int, default=3, help="trials of each policy on each robot")
    parser.add_argument("--quick", action="store_true", help="train for seconds, try once; the numbers mean nothing")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    arguments = parser.parse_args()
    quick = arguments.quick
    output = arguments.output or (transfer_tables.QUICK_OUTPUT if quick else transfer_tables.OUTPUT)
    options = pipeline.Options(output=output, robot_seed=arguments.robot_seed, quick=quick)
    story, trials = pipeline.Story(options, arguments.seed), 1 if quick else arguments.trials
    robots = variants(virtual_robot.draw_robot(arguments.robot_seed))
    folder = output / f"effects-{arguments.task}-seed-{arguments.seed}"
    results = {}
    for setting in arguments.settings:
        policy = Policy.load(story.policy(arguments.task, setting))
        results[setting] = measure(policy, robots, trials, folder / setting)
    plain = {s: {n: [t.to_json() for t in found] for n, found in by.items()} for s, by in results.items()}
    (folder / "effects.json").write_text(json.dumps(plain, indent=2) + "\n")
    seeds = {"training": [arguments.seed], "robot": [arguments.robot_seed]}
    tables = {"effects": table(results, "x" if arguments.task == "walk" else "y")}
    _setup.write_tables(tables, folder, arguments.results, seeds)
    print(f"\nWritten to {folder}.")


if __name__ == "__main__":
    _setup.run(main)
