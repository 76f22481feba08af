# %% [markdown]
# # A real compass-gait walker: torques at the hip, single steps
#
# The data are public: `imanchester/SydneyCompassGait` on GitHub, commit `92546f6`, MIT (c) 2017 Ian Manchester;
# Boudali, Kong, Martinez, Tang, Manchester, design and modelling of an open platform for dynamic walking. `--data` is a
# folder with `SysID_data_12exp_120steps.mat`: 12 walks of 10 steps, joined end to end, at 200 Hz. `hipangle` (deg) is
# the angle between the legs, `stanceangle` (rad) that of the leg on the floor, `umaxonsatu` the motor's voltage;
# `innoutst` is 1 where the outer leg stands.
#
# Each step is a recording of its own, from 20 ms after the leg has changed to the next change. The foot on the floor is
# a hinge: contacts are left out, and errors do not pass from one step to the next. The model is that of the outer leg
# on the floor. With the inner leg there, masses and inertias change places.
#
# | use | steps |
# | --- | --- |
# | training | outer leg stands, walks 0, 2, 4, 6, 8, 10 and 11 |
# | validation | outer leg stands, walks 3 and 9 |
# | test, near | outer leg stands, walks 1, 5 and 7 |
# | test, other leg | inner leg stands, walks 1, 5 and 7: another model than the residual was learned with |
#
# The published model has no friction at the hip. The reference is the friction that the data's authors identified.
#
# `python experiments/real/compass_gait/compass_gait.py --data FOLDER`; `--quick` shows that it works. `--seeds` says
# how many trainings there are, `--methods` by which methods.

# %%
from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path("experiments/real/compass_gait") if "ipykernel" in sys.modules else Path(__file__).parent
sys.path[1:1] = [str(FOLDER.parent), str(FOLDER.parents[1])]

import _setup

_setup.prepare()

import json
import tempfile
from collections.abc import Sequence

import _fit
import _residuals
import numpy as np
import scipy.io

from ballu_mjx.common.errors import InputError
from ballu_mjx.evaluation.open_loop import OpenLoopEvaluator, Replay
from ballu_mjx.identification.residuals import SamplingConfig, held_motion
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.residuals.envmimic import EnvMimicConfig
from ballu_mjx.robots.description import RobotDescription, read_description
from ballu_mjx.sim.simulator import Simulator

FILE = "SysID_data_12exp_120steps.mat"
COLUMNS = ("datatime", "hipangle", "stanceangle", "umaxonsatu", "innoutst")
TRAINING, VALIDATION, TEST = (0, 2, 4, 6, 8, 10, 11), (3, 9), (1, 5, 7)
STEPS_A_WALK = 10
IMPACT = 0.02
"""s after a change of the leg that are left out."""
FULL_VOLTAGE = 10.0
SAMPLING = SamplingConfig(sample_timestep=0.01, angle_noise=np.deg2rad(0.1), position_window=0.03, rate_window=0.06)
PUBLISHED = {"hip_frictionloss": 0.0061, "hip_damping": 0.00156}
"""Of the data's authors (Coulomb and viscous)."""
HORIZONS = (0.1, 0.2, 0.4)


