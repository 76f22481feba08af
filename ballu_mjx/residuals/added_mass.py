"""Mass of the fluid that a body drags along, as fields of the robot's model."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
from jax.typing import ArrayLike

from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.residual import Fields


class DraggingBody:
    """The tracked body of a robot, with the fluid that it drags along."""

    def __init__(self, robot: RobotDescription, model: mujoco.MjModel) -> None:
        """`model`: the robot's C model without this fluid."""
        self.id = int(model.site_bodyid[model.site(robot.tracked).id])
        self._mass, self._inertia = jnp.asarray(model.body_mass), jnp.asarray(model.body_inertia)
        self._gravcomp = jnp.asarray(model.body_gravcomp)

    def fields(self, mass: ArrayLike, inertia: ArrayLike, lifted: ArrayLike = 0.0) -> Fields:
        """Return model fields with the fluid's mass (kg) and moments of inertia.

        `inertia` are three numbers (kg m^2), about the body's principal axes, or one for all axes. The body's lift also
        bears the weight of the fluid, and of a further mass `lifted` (kg).
        """
        body = self.id
        total = self._mass.at[body].add(mass)
        borne = self._gravcomp[body] * self._mass[body] + mass + lifted
        return {
            "body_mass": total,
            "body_inertia": self._inertia.at[body].add(inertia),
            "body_gravcomp": self._gravcomp.at[body].set(borne / total[body]),
        }
