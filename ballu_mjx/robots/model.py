"""MJCF models and their fields.

Frames: world z up. SI units and radians.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array
from mujoco import mjx


@runtime_checkable
class ModelParameters(Protocol):
    """Parameters that change fields of a model, such as identified actuators."""

    def fields(self, model: mujoco.MjModel) -> dict[str, Array]:
        """Return the fields of `model` that carry the parameters, by name."""
        ...


def assets() -> Path:
    """Folder with the model and the bundled recordings, from a wheel or from a checkout."""
    packaged = Path(str(resources.files("ballu_mjx"))) / "assets"
    return packaged if packaged.is_dir() else packaged.parents[1] / "assets"


def load_model(file: Path, parameters: ModelParameters | None = None) -> mujoco.MjModel:
    """Return the model in an MJCF file, nominal or with identified parameters and the constants that follow.

    With identified dry friction the solver makes at least `FRICTION_ITERATIONS`.
    """
    model = mujoco.MjModel.from_xml_path(str(file))
    if parameters is not None:
        set_fields(model, parameters.fields(model))
        raise_iterations(model)
        # Contacts, limits and friction are as soft as the inertia matrix at the reference pose says.
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


FRICTION_ITERATIONS = 6
"""Each joint with dry friction is one more constraint that sticks or slips. BALLU's 3 iterations, enough without, leave
its base 3 mm off after 2 s (median of 16 walks; with 4 iterations 0.3 mm, with 6 0.02 mm)."""


def raise_iterations(model: mujoco.MjModel) -> None:
    """Let the solver make `FRICTION_ITERATIONS` or more where a model has dry friction, in place."""
    if np.any(model.dof_frictionloss > 0) or np.any(model.tendon_frictionloss > 0):
        model.opt.iterations = max(model.opt.iterations, FRICTION_ITERATIONS)


def bare_parameters(parameters: ModelParameters | None) -> ModelParameters | None:
    """Return the parameters in what may hold more, such as `adapter.IdentifiedActuators`."""
    return getattr(parameters, "parameters", parameters)


def same_parameters(one: ModelParameters | None, other: ModelParameters | None) -> bool:
    """Return whether two simulators have equal parameters (None: nominal)."""
    if one is None or other is None:
        return one is other
    if type(one) is not type(other):
        return False
    # By path: a parameter that is None in one of them has no leaf there.
    leaves, others = (dict(jax.tree_util.tree_leaves_with_path(each)) for each in (one, other))
    return leaves.keys() == others.keys() and all(
        np.array_equal(np.float32(leaf), np.float32(others[path])) for path, leaf in leaves.items()
    )


def with_fields(model: mjx.Model, fields: dict[str, Array]) -> mjx.Model:
    """`model` with `fields` in place of its own, in its own dtypes."""
    return model.replace(**{k: jnp.asarray(v, getattr(model, k).dtype) for k, v in fields.items()})  # pyright: ignore


def set_fields(model: mujoco.MjModel, fields: dict[str, Any]) -> None:
    """Write `fields` into a C model, in place."""
    for name, value in fields.items():
        getattr(model, name)[:] = np.asarray(value)
