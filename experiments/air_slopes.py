# %% [markdown]
# # Finite differences or derivatives for the fit of the air
#
# MJX is differentiable, so that the exact derivative of a window's errors with respect to a parameter is available.
# This experiment tests whether this derivative helps a search. The robot has lost 5 % of its lift, but the model has
# not, and the loss is to be found from one recording of 20 s. For windows of 0.5 to 2 s, the table compares the
# direction of the derivative with that of finite differences, for steps from 0.1 to 100 mN. The figure shows the cost
# of the search along the lift.
#
# `python experiments/air_slopes.py` takes about seven minutes on one core, most of it compilation. `--quick` uses only
# the shortest windows.

# %%
from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import deflation
import jax
import matplotlib.pyplot as plt
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ballu_mjx.ballu.virtual import dataset
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.recordings.motion_windows import MotionWindows
from ballu_mjx.recordings.reconstruct import reconstruct_for_simulator
from ballu_mjx.recordings.window_errors import pseudo_huber
from ballu_mjx.residuals.aerodynamics_fit import AirConfig, AirWindows
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.sharding import shard_over_devices
from ballu_mjx.sim.simulator import Simulator

STEPS = (0.1e-3, 1e-3, 3e-3, 10e-3, 30e-3, 100e-3)
"""Steps of the finite differences in lift (N)."""
LOSS = 0.05
"""Fraction of the lift that the robot has lost."""

# %% [markdown]
# ## Derivatives and finite differences


# %%
def cosines(
    one: Float[np.ndarray, "windows entries"], other: Float[np.ndarray, "windows entries"]
) -> Float[np.ndarray, " windows"]:
    """Return the cosine of the angle between two changes of each window's errors (1: same direction, 0: orthogonal)."""
    norms = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    return np.sum(one * other, axis=1) / np.maximum(norms, np.finfo(float).tiny)


@dataclasses.dataclass(frozen=True)
class Slopes:
    """Changes of the errors per newton of lost lift, at the old lift, for windows of one length."""

    derivative: Float[np.ndarray, "windows entries"]
    """Derivative of the errors (1/N)."""
    differences: dict[float, Float[np.ndarray, "windows entries"]]
    """Finite differences of the errors (1/N), by step (N)."""
    loss: Float[np.ndarray, "grid 2"]
    """Lost lift (N), and the robust cost there."""


def slopes(simulated: AirWindows, known: Float[np.ndarray, " parameters"], lift: int, lost: float) -> Slopes:
    """Return derivative, finite differences and cost of the windows along the lift.

    **Arguments**

    - `known`: vector of the air's parameters before the loss.
    - `lift`: index of the lift in it.
    - `lost`: lift that the robot has lost (N), which sets the range of the cost's grid.
    """

    def cost(errors: np.ndarray) -> float:
        return float(np.sum(pseudo_huber(np.sum(errors**2, axis=1)))) / 2

    def at(less: float) -> np.ndarray:
        vector = known.copy()
        vector[lift] -= less
        return simulated.errors(vector)

    def along(vector: Array, direction: Array, window: MotionWindows) -> Array:
        return jax.jvp(lambda vector: simulated.simulate(vector, window), (vector,), (direction,))[1]

    direction = np.zeros_like(known, np.float32)
    direction[lift] = -1.0
    derivative = shard_over_devices(along, shared=2)(np.float32(known), direction, simulated.windows)
    grid = np.linspace(-0.2 * lost, 1.6 * lost, 37)
    return Slopes(
        derivative=np.asarray(derivative, np.float64),
        differences={step: (at(step) - at(0.0)) / step for step in STEPS},
        loss=np.stack([grid, [cost(at(less)) for less in grid]], axis=1),
    )


# %% [markdown]
# ## Table and figure


# %%
def main() -> None:
    parser = argparse.ArgumentParser(
        description="Compare derivatives and finite differences of windows of motion with respect to the lift."
    )
    parser.add_argument("--air", type=Path, required=True, help="folder of a `train aerodynamic` run before the loss")
    parser.add_argument("--quick", action="store_true", help="use only windows of 0.5 s")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    options = _setup.parse(parser, Path("runs/air-slopes"))

    known = TrainedResidual.load(options.air, load_robot())
    simulator = Simulator(load_robot(), known.actuators)
    model = simulator.mj_model
    full = virtual_robot.draw_robot(dataset.ROBOT_SEED)
    deflated = dataclasses.replace(full, buoyancy=full.buoyancy * (1 - LOSS))
    lost = deflation.lift(LOSS * full.buoyancy)
    gait = next(job for job in dataset.jobs() if job.split == "training")
    recorded = deflation.recorded(gait, deflated, 2000, options.output / "recordings")
    motions = [reconstruct_for_simulator(recorded, simulator)]
    # A delay of whole physics steps, at which the errors are differentiable.
    timestep = float(model.opt.timestep)
    delay = np.round(float(known.params.delay) / timestep) * timestep
    vector, unravel = ravel_pytree(dataclasses.replace(known.params, delay=jax.numpy.float32(delay)))
    lift = int(unravel(jax.numpy.arange(len(vector), dtype=vector.dtype)).lift)

    columns = (*(f"{step * 1e3:g} mN" for step in STEPS), "length, of that over 30 mN")
    rows = []
    lengths = (0.5,) if options.quick else (0.5, 1.0, 2.0)
    figure, axes = plt.subplots(1, len(lengths), figsize=(3.6 * len(lengths), 3.2), layout="constrained", squeeze=False)
    for length, axis in zip(lengths, axes[0], strict=True):
        config = AirConfig(window_seconds=length, interval_seconds=1.0)
        found = slopes(AirWindows(simulator, motions, config), np.asarray(vector, np.float64), lift, lost)
        same = [float(np.median(cosines(found.derivative, found.differences[step]))) for step in STEPS]
        smooth = np.linalg.norm(found.differences[30e-3], axis=1)
        ratio = np.median(np.linalg.norm(found.derivative, axis=1) / smooth)
        rows.append((Cell((length,), "g"), *(Cell((cosine,)) for cosine in same), Cell((float(ratio),), ".1f")))
        axis.plot(found.loss[:, 0] * 1e3, found.loss[:, 1], color="0.2")
        axis.axvline(lost * 1e3, color="0.6", linestyle=":", label="truth")
        axis.set_title(f"windows of {length:g} s")
        axis.set_xlabel("lift lost (mN)")
    axes[0, 0].set_ylabel("cost")
    axes[0, 0].legend(frameon=False)
    figure.savefig(options.output / "cost.png", dpi=150)
    plt.close(figure)
    print("Agreement of derivative and finite differences: median cosine over windows, by the size of the step\n")
    tables = {"slopes": Table(("window (s)", *columns), tuple(rows))}
    _setup.write_tables(tables, options.output, options.results, {"robot": [dataset.ROBOT_SEED]})
    print(f"\nWritten to {options.output}.")


if __name__ == "__main__":
    _setup.run(main)
