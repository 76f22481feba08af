"""Do standard errors cover the truth where the model lacks something?

A servo arm (`tests/servo_arm.py`) whose true parameters are drawn from their priors is recorded with 0.5 deg of noise
and 1 deg of dry friction, which no parameter can express. `fit_robot` identifies it. How often does the truth lie
within two standard errors: of the sandwich, which hold under misfit, and of white noise, which do not?

    python benchmarks/coverage.py                    # 50 draws
    python benchmarks/coverage.py --draws 4
    python benchmarks/coverage.py --output FOLDER    # FOLDER/coverage.json too
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

from ballu_mjx.common import runtime

runtime.prepare()

import numpy as np
from common import described, machine, write

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


def examine(robot: RobotDescription, parameters: ParameterSet, folder: Path, seed: int) -> dict[str, Any]:
    """Return a draw's truth, what was found, and both standard errors."""
    truth, model = draw_truth(parameters, seed), robot.load_model()
    sampling = SamplingConfig(angle_noise=float(np.deg2rad(NOISE)))
    motions = []
    for number in range(RECORDINGS + 1):
        options = {"truth": truth, "noise": NOISE, "friction": FRICTION}
        path = record_arm(folder, robot, f"draw-{seed}-{number}", 100 * seed + number, "suspended", **options)
        motions.append(measure_recording(read_recording(path, robot), robot, model, sampling))
    fit = fit_robot(parameters, motions[:-1], motions[-1:], FitConfig(starts=1))
    found = zip(parameters.names, fit.values, fit.standard_errors, fit.white_noise_errors, strict=True)
    return {
        name: {"truth": truth[name], "found": float(v), "robust": float(r), "white": float(w)}
        for name, v, r, w in found
    }


def table(draws: list[dict[str, Any]]) -> str:
    """Return shares within two standard errors as text."""
    lines = [f"{'parameter':20}{'robust':>8}{'white':>8}{'rms error':>12}{'median robust':>15}"]
    shares = []
    for name in draws[0]:
        rows = [draw[name] for draw in draws]
        off = np.array([row["found"] - row["truth"] for row in rows])
        within = [np.mean(np.abs(off) < 2 * np.array([row[kind] for row in rows])) for kind in ("robust", "white")]
        shares.append(within)
        median = np.median([row["robust"] for row in rows])
        rms = np.sqrt(np.mean(off**2))
        lines.append(f"{name:20}{within[0]:>8.0%}{within[1]:>8.0%}{rms:>12.3g}{median:>15.3g}")
    robust, white = np.mean(shares, axis=0)
    lines.append(f"{'all':20}{robust:>8.0%}{white:>8.0%}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=DRAWS)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    draws = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        robot = write_arm(folder)
        parameters = declared_parameters(robot, robot.load_model())
        for seed in range(arguments.draws):
            draws.append(examine(robot, parameters, folder, seed))
            print(f"draw {seed + 1} of {arguments.draws}", flush=True)
    print(f"{described(machine())}; {NOISE:g} deg of noise, {FRICTION:g} deg of friction\n{table(draws)}")
    if arguments.output:
        write(arguments.output, "coverage", {"noise_deg": NOISE, "friction_deg": FRICTION, "draws": draws})


if __name__ == "__main__":
    main()
