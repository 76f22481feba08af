# %% [markdown]
# # Identification of a real motor with three payloads, and test with a fourth
#
# A Unitree Go1 motor swings a pendulum with 0, 1, 2 or 3 kg at 0.15 m. The data are public: `rimim/bam` on GitHub,
# commit `38071b1`, `example_data/data_raw_go1`, a fork of `Rhoban/bam` (Apache-2.0). Method and friction models are by
# Duclusaud et al., ICRA 2025 (arXiv 2410.08650).
#
# `--data` is a clone of that repository, or a folder with the recordings that an earlier run made of its files
# (`go1_0/recordings` to `go1_3/recordings`). Each payload has three recordings: `sin_sin`, `sin_time_square` and
# `up_and_down`. The column `motor` is `position` (rad), and `command_goal` is `goal_position / (2 pi) + 0.5`. The pose
# of `load` is computed by forward kinematics. `lift_and_drop` is left out, because it switches the motor off, and
# commands do not show this.
#
# The fit uses 0, 1 and 2 kg. Each payload has its own model, and all models share the parameters.
#
# Run `python experiments/real/go1/go1.py --data FOLDER`. `--quick` is a short trial run.

# %%
from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path("experiments/real/go1") if "ipykernel" in sys.modules else Path(__file__).parent
sys.path[1:1] = [str(FOLDER.parent), str(FOLDER.parents[1])]

import _setup

_setup.prepare()

import _fit
import _public
import mujoco
import numpy as np

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.fit_robot import FitConfig, RobotFit, fit_robot, replay
from ballu_mjx.identification.measured_motion import MeasuredMotion, SamplingConfig, measure
from ballu_mjx.recordings.csv_format import list_recordings, read_recording
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import read_description

LOADS = (0, 1, 2, 3)
"""Payloads (kg). The last one is for the test."""
SAMPLING = SamplingConfig(sample_timestep=0.016, angle_noise=np.deg2rad(0.1), position_window=0.08, rate_window=0.1)
TRAJECTORIES = ("sin_sin", "sin_time_square", "up_and_down")
"""Trajectories of the goal."""
PUBLIC = "example_data/data_raw_go1"
"""Folder of the public files."""
LIGHTEST = 0.001
"""Mass (kg) of the payload's body without payload, because MuJoCo needs a positive mass."""
PUBLISHED = {"motor_frictionloss": 0.0914, "motor_damping": 0.047}
"""Coulomb and viscous friction of the data's authors."""
SECONDS = 5.9
"""Length of the replays (s)."""


def prepare(data: Path, made: Path) -> Path:
    """Return the folder with all recordings, which are written to `made` if `data` has public files instead.

    **Raises** `InputError` from `_public.recordings_of`, or if a public file is damaged.
    """
    found = {}
    for path in sorted((data / PUBLIC).glob("*.json")):
        log = files.read_json(path, "download the file again")
        found[log.get("mass"), log.get("trajectory")] = str(path.relative_to(data))
    sources = {
        f"go1_{kilograms}/recordings/{trajectory}": found.get(
            (kilograms, trajectory), f"{PUBLIC}/*.json with {kilograms} kg and {trajectory}"
        )
        for kilograms in LOADS
        for trajectory in TRAJECTORIES
    }
    return _public.recordings_of(data, made, sources, convert, read_description(FOLDER / "go1.robot.json"))


def convert(path: Path, name: str) -> Recording:
    """Return a run of the public data as a recording.

    **Raises** `InputError` if the file lacks an entry, or if an entry is not a finite number.
    """
    robot = read_description(FOLDER / "go1.robot.json")
    entries = files.read_json(path, "download the file again").get("entries", [])
    try:
        rows = np.array(
            [[entry[key] for key in ("timestamp", "position", "goal_position")] for entry in entries], float
        )
        time, position, goal = rows.T
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: entries must have the numbers timestamp, position and goal_position; download the file again."
        ) from error
    if not (np.isfinite(rows).all() and (np.diff(time) > 0).all()):
        raise InputError(f"{path}: entries must be finite, and times must increase; download the file again.")
    recording = Recording(
        name=name,
        kind="free",
        robot="Unitree Go1 motor",
        notes=f"rimim/bam 38071b1 {PUBLIC}/{path.name}, fork of Rhoban/bam (Apache-2.0)",
        time=time - time[0],
        command=goal[:, None] / (2 * np.pi) + 0.5,
        joint_angles={"motor": position},
    )
    return _public.with_kinematics(recording, robot, robot.load_model())


def load(data: Path, kilograms: int) -> list[MeasuredMotion]:
    """Read and measure the recordings of a payload (kg), each with the model of this payload."""
    robot = read_description(FOLDER / "go1.robot.json")
    spec = mujoco.MjSpec.from_file(str(robot.model))
    spec.body("load").mass = max(kilograms, LIGHTEST)
    model = spec.compile()
    paths = list_recordings([data / f"go1_{kilograms}" / "recordings"])
    return [measure(read_recording(path, robot), robot, model, SAMPLING) for path in paths]


def identify(data: Path, *, quick: bool) -> RobotFit:
    """Fit the declared parameters to the recordings of all payloads but the last."""
    robot = read_description(FOLDER / "go1.robot.json")
    parameters = declared_parameters(robot, robot.load_model())
    training = [motion for kilograms in LOADS[:-1] for motion in load(data, kilograms)]
    config = FitConfig(window_seconds=2.0, starts=1 if quick else 2, steps=4 if quick else 15)
    return fit_robot(parameters, training[1:5:3] if quick else training, load(data, LOADS[-1]), config, _fit.report)


def mean_errors(fit: RobotFit, motions: list[MeasuredMotion], points: list[np.ndarray]) -> np.ndarray:
    """Return mean absolute angle errors (deg) over `SECONDS`, by parameter vector and recording."""
    found = replay(fit.parameters, motions, points, SECONDS, 2 * SECONDS)
    return np.array([np.rad2deg(np.abs(errors.errors[..., 0]).mean(axis=1)) for errors in found])


# %%
def main() -> None:
    description = "Identify a Unitree Go1 motor with 0, 1 and 2 kg, and test with 3 kg."
    options = _fit.parse(description, Path("runs/go1"))
    data = prepare(options.data, options.output / "recordings")
    fit = identify(data, quick=options.quick)
    _fit.show(fit)
    points = _fit.candidates(fit, PUBLISHED)
    rows = []
    for kilograms in LOADS[-1:] if options.quick else LOADS:
        errors = mean_errors(fit, load(data, kilograms), list(points.values()))
        rows.append((f"{kilograms} kg", *(Cell((float(error),)) for error in errors.mean(axis=1))))
    heads = (f"mean error over {SECONDS:g} s (deg)", *points)
    tables = {"loads": Table(heads, tuple(rows)), "parameters": _fit.parameter_table(fit, PUBLISHED)}
    _setup.write_tables(tables, options.output, options.results, {})


if __name__ == "__main__":
    _setup.run(main)
