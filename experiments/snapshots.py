# %% [markdown]
# # Snapshots of the robot under policies without and with residual physics
#
# This experiment repeats the last two figures of the paper's section "Improved Sim-to-real Transfer". They are
# photographs of one trial of a policy on the robot, walking forward (at 0, 5, 11, 16 and 24 s) and turning left (at 0,
# 4, 10, 18 and 22 s). The policy in the top row was trained with identified actuators and domain randomization. The
# policy in the bottom row was also trained with EnvMimic's forces. In the paper, the first policy turns away, and the
# second walks twice as far.
#
# Here, recordings of the virtual robot replace the photographs. Each recording is reconstructed into states of the
# model, and the model is drawn from a fixed viewpoint, so that all pictures of a task have the same scale.
#
# `python experiments/snapshots.py` needs the trials of `python -m ballu_mjx.train all` (or of
# `experiments/transfer_tables.py`, which runs it). Drawing takes a minute.

# %%
from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.append("experiments")  # a notebook runs in the repository's root

import _setup

_setup.prepare()

import mujoco
import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import proj3d
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, SIDES, load_model
from ballu_mjx.common.errors import InputError
from ballu_mjx.policies import pipeline_layout
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.viz.style import colour_of, label_of

TIMES = {"walk": (0.0, 5.0, 11.0, 16.0, 24.0), "turn": (0.0, 4.0, 10.0, 18.0, 22.0)}
"""Times of the paper's pictures (s), by task."""
PAPER_SIMULATORS = ("vanilla+sysid+dr", "envmimic")
"""Rows, from top to bottom."""
COLOURS = {"left": "#1f77b4", "right": "#d64d1f", "frame": "#26262b", "balloon": "#b9bdc6"}
"""Colours by part. The legs have the colours of the model."""
VIEW = {"walk": (14.0, -72.0), "turn": (14.0, -38.0)}
"""Elevation and azimuth of the camera (deg), by task. Walking goes to the right, turning to the back."""

WIDTH, HEIGHT = 4.0, 3.6
"""Largest size of a picture (inches)."""
TOP = 1.5
"""Height (m) that the balloons do not exceed."""

# %% [markdown]
# ## States of one trial
#
# Inverse kinematics on the recorded markers gives the model's pose at every control step. The path is that of the
# centre of mass. The yaw is that of the balloons, unwrapped.


# %%
@dataclasses.dataclass(frozen=True)
class Shown:
    """Trial on the robot, reconstructed."""

    setting: str
    qpos: Float[np.ndarray, "states nq"]
    com: Float[np.ndarray, "states 3"]
    """Position of the centre of mass (m, world frame)."""
    yaw: Float[np.ndarray, " states"]
    """Yaw of the balloons (rad, world frame), unwrapped."""

    def state(self, time: float) -> int:
        """Return the index of the state nearest to `time` (s).

        `time` may be a little later than the last state, because a recording loses its last samples.
        """
        return min(round(time / CONTROL_TIMESTEP), len(self.qpos) - 1)


def read_trial(run: Path, task: str, setting: str, seed: int, trial: int, until: float) -> Shown:
    """Read and reconstruct a trial in the folder `run` of `train all`.

    **Raises** `InputError` if it does not exist, or ends before `until` (s).
    """
    path = run / f"seed-{seed}" / f"trials-{task}-{setting}" / f"trial-{trial}.csv.gz"
    if not path.exists():
        raise InputError(
            f"{path}: there is no such trial; make it with `python -m ballu_mjx.train all --output {run} --tasks "
            f"{task} --seeds {seed}`, or select another trial by --run, --tasks, --settings, --seed and --trial."
        )
    model = load_model()
    motion = reconstruct(read_recording(path, load_robot()), load_robot(), model)
    if motion.time[-1] < until - 0.5:
        raise InputError(f"{path}: ends at {motion.time[-1]:.1f} s, before {until:g} s; give earlier --times.")
    data = mujoco.MjData(model)
    com, yaw = [], []
    for state in motion.qpos:
        place(model, data, state)
        com.append(data.subtree_com[1].copy())
        yaw.append(np.arctan2(data.body("balloon").xmat[3], data.body("balloon").xmat[0]))
    return Shown(setting, motion.qpos, np.array(com), np.unwrap(yaw))


