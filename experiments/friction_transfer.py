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
import functools
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path += ["experiments", "benchmarks"]  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import dataclasses

import fidelity
import foot_friction
import numpy as np

from ballu_mjx.ballu.virtual.hardware import Hardware
from ballu_mjx.ballu.virtual.trials import run_trials
from ballu_mjx.cli import train_policy
from ballu_mjx.cli.cached_stages import cached_stage
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.evaluation import transfer
from ballu_mjx.evaluation.transfer import Transfer
from ballu_mjx.policies.locomotion_config import LocomotionConfig
from ballu_mjx.policies.policy import Policy
from ballu_mjx.policies.tasks import TASKS
from ballu_mjx.policies.training import locomotion_ppo
from ballu_mjx.runs.checkpoints import list_checkpoints

STEPS = 3_000_000
"""Number of control steps of each training, as in `train all`."""
FIRST_TRIAL = 5000
"""Number of the first trial. Recordings have other numbers, and so other draughts."""
COLUMNS = ("mean CoM error (m)", "x-distance (m)", "x-distance in its simulator (m)", "final yaw error (deg)")

# %% [markdown]
# ## Measurement


# %%
def trials_of(
    hardware: Hardware, method: str, residual: Path, seed: int, folder: Path, trials: int, quick: bool
) -> list[Transfer]:
    """Train a policy in the simulator with a residual, and return its trials on the robot. Finished stages are kept."""
    env = LocomotionConfig(domain_randomization=True)
    ppo = locomotion_ppo(seed=seed, **train_policy.QUICK if quick else {"num_timesteps": STEPS})
    options = {"method": method, "env": dataclasses.asdict(env), "ppo": dataclasses.asdict(ppo)}
    name = f"{method}-{seed}"

    def train(where: Path) -> None:
        started = bool(list_checkpoints(where))
        data = train_policy.Data(resume=where) if started else train_policy.Data(output=where, residual=residual)
        train_policy.train(TASKS["walk"], data, env, ppo)

    policy = cached_stage(folder / f"walk-{name}", options, [], train)

    def run(where: Path) -> None:
        numbers = range(FIRST_TRIAL, FIRST_TRIAL + trials)
        tell = functools.partial(print, flush=True)
        transfer.write_transfer(
            where / "transfer.json", run_trials(Policy.load(policy), hardware, numbers, where, tell=tell)
        )

    done = cached_stage(folder / f"trials-{name}", {"trials": trials}, [policy], run)
    return transfer.read_transfer(done / "transfer.json")


def row(name: str, method: str, found: Sequence[Sequence[Transfer]]) -> tuple[str | Cell, ...]:
    """Return the row of a robot and method, given the trials of each seed. A value is the mean over a seed's trials."""

    def cell(values: Sequence[Sequence[float]], form: str = ".2f") -> Cell:
        return Cell(tuple(float(np.mean(each)) for each in values), form)

    return (
        name,
        fidelity.METHODS[method].label,
        cell([[trial.com_error for trial in each] for each in found]),
        cell([[trial.x_distance for trial in each] for each in found]),
        cell([[trial.sim_x_distance for trial in each] for each in found]),
        cell([[abs(trial.yaw_error) for trial in each] for each in found], ".0f"),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure what identified friction contributes to walking policies.")
    parser.add_argument("--own", type=int, nargs="*", default=[], help="seeds of robots of the own family (none)")
    parser.add_argument("--bullet", type=int, nargs="*", default=[1, 2], help="seeds of PyBullet's robots (1 2)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="seeds of the trainings (0 1 2)")
    parser.add_argument("--fresh", type=int, default=2026, help="seed of the test recordings of the fits")
    parser.add_argument("--quick", action="store_true", help="one robot, for minutes; the numbers mean nothing")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    options = _setup.parse(parser, Path("runs/foot-friction"))
    _setup.reserve(options.output, fresh=options.fresh, quick=options.quick)
    chosen = foot_friction.robots([1], []) if options.quick else foot_friction.robots(options.own, options.bullet)
    seeds, trials = (options.seeds[:1], 1) if options.quick else (options.seeds, 5)
    rows = []
    for name, (hardware, _) in chosen.items():
        folder = options.output / name.replace(" ", "-").lower()
        _, residuals = foot_friction.fits(hardware, options.fresh, folder, options.quick)
        for method in foot_friction.METHODS:
            made = [
                trials_of(hardware, method, residuals[method][0], seed, folder / "policies", trials, options.quick)
                for seed in seeds
            ]
            rows.append(row(name, method, made))
    used = {"own_robot": options.own, "pybullet_robot": options.bullet, "training": seeds}
    tables = {"walking": Table(("robot", "simulator", *COLUMNS), tuple(rows))}
    _setup.write_tables(tables, options.output, options.results, used)


if __name__ == "__main__":
    _setup.run(main)
