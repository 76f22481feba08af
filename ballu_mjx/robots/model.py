"""MJCF models and their fields.

The world frame has z up. Units are SI, and angles are in radians.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Int
from mujoco import mjx


@runtime_checkable
class ModelParameters(Protocol):
    """Parameters that change fields of a model, such as identified actuators."""

    def fields(self, model: mujoco.MjModel) -> dict[str, Array]:
        """Return the fields of `model` that carry the parameters, by name."""
        ...


def assets() -> Path:
    """Return the folder of the bundled models and recordings, in a wheel or in a checkout."""
    packaged = Path(str(resources.files("ballu_mjx"))) / "assets"
    return packaged if packaged.is_dir() else packaged.parents[1] / "assets"


def load_model(file: Path, parameters: ModelParameters | None = None) -> mujoco.MjModel:
    """Load the model in an MJCF file, nominal or with identified parameters.

    With parameters, the constants that MuJoCo derives from masses and inertias are computed again. If the model then
    has dry friction, its solver makes at least `FRICTION_ITERATIONS`.

    Every body's centre of mass and principal axes can be changed. MuJoCo compiles some bodies as simple: a free body
    without others, for example. It stores only the diagonal of their inertia matrix, and refuses to move their inertial
    frame. MJX takes over this structure without a word. The loaded model has no such bodies.
    """
    model = mujoco.MjModel.from_xml_path(str(file))
    if has_simple_bodies(model):
        spec = mujoco.MjSpec.from_file(str(file))
        for body in spec.bodies:
            body.simple = 0
        model = spec.compile()
    if parameters is not None:
        fields = parameters.fields(model)
        set_fields(model, fields)
        raise_iterations(model)
        # The softness of contacts, joint limits and friction depends on the inertia matrix at the reference pose.
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def has_simple_bodies(model: mujoco.MjModel) -> bool:
    """Return whether MuJoCo stores only the diagonal of a body's inertia matrix (`load_model`)."""
    return bool(np.any(model.body_simple[1:]))


FRICTION_ITERATIONS = 6
"""Smallest number of solver iterations for a model with dry friction.

Each joint with dry friction adds a constraint that sticks or slips. BALLU's 3 iterations suffice without dry friction.
With it they leave an error of 3 mm in its base's position after 2 s (median of 16 walks). The error is 0.3 mm with 4
iterations and 0.02 mm with 6."""


def raise_iterations(model: mujoco.MjModel) -> None:
    """Raise the solver's iterations to at least `FRICTION_ITERATIONS` if the model has dry friction, in place."""
    if np.any(model.dof_frictionloss > 0) or np.any(model.tendon_frictionloss > 0):
        model.opt.iterations = max(model.opt.iterations, FRICTION_ITERATIONS)


def bare_parameters(parameters: ModelParameters | None) -> ModelParameters | None:
    """Return the parameters inside a container such as `adapter.IdentifiedActuators`, or bare parameters unchanged."""
    return getattr(parameters, "parameters", parameters)


def same_parameters(one: ModelParameters | None, other: ModelParameters | None) -> bool:
    """Return whether two simulators have equal parameters, in single precision (None: nominal)."""
    if one is None or other is None:
        return one is other
    if type(one) is not type(other):
        return False
    # Leaves are compared by path, because a parameter that is None has no leaf.
    leaves, others = (dict(jax.tree_util.tree_leaves_with_path(each)) for each in (one, other))
    return leaves.keys() == others.keys() and all(
        np.array_equal(np.float32(leaf), np.float32(others[path])) for path, leaf in leaves.items()
    )


def colliding_geoms(model: mujoco.MjModel) -> Int[np.ndarray, " colliding"]:
    """Return the ids of the geoms that may touch others, including those of the world."""
    return np.flatnonzero((model.geom_contype != 0) | (model.geom_conaffinity != 0))


def with_fields(model: mjx.Model, fields: dict[str, Array]) -> mjx.Model:
    """Return `model` with the given fields replaced, in the model's dtypes."""
    return model.replace(**{k: jnp.asarray(v, getattr(model, k).dtype) for k, v in fields.items()})  # pyright: ignore


def set_fields(model: mujoco.MjModel, fields: dict[str, Any]) -> None:
    """Write `fields` into a C model, in place."""
    for name, value in fields.items():
        getattr(model, name)[:] = np.asarray(value)
