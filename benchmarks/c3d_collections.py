"""Is each public C3D file read exactly as an independent reader does, or refused with a true sentence?

The files are the sample collections of three projects, fetched from their repositories (some hold C3D files in their
history alone, and some large ones behind Git LFS):

    git clone https://github.com/Biomechanical-ToolKit/BTKData
    git clone https://github.com/pyomeca/ezc3d-testFiles
    git clone https://github.com/kineticstoolkit/kineticstoolkit

    pip install ezc3d c3d
    python benchmarks/c3d_collections.py --data FOLDER-WITH-THE-CLONES

The independent readers are ezc3d (https://github.com/pyomeca/ezc3d) and py-c3d (`c3d` on PyPI). Places are compared of
all points in all frames; a point with a negative residual, or at exactly 0, counts as not seen in all readers. Files of
the same content are compared once.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import hashlib
import io
import subprocess
import sys
from pathlib import Path

import numpy as np

from ballu_mjx.common.results import Cell, Table, write_results
from ballu_mjx.recordings.importers.c3d_file import C3DError, read_c3d_points

ROUNDING = 2e-7
"""Of the largest coordinate: single precision."""
LONGEST = 120.0
"""s, for another reader."""
_BEGIN = """
import io, os, sys, warnings
import numpy as np
warnings.simplefilter("ignore")
out = os.fdopen(os.dup(1), "wb")
os.dup2(2, 1)
path = sys.argv[1]
"""
_END = """
place = place.astype(float)
place[:, (residual < 0) | (place == 0).all(axis=0)] = np.nan
archive = io.BytesIO()
np.save(archive, place)
out.write(archive.getvalue())
"""
READERS = {
    "ezc3d": """
import ezc3d
try:
    found = ezc3d.c3d(path)
except OSError:
    found = ezc3d.c3d(path, ignore_bad_formatting=True)
place, residual = np.asarray(found["data"]["points"])[:3], np.asarray(found["data"]["meta_points"]["residuals"])[0]
""",
    "py-c3d": """
import c3d
with open(path, "rb") as stream:
    every = np.stack([points for _, points, _ in c3d.Reader(stream).read_frames(copy=True)]).transpose(2, 1, 0)
place, residual = every[:3], every[3]
""",
}
"""Scripts of processes of their own: some files take a reader's process down."""


@dataclasses.dataclass(frozen=True)
class Compared:
    """One file."""

    path: Path
    ours: str
    """"equal", "DIFFERENT", "read alone", or "refused: " and the sentence."""
    others: dict[str, str]


def compare(path: Path) -> Compared:
    """Return what the readers make of a file."""
    others = {name: _read(script, path) for name, script in READERS.items()}
    shown = {name: value if isinstance(value, str) else f"{value.shape[2]} frames" for name, value in others.items()}
    try:
        place = read_c3d_points(path.read_bytes()).position
    except C3DError as error:
        return Compared(path, f"refused: {error.problem}; {error.fix}", shown)
    verdicts = {name: _verdict(place, value) for name, value in others.items()}
    read = [verdict for verdict in verdicts.values() if verdict in ("equal", "different")]
    ours = "read alone" if not read else "equal" if "equal" in read else "DIFFERENT"
    return Compared(path, ours, verdicts)


def _read(script: str, path: Path) -> np.ndarray | str:
    line = [sys.executable, "-c", _BEGIN + script + _END, str(path)]
    try:
        done = subprocess.run(line, capture_output=True, timeout=LONGEST, check=False)
    except subprocess.TimeoutExpired:
        return "does not end"
    if done.returncode != 0:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        return said[-1][:90] if done.returncode > 0 and said else f"dies (signal {-done.returncode})"
    place = np.load(io.BytesIO(done.stdout))
    return place if place.size else "reads no point"


def _verdict(ours: np.ndarray, theirs: np.ndarray | str) -> str:
    if isinstance(theirs, str):
        return theirs
    if ours.shape != theirs.shape or (np.isnan(ours) != np.isnan(theirs)).any():
        return "different"
    largest = float(np.nanmax(np.abs(theirs), initial=0.0))
    return "equal" if np.nanmax(np.abs(ours - theirs), initial=0.0) <= ROUNDING * largest else "different"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the files, at any depth")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    options = parser.parse_args()
    folder: Path = options.data
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() == ".c3d" and path.is_file():
            found.setdefault(hashlib.sha256(path.read_bytes()).hexdigest(), path)
    results = [compare(path) for path in found.values()]
    for each in results:
        others = "; ".join(f"{name}: {said}" for name, said in each.others.items())
        print(f"{each.path.relative_to(folder)} | {each.ours} | {others}")
    table = count_table(results, [each.path.relative_to(folder).parts[0] for each in results])
    print(f"\n{table.to_markdown()}")
    if options.results is not None:
        write_results(options.results, {"collections": table}, "Public files", packages=("ballu-mjx", "ezc3d", "c3d"))
    return 1 if any(each.ours == "DIFFERENT" for each in results) else 0


def count_table(results: list[Compared], collections_of: list[str]) -> Table:
    """Return how many files of each collection were read, and how."""
    head = ("collection", "files", "equal", "refused", "read alone", "different", "ezc3d differs or fails", "py-c3d")
    rows = []
    for name in [*dict.fromkeys(collections_of), "all"]:
        own = [each for each, of in zip(results, collections_of, strict=True) if name in (of, "all")]
        count = collections.Counter(each.ours.partition(":")[0] for each in own)
        kinds = [count[kind] for kind in ("equal", "refused", "read alone", "DIFFERENT")]
        readable = [each for each in own if not each.ours.startswith("refused")]
        lost = [sum(each.others[reader] != "equal" for each in readable) for reader in READERS]
        rows.append((name, *(Cell((number,), "g") for number in (len(own), *kinds, *lost))))
    return Table(head, tuple(rows))


if __name__ == "__main__":
    sys.exit(main())
