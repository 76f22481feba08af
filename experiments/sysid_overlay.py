# %% [markdown]
# # Effect of identified actuators on the simulation
#
# This experiment repeats a check in the paper's section "Actuator System Identification". The same periodic bang-bang
# commands are simulated with nominal and with identified actuators. In the paper, the final centres of mass are 0.23 m
# apart, and joint angles differ by 10.15 deg on average. Here, the identified actuators are the bundled
# `actuators.json`, and several gaits are simulated. A figure shows both robots at the end of one gait.
#
# `python experiments/sysid_overlay.py` takes seconds, because it needs only C MuJoCo.

# %%
from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import mujoco
import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ballu_mjx.ballu.actuators_file import read_actuators
from ballu_mjx.ballu.model import KNEES, MOTORS, SIDES, load_model, standing_qpos
from ballu_mjx.identification.actuators import ACTUATORS_FILE
from ballu_mjx.robots.model import assets
from ballu_mjx.viz.style import colour_of, label_of

PERIODS = (0.8, 1.0, 1.2, 1.4, 1.6)
"""Periods of the commands (s). The legs are half a period apart, each at full command for 0.4 of the period."""
SECONDS = 10.0
"""Length of a simulation (s)."""

# %% [markdown]
# ## Simulation of the same commands in both simulators


# %%
def simulate(
    model: mujoco.MjModel, period: float
) -> tuple[Float[np.ndarray, "steps 3"], Float[np.ndarray, "steps nq"]]:
    """Simulate 2 s of standing, then the commands; return centre of mass (m, world frame) and generalized positions.

    They are given at every physics step after the standing.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    mujoco.mj_step(model, data, round(2.0 / model.opt.timestep))
    com, qpos = [], []
    for step in range(round(SECONDS / model.opt.timestep)):
        phases = (step * model.opt.timestep / period + np.array([0.0, 0.5])) % 1.0
        data.ctrl[:] = phases < 0.4
        mujoco.mj_step(model, data)
        com.append(data.subtree_com[1].copy())
        qpos.append(data.qpos.copy())
    return np.array(com), np.array(qpos)


def compare(models: dict[str, mujoco.MjModel]) -> str:
    """Return lines with the differences between the two simulators, by period and on average."""
    lines = ["period (s)  final CoM (m)  knees and motors (deg)"]
    rows = []
    for period in PERIODS:
        (com, qpos), (other_com, other_qpos) = (simulate(model, period) for model in models.values())
        joints = np.concatenate([np.arange(7, qpos.shape[1])[part] for part in (KNEES, MOTORS)])
        start, other_start = com[0], other_com[0]
        apart = np.linalg.norm((com[-1] - start) - (other_com[-1] - other_start))
        angles = np.rad2deg(np.abs(qpos[:, joints] - other_qpos[:, joints])).mean()
        rows.append((apart, angles))
        lines.append(f"{period:10.1f}{apart:15.2f}{angles:24.1f}")
    apart, angles = np.mean(rows, axis=0)
    lines.append(f"{'mean':>10}{apart:15.2f}{angles:24.1f}    (paper: 0.23 m, 10.15 deg)")
    return "\n".join(lines)


# %% [markdown]
# ## Figure of both robots from the side
#
# A stick drawing needs no renderer.


# %%
def draw(models: dict[str, mujoco.MjModel], period: float, path: Path) -> None:
    """Draw both robots at the end, seen from the side, and the paths of the centres of mass, seen from above."""
    figure = Figure(figsize=(10.0, 5.0), layout="constrained")
    side, above = figure.subplots(1, 2, width_ratios=[1, 2])
    for name, model in models.items():
        com, qpos = simulate(model, period)
        data = mujoco.MjData(model)
        data.qpos[:] = qpos[-1]
        mujoco.mj_kinematics(model, data)
        colour = colour_of(name)
        for leg, style in zip(SIDES, ("-", "--"), strict=True):
            points = [data.body("base").xpos, data.body(f"tibia_{leg}").xpos, data.site(f"foot_{leg}").xpos]
            label = f"{label_of(name)}, {leg} leg"
            side.plot(*np.array(points)[:, [0, 2]].T, style, color=colour, linewidth=2, marker="o", label=label)
        neck, balloon = data.body("base").xpos, data.site("balloon").xpos
        side.plot(*np.array([neck, balloon])[:, [0, 2]].T, ":", color=colour)
        side.plot(balloon[0], balloon[2], "o", markersize=22, color=colour, alpha=0.3)
        above.plot(*(com - com[0])[:, :2].T, color=colour, label=label_of(name))
    side.axhline(0, color="grey", linewidth=0.8)
    for axis, title, second in ((side, f"after {SECONDS:g} s, from the side", "z (m)"), (above, "from above", "y (m)")):
        axis.set(title=title, xlabel="x (m)", ylabel=second)
        axis.grid(alpha=0.3)
    side.set_aspect("equal")
    figure.legend(*side.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=120)


# %% [markdown]
# ## Run


# %%
def main() -> None:
    parser = argparse.ArgumentParser(description="Simulate the same commands with nominal and identified actuators.")
    bundled = assets() / "recordings" / ACTUATORS_FILE
    parser.add_argument(
        "--actuators", type=Path, default=bundled, help="file of identified actuators (the bundled one)"
    )
    parser.add_argument("--output", type=Path, default=Path("sysid_overlay.png"), help="figure to write")
    options = parser.parse_args()
    _, identified = read_actuators(options.actuators)
    models = {"vanilla": load_model(), "vanilla+sysid": load_model(identified)}
    print(compare(models))
    draw(models, PERIODS[2], options.output)
    print(f"Written to {options.output}.")


if __name__ == "__main__":
    _setup.run(main)
