"""Draw the seeds of the final tier: `python experiments/draw_final.py --tag TAG`.

The seeds follow from the hash of the tagged commit. The author of the commit therefore cannot choose them, and anybody
can draw them again to check the table. See experiments/protocol.md.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ballu_mjx.common import files, provenance
from ballu_mjx.common.errors import InputError

FORMAT = "ballu-final/1"
COUNTS: Mapping[str, int] = {"robots": 3, "robots_outside": 2, "recordings": 1, "trainings": 5}
"""Number of seeds by use: robots of the virtual robot's family, robots outside the class of the aerodynamic residual
(white box), sets of test recordings, and trainings of each method. The draughts of trials follow from the seed of the
training."""
FIRST_SEED, SEEDS = 10_000, 2**31
"""Range of the drawn seeds, without its end. It excludes the seeds of development, which are small or a year."""
_ROOT = Path(__file__).parents[1]


def draw_seeds(commit: str) -> dict[str, list[int]]:
    """Return the seeds that follow from the full hash of a commit, by use."""
    return {use: [_seed(f"{commit} {use} {number}") for number in range(count)] for use, count in COUNTS.items()}


def _seed(text: str) -> int:
    number = int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")
    return FIRST_SEED + number % (SEEDS - FIRST_SEED)


def draw_final(tag: str, output: Path, repository: Path) -> dict[str, Any]:
    """Draw the seeds for a tag of `repository`, write them to `output`, and return the content of the file.

    **Raises** `InputError` if `output` exists, if the tag is missing or is not checked out, or if the working tree has
    changes.
    """
    if output.exists():
        raise InputError(f"{output}: seeds were drawn already, and a final run is made once; keep the file.")
    commit = _git(repository, "rev-parse", "--verify", "--quiet", f"refs/tags/{tag}^{{commit}}")
    if not commit:
        raise InputError(f"--tag {tag}: there is no such tag; commit everything, then `git tag {tag}`.")
    if _git(repository, "rev-parse", "HEAD") != commit:
        raise InputError(f"--tag {tag}: is not the commit that is checked out; `git checkout {tag}` first.")
    if changed := _git(repository, "status", "--porcelain"):
        raise InputError(f"{repository}: has changes ({changed.splitlines()[0].strip()}); commit them, and tag that.")
    found = {
        "format": FORMAT,
        "tag": tag,
        "commit": commit,
        "drawn": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        "seeds": draw_seeds(commit),
        "machine": provenance.describe_machine(),
        "versions": provenance.package_versions(),
    }
    output.parent.mkdir(parents=True, exist_ok=True)
    files.write(output, json.dumps(found, indent=2) + "\n")
    return found


def _git(repository: Path, *arguments: str) -> str:
    """Return the output of a git command, or an empty string if it fails."""
    done = subprocess.run(["git", "-C", str(repository), *arguments], capture_output=True, text=True)
    return done.stdout.strip() if done.returncode == 0 else ""


def main() -> int:
    parser = argparse.ArgumentParser(description="Draw the seeds of the final tier from a tagged commit.")
    parser.add_argument("--tag", required=True, help="tag of the commit that is checked out")
    parser.add_argument("--output", type=Path, default=_ROOT / "results" / "final.json", help="file to write")
    options = parser.parse_args()
    try:
        found = draw_final(options.tag, options.output, _ROOT)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    for use, seeds in found["seeds"].items():
        print(f"{use}: {', '.join(map(str, seeds))}")
    print(f"Written to {options.output}. Commit it before anything is measured.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
