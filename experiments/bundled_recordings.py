"""Record the bundled data set on the virtual robot, bit for bit: `python experiments/bundled_recordings.py`.

What is recorded stands in `ballu_mjx.ballu.virtual.dataset`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ballu_mjx.ballu.virtual.dataset import ROBOT_SEED, record_dataset
from ballu_mjx.robots.model import assets


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=assets() / "recordings", help="folder to write to")
    parser.add_argument("--robot", type=int, default=ROBOT_SEED, help="seed of the virtual robot (bundled: 0)")
    arguments = parser.parse_args()
    for path in record_dataset(arguments.robot, arguments.output):
        print(path)


if __name__ == "__main__":
    main()
