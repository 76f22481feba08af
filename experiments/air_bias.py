# %% [markdown]
# # Bias of the identified air due to missing leg effects
#
# The air is identified with a model whose legs have neither dry friction nor backlash. The robot's legs have both. The
# cables' slack is identified. Here, the training gaits of the bundled robot are recorded again on robots without one
# or both of these effects. The air is identified from each set of recordings, and compared with the true values, which
# are the same for all robots. For the robot with all effects, a second table has all sixteen parameters.
#
# `python experiments/air_bias.py` takes about ten minutes on one core. `--quick` uses three gaits of two robots.

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
import numpy as np

from ballu_mjx.ballu.actuators_file import read_actuators
from ballu_mjx.ballu.model import buoyancy_ratio
from ballu_mjx.ballu.virtual import dataset
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.ballu.virtual.robot import VirtualRobot
from ballu_mjx.cli import train_aerodynamics
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.identification.actuators import ACTUATORS_FILE
from ballu_mjx.recordings.reconstruct import reconstruct_for_simulator
from ballu_mjx.residuals.aerodynamics_fit import AirConfig, AirFit, identify_air
from ballu_mjx.robots.model import assets
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.simulator import Simulator

NONE = (0.0, 0.0)
FRICTION = {"knee_friction": NONE, "motor_friction": NONE}
BACKLASH = {"backlash": NONE}
WHOLE = "all of its legs"
ROBOTS = {
    WHOLE: {},
    "no dry friction": FRICTION,
    "no backlash": BACKLASH,
    "neither": FRICTION | BACKLASH,
}
"""Changes to the fields of the virtual robot, by the label of the changed robot."""


@dataclasses.dataclass(frozen=True)
class Quantity:
    """Display of a parameter of the air."""

    label: str
    form: str
    """Format of its numbers."""
    scale: float = 1.0
    """Factor from SI units to those of the label."""
    axes: str = ""
    """Names of the components of a vector. Empty for a scalar."""


QUANTITIES = {
    "added_mass": Quantity("added mass (kg)", ".3f"),
    "added_inertia": Quantity("added inertia (kg m^2)", ".4f"),
    "lift": Quantity("lift beyond the model's (mN)", ".1f", 1e3),
    "centre": Quantity("centre of mass and lift (mm)", ".1f", 1e3, "xyz"),
    "delay": Quantity("delay of commands (ms)", ".0f", 1e3),
    "linear_drag": Quantity("linear drag (N s/m)", ".3f", axes="xyz"),
    "quadratic_drag": Quantity("quadratic drag (N s^2/m^2)", ".2f", axes="xyz"),
    "turning_drag": Quantity("drag on turning (N m s)", ".4f", axes="xyz"),
}
BIASED = ("lift", "added_mass", "added_inertia", "delay")
"""Parameters that the legs' missing effects might bias."""


# %% [markdown]
# ## Tables


# %%
def truth(robot: VirtualRobot, model_buoyancy: float) -> dict[str, tuple[float, ...]]:
    """Return the true parameters of the robot's air, in SI units. Drag is missing, because it has another form."""
    return {
        "added_mass": (robot.added_mass,),
        "added_inertia": (robot.added_inertia,),
        "lift": (deflation.lift(robot.buoyancy - model_buoyancy),),
        "centre": robot.balloon_offset,
        "delay": (robot.latency,),
    }


def identified_table(fit: AirFit, true: dict[str, tuple[float, ...]]) -> Table:
    """Return the table of all parameters with their standard errors, and of the true values."""
    rows = []
    for name, quantity in QUANTITIES.items():
        found, errors = (np.ravel(getattr(of, name)) * quantity.scale for of in (fit.parameters, fit.standard_errors))
        for place, (value, error) in enumerate(zip(found.tolist(), errors.tolist(), strict=True)):
            label = quantity.label + (f", {quantity.axes[place]}" if quantity.axes else "")
            own = Cell((quantity.scale * true[name][place],), quantity.form) if name in true else ""
            rows.append((label, Cell((value,), quantity.form, standard_error=error), own))
    return Table(("", "identified (standard error)", "the virtual robot's"), tuple(rows))


def legs_table(fits: dict[str, AirFit], true: dict[str, tuple[float, ...]]) -> Table:
    """Return the table of possibly biased parameters and of the cost, by robot."""
    shown = [(name, QUANTITIES[name]) for name in BIASED]
    own = [Cell((quantity.scale * true[name][0],), quantity.form) for name, quantity in shown]
    rows: list[tuple[Cell | str, ...]] = [("truth", *own, "")]
    for robot, fit in fits.items():
        cells = []
        for name, quantity in shown:
            found, error = (quantity.scale * float(getattr(of, name)) for of in (fit.parameters, fit.standard_errors))
            cells.append(Cell((found,), quantity.form, standard_error=error))
        rows.append((robot, *cells, Cell((fit.cost[1],), ".0f")))
    return Table(("robot", *(quantity.label for _, quantity in shown), "cost"), tuple(rows))


# %% [markdown]
# ## Run


# %%
def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the bias of the identified air due to missing leg effects.")
    parser.add_argument("--quick", action="store_true", help="use three gaits of two robots; the numbers mean little")
    parser.add_argument("--results", type=Path, help="JSON file to write the tables to")
    options = _setup.parse(parser, Path("runs/air-bias"))

    simulator = Simulator(load_robot(), read_actuators(assets() / "recordings" / ACTUATORS_FILE)[1])
    full = virtual_robot.draw_robot(dataset.ROBOT_SEED)
    fits: dict[str, AirFit] = {}
    config = AirConfig(**train_aerodynamics.QUICK) if options.quick else AirConfig()
    training = [job for job in dataset.jobs() if job.split == "training"][: 3 if options.quick else None]
    for name, changes in list(ROBOTS.items())[: 2 if options.quick else None]:
        legs = dataclasses.replace(full, **changes)
        folder = options.output / name.replace(" ", "-")
        gaits = [deflation.recorded(job, legs, 2000 + number, folder) for number, job in enumerate(training)]
        motions = [reconstruct_for_simulator(gait, simulator) for gait in gaits]
        fits[name] = identify_air(simulator, motions, config)
        print(f"{name}: cost {fits[name].cost[1]:.0f}", flush=True)
    true = truth(full, buoyancy_ratio(simulator.mj_model))
    tables = {"identified": identified_table(fits[WHOLE], true), "legs": legs_table(fits, true)}
    _setup.write_tables(tables, options.output, options.results, {"robot": [dataset.ROBOT_SEED]})
    print(f"\nStandard errors are in parentheses. Written to {options.output}.")


if __name__ == "__main__":
    _setup.run(main)
