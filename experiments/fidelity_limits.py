# %% [markdown]
# # Lower limit of simulation errors, and cost of each simplification
#
# Every error of a simulator includes the error of its starting state. Motion capture measures positions to about half a
# millimetre, and reconstruction gives states to about a millimetre and a degree. Here, the virtual robot itself starts
# from reconstructed states, one second apart, with the commands and the draught of the recording. The angles of its
# motors are not recorded. They follow from the commands, after the robot's latency and backlash. Its error over 5 s is
# a lower limit for all simulators. Then one property at a time is changed to that of the training simulators: still
# air, long physics steps, or no joint friction. The increase of the error is the cost of this simplification.
#
# `python experiments/fidelity_limits.py` takes six minutes on two cores for the twelve recordings of the larger test
# set of `fidelity.py`. `--quick` uses two recordings.

# %%
from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import deflation
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, load_model
from ballu_mjx.ballu.virtual import dataset
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.ballu.virtual.robot import VirtualRobot
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.evaluation.open_loop import START_INTERVAL
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.recording_groups import group_of
from ballu_mjx.robots.registry import load_robot

HORIZON = 5.0
"""Horizon of the errors (s), from each start."""


# %% [markdown]
# ## Variants: one in each row


# %%
@dataclasses.dataclass(frozen=True)
class Variant:
    """Simulator that differs from the virtual robot in some properties."""

    label: str
    robot: tuple[str, ...] = ()
    """Fields of `VirtualRobot` that are set to 0, for both legs."""
    still: bool = False
    """Whether there is no draught."""
    timestep: float = 0.0
    """Physics time step (s), with the integrator and solver of the training simulator. 0 for the robot's own time step,
    integrator and solver."""
    iterations: int = 0
    """Maximum number of iterations of the solver and of its line search, if `timestep` is set. 0 for those of the
    training simulator."""
    fluid: bool = True
    """Whether drag and lift act on the balloons. Their added mass always does."""


FRICTION, PLAY = ("knee_friction", "motor_friction"), ("backlash",)
VARIANTS = (
    Variant("the robot itself"),
    Variant("in still air", still=True),
    Variant("physics steps of 2 ms", timestep=0.002),
    Variant("physics steps of 5 ms", timestep=0.005),
    Variant("physics steps of 10 ms, the training simulator's", timestep=0.01),
    Variant("the same, the solver run to its end", timestep=0.01, iterations=50),
    Variant("no dry friction", robot=FRICTION),
    Variant("no backlash", robot=PLAY),
    Variant("no drag and lift", fluid=False),
    Variant("still air, 10 ms", still=True, timestep=0.01),
    Variant("still air, 10 ms, no dry friction, no backlash", robot=FRICTION + PLAY, still=True, timestep=0.01),
    Variant("still air, 5 ms, no dry friction, no backlash", robot=FRICTION + PLAY, still=True, timestep=0.005),
)


def simulator(virtual: VirtualRobot, variant: Variant) -> mujoco.MjModel:
    """Return the MuJoCo model of a variant."""
    model = virtual_robot.build(virtual)
    if variant.timestep:
        training = load_model().opt
        model.opt.timestep, model.opt.integrator = variant.timestep, training.integrator
        model.opt.iterations = variant.iterations or training.iterations
        model.opt.ls_iterations = variant.iterations or training.ls_iterations
    if not variant.fluid:
        model.opt.density = model.opt.viscosity = 0.0
    return model


# %% [markdown]
# ## Errors from starts in every second of a recording


