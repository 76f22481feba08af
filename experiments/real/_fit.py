"""Shared code of the experiments on public recordings: options, and reports of a fit."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ballu_mjx.identification.fit_robot import RobotFit


def parse(description: str) -> argparse.Namespace:
    """Parse the command line, and return its options `data` and `quick`."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--data", type=Path, required=True, help="folder of the recordings")
    parser.add_argument("--quick", action="store_true", help="short trial run; the numbers mean little")
    return parser.parse_args()


def report(stage: str, iteration: int, steps: int, value: float) -> None:
    """Print the progress of a fit to stderr."""
    print(f"{stage} {iteration}/{steps}: {value:.6g}", file=sys.stderr, flush=True)


def show(fit: RobotFit) -> None:
    """Print the identified parameters with standard errors, and diagnostics of the fit."""
    print("| parameter | nominal | identified | standard error | unit |\n| --- | --- | --- | --- | --- |")
    for parameter, value, error in zip(fit.parameters.parameters, fit.values, fit.standard_errors, strict=True):
        print(f"| {parameter.name} | {parameter.nominal:.4g} | {value:.4g} | {error:.2g} | {parameter.unit} |")
    print(f"at bounds: {fit.at_bounds}; not shown by the data: {fit.unseen}; open: {fit.unidentified}")
    print(f"strong correlations: {fit.strong_correlations}; scatter over noise: {fit.scatter.round(1)}")


def candidates(fit: RobotFit, published: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return parameter vectors by name: nominal, nominal with the `published` values, and identified."""
    vector = fit.parameters.nominal.copy()
    for name, value in published.items():
        vector[fit.parameters.names.index(name)] = value
    return {"nominal": fit.parameters.nominal, "published friction": vector, "identified": fit.values}
