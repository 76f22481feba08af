# %% [markdown]
# # A quadrotor in wind: forces learned from recorded flights
#
# A quadrotor flies a figure of eight in front of a wall of fans (Caltech). The data belong to O'Connell, Shi et al.,
# Neural-Fly enables rapid learning for agile flight in strong winds, Science Robotics 7(66), 2022,
# doi:10.1126/scirobotics.abm6597. They are public: `aerorobotics/neural-fly` on GitHub, commit `0ed5024`,
# `data/experiment/custom_figure8_METHOD_WIND.csv`.
#
# The data are "for personal and educational use only", and "written permission from the authors is required for further
# use" (README of their repository). This project therefore has neither the data nor results on them. Download the files
# yourself, and check that your use is permitted.
#
# The files have 50 Hz. The controllers (METHOD) differ between flights. WIND is `nowind` (0 m/s), `35wind` (4.2 m/s),
# `70wind` (8.5 m/s), `70p20sint` (8.5 + 2.4 sin t m/s) or `100wind` (12.1 m/s).
#
# | use | controllers | winds (m/s) |
# | --- | --- | --- |
# | training | baseline, indi, L1 | 0, 4.2, 8.5 |
# | validation | NF-C | 0, 4.2, 8.5 |
# | test, near | NF, NF-T | 0, 4.2, 8.5 |
# | test, far | all six | 12.1, and 8.5 + 2.4 sin t |
#
# Commands are the set points that were sent to the flight controller: thrust, in multiples of the hover thrust, and
# attitude. They come from feedback, and are replayed open loop. The drone is a double integrator, so errors grow with
# the square of time. The model has no air. Residuals can detect the wind only through the attitude that holds the drone
# against it.
#
# A steady wind exerts nearly the same force all the time. Two baselines are therefore constant forces in the room: the
# best one for the training flights, and the best one for each test flight. The second one uses the test flight itself.
# A residual that is better has learned more than a mean force.
#
# Run `python experiments/real/quadrotor/quadrotor.py --data FOLDER`. `--quick` is a short trial run.

# %%
from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path("experiments/real/quadrotor") if "ipykernel" in sys.modules else Path(__file__).parent
sys.path[1:1] = [str(FOLDER.parent), str(FOLDER.parents[1])]

import _setup

_setup.prepare()

import argparse
import csv
import io
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import _public
import numpy as np
from _constant_wrench import ConstantWrench
from _networks import learn_network
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import Table
from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator, Replay
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.residuals.fluid_fit import FluidConfig
from ballu_mjx.residuals.fluid_training import fit_fluid
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.runs.progress import PhaseProgress
from ballu_mjx.sim.simulator import Simulator

HORIZONS = (1.0, 2.0, 5.0)
"""Horizons of the errors (s)."""
WINDS = {
    "nowind": "0 m/s",
    "35wind": "4.2 m/s",
    "70wind": "8.5 m/s",
    "100wind": "12.1 m/s",
    "70p20sint": "8.5 + 2.4 sin t m/s",
}
"""Speeds of the wind, by its name in the files' names."""
NEAR_WINDS, FAR_WINDS = ("nowind", "35wind", "70wind"), ("100wind", "70p20sint")


class Flight(NamedTuple):
    """A flight of the data set."""

    method: str
    """The controller."""
    wind: str
    """The wind, a key of `WINDS`."""

    @property
    def file(self) -> str:
        """Name of its public file."""
        return f"custom_figure8_{self.method}_{self.wind}.csv"

    @property
    def name(self) -> str:
        """Name of its recording. The part before the first hyphen, the wind, is its group."""
        return f"{self.wind}-{self.method}"


def flights(methods: Iterable[str], winds: Iterable[str]) -> tuple[Flight, ...]:
    """Return the flights with all pairs of a controller and a wind."""
    return tuple(Flight(*pair) for pair in itertools.product(methods, winds))


