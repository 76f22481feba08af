"""Transfer of a policy: its trajectories in its simulator and on the robot, compared by the paper's figures.

The figures are those of the paper's section "Improved Sim-to-real Transfer": Table I (`fwd_walk`) for walking, Table II
(`left_turn`) for turning.
"""

from __future__ import annotations

import dataclasses
import json
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError, is_number
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.evaluation.seed_intervals import LEVEL, seed_means, t_interval

STRIDE = 1.0
"""Time (s) between the points from which the length of a path is computed."""

PAPER_WALKING: Mapping[str, tuple[float, float, float]] = {
    "vanilla+sysid": (2.01, 0.27, 1.24),
    "vanilla+dr": (1.24, 0.32, 0.60),
    "vanilla+sysid+dr": (1.07, 0.56, 0.94),
    "envmimic": (0.90, 1.12, 1.28),
}
"""Values of the paper's Table I, forward walking: mean CoM error, x-distance and total distance (m), by setting."""
PAPER_TURNING: Mapping[str, tuple[float, float, float]] = {
    "vanilla+sysid": (16.41, 0.20, 16.72),
    "vanilla+dr": (38.18, -0.04, -4.28),
    "vanilla+sysid+dr": (-8.50, 0.11, 39.77),
    "envmimic": (3.50, 0.29, 36.42),
}
"""Values of the paper's Table II, turning left: final yaw error (deg, signed), y-distance (m) and change of yaw (deg),
by setting."""


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """Trajectory of a simulated or real robot at the control rate. The starting state comes first."""

    com: Float[np.ndarray, "T 3"]
    """Position of the centre of mass (m, world frame)."""
    yaw: Float[np.ndarray, " T"]
    """Yaw of the tracked body (rad, world frame), not unwrapped."""
    steps: Int[np.ndarray, " T"]
    """Number of footsteps of a walking robot up to each state."""
    control_timestep: float
    """Time between two states (s)."""


@dataclasses.dataclass(frozen=True)
class Transfer:
    """Figures of one trial: a policy on the robot, compared with the same policy in simulation.

    Distances and changes of yaw are from the first state to the last, in the world frame.
    """

    com_error: float
    """Mean over time of the distance (m) between the centres of mass (paper, Table I, `(CoM_sim - CoM_hw) / T`)."""
    x_distance: float
    """Distance of the robot along x (m; paper, Table I)."""
    total_distance: float
    """Length of the robot's path (m; paper, Table I); see `path_length`."""
    y_distance: float
    """Distance of the robot along y (m; paper, Table II)."""
    yaw_error: float
    """Final yaw in simulation minus that of the robot (deg, signed; paper, Table II). Full turns count. In contrast,
    yaw errors in `errors` are wrapped to 180 deg."""
    yaw_change: float
    """Change of the robot's yaw (deg; paper, Table II). Full turns count."""
    sim_x_distance: float
    """Distance along x in simulation (m)."""
    sim_y_distance: float
    """Distance along y in simulation (m)."""
    sim_yaw_change: float
    """Change of yaw in simulation (deg). Full turns count."""
    steps: float
    """Number of footsteps of the robot."""
    sim_steps: float
    """Number of footsteps in simulation."""

    def to_json(self) -> dict[str, float]:
        """Return all figures by name."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> Transfer:
        """Return the trial from the figures that `to_json` returned.

        **Raises** `ValueError` if a figure is missing or is no number.
        """
        names = {field.name for field in dataclasses.fields(Transfer)}
        if values.keys() != names or not all(map(is_number, values.values())):
            raise ValueError(f"it needs {', '.join(sorted(names))}, each a number")
        return Transfer(**{name: float(value) for name, value in values.items()})


def write_transfer(path: pathlib.Path, transfers: Sequence[Transfer]) -> None:
    """Write trials to a JSON file."""
    files.write(path, json.dumps([each.to_json() for each in transfers], indent=2) + "\n")


def read_transfer(path: pathlib.Path) -> list[Transfer]:
    """Return the trials in a file that `write_transfer` wrote.

    **Raises** `InputError` if the file holds no valid trials.
    """
    fix = "delete its folder, and the trials will be made again"
    found = files.parse_json(files.read_text(path), str(path), fix)
    try:
        if isinstance(found, list) and found:
            return [Transfer.from_json(each) for each in found]
        problem = "holds no trials"
    except (ValueError, AttributeError) as error:
        problem = f"holds an invalid trial ({error})"
    raise InputError(f"{path}: {problem}; {fix}.")


def compare_trajectories(simulation: Trajectory, robot: Trajectory) -> Transfer:
    """Return the paper's figures for two trajectories, over the length of the shorter one.

    Both must start from (nearly) the same state. The trajectories are not aligned, so that an offset at the start
    counts as error. Only the difference of the starting yaws is wrapped to 180 deg.

    **Raises** `ValueError` if a trajectory has fewer than 2 states, or if its numbers of yaws, step counts and centres
    of mass differ.
    """
    for name, path in (("simulation", simulation), ("robot", robot)):
        for what, states in (("yaws", path.yaw), ("numbers of steps", path.steps)):
            if len(path.com) != len(states):
                raise ValueError(f"The {name} has {len(path.com)} centres of mass, but {len(states)} {what}.")
        if len(path.com) < 2:
            raise ValueError(f"The {name} has {len(path.com)} states; a trajectory needs 2 or more.")
    states = min(len(simulation.com), len(robot.com))
    sim_com, com = (path.com[:states].astype(np.float64) for path in (simulation, robot))
    sim_turn, turn = (np.rad2deg(_turn(path.yaw[:states])) for path in (simulation, robot))
    start = np.float64(simulation.yaw[0]) - np.float64(robot.yaw[0])
    sim_way, way = sim_com[-1] - sim_com[0], com[-1] - com[0]
    return Transfer(
        com_error=float(np.linalg.norm(sim_com - com, axis=1).mean()),
        x_distance=float(way[0]),
        total_distance=path_length(com, robot.control_timestep),
        y_distance=float(way[1]),
        yaw_error=float(np.rad2deg(np.arctan2(np.sin(start), np.cos(start))) + sim_turn - turn),
        yaw_change=float(turn),
        sim_x_distance=float(sim_way[0]),
        sim_y_distance=float(sim_way[1]),
        sim_yaw_change=float(sim_turn),
        steps=float(robot.steps[states - 1]),
        sim_steps=float(simulation.steps[states - 1]),
    )


def path_length(com: Float[np.ndarray, "T 3"], control_timestep: float) -> float:
    """Return the length (m) of the horizontal path of the centre of mass.

    The path is sampled every `STRIDE` seconds and at the end.

    A path through all states would be too long: the centre of mass of a walking robot sways within each step, and
    sensor noise adds length.
    """
    points = com[:: round(STRIDE / control_timestep), :2]
    points = np.concatenate([points, com[-1:, :2]])  # a repeated last point adds no length
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


class _Column(NamedTuple):
    title: str
    paper: str | None
    """Title of the column with the paper's numbers. None for a quantity that is not in the paper; these come last."""
    of: Callable[[Transfer], float]
    digits: int


