"""Write the descriptions of robots for tests to files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ballu_mjx.robots.description import RobotDescription, read_description


def write_robot(folder: Path, name: str, mjcf: str, **keys: Any) -> RobotDescription:
    """Write a model and its description, with the further keys `keys`, to a folder. Return the description."""
    (folder / f"{name}.xml").write_text(mjcf)
    content = {"format": "ballu-robot/1", "name": name, "model": f"{name}.xml", "points": [], **keys}
    (folder / f"{name}.robot.json").write_text(json.dumps(content))
    return read_description(folder / f"{name}.robot.json")