FLIGHTS: Mapping[str, tuple[Flight, ...]] = {
    "training": flights(("baseline", "indi", "L1"), NEAR_WINDS),
    "validation": flights(("NF-C",), NEAR_WINDS),
    "near": flights(("NF", "NF-T"), NEAR_WINDS),
    "far": flights(("baseline", "indi", "L1", "NF-C", "NF-T", "NF"), FAR_WINDS),
}
"""Flights by use. `near` and `far` are for the test."""
TEST = ("near", "far")
WIDTHS = {"t": 1, "p": 3, "q": 4, "T_sp": 1, "q_sp": 4, "hover_throttle": 1}
"""Columns of the public files that are used, and how many numbers a cell has."""
DECIMALS = 7
"""Decimals of positions in the converted recordings (m)."""

# %% [markdown]
# ## Conversion
#
# Recordings have the columns `drone_x` to `drone_z` (position `p`, m; z is up), `drone_qw` to `drone_qz` (attitude `q`,
# which the files write as x, y, z, w), `command_thrust` (`T_sp / hover_throttle`), and `command_roll`, `command_pitch`
# and `command_yaw` (the angles of `q_sp`, rad, intrinsic rotations about z, y and x). Numbers are kept as they are.


# %%
def convert(path: Path, name: str) -> Recording:
    """Return a flight of the public data as a recording.

    **Raises** `InputError` if the file lacks a column, has no rows, or has a cell without the expected numbers.
    """
    columns = read_columns(path)
    hover = columns["hover_throttle"]
    for column in ("q", "q_sp"):
        length = np.linalg.norm(columns[column], axis=1)
        if not np.allclose(length, 1, atol=0.02):
            row = int(np.argmax(np.abs(length - 1)))
            raise InputError(
                f"{path}, column {column}, row {row + 2}: the quaternion has length {length[row]:.3g} instead of 1; "
                "give a file of the public data set."
            )
    if (hover <= 0).any():
        raise InputError(
            f"{path}, column hover_throttle, row {int(np.argmax(hover <= 0)) + 2}: the throttle must be greater than "
            "0; give a file of the public data set."
        )
    yaw, pitch, roll = np.unwrap(Rotation.from_quat(columns["q_sp"]).as_euler("ZYX"), axis=0).T
    return Recording(
        name=name,
        kind="free",
        robot="Neural-Fly custom quadrotor",
        notes=f"aerorobotics/neural-fly data/experiment/{path.name}, personal and educational use only",
        time=columns["t"][:, 0],
        command=np.column_stack([columns["T_sp"] / hover, roll, pitch, yaw]),
        tracked_position=columns["p"],
        tracked_quaternion=columns["q"][:, [3, 0, 1, 2]],
    )


def read_columns(path: Path) -> dict[str, Float[np.ndarray, "rows _"]]:
    """Return the columns of a public file that are used.

    **Raises** `InputError` with the place in the file, as `convert` does.
    """
    reader = csv.reader(io.StringIO(_public.read_text(path), newline=""))
    header = next(reader, [])
    missing = [column for column in WIDTHS if column not in header]
    if missing:
        lacking = "no column" if len(missing) == 1 else "no columns"
        raise InputError(f"{path}: there is {lacking} {', '.join(missing)}; give a file of the public data set.")
    found: dict[str, list[np.ndarray]] = {column: [] for column in WIDTHS}
    places = {column: header.index(column) for column in WIDTHS}
    for number, cells in enumerate(reader, 2):
        for column, place in places.items():
            cell = cells[place] if place < len(cells) else ""
            numbers = parse_cell(cell)
            if numbers.shape != (WIDTHS[column],) or not np.isfinite(numbers).all():
                wanted = "a finite number" if WIDTHS[column] == 1 else f"a list of {WIDTHS[column]} finite numbers"
                raise InputError(
                    f"{path}, column {column}, row {number}: {cell[:40]!r} is not {wanted}; download the file again."
                )
            found[column].append(numbers)
    if not found["t"]:
        raise InputError(f"{path}: there is no row below the header; download the file again.")
    return {column: np.stack(values) for column, values in found.items()}


