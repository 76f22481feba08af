# %% [markdown]
# # Deflation: balloons lose lift over weeks
#
# The paper names deflation as future work. The lift is one of the identified parameters of the air. After a loss, it is
# identified again from one recording of 20 s, and all other parameters are kept. The errors are measured on sixteen
# recordings, with the commands of the bundled test recordings and of the larger test set. They are recorded with the
# full lift and, in the same draughts, with 5 % less. The table compares the old lift with the new one. `--anew` adds an
# identification of all parameters from all training gaits of the deflated robot.
#
# `python experiments/deflation.py` takes about five minutes on two cores. Without `--air`, it first identifies the air,
# which takes longer. `--quick` is a short trial run.

# %%
from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import fidelity
import numpy as np

from ballu_mjx.ballu.model import load_model
from ballu_mjx.ballu.virtual import dataset
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.ballu.virtual.hardware import VirtualHardware
from ballu_mjx.ballu.virtual.robot import VirtualRobot
from ballu_mjx.cli import train_aerodynamics
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.evaluation.errors import Evaluation
from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct_for_simulator
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.residuals.aerodynamics_fit import AirConfig, identify_air
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.simulator import Simulator

HORIZON = 5.0
"""Horizon of the errors (s)."""

# %% [markdown]
# ## Recordings of the same commands with full and with less lift


# %%
def recorded(job: dataset.Job, virtual: VirtualRobot, trial: int, folder: Path) -> Recording:
    """Record the commands of a job on a virtual robot into `folder`, and return the recording.

    `trial` is the seed of the trial conditions, such as the draught.
    """
    path = dataset.record_job(dataclasses.replace(job, trial=trial), VirtualHardware(virtual), folder)
    return read_recording(path, load_robot())  # reading fills the gaps of hidden markers


def lift(buoyancy: float) -> float:
    """Return the lift (N) of balloons that carry a fraction `buoyancy` of BALLU's weight."""
    model = load_model()
    return buoyancy * float(model.body_mass.sum() * np.linalg.norm(model.opt.gravity))


# %% [markdown]
# ## Table


# %%
def errors_table(results: Mapping[str, Evaluation]) -> Table:
    """Return the table of errors over 5 s, by group. Cells have one value for each recording."""
    groups = sorted(next(iter(results.values())).groups, reverse=True)  # near before far
    forms = {"position": ".3f", "orientation": ".1f"}
    columns = [f"{group}: {called}" for group in groups for called in ("position (m)", "yaw (deg)")]
    rows = []
    for label, result in results.items():
        cells = [
            Cell(
                tuple(getattr(errors, quantity)[HORIZON][0] for errors in result.residual if errors.group == group),
                form,
                spread=False,
            )
            for group in groups
            for quantity, form in forms.items()
        ]
        rows.append((label, *cells))
    return Table((f"{HORIZON:g} s", *columns), tuple(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description="Identify a loss of lift from one recording.")
    parser.add_argument("--air", type=Path, help="folder of a `train aerodynamic` run; without it, one is made")
    parser.add_argument("--loss", type=float, default=0.05, help="fraction of the lift that is lost (0.05)")
    parser.add_argument(
        "--anew", action="store_true", help="also identify all parameters of the air again; ten more minutes"
    )
    parser.add_argument("--fresh", type=int, default=2026, help="seed of the larger test set")
    parser.add_argument("--quick", action="store_true", help="use one test gait; the numbers mean little")
    parser.add_argument("--results", type=Path, help="JSON file to write the tables to")
    options = _setup.parse(parser, Path("runs/deflation"))
    _setup.reserve(options.output, quick=options.quick)

    air = options.air
    if air is None:
        air = options.output / "aerodynamic"
        fidelity.train(air, "aerodynamic", *(["--quick"] if options.quick else []))
    known = TrainedResidual.load(air, load_robot())
    simulator = Simulator(load_robot(), known.actuators)
    full = virtual_robot.draw_robot(dataset.ROBOT_SEED)
    deflated = dataclasses.replace(full, buoyancy=full.buoyancy * (1 - options.loss))
    bundled = dataset.jobs()
    tests = [*(job for job in bundled if job.split == "test"), *dataset.fresh_jobs(options.fresh)]

    def motions(virtual: VirtualRobot, jobs: Sequence[dataset.Job], first: int, name: str) -> list[Motion]:
        folder = options.output / name
        recordings = [recorded(job, virtual, first + number, folder) for number, job in enumerate(jobs)]
        return [reconstruct_for_simulator(each, simulator) for each in recordings]

    tests = tests[:1] if options.quick else tests
    before, after = motions(full, tests, 1000, "before"), motions(deflated, tests, 1000, "after")
    training = [job for job in bundled if job.split == "training"]
    every = motions(deflated, training if options.anew else training[:1], 2000, "after")
    fit = identify_air(simulator, every[:1], AirConfig(), fixed_from=known.params, free=("lift",))

    sound = OpenLoopEvaluator(simulator, before, known.model)(known.params)
    evaluator = OpenLoopEvaluator(simulator, after, known.model)
    less = f"{options.loss:.0%} less"
    results = {
        "all of the lift": sound,
        f"{less}, lift as it was": evaluator(known.params),
        f"{less}, lift from one recording": evaluator(fit.parameters),
    }
    if options.anew:
        anew = identify_air(simulator, every, AirConfig(**train_aerodynamics.QUICK if options.quick else {}))
        results[f"{less}, all of the air, {len(every)} recordings"] = evaluator(anew.parameters)
    lost, found = lift(options.loss * full.buoyancy), float(known.params.lift - fit.parameters.lift)
    error = 1e3 * float(fit.standard_errors.lift)
    lift_row = (Cell((1e3 * lost,), ".0f"), Cell((1e3 * found,), ".0f", standard_error=error))
    tables = {
        "errors": errors_table(results),
        "lift": Table(("lift lost (mN)", "found (standard error)"), (lift_row,)),
    }
    seeds = {"robot": [dataset.ROBOT_SEED], "recording": [options.fresh]}
    _setup.write_tables(tables, options.output, options.results, seeds)


if __name__ == "__main__":
    _setup.run(main)
