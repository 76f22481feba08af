"""The bundled data set, recorded on the virtual robot, and larger random test sets of the same family.

The training set has ten hand-designed gaits of 20 s: bang-bang commands with different period, phase, duty and
asymmetry. Two of them are recorded three times, in different draughts. The validation and the test set have two near
and two far recordings each. Near recordings are gaits of the same family, with parameters between those of training.
Far recordings have commands unlike any gait. There is also one suspended sweep.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu.gaits import Gait, hopping, one_legged, telegraph, waves
from ballu_mjx.ballu.model import CONTROL_TIMESTEP
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.ballu.virtual.hardware import Hardware
from ballu_mjx.recordings.csv_format import write_recording
from ballu_mjx.robots.registry import load_robot

ROBOT_SEED = 0
"""Seed of the virtual robot of the bundled recordings."""
DECIMALS = 4
"""Decimals of positions. Quaternions have one fewer. Rounding by at most a tenth of the noise keeps the set at 2 MB."""
SECONDS = {"training": 20.0, "validation": 25.0, "test": 25.0}
"""Length (s) of recordings. Validation and test recordings are 5 s longer, which gives five starts for a horizon of
20 s. A single start would depend too much on chance."""

TRAINING = (
    Gait(0.70, 0.50, (0.40, 0.40), (1.00, 1.00)),
    Gait(0.90, 0.50, (0.35, 0.35), (0.90, 0.90)),
    Gait(1.10, 0.20, (0.45, 0.45), (0.80, 0.80)),
    Gait(1.30, 0.50, (0.40, 0.40), (1.00, 1.00)),
    Gait(1.60, 0.30, (0.30, 0.30), (0.80, 0.80)),
    Gait(1.90, 0.70, (0.45, 0.45), (0.70, 0.70)),
    Gait(1.00, 0.40, (0.40, 0.60), (1.00, 0.50)),
    Gait(1.20, 0.60, (0.60, 0.35), (0.50, 1.00)),
    Gait(1.50, 0.45, (0.35, 0.45), (0.90, 0.80)),
    Gait(0.80, 0.80, (0.45, 0.35), (0.80, 1.00)),
)
"""Gaits of the training recordings."""
REPEATED = (1, 3)
"""Indices of the training gaits that are recorded three times."""
NEAR = {
    "validation": (
        Gait(1.00, 0.50, (0.40, 0.40), (0.90, 0.90)),
        Gait(1.40, 0.45, (0.40, 0.35), (0.85, 0.95)),
    ),
    "test": (
        Gait(1.20, 0.50, (0.40, 0.40), (0.90, 0.90)),
        Gait(0.95, 0.55, (0.40, 0.45), (0.95, 0.80)),
    ),
}
FAR = {"validation": (hopping, one_legged), "test": (telegraph, waves)}


@dataclasses.dataclass(frozen=True)
class Job:
    """A recording to make."""

    split: str
    """Folder of the recording, such as "training"."""
    name: str
    commands: Float[np.ndarray, "steps 2"]
    """Commands (left, right) at the control rate."""
    trial: int
    """Seed of the trial's conditions."""
    notes: str


def jobs() -> list[Job]:
    """Return the jobs for all free recordings of the data set. Each recording has a different draught."""
    found: list[tuple[str, str, Float[np.ndarray, "steps 2"], str]] = []
    for index, gait in enumerate(TRAINING):
        for take in range(3 if index in REPEATED else 1):
            name = f"gait-{index:02d}-take-{take + 1}"
            found.append(("training", name, gait.commands(SECONDS["training"]), str(gait)))
    for split in ("validation", "test"):
        for index, gait in enumerate(NEAR[split]):
            found.append((split, f"near-{index + 1}", gait.commands(SECONDS[split]), str(gait)))
        for index, make in enumerate(FAR[split]):
            found.append((split, f"far-{index + 1}", make(SECONDS[split]), f"{make.__name__}: {make.__doc__}"))
    return [Job(*entry[:3], trial=100 + number, notes=entry[3]) for number, entry in enumerate(found)]