def parse_cell(cell: str) -> Float[np.ndarray, ...]:
    """Return the numbers of a cell, which is a number or a list in brackets. Other cells give an empty array."""
    try:
        return np.atleast_1d(np.asarray(json.loads(cell), float))
    except (ValueError, TypeError):
        return np.zeros(0)


def load(data: Path, chosen: Sequence[Flight], robot: RobotDescription, made: Path) -> list[Motion]:
    """Return the reconstructed motions of flights. Recordings are written to `made` if `data` has public files.

    **Raises** `InputError` from `_public.recordings_of` and `convert`.
    """
    sources = {flight.name: flight.file for flight in chosen}
    folder = _public.recordings_of(data, made, sources, convert, robot, decimals=DECIMALS)
    return [reconstruct(read_recording(folder / f"{name}.csv.gz", robot), robot) for name in sources]


# %% [markdown]
# ## Constant forces
#
# The servos hold the attitude, so a force at the centre of mass moves the drone without turning it. The displacement is
# then linear in the force, and four replays determine the best one.


# %%
FIT_SECONDS = 2.0
"""Length of the simulations to which a constant force is fitted (s)."""


def fit_constant_force(evaluator: OpenLoopEvaluator) -> Float[np.ndarray, " 6"]:
    """Return parameters of the `ConstantWrench` without torque that explains the evaluator's motions best."""
    without, *pushed = (evaluator.replay(wrench(axis)).position for axis in (None, 0, 1, 2))
    most = round(FIT_SECONDS / evaluator.robot.control_timestep)
    effects, missing = [], []
    for run in range(len(evaluator.starts)):
        recorded, _ = evaluator.recorded(run)
        steps = slice(1, min(most + 1, len(recorded)))
        missing.append((recorded[steps] - without[run, steps]).ravel())
        effects.append(np.stack([(each[run, steps] - without[run, steps]).ravel() for each in pushed], axis=1))
    force = np.linalg.lstsq(np.concatenate(effects), np.concatenate(missing), rcond=None)[0]
    return np.concatenate([force, np.zeros(3)]).astype(np.float32)


def wrench(axis: int | None) -> Float[np.ndarray, " 6"]:
    """Return a wrench with a force of 1 N along an axis. None for no force."""
    return np.zeros(6, np.float32) if axis is None else np.eye(6, dtype=np.float32)[axis]


# %% [markdown]
# ## Residuals


# %%
def learn(
    method: str,
    simulator: Simulator,
    training: Sequence[Motion],
    validation: Sequence[Motion],
    seed: int,
    *,
    quick: bool,
) -> TrainedResidual:
    """Learn a residual by a method of `METHODS`. `quick` learns for seconds."""
    if method != "fluid":
        return learn_network(method, simulator, training, validation, "force", seed, quick=quick)
    # Wind adds energy to the drone, so the forces must not be passive.
    config = FluidConfig(passive=False, window_seconds=(0.5, 2.0), windows=150)
    if quick:
        config = FluidConfig(passive=False, terms="linear", window_seconds=(0.5,), windows=10, steps=2)
    return fit_fluid(simulator, training, validation, config, progress=PhaseProgress())


METHODS = {"supervised": "supervised", "fluid": "fluid, `--no-passive`", "envmimic": "EnvMimic, force"}
"""Rows of the tables, by method."""

# %% [markdown]
# ## Errors


# %%
Ends = dict[str, Float[np.ndarray, "starts horizons"]]
"""Position errors (m) at the end of each horizon, by flight. NaN beyond the flight's end, infinite if diverged."""


