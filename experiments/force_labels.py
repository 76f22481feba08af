# %% [markdown]
# # Accuracy of force labels and of the networks that learn them
#
# The paper's supervised baseline fits a network to the force that explains each recorded control step. The virtual
# robot shows how accurate these forces are, because its true states are known. The trials of the validation recordings
# are repeated with true states instead of motion capture. The forces that explain the *true* states are the reference
# for labels and networks.
#
# `python experiments/force_labels.py RUN [RUN ...]` takes two minutes. The runs are of
# `train supervised --force-shares 1` on the bundled recordings, one for each seed. The table is in docs/fidelity.md,
# beside the open-loop errors with these networks.

# %%
from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import collect_runs
import jax
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.model import CONTROL_TIMESTEP
from ballu_mjx.ballu.virtual import dataset
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.recordings.csv_format import Split, list_bundled, read_recording
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct_for_simulator
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.residuals.force_regression import ForceLabeller, SupervisedConfig
from ballu_mjx.residuals.force_training import resolve_joint_spreads
from ballu_mjx.residuals.network import NetworkResidual
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.runs.folder import read_config, typed_config
from ballu_mjx.sim.linearize import Linearizer
from ballu_mjx.sim.observation import HISTORY, commands_seen
from ballu_mjx.sim.simulator import Simulator

# %% [markdown]
# ## The same trials with true states

# %%
SEEN_WELL = {"position_noise": 2e-5, "angle_noise": 0.01, "held_angle_noise": 0.01}
"""Options of `SupervisedConfig` for true states, which have no motion-capture noise."""


def reconstruct_split(split: Split, simulator: Simulator) -> dict[str, Motion]:
    """Return the reconstructed motions of a split of the bundled recordings, by name."""
    recordings = [read_recording(path, simulator.robot) for path in list_bundled(split)]
    return {recording.name: reconstruct_for_simulator(recording, simulator) for recording in recordings}


def twin(job: dataset.Job) -> Motion:
    """Return the true motion of the virtual robot in the trial of a job, at the control rate."""
    steps = len(job.commands)
    qpos, qvel = virtual_robot.record_truth(
        virtual_robot.draw_robot(dataset.ROBOT_SEED),
        virtual_robot.draw_trial(job.trial),
        virtual_robot.open_loop(job.commands),
        steps * CONTROL_TIMESTEP,
    )
    every = round(CONTROL_TIMESTEP / virtual_robot.CAPTURE_TIMESTEP)
    time = np.arange(steps + 1) * CONTROL_TIMESTEP
    return Motion(job.name, time, job.commands, qpos[::every], qvel[::every], {})


# %% [markdown]
# ## Errors of labels and networks


# %%
def forces(simulator: Simulator, residual: TrainedResidual, motion: Motion) -> Float[np.ndarray, "steps 3"]:
    """Return the forces (N, world frame) of a residual along a motion, from the first state with a full history on."""
    reference, _ = stack_motions(simulator, [motion])

    def at(time: jax.Array) -> jax.Array:
        history = jax.lax.dynamic_slice_in_dim(reference.features[0], time - HISTORY + 1, HISTORY)
        return residual.bound.act(history, commands_seen(reference.command[0], time)).wrench[0, :3]

    return np.asarray(jax.jit(jax.vmap(at))(np.arange(HISTORY - 1, len(motion.command))))


GROUPS = ("near", "far")


