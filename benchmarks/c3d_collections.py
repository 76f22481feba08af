"""Check that public C3D files are read as independent readers do, or refused with a correct message.

The files are the sample collections of these projects, in all versions of their repositories' histories:

    git clone https://github.com/Biomechanical-ToolKit/BTKData
    git clone https://github.com/pyomeca/ezc3d
    git clone https://github.com/pyomeca/ezc3d-testFiles
    git clone https://github.com/kineticstoolkit/kineticstoolkit
    git clone https://github.com/EmbodiedCognition/py-c3d

    pip install ezc3d c3d
    python benchmarks/c3d_collections.py --data FOLDER-WITH-THE-CLONES

Clones may be bare. Files that a clone lacks (in a partial clone, or behind Git LFS) are listed as "not to be had".

The independent readers are ezc3d (https://github.com/pyomeca/ezc3d) and py-c3d (`c3d` on PyPI). The positions of all
points in all frames are compared. In all readers, a point with a negative residual, or at exactly 0, counts as not
seen. Files of the same content are compared once, and counted in the first collection by name.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import hashlib
import io
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from ballu_mjx.common.results import Cell, Table, write_results
from ballu_mjx.recordings.importers.c3d_file import C3DError, read_c3d_points

ROUNDING = 2e-7
"""Tolerance of single precision, as a share of the largest coordinate."""
_LFS = b"version https://git-lfs"
"""Start of the placeholder of a file behind Git LFS."""
LONGEST = 120.0
"""Timeout of another reader (s)."""
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
"""Scripts of the other readers. They run in separate processes, because some files crash them."""


@dataclasses.dataclass(frozen=True)
class Compared:
    """Comparison of one file."""

    name: str
    ours: str
    """"equal", "DIFFERENT", "read alone" (by no other reader), or "refused: " and the message."""
    others: dict[str, str]
    """Verdict on each other reader."""


def collect(clone: Path) -> tuple[dict[str, bytes], list[str]]:
    """Return all versions of the C3D files in a clone, by path and version, and the paths of files that it lacks."""
    git = ["git", f"--git-dir={clone / '.git' if (clone / '.git').exists() else clone}"]
    # List names and versions only, because rename detection would read files that a partial clone lacks.
    line = [*git, "log", "--all", "-m", "--root", "--raw", "--no-renames", "--no-abbrev", "--format=", "-z"]
    listed = subprocess.run([*line, "--", ":(icase)*.c3d"], capture_output=True, check=True).stdout
    fields = listed.decode(errors="replace").split("\0")
    changes = [*zip(fields[::2], fields[1::2], strict=False)]
    versions = {change.split()[3]: path for change, path in reversed(changes)}  # Under the newest path.
    found: dict[str, bytes] = {}
    lacking: list[str] = []
    for version, path in versions.items():
        if not version.strip("0"):
            continue  # The file was deleted.
        read = subprocess.run([*git, "cat-file", "blob", version], capture_output=True, check=False)
        if read.returncode or read.stdout.startswith(_LFS):
            lacking.append(path)
        else:
            found[f"{path}@{version[:8]}"] = read.stdout
    return found, lacking


def compare(name: str, content: bytes) -> Compared:
    """Return the comparison of all readers on a file with this content."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file.c3d"
        path.write_bytes(content)
        return _compare(name, path)


def _compare(name: str, path: Path) -> Compared:
    others = {name: _read(script, path) for name, script in READERS.items()}
    shown = {name: value if isinstance(value, str) else f"{value.shape[2]} frames" for name, value in others.items()}
    try:
        place = read_c3d_points(path.read_bytes()).position
    except C3DError as error:
        return Compared(name, f"refused: {error.problem}; {error.fix}", shown)
    verdicts = {name: _verdict(place, value) for name, value in others.items()}
    read = [verdict for verdict in verdicts.values() if verdict in ("equal", "different")]
    ours = "read alone" if not read else "equal" if "equal" in read else "DIFFERENT"
    return Compared(name, ours, verdicts)


def _read(script: str, path: Path) -> np.ndarray | str:
    """Return the positions (3, points, frames) that another reader's script finds, or its error message."""
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
    parser.add_argument("--data", type=Path, required=True, help="folder with the clones")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    options = parser.parse_args()
    compared: set[str] = set()
    results: list[Compared] = []
    collections_of: list[str] = []
    for clone in sorted(path for path in options.data.iterdir() if path.is_dir()):
        found, lacking = collect(clone)
        for name, content in sorted(found.items()):
            digest = hashlib.sha256(content).hexdigest()
            if digest not in compared:
                compared.add(digest)
                results.append(compare(name, content))
                collections_of.append(clone.name)
                others = "; ".join(f"{reader}: {said}" for reader, said in results[-1].others.items())
                print(f"{clone.name}/{name} | {results[-1].ours} | {others}", flush=True)
        print(f"{clone.name}: {len(found)} files; not to be had: {', '.join(sorted(set(lacking))) or 'none'}")
    table = count_table(results, collections_of)
    print(f"\n{table.to_markdown()}")
    if options.results is not None:
        write_results(options.results, {"collections": table}, "Public files", packages=("ballu-mjx", "ezc3d", "c3d"))
    return 1 if any(each.ours == "DIFFERENT" for each in results) else 0


def count_table(results: list[Compared], collections_of: list[str]) -> Table:
    """Return a table of the numbers of files in each collection, by verdict."""
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
