"""Check that the results of two trainings with the same options are equal to the bit.

    python tests/faults/repeated.py RUN RUN

The script compares all measurements except timings, the whole last training state, and the evaluation.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from ballu_mjx.common import runtime


def differences(first: Path, second: Path) -> list[str]:
    """Return descriptions of the differences between two runs."""
    from campaign import outcome

    (rows, state), (other_rows, other_state) = outcome(first), outcome(second)
    shared = state.keys() & other_state.keys()
    found = [f"{name} of the state" for name in sorted(shared) if not np.array_equal(state[name], other_state[name])]
    found += [f"a measurement at step {a['step']}" for a, b in zip(rows, other_rows, strict=False) if a != b]
    if len(rows) != len(other_rows) or state.keys() != other_state.keys():
        found.append("the number of measurements or arrays")
    for name in ("evaluation.json", "observed.json"):
        if (first / name).read_bytes() != (second / name).read_bytes():
            found.append(name)
    print(f"{len(rows)} rows of measurements, {len(state)} arrays of the last state, the evaluation")
    return found


def main() -> int:
    first, second = map(Path, sys.argv[1:])
    runtime.prepare()
    found = differences(first, second)
    print("The runs differ in " + ", ".join(found) if found else "The runs are equal to the bit.")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