def end_errors(evaluator: OpenLoopEvaluator, replay: Replay) -> Ends:
    """Return the position errors of a replay at the end of each horizon."""
    found: dict[str, list[list[float]]] = {}
    for run, (number, _) in enumerate(evaluator.starts):
        position, _ = evaluator.recorded(run)
        errors = []
        for horizon in HORIZONS:
            steps = round(horizon / evaluator.robot.control_timestep)
            error = np.inf
            if steps >= len(position):
                error = np.nan
            elif np.isfinite(replay.position[run, steps]).all():
                error = float(np.linalg.norm(replay.position[run, steps] - position[steps]))
            errors.append(error)
        found.setdefault(evaluator.motions[number].name, []).append(errors)
    return {name: np.array(errors) for name, errors in found.items()}


def cell(ends: Ends, names: Iterable[str]) -> str:
    """Return the root mean square errors (m) of some flights at all horizons, as text."""
    errors = np.concatenate([np.zeros((0, len(HORIZONS))), *(ends[name] for name in names if name in ends)])
    numbers = []
    for each in errors.T:
        kept = each[np.isfinite(each)]
        numbers.append(f"{np.sqrt(np.mean(kept**2)):.2f}" if len(kept) else "-")
    diverged = int(np.isinf(errors).any(axis=1).sum())
    return ", ".join(numbers) + (f" ({diverged} of {len(errors)} diverged)" if diverged else "")


def tables(rows: Mapping[str, Ends]) -> dict[str, Table]:
    """Return tables of position errors by test group and by wind; `rows[method]` holds the errors."""
    seconds = ", ".join(f"{horizon:g}" for horizon in HORIZONS)
    groups = {group: [flight.name for flight in FLIGHTS[group]] for group in TEST}
    tested = [flight for group in TEST for flight in FLIGHTS[group]]
    winds = {speed: [each.name for each in tested if each.wind == wind] for wind, speed in WINDS.items()}
    return {
        title: Table(
            (f"position (m) after {seconds} s", *columns),
            tuple((method, *(cell(ends, names) for names in columns.values())) for method, ends in rows.items()),
        )
        for title, columns in (("groups", groups), ("winds", winds))
    }


# %% [markdown]
# ## Run


# %%
def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Learn the forces of wind on a real quadrotor, and predict flights.")
    parser.add_argument("--data", type=Path, required=True, help="folder with the public files, or with recordings")
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=list(METHODS), help="methods (all)")
    parser.add_argument("--seed", type=int, default=0, help="training seed (0)")
    parser.add_argument("--quick", action="store_true", help="few flights and steps; the numbers mean little")
    options = _setup.parse(parser, Path("runs/quadrotor"), arguments)
    robot = read_description(FOLDER / "quadrotor.robot.json")
    few = slice(0, 2) if options.quick else slice(None)
    motions = {
        use: load(options.data, chosen[few], robot, options.output / "recordings" / use)
        for use, chosen in FLIGHTS.items()
    }
    simulator = Simulator(robot)
    test = [motion for group in TEST for motion in motions[group]]
    constant = OpenLoopEvaluator(simulator, motions["training"], ConstantWrench(anchored=True))
    mean = fit_constant_force(constant)
    print(f"Best constant force for the training flights: {np.round(mean[:3], 3).tolist()} N", flush=True)
    on_test = constant.on(test)
    rows = {
        "vanilla": end_errors(on_test, on_test.replay(wrench(None))),
        "constant force": end_errors(on_test, on_test.replay(mean)),
    }
    for method in options.methods:
        found = learn(method, simulator, motions["training"], motions["validation"], options.seed, quick=options.quick)
        if found.report:
            print(f"\n{METHODS[method]}\n{found.report}\n", flush=True)
        evaluator = OpenLoopEvaluator(simulator, test, found.model)
        rows[METHODS[method]] = end_errors(evaluator, evaluator.replay(found.params))
    rows["constant force of each flight"] = {}
    for motion in test:
        own = constant.on([motion])
        rows["constant force of each flight"] |= end_errors(own, own.replay(fit_constant_force(own)))
    _setup.write_tables(tables(rows), options.output, None, {})


if __name__ == "__main__":
    _setup.run(main)