def convert(path: Path) -> dict[tuple[int, bool], list[Recording]]:
    """Return the steps of the public file by walk and by whether the outer leg stands.

    Angles are those of the model: the stance leg leans forward by `stance`, the swing leg by `hip` more.

    **Raises** `InputError` where the file is missing or lacks a column.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; fetch the public data set.")
    content = scipy.io.loadmat(path)
    for column in COLUMNS:
        if column not in content:
            raise InputError(f"{path}: there is no {column}; give a file of the public data set.")
    time, hip, stance, voltage, outer = (np.ravel(content[column]).astype(float) for column in COLUMNS)
    edges = [0, *(np.flatnonzero(np.diff(outer)) + 1), len(time)]
    found: dict[tuple[int, bool], list[Recording]] = {}
    for number, (first, last) in enumerate(zip(edges, edges[1:], strict=False)):
        first += round(IMPACT / (time[1] - time[0]))
        rows, walk, stands = slice(first, last), number // STEPS_A_WALK, bool(outer[last - 1])
        sign = 1.0 if stands else -1.0
        recording = Recording(
            name=f"near-walk{walk:02d}-step{number % STEPS_A_WALK}",
            kind="suspended",
            robot="Sydney compass gait",
            notes=f"imanchester/SydneyCompassGait 92546f6 {path.name}, MIT",
            time=time[rows] - time[first],
            command=(sign * voltage[rows] / (2 * FULL_VOLTAGE) + 0.5)[:, None],
            tracked_position=None,
            tracked_quaternion=None,
            joint_angles={"stance": -stance[rows], "hip": sign * np.deg2rad(hip[rows])},
        )
        found.setdefault((walk, stands), []).append(recording)
    return found


def other_leg(folder: Path) -> RobotDescription:
    """Write the robot with the inner leg on the floor to a folder, and return it."""
    robot = read_description(FOLDER / "compass_gait.robot.json")
    text = robot.model.read_text()
    for outer, inner in (('"0 0 0.2276"', '"0 0 0.2330"'), ('"0 0 -0.0448"', '"0 0 -0.0502"')):
        text = text.replace(outer, inner)
    text = text.replace("0.002605", "SWING").replace("0.002919", "0.002605").replace("SWING", "0.002919")
    (folder / "inner.xml").write_text(text)
    content = json.loads(robot.file.read_text()) | {"name": "inner leg on the floor", "model": "inner.xml"}
    (folder / "inner.robot.json").write_text(json.dumps(content))
    return read_description(folder / "inner.robot.json")


def leg_errors(evaluator: OpenLoopEvaluator, replay: Replay) -> np.ndarray:
    """Root mean square errors (deg) of stance and swing leg after 0.1, 0.2 and 0.4 s, of starts that stayed finite."""
    found = []
    for seconds in HORIZONS:
        steps, legs = round(seconds / evaluator.robot.control_timestep), []
        for run, (recording, start) in enumerate(evaluator.starts):
            recorded = evaluator.motions[recording].qpos
            if start + steps < len(recorded):
                legs.append(np.cumsum(replay.joints[run, steps] - recorded[start + steps]))
        errors = np.rad2deg(np.array(legs))
        lost = ~np.isfinite(errors).all(axis=1)
        found.append(np.sqrt(np.mean(errors**2, axis=0)) if not lost.any() else np.full(2, np.inf))
    return np.concatenate(found)


# %%
def main() -> None:
    options = _fit.parse(__doc__)
    steps = convert(options.data / FILE)
    with tempfile.TemporaryDirectory() as folder:
        robot = read_description(FOLDER / "compass_gait.robot.json")
        robots = {True: robot, False: other_leg(Path(folder))}

        def motions(walks: Sequence[int], *, outer: bool) -> list[Motion]:
            own = robots[outer]
            chosen = [step for walk in (walks[:1] if options.quick else walks) for step in steps[walk, outer]]
            return [held_motion(step, own, own.load_model(), SAMPLING) for step in chosen]

        simulators = {
            outer: {
                "no friction": Simulator(own),
                "published friction": Simulator(own, _residuals.with_values(own, PUBLISHED)),
            }
            for outer, own in robots.items()
        }
        print("Root mean square errors at the horizon's end; of several seeds the mean (lowest to highest)\n")
        print(
            _residuals.compare(
                simulators[True],
                {"training": motions(TRAINING, outer=True), "validation": motions(VALIDATION, outer=True)},
                {"near": motions(TEST, outer=True), "other leg": motions(TEST, outer=False)},
                EnvMimicConfig(forces="joints"),
                options.methods,
                _residuals.Effort.of(options.seeds, quick=options.quick),
                leg_errors,
                [f"{leg} {seconds:g} s (deg)" for seconds in HORIZONS for leg in ("stance", "swing")],
                {"other leg": simulators[False]},
            )
        )


if __name__ == "__main__":
    _setup.run(main)
