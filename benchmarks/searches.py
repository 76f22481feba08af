"""Shared parts of the identification benchmarks: timed alternative optimizers, and comparison of two methods."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import io
import re
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.optimize
from common import cores

THREADS = len(cores())
DIFFERENCE = 1e-6
"""Step of finite differences, as a share of the span between the bounds."""

Trace = list[tuple[float, float]]
"""Pairs of seconds since the start and lowest objective so far."""


@dataclasses.dataclass(frozen=True)
class Search:
    """Judged result of one method with one set of parameters."""

    way: str
    """Name of the method."""
    parameters: int
    """Number of parameters."""
    seconds: float
    """Duration of the search (s), without compiling."""
    compile_seconds: float | None
    """Duration of compiling (s). None if nothing is compiled."""
    objective: float
    """Final objective, by the common judge."""
    trace: Trace
    """Course of the objective. Empty if only the final objective is known."""

    def reached(self, objective: float) -> float:
        """Return the seconds until the objective was at most `objective`, or infinity if it never was."""
        if self.trace:
            return next((seconds for seconds, value in self.trace if value <= objective), np.inf)
        return self.seconds if self.objective <= objective else np.inf


CLOSE = 1e-3
"""Relative tolerance of an objective, because the judge is more accurate than the searches."""


def compare(one: Sequence[Search], other: Search) -> str:
    """Return a text that compares the times to the same objective of the best variant in `one` and of `other`."""
    best = min(one, key=lambda row: row.objective)
    target = max(best.objective, other.objective) * (1 + CLOSE)
    ours_at, row = min(((r.reached(target), r) for r in one), key=lambda pair: pair[0])
    compiled = ours_at + (row.compile_seconds or 0.0)
    there = other.reached(target)
    ends = "the lower of the two" if best.objective < other.objective else "the higher of the two"
    how = f"{there / ours_at:.2g} times sooner" if ours_at < there else f"{ours_at / there:.2g} times later"
    return (
        f"{other.parameters} parameters: ours ends at {best.objective:.6f} ({ends}), {other.way} at "
        f"{other.objective:.6f}. {target:.6f} is reached by {row.way} in {ours_at:.2f} s ({compiled:.0f} s with "
        f"compiling), by {other.way} in {there:.2f} s: ours {how}."
    )


def lowest_so_far(trace: Trace) -> Trace:
    """Return a trace with the running minimum of its objectives."""
    values = np.minimum.accumulate([value for _, value in trace])
    return [(seconds, float(value)) for (seconds, _), value in zip(trace, values, strict=True)]


def lbfgsb(
    function: Callable[[np.ndarray], tuple[float, np.ndarray]], start: np.ndarray, iterations: int
) -> tuple[np.ndarray, float, Trace]:
    """Minimize a function of value and gradient within [0, 1] by SciPy's L-BFGS-B.

    **Returns** the minimum, the seconds and the trace.
    """
    trace: Trace = []

    def noting(shares: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = function(shares)
        trace.append((time.perf_counter() - began, value))
        return value, gradient

    function(start)  # Compiles.
    began = time.perf_counter()
    bounds, options = [(0.0, 1.0)] * len(start), {"maxiter": iterations}
    found = scipy.optimize.minimize(noting, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return found.x, time.perf_counter() - began, lowest_so_far(trace)


def missing_for_toolbox() -> list[str]:
    """Return the missing packages that `mujoco.sysid` needs. Empty if it can be used."""
    from mujoco import sysid

    if hasattr(sysid, "optimize"):
        return []
    missing = []
    for requirement in importlib.metadata.requires("mujoco") or []:
        name = re.split(r"[^\w.-]", requirement)[0]
        if 'extra == "sysid"' in requirement:
            try:
                importlib.metadata.version(name)
            except importlib.metadata.PackageNotFoundError:
                missing.append(name)
    return missing or ["mujoco.sysid itself"]


def optimize_by_toolbox(
    parameters: Any, residual: Callable[..., Any], iterations: int
) -> tuple[np.ndarray, float, list[tuple[float, np.ndarray]]]:
    """Minimize a residual by the optimizer of `mujoco.sysid`.

    **Returns** the minimum, the seconds, and the visited points with their times (s).
    """
    from mujoco import sysid

    visited: list[tuple[float, np.ndarray]] = []

    def noting(x: np.ndarray, parameters: Any, **options: Any) -> Any:
        result = residual(x, parameters, **options)
        if x.ndim == 1 or x.shape[1] == 1:
            visited.append((time.perf_counter() - began, x.ravel().copy()))
        return result

    residual(parameters.as_vector(), parameters.copy())  # Compiles.
    began = time.perf_counter()
    # The parameters have different units, for which the toolbox recommends to scale by the Jacobian.
    with contextlib.redirect_stdout(io.StringIO()):
        found, _ = sysid.optimize(
            initial_params=parameters, residual_fn=noting, verbose=False, max_iters=iterations, x_scale="jac"
        )
    return found.as_vector(), time.perf_counter() - began, visited
