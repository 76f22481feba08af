"""Do standard errors cover the truth where the model lacks something?

A servo arm (`tests/servo_arm.py`) whose true parameters are drawn from their priors is recorded with 0.5 deg of noise
and 1 deg of dry friction, which no parameter can express. `fit_robot` identifies it. How often does the truth lie
within two standard errors: of the sandwich, which count residuals that go together, and of white noise?

    python benchmarks/coverage.py                    # 50 draws
    python benchmarks/coverage.py --draws 4
    python benchmarks/coverage.py --friction 0       # nothing is left out
    python benchmarks/coverage.py --output FOLDER    # FOLDER/coverage.json too
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ballu_mjx.common import runtime

runtime.prepare()

import numpy as np
from common import described, machine, write

from ballu_mjx.common.results import Table, write_results
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.declared import measure_recording
from ballu_mjx.identification.fit_robot import FitConfig, fit_robot
from ballu_mjx.identification.parameters import ParameterSet
from ballu_mjx.identification.residuals import SamplingConfig
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.robots.description import RobotDescription

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from servo_arm import record_arm, write_arm  # pyright: ignore[reportMissingImports]

DRAWS, NOISE, FRICTION = 50, 0.5, 1.0
"""Draws; deg."""
KINDS = ("robust", "white")
RECORDINGS = 3
"""For the fit, of 6 s each; one more is held out."""
ZERO_SPREADS = {"shoulder_delay": 0.02, "shoulder_backlash": 0.05}
"""True values of what is 0 in the nominal arm are half-normal."""


def draw_truth(parameters: ParameterSet, seed: int) -> dict[str, float]:
    """Return true values, drawn from the priors within the bounds."""
    rng = np.random.default_rng([seed, 45])
    truth = {}
    for parameter in parameters.parameters:
        value = parameter.nominal + parameter.prior * float(rng.normal())
        if parameter.name in ZERO_SPREADS:
            value = ZERO_SPREADS[parameter.name] * abs(float(rng.normal()))
        low, high = parameter.bounds
        truth[parameter.name] = float(np.clip(value, low + 0.05 * (high - low), high - 0.05 * (high - low)))
    return truth


def examine(
    robot: RobotDescription, parameters: ParameterSet, folder: Path, seed: int, friction: float
) -> dict[str, Any]:
    """Return a draw's truth, what was found, and both standard errors."""
    truth, model = draw_truth(parameters, seed), robot.load_model()
    sampling = SamplingConfig(angle_noise=float(np.deg2rad(NOISE)))
    motions = []
    for number in range(RECORDINGS + 1):
        options = {"truth": truth, "noise": NOISE, "friction": friction}
        path = record_arm(folder, robot, f"draw-{seed}-{number}", 100 * seed + number, "suspended", **options)
        motions.append(measure_recording(read_recording(path, robot), robot, model, sampling))
    fit = fit_robot(parameters, motions[:-1], motions[-1:], FitConfig(starts=1))
    found = zip(parameters.names, fit.values, fit.standard_errors, fit.white_noise_errors, strict=True)
    return {
        name: {"truth": truth[name], "found": float(v), "robust": float(r), "white": float(w)}
        for name, v, r, w in found
    }


def coverage_table(draws: Sequence[Mapping[str, Mapping[str, float]]]) -> Table:
    """Return shares of draws within two standard errors, beside the mean error and both standard errors."""
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
    parser.add_argument("--draws", type=int, default=DRAWS)
    parser.add_argument("--friction", type=float, default=FRICTION, help="dry friction that no parameter has (deg)")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    arguments = parser.parse_args()
    draws = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        robot = write_arm(folder)
        parameters = declared_parameters(robot, robot.load_model())
        for seed in range(arguments.draws):
            draws.append(examine(robot, parameters, folder, seed, arguments.friction))
            print(f"draw {seed + 1} of {arguments.draws}", flush=True)
    found = coverage_table(draws)
    print(f"{described(machine())}; {NOISE:g} deg of noise, {arguments.friction:g} deg of friction")
    print(found.to_markdown())
    if arguments.output:
        write(arguments.output, "coverage", {"noise_deg": NOISE, "friction_deg": arguments.friction, "draws": draws})
    if arguments.results:
        data = f"Made data, {arguments.draws} draws from seed 0 on"
        write_results(arguments.results, {"coverage": found}, data)


if __name__ == "__main__":
    main()
