# %% [markdown]
# # What the legs lack passes for air
#
# The air is identified beside legs that have neither dry friction nor backlash and slack; the robot's have both. Here
# the bundled robot's training gaits are recorded anew on robots without one or both of these, and the air identified
# from each: what it finds beside the truth that no robot's legs change.
#
# `python experiments/air_bias.py` takes about ten minutes on one core; `--quick` takes three gaits of two robots.

# %%
from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import deflation

from ballu_mjx.ballu.actuators_file import read_actuators
from ballu_mjx.ballu.model import buoyancy_ratio, load_model
from ballu_mjx.ballu.virtual import dataset
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.cli import train_aerodynamics
from ballu_mjx.identification.actuators import ACTUATORS_FILE
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.residuals.aerodynamics_fit import AirConfig, identify_air
from ballu_mjx.robots.model import assets
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.simulator import Simulator

NONE = (0.0, 0.0)
FRICTION = {"knee_friction": NONE, "motor_friction": NONE}
PLAY = {"backlash": NONE, "cable_slack": NONE}
ROBOTS = {
    "all of its legs": {},
    "no dry friction": FRICTION,
    "no backlash or slack": PLAY,
    "neither": FRICTION | PLAY,
}
"""What is another, of the virtual robot."""


def main() -> None:
    parser = argparse.ArgumentParser(description="What the legs lack, found as air.")
    parser.add_argument("--output", type=Path, default=Path("runs/air-bias"), help="folder of recordings and table")
    parser.add_argument("--quick", action="store_true", help="three gaits of two robots; the numbers mean little")
    options = parser.parse_args()

    model = load_model(read_actuators(assets() / "recordings" / ACTUATORS_FILE)[1])
    full = virtual_robot.draw_robot(0)
    lift = deflation.lift(full.buoyancy - buoyancy_ratio(model))
    lines = [
        "| robot | lift (mN) | added mass (kg) | added inertia (kg m^2) | delay (ms) | cost |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
        f"| truth | {lift * 1e3:.0f} | {full.added_mass:.3f} | {full.added_inertia:.4f} | {full.latency * 1e3:.0f} | |",
    ]
    config = AirConfig(**train_aerodynamics.QUICK) if options.quick else AirConfig()
    training = [job for job in dataset.jobs() if job.split == "training"][: 3 if options.quick else None]
    for name, changes in list(ROBOTS.items())[: 2 if options.quick else None]:
        legs = dataclasses.replace(full, **changes)
        folder = options.output / name.replace(" ", "-")
        gaits = [deflation.recorded(job, legs, 2000 + number, folder) for number, job in enumerate(training)]
        motions = [reconstruct(gait, load_robot(), model) for gait in gaits]
        fit = identify_air(Simulator(load_robot(), model=model), motions, config)
        air, error = fit.parameters, fit.standard_errors
        lines.append(
            f"| {name} | {float(air.lift) * 1e3:.0f} ({float(error.lift) * 1e3:.0f}) | "
            f"{float(air.added_mass):.3f} ({float(error.added_mass):.3f}) | "
            f"{float(air.added_inertia):.4f} ({float(error.added_inertia):.4f}) | "
            f"{float(air.delay) * 1e3:.0f} ({float(error.delay) * 1e3:.0f}) | {fit.cost[1]:.0f} |"
        )
        print(lines[-1], flush=True)
    _setup.write_table("\n".join(lines), options.output)
    print(f"\nIn brackets standard errors. Written to {options.output}.")


if __name__ == "__main__":
    _setup.run(main)
