# %% [markdown]
# # Why the air's search takes slopes over a step, not derivatives
#
# MJX can be differentiated: what a window of motion makes of a parameter's smallest change is known exactly. Is that of
# use to a search? Here the robot has lost 5 % of its lift, the model has not, and one recording of 20 s is to say so.
# For windows of half a second to two seconds: which way errors go by their derivative, and which way they go indeed
# over steps of a millinewton to all that was lost. The figure is the cost that the search sees, along the lift.
#
# `python experiments/air_slopes.py` takes about seven minutes on one core, most of them compiling; `--quick` takes the
# shortest windows alone.

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
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.window_errors import pseudo_huber
from ballu_mjx.residuals.aerodynamics_fit import AirConfig, AirWindows
from ballu_mjx.residuals.trained import TrainedResidual
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.sharding import shard_over_devices
from ballu_mjx.sim.simulator import Simulator

STEPS = (0.1e-3, 1e-3, 3e-3, 10e-3, 30e-3, 100e-3)
"""Of the lift (N)."""
LOSS = 0.05
"""Share of the lift that the robot has lost."""

# %% [markdown]
# ## Derivatives, and differences


# %%
def cosines(
    one: Float[np.ndarray, "windows entries"], other: Float[np.ndarray, "windows entries"]
) -> Float[np.ndarray, " windows"]:
    """Of the angle between two changes of each window's errors; 1: the same way, 0: nothing in common."""
    norms = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    return np.sum(one * other, axis=1) / np.maximum(norms, np.finfo(float).tiny)


@dataclasses.dataclass(frozen=True)
class Slopes:
    """At the old lift, for windows of one length; changes of errors per newton that is lost."""

    derivative: Float[np.ndarray, "windows entries"]
    differences: dict[float, Float[np.ndarray, "windows entries"]]
    """By the step (N)."""
    loss: Float[np.ndarray, "grid 2"]
    """Lift lost (N), and the softened cost there."""


def slopes(simulated: AirWindows, known: Float[np.ndarray, " parameters"], lift: int, lost: float) -> Slopes:
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
    parser = argparse.ArgumentParser(description="Derivatives and differences of windows of motion, by the lift.")
    parser.add_argument("--air", type=Path, required=True, help="run of `train aerodynamic`, before the loss")
    parser.add_argument("--output", type=Path, default=Path("runs/air-slopes"), help="folder of the table and figure")
    parser.add_argument("--quick", action="store_true", help="windows of half a second alone")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    options = parser.parse_args()

    known = TrainedResidual.load(options.air, load_robot())
    simulator = Simulator(load_robot(), known.actuators)
    model = simulator.mj_model
    full = virtual_robot.draw_robot(dataset.ROBOT_SEED)
    deflated = dataclasses.replace(full, buoyancy=full.buoyancy * (1 - LOSS))
    lost = deflation.lift(LOSS * full.buoyancy)
    gait = next(job for job in dataset.jobs() if job.split == "training")
    recorded = deflation.recorded(gait, deflated, 2000, options.output / "recordings")
    motions = [reconstruct(recorded, load_robot(), model)]
    # At a whole delay, where errors can be differentiated.
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
    print("How far errors change as their derivative says: median cosine over windows, by the size of the step\n")
    tables = {"slopes": Table(("window (s)", *columns), tuple(rows))}
    _setup.write_tables(tables, options.output, options.results, {"robot": [dataset.ROBOT_SEED]})
    print(f"\nWritten to {options.output}.")


if __name__ == "__main__":
    _setup.run(main)
