"""Record the bundled data set on the virtual robot again, bit for bit: `python experiments/bundled_recordings.py`.

`ballu_mjx.ballu.virtual.dataset` defines the recordings.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ballu_mjx.ballu.virtual.dataset import ROBOT_SEED, record_dataset
from ballu_mjx.ballu.virtual.hardware import VirtualHardware
from ballu_mjx.robots.model import assets


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=assets() / "recordings", help="folder to write to")
    parser.add_argument("--robot", type=int, default=ROBOT_SEED, help="seed of the virtual robot (0, the bundled one)")
    arguments = parser.parse_args()
    for path in record_dataset(VirtualHardware.draw(arguments.robot), arguments.output):
        print(path)


if __name__ == "__main__":
    main()