def place(model: mujoco.MjModel, data: mujoco.MjData, qpos: Float[np.ndarray, " nq"]) -> None:
    """Set `data` to the generalized positions `qpos`, and compute what drawing needs."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)


# %% [markdown]
# ## Drawing, with sticks for the legs and the model's ellipsoids for the balloons


# %%
def draw_robot(axis: Axes3D, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Draw the robot in the state of `data`, and a shadow of the balloons on the floor, which shows its position."""
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        surface = ellipsoid(data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom])
        axis.plot_surface(
            *surface, color=COLOURS["balloon"], alpha=0.22, linewidth=0, rcount=14, ccount=22, shade=True, zorder=3
        )
        angle = np.linspace(0, 2 * np.pi, 40)
        x, y = data.geom_xpos[geom, :2, None] + model.geom_size[geom, 0] * np.array([np.cos(angle), np.sin(angle)])
        shadow = Poly3DCollection([np.column_stack([x, y, np.zeros(len(angle))])], facecolor="black", alpha=0.05)
        axis.add_collection3d(shadow)
        shadow.set_zorder(1)
    hips = [data.body(f"femur_{side}").xpos for side in SIDES]
    stick(axis, hips, COLOURS["frame"], 3.0)
    stick(axis, [data.site("base").xpos, data.site("balloon").xpos], COLOURS["frame"], 0.9)
    for side, hip in zip(SIDES, hips, strict=True):
        foot = data.site(f"foot_{side}").xpos
        stick(axis, [hip, data.body(f"tibia_{side}").xpos, foot], COLOURS[side], 2.2)
        axis.plot(*foot[:, None], "o", color=COLOURS[side], markersize=3.5, zorder=6)


def stick(axis: Axes3D, points: Sequence[Float[np.ndarray, " 3"]], colour: str, width: float) -> None:
    """Draw a line through `points`, with round ends."""
    axis.plot(*np.array(points).T, color=colour, linewidth=width, solid_capstyle="round", zorder=5)


def ellipsoid(
    centre: Float[np.ndarray, " 3"], rotation: Float[np.ndarray, "3 3"], radii: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "3 n m"]:
    """Return points (m) on the surface of an ellipsoid, on a grid of longitude and latitude."""
    longitude, latitude = np.meshgrid(np.linspace(0, 2 * np.pi, 23), np.linspace(0, np.pi, 15))
    sphere = [np.cos(longitude) * np.sin(latitude), np.sin(longitude) * np.sin(latitude), np.cos(latitude)]
    return centre[:, None, None] + np.einsum("ij,jnm->inm", rotation * radii, np.array(sphere))


def draw(trials: Sequence[Shown], times: Sequence[float], view: tuple[float, float], path: Path) -> None:
    """Draw a figure with a row for each trial and a column for each time.

    The path up to this time has the setting's colour, and the whole path is grey. Titles give x, y and yaw relative to
    the start, as in the paper's tables.
    """
    model = load_model()
    data = mujoco.MjData(model)
    low, high = limits(trials, times)
    corners = [(x, y, 0.0) for x in (low[0], high[0]) for y in (low[1], high[1])]
    balloons = [trial.com[trial.state(time)] * (1, 1, 0) + (0, 0, TOP) for trial in trials for time in times]
    left, right, bottom, top = extent(low, high, view, np.array(corners + balloons))
    side = min(WIDTH / (right - left), HEIGHT / (top - bottom))
    cell = np.array([max(side * (right - left), 2.6) + 0.1, side * (top - bottom) + 0.7])
    size = cell * (len(times), len(trials)) + (0.4, 0.1)
    figure = Figure(figsize=(size[0], size[1]))
    for row, trial in enumerate(trials):
        corner = np.array([0.4, size[1] - cell[1] * (row + 1)])
        label, colour = label_of(trial.setting), colour_of(trial.setting)
        middle = (corner[1] + (cell[1] - 0.5) / 2) / size[1]
        figure.text(
            0.2 / size[0], middle, label, rotation=90, ha="center", va="center", color=colour, size=13, weight="bold"
        )
        for column, time in enumerate(times):
            centre = corner + (cell[0] * (column + 0.5), (cell[1] - 0.5) / 2)
            origin = (centre - side * np.array([left + right, bottom + top]) / 2) / size
            axis = figure.add_axes((*origin, *(side / size)), projection="3d")
            assert isinstance(axis, Axes3D)
            state = trial.state(time)
            place(model, data, trial.qpos[state])
            stage(axis, low, high, view)
            floor = np.column_stack([trial.com[:, :2], np.zeros(len(trial.com))])
            axis.plot(*floor.T, color="grey", linewidth=0.8, alpha=0.6, zorder=2)
            axis.plot(*floor[: state + 1].T, color=colour, linewidth=1.8, zorder=2)
            draw_robot(axis, model, data)
            x, y, _ = trial.com[state] - trial.com[0]
            turned = np.rad2deg(trial.yaw[state] - trial.yaw[0])
            title = f"t = {time:g} s\nx {x:.2f} m, y {y:.2f} m, yaw {turned:.0f} deg"
            place_x, place_y = np.array([centre[0], corner[1] + cell[1] - 0.08]) / size
            figure.text(place_x, place_y, title, ha="center", va="top", size=9.5)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=120)


