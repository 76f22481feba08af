"""ezc3d in a process of its own: on some damaged files it takes the whole process down.

This file is run as a script, with a C3D's path; it writes a NumPy archive to standard output, or a reason to standard
error. It imports nothing of this package.
"""

from __future__ import annotations

import dataclasses
import io
import os
import subprocess
import sys

import numpy as np

_LONGEST = 300.0
"""s."""
_UNREADABLE, _NOT_INSTALLED = 3, 4
"""Exit statuses."""


@dataclasses.dataclass(frozen=True, eq=False)
class Points:
    """What a C3D holds of points, as it stands there; labels may be fewer or more than points."""

    rate: float | None
    unit: str
    labels: list[str]
    position: np.ndarray
    """(3, points, frames)."""
    residual: np.ndarray
    """(points, frames)."""


def read_points(path: str) -> Points:
    """The points of the C3D at `path`.

    **Raises** `ImportError` without ezc3d, and `ValueError`, with a reason, for files that it cannot read.
    """
    # -P: this folder is not to be searched for modules.
    line = [sys.executable, "-P", __file__, path]
    try:
        done = subprocess.run(line, capture_output=True, timeout=_LONGEST, check=False)
    except subprocess.TimeoutExpired as error:
        raise ValueError("its reader does not come to an end") from error
    if done.returncode == _NOT_INSTALLED:
        raise ImportError("ezc3d")
    if done.returncode == _UNREADABLE:
        raise ValueError(done.stderr.decode(errors="replace").strip() or "no reason given")
    if done.returncode != 0:
        raise ValueError("its reader died of it")
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as found:
        rate = float(found["rate"])
        return Points(
            rate=None if np.isnan(rate) else rate,
            unit=str(found["unit"]),
            labels=[str(label) for label in found["labels"]],
            position=found["position"],
            residual=found["residual"],
        )


def main(path: str) -> int:
    """Write the points of `path` to standard output; returns the exit status."""
    # The library prints; what it prints must not come between.
    output = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    try:
        import ezc3d
    except ImportError:
        return _NOT_INSTALLED
    try:
        content = ezc3d.c3d(path)
        point = content["parameters"]["POINT"]
        rates, units = (point[name]["value"] if name in point else [] for name in ("RATE", "UNITS"))
        labels = [str(label).strip() for name in _label_parameters(point) for label in point[name]["value"]]
        archive = io.BytesIO()
        np.savez(
            archive,
            rate=float(rates[0]) if len(rates) else np.nan,
            unit=str(units[0]).strip() if len(units) else "",
            labels=np.array(labels, dtype=str),
            position=np.asarray(content["data"]["points"], float)[:3],
            residual=np.asarray(content["data"]["meta_points"]["residuals"], float)[0],
        )
    except Exception as error:  # whatever the library makes of a damaged file
        print(str(error).splitlines()[0] if str(error) else type(error).__name__, file=sys.stderr)
        return _UNREADABLE
    with output:
        output.write(archive.getvalue())
    return 0


def _label_parameters(point: dict) -> list[str]:
    """LABELS; above 255 labels there are LABELS2 and so on."""
    names = ["LABELS", *(f"LABELS{i}" for i in range(2, 100))]
    return [name for i, name in enumerate(names) if all(n in point for n in names[: i + 1])]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
