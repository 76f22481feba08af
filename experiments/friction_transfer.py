# %% [markdown]
# # Policies on robots whose friction was identified
#
# Does identified friction help a policy on the robot? `foot_friction.py` identifies the air of several virtual robots
# with the model's friction, and together with the friction. This experiment trains policies for walking in both
# simulators, with several seeds each, and runs them on the robot in five trials of 24 s.
#
# `python experiments/friction_transfer.py` keeps the fits in the folder of `foot_friction.py`, and finds them there if
# that ran before. A policy takes five minutes on one core. `--quick` is a short trial run.

# %%
from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path += ["experiments", "benchmarks"]  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import fidelity
import foot_friction
import numpy as np
from final_tier import Figure

from ballu_mjx.ballu.virtual.hardware import Hardware
from ballu_mjx.cli import pipeline, train_policy
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.evaluation.transfer import Transfer
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.training import locomotion_ppo
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.robots.registry import load_robot

WHOLE = pipeline.Options()
"""Number of control steps of each training, and of trials of each policy: those of `train all`."""
FIRST_TRIAL = 5000
"""Number of the first trial. Recordings have other numbers, and so other draughts."""
FIGURES = (
    Figure("mean CoM error (m)", lambda t: t.com_error),
    Figure("x-distance (m)", lambda t: t.x_distance),
    Figure("x-distance in its simulator (m)", lambda t: t.sim_x_distance),
    Figure("final yaw error (deg)", lambda t: abs(t.yaw_error), ".0f"),
)
"""Columns of the table. Values are means over trials."""

# %% [markdown]
# ## Measurement


# %%
def trials_of(hardware: Hardware, method: str, residual: Path, seed: int, folder: Path, quick: bool) -> list[Transfer]:
    """Train a policy in the simulator with a residual, and return its trials on the robot. Finished stages are kept."""
    config = LocomotionConfig(domain_randomization=True)
    ppo = locomotion_ppo(seed=seed, **train_policy.QUICK if quick else {"num_timesteps": WHOLE.policy_steps})
    trials = 1 if quick else WHOLE.trials
    data = train_policy.Data(residual=residual)
    policy = pipeline.train_stage(folder / f"walk-{method}-{seed}", [], "walk", data, config, ppo)
    numbers = range(FIRST_TRIAL, FIRST_TRIAL + trials)
    return pipeline.trials_stage(folder / f"trials-{method}-{seed}", policy, hardware, numbers, {"trials": trials})


def row(name: str, method: str, found: Sequence[Sequence[Transfer]]) -> tuple[str | Cell, ...]:
    """Return the row of a robot and method, given the trials of each seed."""
    cells = (
        Cell(tuple(float(np.mean([figure.of(trial) for trial in trials])) for trials in found), figure.form)
        for figure in FIGURES
    )
    return (name, fidelity.METHODS[method].label, *cells)


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure what identified friction contributes to walking policies.")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="seeds of the trainings (0 1 2)")
    options, chosen = foot_friction.parse(parser, [], [1, 2])
    seeds = options.seeds[:1] if options.quick else options.seeds
    rows = []
    for robot in chosen:
        _, residuals = foot_friction.fits(robot.hardware, options.fresh, robot.folder, options.quick)
        place = robot.folder / "policies"
        learned = {name: TrainedResidual.load(folders[0], load_robot()).sha256 for name, folders in residuals.items()}
        _setup.reserve(place, robot=robot.hardware.name, residuals=learned)
        for method, folders in residuals.items():
            made = [trials_of(robot.hardware, method, folders[0], seed, place, options.quick) for seed in seeds]
            rows.append(row(robot.name, method, made))
    used = {"own robot": options.own, "PyBullet robot": options.bullet, "training": seeds}
    tables = {"walking": Table(("robot", "simulator", *(figure.title for figure in FIGURES)), tuple(rows))}
    # The folder itself has the table of `foot_friction.py`, which makes the same fits.
    _setup.write_tables(tables, options.output / "transfer", options.results, used)


if __name__ == "__main__":
    _setup.run(main)