def rms(values: np.ndarray) -> float:
    """Return the root mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))


def cells(found: Sequence[Mapping[str, np.ndarray]], true: Mapping[str, np.ndarray]) -> list[Cell]:
    """Return the RMS errors of forces relative to the RMS of the true ones, by group: all axes together, then each.

    Cells have one value for each element of `found`, which holds forces by motion.
    """

    def off(forces: Mapping[str, np.ndarray], group: str, axes: slice) -> float:
        ours, exact = (
            np.concatenate([force[:, axes] for motion, force in each.items() if motion.startswith(group)])
            for each in (forces, true)
        )
        return rms(ours - exact) / rms(exact)

    parts = (slice(None), *(slice(i, i + 1) for i in range(3)))
    return [Cell(tuple(off(forces, group, axes) for forces in found)) for group in GROUPS for axes in parts]


def figure(shown: dict[str, np.ndarray], title: str, path: Path, seconds: float = 6.0) -> None:
    """Draw forces along the three axes over time."""
    styles = {"true": ("black", 1.6), "label": ("#e69f00", 1.0), "network": ("#56b4e9", 1.6)}
    whole, axes = plt.subplots(3, 1, figsize=(8, 6.4), sharex=True, layout="constrained")
    count = round(seconds / CONTROL_TIMESTEP)
    for axis, ax in enumerate(axes):
        for name, force in shown.items():
            color, width = styles[name]
            time = (np.arange(len(force)) + HISTORY - 1) * CONTROL_TIMESTEP
            ax.plot(time[:count], 1e3 * force[:count, axis], color=color, linewidth=width, label=name)
        ax.set_ylabel(f"force along {'xyz'[axis]} (mN)")
        ax.grid(alpha=0.3)
    axes[0].set_title(title)
    whole.legend(*axes[0].get_legend_handles_labels(), ncols=3, loc="outside lower center")
    axes[-1].set_xlabel("time (s)")
    whole.savefig(path, dpi=130)
    plt.close(whole)


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the accuracy of force labels and of supervised networks.")
    parser.add_argument("runs", type=Path, nargs="+", help="folders of `train supervised` runs with different seeds")
    parser.add_argument("--output", type=Path, default=Path("runs/force_labels"), help="folder of table and figure")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    arguments = parser.parse_args()
    networks = [TrainedResidual.load(folder, load_robot()) for folder in arguments.runs]
    seeds = [collect_runs.seed_of(read_config(folder, "supervised")) for folder in arguments.runs]
    first = networks[0]
    robot = load_robot()
    config = typed_config(SupervisedConfig, read_config(arguments.runs[0], "supervised"), "fit", arguments.runs[0])
    simulator = Simulator(robot, first.actuators)
    linearize = Linearizer(simulator, joints=robot.joints)
    known = reconstruct_split("training", simulator)
    assert isinstance(first.model, NetworkResidual)
    env = first.model.config
    config = resolve_joint_spreads(config, env.forces, simulator, list(known.values()))
    label = ForceLabeller(linearize, config, env)
    label_well = ForceLabeller(linearize, dataclasses.replace(config, **SEEN_WELL), env)

    seen = reconstruct_split("validation", simulator)
    true, labels, twins = {}, {}, {}
    for job in dataset.jobs():
        if job.split == "validation":
            twins[job.name] = twin(job)
            true[job.name] = label_well(twins[job.name])[HISTORY - 1 :]
            labels[job.name] = label(seen[job.name])[HISTORY - 1 :]
            print(f"{job.name}: true forces {1e3 * rms(true[job.name]):.0f} mN (RMS along an axis)", flush=True)
    found = [{name: forces(simulator, network, motion) for name, motion in twins.items()} for network in networks]
    columns = [f"{group}{axis}" for group in GROUPS for axis in ("", ": x", ": y", ": z")]
    rows = (
        ("labels from motion capture", *cells([labels], true)),
        ("network from true states", *cells(found, true)),
    )
    table = Table(("error over that of no force", *columns), rows)
    arguments.output.mkdir(parents=True, exist_ok=True)
    shown = next(iter(true))
    series = {"true": true[shown], "label": labels[shown], "network": found[0][shown]}
    figure(series, f"{shown}: the force that explains each control step", arguments.output / "force_labels.png")
    _setup.write_tables({"forces": table}, arguments.output, arguments.results, {"training": seeds})
    print(f"\nWritten to {arguments.output}.")


if __name__ == "__main__":
    _setup.run(main)
