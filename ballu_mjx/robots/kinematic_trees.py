"""Which bodies of a model belong to the robot."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float


def linked_roots(model: mujoco.MjModel) -> dict[int, int]:
    """Return a representative of each root body. Root bodies that equalities (closed loops) connect share one."""
    linked = {int(root): int(root) for root in model.body_rootid}
    for number in range(model.neq):
        ends = [int(model.eq_obj1id[number]), int(model.eq_obj2id[number])]
        if int(model.eq_type[number]) not in (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)):
            continue
        if model.eq_objtype[number] == mujoco.mjtObj.mjOBJ_SITE:
            ends = [int(model.site_bodyid[site]) for site in ends]
        one, other = (linked[int(model.body_rootid[body])] for body in ends)
        if 0 not in (one, other):
            linked = {root: one if stand_in == other else stand_in for root, stand_in in linked.items()}
    return linked


def mass_shares(model: mujoco.MjModel, tracked: str) -> Float[np.ndarray, " bodies"]:
    """Return each body's share of the robot's mass. The robot's centre of mass is the sum of shares times positions.

    The robot has the moving bodies of the kinematic tree of the site `tracked`, and of trees that equalities connect to
    it. Bodies of the scene and other objects have no share.
    """
    linked = linked_roots(model)
    roots = np.array([linked[int(root)] for root in model.body_rootid])
    own = (roots == roots[model.site(tracked).bodyid[0]]) & (model.body_weldid > 0)
    mass = np.where(own, model.body_mass, 0.0)
    return mass / mass.sum()
