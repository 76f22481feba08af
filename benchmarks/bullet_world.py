"""A PyBullet world with a floor and one robot, for `bullet` and `bullet_family`."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pybullet  # pyright: ignore[reportMissingImports]
from pybullet_utils.bullet_client import BulletClient  # pyright: ignore[reportMissingImports]


def open_world(urdf: str, gravity: Sequence[float], timestep: float, *, held: bool) -> tuple[Any, int]:
    """Return a world with a floor and a robot, and the robot's body number.

    Bullet multiplies the friction coefficients of two surfaces. The floor's is 1, so the robot's coefficient applies.

    **Arguments**

    - `urdf`: the robot as a URDF.
    - `gravity`: gravity (m/s^2).
    - `timestep`: time step (s).
    - `held`: whether the base is fixed.
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
