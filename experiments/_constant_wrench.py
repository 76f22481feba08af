"""Baseline for residuals: the constant force and torque that explain recordings best."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import optimize

from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.motion_windows import cut_motion_windows, simulate_motion_window
from ballu_mjx.recordings.window_errors import fill_diverged
from ballu_mjx.sim.observation import ObservationLayout, world_rotation
from ballu_mjx.sim.residual import Action, BoundResidual, Commands, History, Residual
from ballu_mjx.sim.simulator import Simulator

WINDOW = 2.0
"""Length of the windows of the fit (s)."""


class ConstantWrench(Residual):
    """Residual with a constant force (N) and torque (N m) on the tracked body. Its parameters are these six numbers.

    They are constant in the world frame for an anchored robot, and in the heading frame for other robots.
    """

    def __init__(self, *, anchored: bool) -> None:
        self._anchored = anchored

    @property
    def name(self) -> str:
        """Return the name of a simulator with this residual."""
        return "constant wrench"

    def inputs(self, history: History, commands: Commands) -> Float[Array, " inputs"]:
        """Return the latest features. The wrench does not depend on them, but the interface needs an input."""
        del commands
        return history[-1]

    def act(self, params: Any, history: History, commands: Commands, key: Array | None = None) -> Action:
        """Return the wrench in the world frame."""
        del commands, key
        turn = world_rotation(history[-1, ObservationLayout.yaw], self._anchored)
        return Action((params.reshape(2, 3) @ turn.T).reshape(1, 6))


def fit_constant_wrench(
    simulator: Simulator, motions: Sequence[Motion]
) -> tuple[ConstantWrench, Float[np.ndarray, " 6"]]:
    """Fit the constant wrench by least squares through the simulation of windows of the motions.

    Return the residual and its parameters.

    **Raises** `InputError` if no motion is as long as a window.
    """
    model = ConstantWrench(anchored=simulator.robot.anchored)
    windows = cut_motion_windows(simulator, motions, WINDOW, WINDOW)

    def errors(params: Array) -> Array:
        improved = simulator.with_residual(BoundResidual(model, params))
        return jax.vmap(lambda window: simulate_motion_window(improved, window).ravel())(windows)

    values, jacobian = jax.jit(errors), jax.jit(jax.jacfwd(errors))
    found = optimize.least_squares(
        lambda x: fill_diverged(np.asarray(values(jnp.asarray(x, jnp.float32)), np.float64)).ravel(),
        np.zeros(6),
        lambda x: np.nan_to_num(np.asarray(jacobian(jnp.asarray(x, jnp.float32)), np.float64)).reshape(-1, 6),  # pyright: ignore[reportArgumentType]
        loss="soft_l1",
        x_scale="jac",
    )
    return model, np.asarray(found.x)