def fresh_jobs(seed: int, each: int = 6) -> list[Job]:
    """Draw a larger test set than the bundled one, with `each` near and `each` far recordings.

    Near recordings are gaits whose period, phase, duty and high commands are drawn from within the range of the
    training gaits. Far recordings cycle through five kinds: random jumps, both legs together, smooth waves with a phase
    shift, smooth waves with two periods, and one leg at a time.
    """
    rng = np.random.default_rng([seed, 4])
    seconds = SECONDS["test"]
    time = np.arange(round(seconds / CONTROL_TIMESTEP))[:, None] * CONTROL_TIMESTEP

    def pair(low: float, high: float) -> tuple[float, float]:
        left, right = np.round(rng.uniform(low, high, 2), 2)
        return float(left), float(right)

    def far(kind: int) -> Float[np.ndarray, "steps 2"]:
        period, phase, high = rng.uniform(0.8, 1.6), rng.uniform(0.2, 0.8), rng.uniform(0.75, 1.0)
        if kind == 0:
            return telegraph(seconds, int(rng.integers(2**31)))
        if kind == 1:
            return Gait(period, 0.0, (0.4, 0.4), (high, high)).commands(seconds)
        if kind == 2:
            return 0.5 - 0.5 * np.cos(2 * np.pi * (time / period + np.array([0.0, phase])))
        if kind == 3:
            return 0.5 - 0.5 * np.cos(2 * np.pi * time / rng.uniform(0.8, 1.8, 2))
        both = Gait(period, 0.0, (0.4, 0.4), (high, high)).commands(seconds)
        return np.where(np.hstack([time % 6 < 3, time % 6 >= 3]), both, 0.0)

    near = [
        Gait(round(rng.uniform(0.8, 1.6), 2), round(rng.uniform(0.3, 0.7), 2), pair(0.35, 0.5), pair(0.75, 1.0))
        for _ in range(each)
    ]
    found = [(f"near-{i + 1}", gait.commands(seconds), str(gait)) for i, gait in enumerate(near)]
    found += [(f"far-{i + 1}", np.round(far(i % 5), 3), f"far, kind {i % 5}") for i in range(each)]
    return [
        Job("fresh", name, commands, trial=10_000 * (seed + 1) + number, notes=notes)
        for number, (name, commands, notes) in enumerate(found)
    ]


def record_job(job: Job, robot: Hardware, output: Path) -> Path:
    """Record one job on a robot, and write it to the folder of its split in `output`. Return the file."""
    seconds = len(job.commands) * CONTROL_TIMESTEP
    recording = robot.record(job.trial, virtual_robot.open_loop(job.commands), seconds, job.name, job.notes)
    path = output / job.split / f"{job.name}.csv.gz"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_recording(recording, path, load_robot(), decimals=DECIMALS)
    return path


def record_fresh(seed: int, robot: Hardware, folder: Path, each: int = 6) -> list[Path]:
    """Record `fresh_jobs` on a robot into a folder, on all cores, and return the files. Existing files are kept."""
    wanted = fresh_jobs(seed, each)
    paths = [folder / job.split / f"{job.name}.csv.gz" for job in wanted]
    record_jobs([job for job, path in zip(wanted, paths, strict=True) if not path.exists()], robot, folder)
    return paths


def record_dataset(robot: Hardware, folder: Path) -> list[Path]:
    """Record the whole data set on a robot into a folder, and return the files, the sweep last."""
    paths = record_jobs(jobs(), robot, folder)
    sweep = folder / "suspended" / "sweep.csv.gz"
    sweep.parent.mkdir(parents=True, exist_ok=True)
    write_recording(robot.record_sweep("sweep"), sweep, load_robot(), decimals=DECIMALS)
    return [*paths, sweep]


def record_jobs(wanted: Sequence[Job], robot: Hardware, folder: Path) -> list[Path]:
    """Record several jobs on all cores, and return their files in the same order."""
    if not wanted:
        return []
    with multiprocessing.get_context("spawn").Pool() as pool:
        return pool.starmap(record_job, [(job, robot, folder) for job in wanted])
