"""Measure how often standard errors cover the truth if the model lacks an effect.

A servo arm (`tests/servo_arm.py`) has true parameters that are drawn from their priors. It is recorded with 0.5 deg of
noise and 1 deg of dry friction, which no declared parameter can express. `fit_robot` identifies it. The result is the
share of draws in which the truth lies within two standard errors. Robust standard errors account for correlated
residuals. Those of white noise do not.

Then the parameters that `suggest_parameters` proposes are declared too, and the arm is identified again.

    python benchmarks/interval_coverage.py                    # 50 draws
    python benchmarks/interval_coverage.py --draws 4
    python benchmarks/interval_coverage.py --friction 0       # the model lacks nothing
    python benchmarks/interval_coverage.py --output FOLDER    # also write FOLDER/coverage.json
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from ballu_mjx.common import runtime

runtime.prepare()

import numpy as np
from common import described, machine, write

from ballu_mjx.common.results import Table, write_results
from ballu_mjx.identification.declarations import declared_parameters, parameters_of
from ballu_mjx.identification.declared import measure_recording
from ballu_mjx.identification.fit_robot import FitConfig, RobotFit, fit_robot
from ballu_mjx.identification.measured_motion import SamplingConfig
from ballu_mjx.identification.parameters import ParameterSet
from ballu_mjx.identification.undeclared import suggest_parameters
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.robots.description import RobotDescription

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from servo_arm import record_arm, write_arm  # pyright: ignore[reportMissingImports]

DRAWS, NOISE, FRICTION = 50, 0.5, 1.0
"""Default number of draws, noise of angles (deg), and dry friction (deg)."""
KINDS = ("robust", "white")
RECORDINGS = 3
"""Number of recordings of 6 s for the fit. One more is held out."""
ZERO_SPREADS = {"shoulder_delay": 0.02, "shoulder_backlash": 0.05}
"""Scales of the half-normal distributions of true values that are 0 in the nominal arm."""


def draw_truth(parameters: ParameterSet, seed: int) -> dict[str, float]:
    """Return true values, drawn from the priors and kept within the bounds."""
    rng = np.random.default_rng([seed, 45])
    truth = {}
    for parameter in parameters.parameters:
        value = parameter.nominal + parameter.prior * float(rng.normal())
        if parameter.name in ZERO_SPREADS:
            value = ZERO_SPREADS[parameter.name] * abs(float(rng.normal()))
        low, high = parameter.bounds
        truth[parameter.name] = float(np.clip(value, low + 0.05 * (high - low), high - 0.05 * (high - low)))
    return truth


class Draw(NamedTuple):
    """Result of one arm."""

    declared: dict[str, dict[str, float]]
    """True value, identified value and both standard errors of each declared parameter."""
    suggested: tuple[str, ...]
    """Names of the proposed parameters."""
    completed: dict[str, dict[str, float]]
    """As `declared`, with the proposed parameters declared too."""


def examine(robot: RobotDescription, parameters: ParameterSet, folder: Path, seed: int, friction: float) -> Draw:
    """Draw an arm, record it, identify it, declare the proposed parameters, and identify it again."""
    truth, model = draw_truth(parameters, seed), robot.load_model()
    sampling = SamplingConfig(angle_noise=float(np.deg2rad(NOISE)))
    motions = []
    for number in range(RECORDINGS + 1):
        options = {"truth": truth, "noise": NOISE, "friction": friction}
        path = record_arm(folder, robot, f"draw-{seed}-{number}", 100 * seed + number, "suspended", **options)
        motions.append(measure_recording(read_recording(path, robot), robot, model, sampling))
    config = FitConfig(starts=1)
    first = again = fit_robot(parameters, motions[:-1], motions[-1:], config)
    proposed = suggest_parameters(robot, first, motions[:-1], config)
    if proposed:
        more = parameters_of(robot, model, [each.entry for each in proposed])
        complete = ParameterSet([*parameters.parameters, *more], parameters.commands)
        again = fit_robot(complete, motions[:-1], motions[-1:], config)
    return Draw(compared(first, truth), tuple(each.parameter.name for each in proposed), compared(again, truth))


def compared(fit: RobotFit, truth: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """Return the results of a fit for the parameters with known true values."""
    found = zip(fit.parameters.names, fit.values, fit.standard_errors, fit.white_noise_errors, strict=True)
    return {
        name: {"truth": truth[name], "found": float(v), "robust": float(r), "white": float(w)}
        for name, v, r, w in found
        if name in truth
    }


def coverage_table(draws: Sequence[Mapping[str, Mapping[str, float]]]) -> Table:
    """Return a table of the shares of draws within two standard errors, mean errors and median standard errors."""
    made, shares = [], []
    for name in draws[0]:
        rows = [draw[name] for draw in draws]
        off = np.array([row["found"] - row["truth"] for row in rows])
        within = [float(np.mean(np.abs(off) < 2 * np.array([row[kind] for row in rows]))) for kind in KINDS]
        shares.append(within)
        errors = (f"{np.median([row[kind] for row in rows]):.2g}" for kind in KINDS)
        made.append((name, *(f"{share:.0%}" for share in within), f"{np.mean(off):.2g}", *errors))
    made.append(("all", *(f"{share:.0%}" for share in np.mean(shares, axis=0)), "", "", ""))
    heads = ("within two standard errors", "robust", "white noise", "mean error", "robust error", "white-noise error")
    return Table(heads, tuple(made))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=DRAWS, help="number of arms")
    parser.add_argument("--friction", type=float, default=FRICTION, help="dry friction that the model lacks (deg)")
    parser.add_argument("--output", type=Path, help="folder for coverage.json")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    arguments = parser.parse_args()
    draws: list[Draw] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        robot = write_arm(folder)
        parameters = declared_parameters(robot, robot.load_model())
        for seed in range(arguments.draws):
            draws.append(examine(robot, parameters, folder, seed, arguments.friction))
            print(f"draw {seed + 1} of {arguments.draws}", flush=True)
    names = sorted({name for draw in draws for name in draw.suggested})
    rows = [(name, f"{np.mean([name in draw.suggested for draw in draws]):.0%}") for name in names]
    tables = {
        "coverage": coverage_table([draw.declared for draw in draws]),
        "suggested": Table(("proposed", "in draws"), tuple(rows) or (("nothing", ""),)),
        "completed": coverage_table([draw.completed for draw in draws]),
    }
    print(f"{described(machine())}; {NOISE:g} deg of noise, {arguments.friction:g} deg of friction")
    print("\n\n".join(table.to_markdown() for table in tables.values()))
    if arguments.output:
        made = [draw._asdict() for draw in draws]
        write(arguments.output, "coverage", {"noise_deg": NOISE, "friction_deg": arguments.friction, "draws": made})
    if arguments.results:
        write_results(arguments.results, tables, f"Simulated data, {arguments.draws} draws from seed 0 on")


if __name__ == "__main__":
    main()
