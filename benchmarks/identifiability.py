"""Measure how well a sweep determines the parameters: `python benchmarks/identifiability.py`.

1. Sweeps are recorded of virtual robots, of which identification knows nothing. The identified parameters are compared
   with the truth. Cells have the left and the right leg. This is repeated with parts of the method removed: first the
   motion between commands (and so delay, backlash and friction), then also the cables' slack, and then all but the
   paper's eight parameters.
2. Sweeps are simulated with known parameters. Without noise, the table has the largest error over different draws of
   starts. With 0.5 deg of noise, it has the share of parameters whose truth lies within two standard errors.

It takes about a quarter of an hour, and with `--quick` a third of that.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

from ballu_mjx.common import runtime

runtime.prepare()

import jax
import numpy as np

from ballu_mjx.ballu.leg_fit import Identifier
from ballu_mjx.ballu.leg_parameters import (
    ALL_PARAMETERS,
    LEG_PARAMETERS,
    PAPER_PARAMETERS,
    IdentificationConfig,
    LegDynamics,
    dynamics_coordinates,
)
from ballu_mjx.ballu.leg_residuals import leg_data
from ballu_mjx.ballu.leg_results import Fit
from ballu_mjx.ballu.model import SIDES
from ballu_mjx.ballu.sweep import Sweep, read_sweep
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.common.results import Cell, Table, write_results

NOISE = float(np.deg2rad(0.5))
"""Noise of a sample (rad)."""
SAMPLES, TIMES, LEVELS = 30, 60, 20
"""Samples in the mean of a hold, samples of its motion, and number of holds."""
DYNAMICS = LegDynamics(
    delay=0.043, motor_friction=3e-3, knee_friction=8e-4, backlash=float(np.deg2rad(2.0)), lag=0.02, knee_damping=4e-3
)
CHANGES = ([1.3, 0.7, 0.05, 0.06, 0.75, 1.2e-3, -0.15, 0.8, 0.03], [0.8, 1.2, -0.08, -0.03, 0.6, 2e-4, 0.0, 1.3, 0.0])
"""True parameters, left and right: factors on the nominal ones, but added to angles (rad), slack (m) and travel."""
RATIOS = {"springs": "knee_spring_stiffness", "gains": "motor_gain", "torque limits": "torque_limit"}
"""Parameters that are compared as ratios, by the head of their column."""


def silent(stage: str, iteration: int, steps: int, value: float) -> None:
    """Ignore progress."""


def simulate(identifier: Identifier, vectors: np.ndarray) -> Sweep:
    """Return a sweep of the model itself with these parameters, without noise."""
    physics, data = identifier.physics, leg_data(blank())
    y = np.stack([identifier.space.coordinates(vector) for vector in vectors])
    qpos, _ = physics.settled(y, data.command)
    dynamics = np.tile(dynamics_coordinates(DYNAMICS), (len(SIDES), 1))
    motion, _ = physics.motion(np.concatenate([y, dynamics], axis=1), data.commanded)
    return dataclasses.replace(
        blank(),
        settled=np.moveaxis(qpos[:, :, physics.leg.angles], 0, -1),
        motion=np.moveaxis(motion[:, data.counts], 0, -1),
    )


def blank() -> Sweep:
    """Return a sweep of the right sizes without measurements."""
    times, command = LEVELS * TIMES, np.repeat(np.linspace(0, 1, LEVELS)[:, None], len(SIDES), axis=1)
    return Sweep(
        robot="model",
        command=command,
        settled=np.zeros((LEVELS, 2, 2)),
        drift=np.zeros((LEVELS, 2, 2)),
        samples=np.full(LEVELS, SAMPLES),
        motion=np.zeros((times, 2, 2)),
        commanded=np.repeat(command, TIMES, axis=0),
        hold=np.repeat(np.arange(LEVELS), TIMES),
        begins=np.arange(times) == 0,
    )


def with_noise(sweep: Sweep, seed: int) -> Sweep:
    """Return a sweep with white noise on every sample."""
    rng = np.random.default_rng(seed)
    return dataclasses.replace(
        sweep,
        settled=sweep.settled + rng.normal(size=sweep.settled.shape) * NOISE / np.sqrt(SAMPLES),
        motion=sweep.motion + rng.normal(size=sweep.motion.shape) * NOISE,
    )


def of_the_model_itself(seeds: int, draws: int) -> dict[str, Table]:
    """Return the errors over draws of starts, and the coverage over draws of noise, for sweeps of the model itself."""
    identifier = Identifier(ALL_PARAMETERS, blank(), silent)
    space = identifier.space
    changes = np.array(CHANGES)
    vectors = np.where(space.relative, space.nominal * changes, space.nominal + changes)
    clean = simulate(identifier, vectors)
    worst = np.zeros(len(LEG_PARAMETERS))
    for seed in range(seeds):
        identifier.config = dataclasses.replace(ALL_PARAMETERS, seed=seed)
        found = np.stack([fit.vector for fit in identifier.run(clean, silent).fits])
        worst = np.maximum(worst, np.abs(found - vectors).max(axis=0))
    relative = np.where(space.relative, worst / vectors.min(axis=0), worst)
    units = [
        "of the value" if own else {"cable_slack": "m", "motor_travel": "of the nominal one"}.get(name, "rad")
        for name, own in zip(LEG_PARAMETERS, space.relative, strict=True)
    ]
    errors = [
        (name, Cell((float(error),), ".1e", unit))
        for name, error, unit in zip(LEG_PARAMETERS, relative, units, strict=True)
    ]
    within = []
    for seed in range(draws):
        identifier.config = dataclasses.replace(ALL_PARAMETERS, draws=32)
        for fit, vector in zip(identifier.run(with_noise(clean, seed), silent).fits, vectors, strict=True):
            within += list(np.abs(fit.vector - vector) < 2 * fit.standard_errors)
    return {
        "without_noise": Table((f"parameter, {seeds} draws of starts", "largest error"), tuple(errors)),
        "with_noise": Table(
            ("draws of 0.5 deg of noise", "parameters within two standard errors"),
            ((str(draws), Cell((float(np.mean(within)),), ".1%")),),
        ),
    }


def of_virtual_robots(robots: Sequence[int]) -> Table:
    """Return identified parameters of virtual robots, relative to their true ones, for left and right leg."""
    ways = {
        "default": IdentificationConfig(),
        "settled angles alone": IdentificationConfig(motion=False),
        "and no slack": IdentificationConfig(motion=False, cable_slack=False),
        "the paper's eight": dataclasses.replace(PAPER_PARAMETERS, motion=False),
    }
    rows = []
    for way, config in ways.items():
        identifier = None
        for number in robots:
            virtual = virtual_robot.draw_robot(number)
            sweep = read_sweep({Path("sweep"): virtual_robot.record_sweep(virtual, number, "sweep")})
            identifier = identifier or Identifier(config, sweep, silent)
            rows.append((way, str(number), *compared(virtual, identifier.run(sweep, silent).fits, config.motion)))
            print(*rows[-1], sep=" | ", flush=True)
    return Table(("parameters", "robot", *RATIOS, "slack - true (mm)", "residual of the motion (deg)"), tuple(rows))


def compared(virtual: virtual_robot.VirtualRobot, fits: tuple[Fit, Fit], motion: bool) -> tuple[str, ...]:
    """Return the cells of one robot: identified over true values, error of the slack (mm), and residual (deg).

    Without the `motion`, residuals are weighted settled angles, which are not shown.
    """
    found = {name: [fit.vector[index] for fit in fits] for index, name in enumerate(LEG_PARAMETERS)}
    ratios = [np.array(found[name]) / np.array(getattr(virtual, name)) for name in RATIOS.values()]
    slack = 1e3 * (np.array(found["cable_slack"]) - np.array(virtual.cable_slack))
    residual = np.rad2deg([fit.residual for fit in fits])
    *cells, last = (
        f"{left:{form}}, {right:{form}}"
        for pairs, form in ((ratios, ".3f"), ([slack, residual], ".2f"))
        for left, right in pairs
    )
    return (*cells, last if motion else "-")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer draws, two robots")
    parser.add_argument("--results", type=Path, help="JSON file to write the tables to")
    arguments = parser.parse_args()
    seeds, draws, robots = (1, 2, range(2)) if arguments.quick else (2, 8, range(3))
    with jax.enable_x64(True):
        tables = {"virtual_robots": of_virtual_robots(robots), **of_the_model_itself(seeds, draws)}
    for table in tables.values():
        print(f"\n{table.to_markdown()}")
    if arguments.results is not None:
        write_results(arguments.results, tables, "Simulated data", seeds={"robot": robots})


if __name__ == "__main__":
    main()