# %%
def seen(model: mujoco.MjModel, qpos: Float[np.ndarray, "states nq"]) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (m) and yaw angles (rad) of the balloon for generalized positions."""
    data, places, turns = mujoco.MjData(model), [], []
    for each in qpos:
        data.qpos[:] = each
        mujoco.mj_kinematics(model, data)
        places.append(data.site("balloon").xpos.copy())
        turns.append(data.body("balloon").xquat.copy())
    return np.array(places), Rotation.from_quat(np.array(turns), scalar_first=True).as_euler("ZYX")[:, 0]


def errors(virtual: VirtualRobot, job: dataset.Job) -> tuple[str, Float[np.ndarray, "variants 2"]]:
    """Record a job, and return the group of the recording and the errors of all variants on it.

    Errors are the RMSE of position (m) and yaw (deg) over the horizon, averaged over starts.
    """
    trial = virtual_robot.draw_trial(job.trial)
    with tempfile.TemporaryDirectory() as folder:
        recorded = deflation.recorded(job, virtual, job.trial, Path(folder))
    own = dataclasses.replace(
        virtual.actuators, delay=jnp.full(2, virtual.latency), backlash=jnp.asarray(virtual.backlash)
    )
    motion = reconstruct(recorded, load_robot(), load_model(own), drivetrain=own.drivetrain())
    steps, interval = (round(s / CONTROL_TIMESTEP) for s in (HORIZON, START_INTERVAL))
    starts = range(2, len(job.commands) - steps + 1, interval)
    nominal = load_model()
    place, turn = seen(nominal, motion.qpos)
    rows = []
    for variant in VARIANTS:
        legs = dataclasses.replace(virtual, **dict.fromkeys(variant.robot, (0.0, 0.0)))
        air = virtual_robot.still(trial) if variant.still else trial
        model, found = simulator(legs, variant), []
        for start in starts:
            state = motion.qpos[start], motion.qvel[start]
            ran = seen(nominal, virtual_robot.continue_trial(legs, air, job.commands, start, state, steps, model))
            after = slice(start + 1, start + steps + 1)
            away = np.sum((ran[0] - place[after]) ** 2, axis=1)
            turned = np.angle(np.exp(1j * (ran[1] - turn[after])))
            found.append([np.sqrt(np.mean(away)), np.rad2deg(np.sqrt(np.mean(turned**2)))])
        rows.append(np.mean(found, axis=0))
    return group_of(job.name), np.array(rows)


# %% [markdown]
# ## Table


# %%
def table(found: Sequence[tuple[str, Float[np.ndarray, "variants 2"]]]) -> Table:
    """Return the table of errors by variant and group, with one value for each recording.

    `found` holds the results of `errors` for all recordings.
    """
    groups = sorted({group for group, _ in found}, reverse=True)  # near before far
    columns = [f"{group}: {quantity}" for group in groups for quantity in ("position (mm)", "yaw (deg)")]
    rows = []
    for place, variant in enumerate(VARIANTS):
        cells: list[Cell] = []
        for group in groups:
            away, turned = np.transpose([rows[place] for of, rows in found if of == group]).tolist()
            cells += [Cell(tuple(1e3 * each for each in away), ".0f", spread=False)]
            cells += [Cell(tuple(turned), ".1f", spread=False)]
        rows.append((variant.label, *cells))
    return Table((f"{HORIZON:g} s", *columns), tuple(rows))


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Measure the lower limit of simulation errors, and the cost of each simplification."
    )
    parser.add_argument("--robot", type=int, default=dataset.ROBOT_SEED, help="seed of the virtual robot")
    parser.add_argument("--fresh", type=int, default=2026, help="seed of the test set, as in fidelity.py (2026)")
    parser.add_argument("--quick", action="store_true", help="use two recordings; the numbers mean little")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    options = _setup.parse(parser, Path("runs/fidelity-limits"))

    virtual = virtual_robot.draw_robot(options.robot)
    jobs = dataset.fresh_jobs(options.fresh, 1 if options.quick else 6)
    with multiprocessing.get_context("spawn").Pool() as pool:
        found = pool.starmap(errors, [(virtual, job) for job in jobs], chunksize=1)
    seeds = {"robot": [options.robot], "recording": [options.fresh]}
    _setup.write_tables({"limits": table(found)}, options.output, options.results, seeds)
    print(f"\n{len(jobs)} recordings. Written to {options.output}.")


if __name__ == "__main__":
    _setup.run(main)
