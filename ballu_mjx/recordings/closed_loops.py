"""Closed loops of a model (`connect` and `joint` equalities) as measurements."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
from jaxtyping import Float

End = tuple[int, Float[np.ndarray, " 3"]]
"""Body id, and a position (m) in the body's frame."""


def closed_loops(model: mujoco.MjModel) -> list[tuple[End, End]]:
    """Return the pairs of points that active `connect` equalities hold together."""
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
    """A `joint` equality. One joint's deviation from its reference is a polynomial of another's, or constant."""

    address: int
    """Address of the first joint in qpos."""
    dof: int
    """Address of the first joint in qvel."""
    reference: float
    """Reference position (rad or m) of the first joint."""
    other: tuple[int, int, float] | None
    """Address, dof and reference of the other joint. None if the first joint is constant."""
    coefficients: Float[np.ndarray, " 5"]
    """Coefficients of the polynomial, the constant first."""

    def misfit(
        self, qpos: Float[np.ndarray, "N nq"], nv: int
    ) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N nv"]]:
        """Return the error (rad or m) of the equality in N poses, and its Jacobian."""
        jacobian = np.zeros((len(qpos), nv))
        jacobian[:, self.dof] = 1.0
        polynomial = np.polynomial.Polynomial(self.coefficients)
        if self.other is None:
            return qpos[:, self.address] - self.reference - self.coefficients[0], jacobian
        address, dof, reference = self.other
        moved = qpos[:, address] - reference
        jacobian[:, dof] = -polynomial.deriv()(moved)
        return qpos[:, self.address] - self.reference - polynomial(moved), jacobian


def joint_couplings(model: mujoco.MjModel) -> list[Coupling]:
    """Return the active `joint` equalities of a model."""
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
