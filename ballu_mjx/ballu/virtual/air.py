"""Air of the virtual robots: lift, added mass, and the forces of MuJoCo's fluid model on ellipsoids."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

_VIRTUAL_MASS = slice(6, 12)
"""Columns of virtual mass and inertia in a row of `geom_fluid`. The columns before them are the interaction and five
coefficients of drag, lift and Magnus force."""


def add_air(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    name: str,
    lift: float,
    added_mass: float,
    semi_axes: Sequence[float] | Float[np.ndarray, " 3"],
) -> None:
    """Give a body a lift (N), an added mass (kg) and an ellipsoid of air `name` at its centre of mass.

    The lift also carries the weight of the added mass. `spec` is changed in place.
    """
    gravity = float(np.linalg.norm(spec.option.gravity))
    body.mass += added_mass
    body.gravcomp = (lift + added_mass * gravity) / (body.mass * gravity)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        size=semi_axes,
        pos=body.ipos,
        contype=0,
        conaffinity=0,
        group=4,
        fluid_ellipsoid=1,
    )


def leave_drag_lift_and_magnus_force(model: mujoco.MjModel) -> None:
    """Remove from MuJoCo's fluid model the parts that this robot's air does not have, in place.

    - The virtual mass and inertia of the ellipsoid. MuJoCo has only their velocity-dependent forces, and the body
      already has the complete added mass. The mass `added_mass` at the centre has the momentum m v, whose rate of
      change in the body frame is m (dv/dt + w x v). This is Kirchhoff's force for added masses that are equal along all
      axes. There is no Munk moment (m v x v = 0).
    - The drag of the other bodies. A body without an ellipsoid would have the drag of its inertia box. A body whose
      coefficients are all 0 has none.
    """
    air = np.flatnonzero(model.geom_fluid[:, 0])
    model.geom_fluid[air, _VIRTUAL_MASS] = 0.0
    for body in range(1, model.nbody):
        if body not in model.geom_bodyid[air]:
            model.geom_fluid[model.body_geomadr[body]] = np.eye(model.geom_fluid.shape[1])[0]
