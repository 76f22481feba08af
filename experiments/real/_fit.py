"""Shared code of the experiments on public recordings: options, and reports of a fit."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping
from pathlib import Path

import _setup
import numpy as np

from ballu_mjx.common.results import Cell, Table
from ballu_mjx.identification.fit_robot import RobotFit


def parse(description: str, output: Path, *, trains: bool = False) -> argparse.Namespace:
    """Parse the command line, and return its options `data`, `output` (see `_setup.parse`), `quick` and `results`.

    An experiment that `trains` networks has `seeds`, too.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--data", type=Path, required=True, help="folder of the public files, or of recordings of them")
    if trains:
        parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="training seeds (0 1 2)")
    parser.add_argument("--quick", action="store_true", help="short trial run; the numbers mean little")
    parser.add_argument("--results", type=Path, help="JSON file to write the tables to")
    return _setup.parse(parser, output)


def report(stage: str, iteration: int, steps: int, value: float) -> None:
    """Print the progress of a fit to stderr. Stages without a loss have the value NaN."""
    loss = f", loss {value:.6g}" if math.isfinite(value) else ""
    print(f"{stage}: {iteration} of {steps}{loss}", file=sys.stderr, flush=True)


def show(fit: RobotFit) -> None:
    """Print diagnostics of a fit."""
    print(f"at bounds: {fit.at_bounds}; not shown by the data: {fit.unseen}; open: {fit.unidentified}")
    print(f"strong correlations: {fit.strong_correlations}; scatter over noise: {fit.scatter.round(1)}")


def parameter_table(fit: RobotFit, published: Mapping[str, float]) -> Table:
    """Return a table of nominal, `published` and identified parameters."""
    rows = zip(fit.parameters.parameters, fit.values, fit.standard_errors, strict=True)
    return Table(
        ("parameter", "unit", "nominal", "published", "identified (standard error)"),
        tuple(
            (
                parameter.name,
                parameter.unit,
                Cell((parameter.nominal,), ".5f"),
                Cell((published.get(parameter.name, parameter.nominal),), ".5f"),
                Cell((float(value),), ".5f", standard_error=float(error)),
            )
            for parameter, value, error in rows
        ),
    )


def candidates(fit: RobotFit, published: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return parameter vectors by name: nominal, nominal with the `published` values, and identified."""
    vector = fit.parameters.nominal.copy()
    for name, value in published.items():
        vector[fit.parameters.names.index(name)] = value
    return {"nominal": fit.parameters.nominal, "published friction": vector, "identified": fit.values}