def extent(
    low: Float[np.ndarray, " 3"],
    high: Float[np.ndarray, " 3"],
    view: tuple[float, float],
    points: Float[np.ndarray, "n 3"],
) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top of `points` in the picture of the stage from `low` to `high`.

    The unit is the side of the square axes.
    """
    figure = Figure(figsize=(1.0, 1.0))
    axis = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d")
    assert isinstance(axis, Axes3D)
    stage(axis, low, high, view)
    xs, ys, zs = points.T
    x, y, _ = proj3d.proj_transform(xs, ys, zs, axis.get_proj())
    seen = axis.transData.transform(np.column_stack([x, y])) / axis.bbox.width
    return seen[:, 0].min(), seen[:, 0].max(), seen[:, 1].min(), seen[:, 1].max()


def limits(trials: Sequence[Shown], times: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return two corners (m) of a box on the floor that contains all paths, with a margin for the robot."""
    ways = np.concatenate([trial.com[: trial.state(max(times)) + 1, :2] for trial in trials])
    margin = 0.35  # half a robot's width
    low, high = np.floor(10 * (ways.min(axis=0) - margin)) / 10, np.ceil(10 * (ways.max(axis=0) + margin)) / 10
    return np.array([*low, 0.0]), np.array([*high, TOP])


def stage(axis: Axes3D, low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"], view: tuple[float, float]) -> None:
    """Draw the floor with a grid of 0.5 m, seen from `view` (deg), with the same scale along all axes."""
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    # The zoom is so small that nothing is cut off at the edges. (Pyright infers int for zoom from its default.)
    axis.set_box_aspect(tuple(high - low), zoom=0.85)  # pyright: ignore[reportArgumentType]
    axis.view_init(*view)
    axis.set_proj_type("persp", focal_length=1.0)
    axis.set_axis_off()
    axis.patch.set_visible(False)  # it would hide neighbouring pictures
    axis.computed_zorder = False
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]], [low[0], low[1]]])
    axis.plot(*corners.T, 0.0, color="grey", linewidth=0.8, zorder=0)
    for coordinate in range(2):
        for value in np.arange(np.ceil(2 * low[coordinate]) / 2, high[coordinate], 0.5):
            line = np.zeros((2, 3))
            line[:, coordinate] = value
            line[:, 1 - coordinate] = low[1 - coordinate], high[1 - coordinate]
            strong = abs(value) < 1e-9
            axis.plot(*line.T, color="grey", linewidth=0.8 if strong else 0.5, alpha=0.9 if strong else 0.4, zorder=0)


# %% [markdown]
# ## Run


# %%
def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Draw the paper's snapshots, from a finished folder of `train all`.")
    parser.add_argument("--run", type=Path, default=Path("runs/all"), help="folder of `train all` (runs/all)")
    parser.add_argument(
        "--tasks", nargs="+", choices=list(TIMES), default=list(TIMES), help="tasks, with a figure for each (both)"
    )
    parser.add_argument(
        "--settings",
        nargs="+",
        choices=pipeline_layout.PAPER_SIMULATORS,
        default=list(PAPER_SIMULATORS),
        help="training simulators, with a row for each (the paper's two)",
    )
    parser.add_argument("--seed", type=int, default=0, help="training seed (0)")
    parser.add_argument("--trial", type=int, default=1, help="number of the trial, from 1 (1)")
    parser.add_argument("--times", type=float, nargs="+", help="times (s), with a column for each (the paper's)")
    parser.add_argument("--output", type=Path, help="folder for snapshots_TASK.png (the folder of --run)")
    return parser.parse_args()


def main() -> None:
    options = parse()
    if options.times and min(options.times) < 0:
        raise InputError(f"--times contains {min(options.times):g}; give seconds from the start, 0 or more.")
    folder = options.output or options.run
    for task in options.tasks:
        times = options.times or TIMES[task]
        trials = [
            read_trial(options.run, task, setting, options.seed, options.trial, max(times))
            for setting in options.settings
        ]
        folder.mkdir(parents=True, exist_ok=True)
        draw(trials, times, VIEW[task], folder / f"snapshots_{task}.png")
        print(f"Written to {folder / f'snapshots_{task}.png'}.")


if __name__ == "__main__":
    _setup.run(main)