_WALKING = (
    _Column("mean CoM error (m)", "paper", lambda t: t.com_error, 2),
    _Column("x-distance (m)", "paper", lambda t: t.x_distance, 2),
    _Column("total distance (m)", "paper", lambda t: t.total_distance, 2),
)
_TURNING = (
    _Column("abs. final yaw error (deg)", "paper (signed)", lambda t: abs(t.yaw_error), 1),
    _Column("y-distance (m)", "paper", lambda t: t.y_distance, 2),
    _Column("change of yaw (deg)", "paper", lambda t: t.yaw_change, 1),
    _Column("mean CoM error (m)", None, lambda t: t.com_error, 2),
    _Column("y-distance in simulation (m)", None, lambda t: t.sim_y_distance, 2),
)


def walking_table(results: Mapping[str, Sequence[Sequence[Transfer]]]) -> str:
    """Return Table I of `results[setting][seed][trial]` in Markdown, with `mean [low, high]` and the paper's number.

    The interval is over the means of seeds (`seed_intervals.t_interval`); a single seed has none. Rows have the order
    of `results`. Settings that are not in the paper show `-` for its numbers. The last column, which is not in the
    paper, shows whether the robot walks: mean and range of `gait.count_steps` over all trials, on the robot and in the
    policies' own simulators. The caption explains the brackets.
    """
    return _text(results, "walk")


def turning_table(results: Mapping[str, Sequence[Sequence[Transfer]]]) -> str:
    """Return Table II in Markdown, in the form of `walking_table`.

    The final yaw error is a mean of absolute values, because signed errors cancel. The paper's values are signed. The
    mean CoM error and the distance in simulation are not in the paper's table.
    """
    return _text(results, "turn")


def transfer_table(task: str, results: Mapping[str, Sequence[Sequence[Transfer]]]) -> Table:
    """Return the data of `walking_table` (task `walk`) or `turning_table` (task `turn`)."""
    columns, paper = {"walk": (_WALKING, PAPER_WALKING), "turn": (_TURNING, PAPER_TURNING)}[task]
    titles = ["setting", *(title for column in columns for title in (column.title, column.paper) if title)]
    rows = []
    for setting, seeds in results.items():
        cells: list[Cell | str] = [setting]
        for index, column in enumerate(columns):
            means = seed_means([[column.of(trial) for trial in trials] for trials in seeds])
            cells.append(Cell(tuple(means), f".{column.digits}f", bounds=t_interval(means).bounds))
            if column.paper is not None:
                cells.append(Cell((paper[setting][index],)) if setting in paper else "-")
        trials = [trial for trials in seeds for trial in trials]
        cells.append(f"{_range([each.steps for each in trials])}; {_range([each.sim_steps for each in trials])}")
        rows.append(tuple(cells))
    return Table((*titles, "steps; in simulation"), tuple(rows))


def _text(results: Mapping[str, Sequence[Sequence[Transfer]]], task: str) -> str:
    return f"{transfer_table(task, results).to_markdown()}\n\n{_caption(results)}"


def _caption(results: Mapping[str, Sequence[Sequence[Transfer]]]) -> str:
    seeds = {len(each) for each in results.values()}
    if seeds == {1}:
        return "One seed a setting: no interval, and no ranking."
    count = f"{min(seeds)} to {max(seeds)}" if len(seeds) > 1 else f"{max(seeds)}"
    return (
        f"Means over {count} seeds, each the mean of its trials. Brackets are {LEVEL:.0%} confidence intervals over "
        "seeds (Student's t); a single seed has none."
    )


def _range(values: Sequence[float]) -> str:
    mean, low, high = (round(float(f(values))) for f in (np.mean, np.min, np.max))
    return str(mean) if low == high else f"{mean} ({low} to {high})"


def _turn(yaw: Float[np.ndarray, " T"]) -> float:
    """Return the change of yaw (rad) from the first state to the last, full turns included."""
    unwrapped = np.unwrap(yaw.astype(np.float64))
    return float(unwrapped[-1] - unwrapped[0])
