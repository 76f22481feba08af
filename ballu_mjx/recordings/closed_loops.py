"""Closed loops of a model, as measurements: `connect` and `joint` equalities."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
from jaxtyping import Float

End = tuple[int, Float[np.ndarray, " 3"]]


def closed_loops(model: mujoco.MjModel) -> list[tuple[End, End]]:
    """Pairs of points that `connect` equalities hold together: bodies, and places in their frames."""
    loops = []
    for number in np.flatnonzero(model.eq_active0):
        if model.eq_type[number] != mujoco.mjtEq.mjEQ_CONNECT:
            continue
        one, other = int(model.eq_obj1id[number]), int(model.eq_obj2id[number])
        if model.eq_objtype[number] == mujoco.mjtObj.mjOBJ_SITE:
            ends = [(int(model.site_bodyid[site]), model.site_pos[site]) for site in (one, other)]
        else:
            ends = [(one, model.eq_data[number, :3]), (other, model.eq_data[number, 3:6])]
        loops.append(tuple(ends))
    return loops


@dataclasses.dataclass(frozen=True)
class Coupling:
    """A `joint` equality: one joint's deviation from its reference is a polynomial of another's (or constant)."""

    address: int
    dof: int
    reference: float
    other: tuple[int, int, float] | None
    coefficients: Float[np.ndarray, " 5"]

    def misfit(
        self, qpos: Float[np.ndarray, "N nq"], nv: int
    ) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N nv"]]:
        slope = np.zeros((len(qpos), nv))
        slope[:, self.dof] = 1.0
        polynomial = np.polynomial.Polynomial(self.coefficients)
        if self.other is None:
            return qpos[:, self.address] - self.reference - self.coefficients[0], slope
        address, dof, reference = self.other
        moved = qpos[:, address] - reference
        slope[:, dof] = -polynomial.deriv()(moved)
        return qpos[:, self.address] - self.reference - polynomial(moved), slope


def joint_couplings(model: mujoco.MjModel) -> list[Coupling]:
    found = []
    for number in np.flatnonzero(model.eq_active0):
        if model.eq_type[number] != mujoco.mjtEq.mjEQ_JOINT:
            continue
        places = [
            (int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]), float(model.qpos0[model.jnt_qposadr[joint]]))
            for joint in (model.eq_obj1id[number], model.eq_obj2id[number])
            if joint >= 0
        ]
        found.append(Coupling(*places[0], places[1] if len(places) > 1 else None, model.eq_data[number, :5].copy()))
    return found
