"""A world in PyBullet with a floor and one robot; what both `bullet` and `bullet_family` simulate in."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pybullet  # pyright: ignore[reportMissingImports]
from pybullet_utils.bullet_client import BulletClient  # pyright: ignore[reportMissingImports]


def open_world(urdf: str, gravity: Sequence[float], timestep: float, *, held: bool) -> tuple[Any, int]:
    """Return a world, and the number of the robot that a URDF describes in it.

    `gravity` is in m/s^2, `timestep` in s. `held`: the base stays where it is put. Bullet multiplies the coefficients
    of friction of two surfaces; the floor's is 1, so the robot's alone decides.
    """
    world: Any = BulletClient(pybullet.DIRECT)
    world.setGravity(*gravity)
    world.setPhysicsEngineParameter(fixedTimeStep=timestep, numSubSteps=1)
    floor = world.createMultiBody(0.0, world.createCollisionShape(pybullet.GEOM_PLANE))
    world.changeDynamics(floor, -1, lateralFriction=1.0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        path.write_text(urdf)
        return world, world.loadURDF(str(path), useFixedBase=held, flags=pybullet.URDF_MAINTAIN_LINK_ORDER)
