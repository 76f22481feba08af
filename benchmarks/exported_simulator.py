"""Measure the difference between an exported simulator in C MuJoCo and ours.

`python benchmarks/exported_simulator.py --case RUN FOLDER --case RUN FOLDER`

Three simulators start from the first state of each recording and replay its commands: ours in single precision, ours in
double precision, and the exported one. Their differences separate errors of the export from rounding in single
precision. Positions are those of the tracked site, angles those of its body.
"""

from __future__ import annotations

import argparse
import functools
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ballu_mjx.common import runtime

runtime.prepare()

import jax
import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import Cell, Table, write_results
from ballu_mjx.policies.load_simulator import load_simulator
from ballu_mjx.recordings.csv_format import list_recordings, read_recording
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.residuals.deploy.export import export_simulator, in_double, rollout_positions
from ballu_mjx.residuals.deploy.residual import ImprovedSimulator
from ballu_mjx.sim.c_model import improved_model, site_poses
from ballu_mjx.sim.simulator import AugmentedSimulator
from ballu_mjx.viz.style import label_of

PAIRS = (("exported", "double"), ("exported", "single"), ("single", "double"))
"""Pairs of simulators to compare."""
Poses = tuple[Float[np.ndarray, "runs steps 3"], Float[np.ndarray, "runs steps 4"]]
"""Positions (m) and quaternions of the tracked site."""


def rollouts(
    simulator: AugmentedSimulator,
    qpos: Float[np.ndarray, "runs nq"],
    qvel: Float[np.ndarray, "runs nv"],
    commands: Float[np.ndarray, "runs steps commands"],
) -> Float[np.ndarray, "runs steps nq"]:
    """Return generalized positions after each control step, in JAX's current precision."""

    run = jax.jit(jax.vmap(functools.partial(rollout_positions, simulator)))
    return np.asarray(run(qpos, qvel, commands))


def in_c(folder: Path, qpos: np.ndarray, qvel: np.ndarray, commands: np.ndarray) -> Float[np.ndarray, "runs steps nq"]:
    """Return generalized positions after each control step of the exported simulator."""
    simulator, runs = ImprovedSimulator(folder), []
    for start, speed, sent in zip(qpos, qvel, commands, strict=True):
        simulator.reset(start, speed, sent[0])
        runs.append([simulator.step(command).qpos.copy() for command in sent])
    return np.array(runs)


def apart(one: Poses, other: Poses) -> tuple[Float[np.ndarray, "runs steps"], Float[np.ndarray, "runs steps"]]:
    """Return distances (mm) and angles (deg) between the poses of two simulators."""
    distance = 1000 * np.linalg.norm(one[0] - other[0], axis=-1)
    # Use the sine of half the angle, because the cosine loses all digits for small angles.
    w, v = one[1][..., :1], one[1][..., 1:]
    turned = w * other[1][..., 1:] - other[1][..., :1] * v - np.cross(v, other[1][..., 1:])
    return distance, 2 * np.rad2deg(np.arcsin(np.minimum(np.linalg.norm(turned, axis=-1), 1.0)))


class Case(NamedTuple):
    """Differences between the simulators of a run, at the end of each rollout.

    **Fields**

    - `label`: robot and residual.
    - `recordings`: names of the recordings.
    - `apart`: distances (mm) and angles (deg), by pair of simulators.
    """

    label: str
    recordings: list[str]
    apart: dict[tuple[str, str], tuple[np.ndarray, np.ndarray]]


def measure(run: Path, recordings: Sequence[Path], count: int, seconds: float) -> Case:
    """Return the differences between a run's simulators after `seconds`, from the starts of `count` recordings.

    **Raises** `InputError` if no recording is long enough.
    """
    simulator = load_simulator(run)
    robot = simulator.robot
    steps = round(seconds / robot.control_timestep)
    motions = []
    for path in list_recordings(recordings):
        if len(motions) < count:
            motion = reconstruct(read_recording(path, robot), robot)
            motions += [motion] if len(motion.command) >= steps else []
    if not motions:
        raise InputError(f"No recording is {seconds:g} s long; give longer ones, or a smaller --seconds.")
    qpos, qvel = (np.stack([getattr(motion, name)[0] for motion in motions]) for name in ("qpos", "qvel"))
    commands = np.stack([motion.command[:steps] for motion in motions])
    model = improved_model(simulator)
    with tempfile.TemporaryDirectory() as folder:
        exported = export_simulator(simulator, Path(folder) / "simulator", check_seconds=0.0)
        found = {"exported": in_c(exported.folder, qpos, qvel, commands)}
    single = [np.asarray(x, np.float32) for x in (qpos, qvel, commands)]
    found["single"] = rollouts(simulator, *single)
    with jax.enable_x64(True):
        found["double"] = rollouts(in_double(simulator, model), qpos, qvel, commands)
    seen = {name: site_poses(model, robot.tracked, each) for name, each in found.items()}
    differences = {(one, other): apart(seen[one], seen[other]) for one, other in PAIRS}
    ends = {pair: (distance[:, -1], angle[:, -1]) for pair, (distance, angle) in differences.items()}
    residual = "" if simulator.residual is None else f", {label_of(simulator.residual.model.name)}"
    return Case(f"{robot.name}{residual}", [motion.name for motion in motions], ends)


def cases_table(cases: Sequence[Case]) -> Table:
    """Return the median and largest differences of the exported simulator over the recordings, one row per run."""
    columns = ["robot, residual", "recordings"]
    pairs = [pair for pair in PAIRS if "exported" in pair]
    for _, other in pairs:
        columns += [f"ours in {other} precision: median (mm)", "worst (mm)", "worst (deg)"]
    rows = []
    for case in cases:
        row: list[Cell | str] = [case.label, Cell((len(case.recordings),), "g")]
        for pair in pairs:
            distance, angle = case.apart[pair]
            row += [Cell((float(x),), ".1g") for x in (np.median(distance), distance.max(), angle.max())]
        rows.append(tuple(row))
    return Table(tuple(columns), tuple(rows))


def recordings_table(cases: Sequence[Case]) -> Table:
    """Return the differences for every recording."""
    columns = ["robot, residual", "recording"]
    for one, other in PAIRS:
        columns += [f"{one} - {other} (mm)", "(deg)"]
    rows = []
    for case in cases:
        for number, recording in enumerate(case.recordings):
            values = [float(each[number]) for pair in PAIRS for each in case.apart[pair]]
            rows.append((case.label, recording, *(Cell((value,), ".1g") for value in values)))
    return Table(tuple(columns), tuple(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--case",
        type=Path,
        nargs="+",
        action="append",
        required=True,
        metavar="PATH",
        help="a run of a residual, of identified actuators or of a policy, then recordings or folders of recordings",
    )
    parser.add_argument("--count", type=int, default=10, help="number of recordings to use (10)")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of a rollout (s, default 5)")
    parser.add_argument("--results", type=Path, help="JSON file for the tables; by default they are only printed")
    options = parser.parse_args()
    if any(len(case) < 2 for case in options.case):
        raise InputError("--case needs a run and its recordings; give both.")
    cases = [measure(run, recordings, options.count, options.seconds) for run, *recordings in options.case]
    tables = {"cases": cases_table(cases), "recordings": recordings_table(cases)}
    for table in tables.values():
        print(table.to_markdown(), end="\n\n")
    if options.results is not None:
        write_results(options.results, tables, f"Differences after {options.seconds:g} s")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
