"""MJCF models and their fields.

Frames: world z up. SI units and radians.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

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


CONTROL_TIMESTEP = 0.05
"""Seconds between two commands (20 Hz)."""


def assets() -> Path:
    """Folder with the model and the bundled recordings, from a wheel or from a checkout."""
    packaged = Path(str(resources.files("ballu_mjx"))) / "assets"
    return packaged if packaged.is_dir() else packaged.parents[1] / "assets"


def load_model(actuators: ModelParameters | None = None, file: Path | None = None) -> mujoco.MjModel:
    """The robot for C MuJoCo: the nominal one ("vanilla"), or with identified actuators ("vanilla+sysid").

    `file` is the MJCF of another one.
    """
    model = mujoco.MjModel.from_xml_path(str(file or assets() / "ballu.xml"))
    if actuators is not None:
        set_fields(model, actuators.fields(model))
    return model


def with_fields(model: mjx.Model, fields: dict[str, Array]) -> mjx.Model:
    """`model` with `fields` in place of its own, in its own dtypes."""
    return model.replace(**{k: jnp.asarray(v, getattr(model, k).dtype) for k, v in fields.items()})  # pyright: ignore


def set_fields(model: mujoco.MjModel, fields: dict[str, Any]) -> None:
    """Write `fields` into a C model, in place."""
    for name, value in fields.items():
        getattr(model, name)[:] = np.asarray(value)
