# %% [markdown]
# # Identification of a real walker: friction and motor of the hip
#
# The Sydney compass gait is a planar walker with two straight legs and a motor at the hip. A boom holds it upright. The
# data are public: `imanchester/SydneyCompassGait` on GitHub, commit `92546f6`, MIT; Boudali, Kong, Martinez, Tang,
# Manchester, design and modelling of an open platform for dynamic walking. We use the twelve walks of ten steps in
# `System Identification/SysID_Experiment 2/SysID_data_12exp_120steps.mat`. They are joined there end to end.
#
# `--data` is a clone of that repository, or a folder with tables of the walks (`walk-00.csv.gz` to `walk-11.csv.gz`).
# A folder of tables has no motor tests (below), so that the fit then uses the walks alone. Tables are sampled at
# 200 Hz, and have these columns:
#
# | column | public file |
# | --- | --- |
# | `time` | `datatime` (s) |
# | `command_motor` | `umaxonsatu / 20 + 0.5` |
# | `command_inner` | `innoutst`: 1 while the outer leg stands, 0 while the inner leg stands |
# | `inner` | angle of the inner leg (rad): `-stanceangle`, plus `hipangle` while the outer leg stands |
# | `outer` | angle of the outer leg relative to the inner leg (rad): `-hipangle` |
#
# A change of legs has an impact that this model does not have. Each step is therefore a recording of its own. The foot
# of the stance leg stays in place during a step, so the model is a double pendulum above this foot. The legs differ, so
# there is a model for each stance leg. Both models share the parameters.
#
# The authors' script calls the first 3884 samples, which are walks 0 to 2, "3VC, 1 ctrl strategy": three virtual
# constraints under one controller. We conclude that three walks in a row share a controller, four in all. Walks 0 to 2
# are the far test: training has no walk of their controller. Five other walks are for training. Two are for validation:
# they chose the declared parameters, the filters and the use of the motor tests. Two are the near test.
#
# Training also has both motor tests, in `System Identification/SysID_Experiment 1`. There the hip is held, and one leg
# hangs from it. It swings from 90 deg, then under steps of 5 V, then under a chirp of 2 V.
#
# Run `python experiments/real/compass_gait/compass_gait.py --data FOLDER`. `--quick` is a short trial run.

# %%
from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path("experiments/real/compass_gait") if "ipykernel" in sys.modules else Path(__file__).parent
sys.path[1:1] = [str(FOLDER.parent), str(FOLDER.parents[1])]

import _setup

_setup.prepare()

import dataclasses
from collections.abc import Mapping, Sequence

import _fit
import _public
import mujoco
import numpy as np
import scipy.io

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import Table
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.fit_robot import FitConfig, HeldOut, RobotFit, fit_robot, replay
from ballu_mjx.identification.measured_motion import MeasuredMotion, SamplingConfig, measure
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import read_description

TRAINING = (4, 6, 8, 10, 11)
VALIDATION = (3, 9)
TEST = {"near": (5, 7), "far": (0, 1, 2)}
PUBLIC = "System Identification/SysID_Experiment 2/SysID_data_12exp_120steps.mat"
"""Public file of the walks."""
MOTOR_TESTS = "System Identification/SysID_Experiment 1/realVSmodel_fwAnd5vstepsx3AndChirp_{leg}SW.mat"
"""Public file of the motor test with a leg, "inner" or "outer"."""
WALKS, STEPS = 12, 10
"""Number of walks in the public file, and of steps in a walk."""
COLUMNS = ("time", "command_motor", "command_inner", "inner", "outer")
"""Columns of a walk."""
HORIZONS = (0.1, 0.2, 0.4)
"""Times after the start of a simulation at which errors are measured (s)."""
SAMPLING = SamplingConfig(sample_timestep=0.01, angle_noise=np.deg2rad(0.1), position_window=0.06, rate_window=0.11)
SETTLE = 0.02
"""Time after a change of legs whose samples are left out (s). The impact makes the legs vibrate."""
BEGIN = 0.05
"""Time from then to the start of simulations (s). The filters need samples on both sides."""
LEGS = {"inner": (0.0448, 0.002919), "outer": (0.0502, 0.002605)}
"""Distance of a leg's centre of mass from the hip (m), and moment of inertia about this centre (kg m^2)."""
LENGTH = 0.2778
"""Length of a leg (m)."""
HELD = 1e4
"""Armature of the stance leg's joint that holds the hip in a motor test (kg m^2)."""
PUBLISHED = {"hip_frictionloss": 0.0061, "hip_damping": 0.00156}
"""Friction of the data's authors."""


def model_of(stance: str) -> mujoco.MjModel:
    """Return the model of a step in which a leg stands: "inner" or "outer"."""
    spec = mujoco.MjSpec.from_file(str(FOLDER / "compass_gait.xml"))
    swing = next(leg for leg in LEGS if leg != stance)
    place_leg(spec, "stance", stance)
    place_leg(spec, "swing", swing)
    return spec.compile()


def place_leg(spec: mujoco.MjSpec, body: str, leg: str) -> None:
    """Give the body "stance" or "swing" the inertia of a leg, "inner" or "outer"."""
    centre, inertia = LEGS[leg]
    spec.body(body).ipos = [0, 0, (LENGTH if body == "stance" else 0.0) - centre]
    spec.body(body).inertia = [inertia, inertia, 0.0005]


def model_of_motor_test(leg: str) -> mujoco.MjModel:
    """Return the model of the motor test with a leg: the leg swings, and the other leg and the hip do not move."""
    spec = mujoco.MjSpec.from_file(str(FOLDER / "compass_gait.xml"))
    place_leg(spec, "swing", leg)
    spec.joint("stance").armature = HELD
    return spec.compile()


def read_walk(data: Path, walk: int) -> dict[str, np.ndarray]:
    """Return the columns of a walk, from the public file or from the walk's table.

    **Raises** `InputError` if `data` has neither, or if one of them is damaged.
    """
    path, public = data / f"walk-{walk:02d}.csv.gz", data / PUBLIC
    if path.is_file():
        return _public.read_columns(path, COLUMNS)
    if not public.is_file():
        raise InputError(
            f"{data}: has neither {path.name} nor {PUBLIC}; give a clone of the public data, or a folder of walks."
        )
    return convert(public, walk)


def convert(path: Path, walk: int) -> dict[str, np.ndarray]:
    """Return the columns of a walk in the public file, in which the walks are joined.

    **Raises** `InputError` if a variable is missing or has another length, or if the walks do not have `STEPS` each.
    """
    table = read_variables(path, ("datatime", "hipangle", "innoutst", "stanceangle", "umaxonsatu"))
    begins = np.r_[0, np.flatnonzero(np.diff(table[2] > 0.5)) + 1, table.shape[1]]
    if len(begins) != WALKS * STEPS + 1:
        raise InputError(
            f"{path}: has {len(begins) - 1} steps instead of {WALKS} walks of {STEPS}; download the file again."
        )
    time, hip, outer_stands, stance, voltage = table[:, begins[walk * STEPS] : begins[(walk + 1) * STEPS]]
    hip = np.deg2rad(hip)
    inner = np.where(outer_stands > 0.5, hip - stance, -stance)
    return dict(zip(COLUMNS, (time - time[0], command_of(voltage), outer_stands, inner, -hip), strict=True))


def command_of(voltage: np.ndarray) -> np.ndarray:
    """Return the command of the motor for a voltage (V). It is 0.5 at 0 V."""
    return voltage / 20 + 0.5


def read_variables(path: Path, names: Sequence[str]) -> np.ndarray:
    """Return variables of a public file as rows, in the order of `names`.

    **Raises** `InputError` if one is missing, or if they have different lengths.
    """
    try:
        variables = scipy.io.loadmat(path, variable_names=names)
        return np.stack([variables[name].ravel() for name in names]).astype(float)
    except (KeyError, ValueError, NotImplementedError) as error:
        raise InputError(f"{path}: a variable is missing or damaged ({error}); download the file again.") from error


def read_motor_test(path: Path, leg: str) -> Recording:
    """Return the motor test with a leg from its public file.

    **Raises** `InputError` from `read_variables`.
    """
    time, voltage, angle = read_variables(path, ("datatimeall", "datainall", "dataoutall"))
    return Recording(
        name=f"motor test of the {leg} leg",
        kind="suspended",
        robot="Sydney compass gait",
        time=time,
        command=command_of(voltage)[:, None],
        joint_angles={"stance": np.zeros_like(angle), "swing": np.deg2rad(angle)},
    )


def cut_steps(table: Mapping[str, np.ndarray], name: str) -> list[tuple[str, Recording]]:
    """Return the stance leg and a recording of each step of a walk, without its first `SETTLE`.

    `table` has the `COLUMNS` of the walk `name`.
    """
    outer_stands = table["command_inner"] > 0.5
    steps = []
    for number, rows in enumerate(np.split(np.arange(len(outer_stands)), np.flatnonzero(np.diff(outer_stands)) + 1)):
        rows = rows[table["time"][rows] - table["time"][rows[0]] > SETTLE - 1e-6]
        outer = bool(outer_stands[rows[0]])
        sign = -1.0 if outer else 1.0  # from the outer leg's angle relative to the inner leg to that of the swing leg
        inner, relative, voltage = (table[name][rows] for name in ("inner", "outer", "command_motor"))
        step = Recording(
            name=f"{name}, step {number}",
            kind="suspended",
            robot="Sydney compass gait",
            time=table["time"][rows],
            command=(0.5 - sign * (voltage - 0.5))[:, None],
            joint_angles={"stance": inner + relative if outer else inner, "swing": sign * relative},
        )
        steps.append(("outer" if outer else "inner", step))
    return steps


def load(data: Path, walks: Sequence[int]) -> list[MeasuredMotion]:
    """Read and measure all steps of walks, each from `BEGIN` on, with the model of its stance leg."""
    robot = read_description(FOLDER / "compass_gait.robot.json")
    models = {leg: model_of(leg) for leg in LEGS}
    motions = []
    for walk in walks:
        for leg, step in cut_steps(read_walk(data, walk), f"walk-{walk:02d}"):
            motion = measure(step, robot, models[leg], SAMPLING)
            motions.append(begin_at(motion, round(BEGIN / motion.sample_timestep)))
    return motions


def load_motor_tests(data: Path) -> list[MeasuredMotion]:
    """Read and measure the motor tests in `data`: one of each leg, or none if `data` has only tables of walks.

    **Raises** `InputError` if `data` has the public walks without the motor tests, and from `read_motor_test`.
    """
    if not (data / PUBLIC).is_file():
        return []
    robot = read_description(FOLDER / "compass_gait.robot.json")
    motions = []
    for leg in LEGS:
        path = data / MOTOR_TESTS.format(leg=leg)
        if not path.is_file():
            raise InputError(f"{path}: file not found; the clone of the public data is incomplete.")
        motions.append(measure(read_motor_test(path, leg), robot, model_of_motor_test(leg), SAMPLING))
    return motions


def begin_at(motion: MeasuredMotion, sample: int) -> MeasuredMotion:
    """Return a motion without its first samples."""
    return dataclasses.replace(
        motion,
        commands=motion.commands[sample * motion.every :],
        qpos=motion.qpos[sample:],
        start_qpos=motion.start_qpos[sample:],
        qvel=motion.qvel[sample:],
    )


def identify(data: Path, *, quick: bool) -> RobotFit:
    """Fit the declared parameters to the training walks."""
    robot = read_description(FOLDER / "compass_gait.robot.json")
    parameters = declared_parameters(robot, robot.load_model())
    config = FitConfig(window_seconds=HORIZONS[-1], starts=1 if quick else 2, steps=2 if quick else 15)
    training = load(data, TRAINING[:1]) if quick else [*load(data, TRAINING), *load_motor_tests(data)]
    return fit_robot(parameters, training, load(data, VALIDATION), config, _fit.report)


def root_mean_squares(found: HeldOut, sample_timestep: float) -> np.ndarray:
    """Return root mean square errors (deg) after each of `HORIZONS`, of the stance and of the swing angle."""
    samples = [round(horizon / sample_timestep) for horizon in HORIZONS]
    return np.rad2deg(np.sqrt(np.mean(found.errors[:, samples, :2] ** 2, axis=0)))


def step_errors(
    fit: RobotFit, points: Mapping[str, np.ndarray], groups: Mapping[str, Sequence[MeasuredMotion]]
) -> dict[str, dict[str, np.ndarray]]:
    """Return the `root_mean_squares` of one simulation of each step, by parameter vector and group of walks."""
    errors: dict[str, dict[str, np.ndarray]] = {name: {} for name in points}
    for group, motions in groups.items():
        longest = max(len(motion.qpos) for motion in motions) * motions[0].sample_timestep
        found = replay(fit.parameters, motions, list(points.values()), HORIZONS[-1], longest)
        for name, held_out in zip(points, found, strict=True):
            errors[name][group] = root_mean_squares(held_out, motions[0].sample_timestep)
    return errors


def tables(fit: RobotFit, errors: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, Table]:
    """Return a table of errors on single steps, and one of the identified parameters."""
    groups = list(next(iter(errors.values())))
    heads = [f"{group}, {horizon:g} s" for group in groups for horizon in HORIZONS]
    cells = {
        name: [f"{stance:.2f} / {swing:.2f}" for group in groups for stance, swing in found[group]]
        for name, found in errors.items()
    }
    return {
        "steps": Table(("stance / swing (deg)", *heads), tuple((name, *row) for name, row in cells.items())),
        "parameters": _fit.parameter_table(fit, PUBLISHED),
    }


# %%
def main() -> None:
    options = _fit.parse("Identify the hip of a walker, and test on unseen walks.", Path("runs/compass_gait"))
    fit = identify(options.data, quick=options.quick)
    _fit.show(fit)
    groups = {"validation": VALIDATION} if options.quick else {"validation": VALIDATION, **TEST}
    motions = {group: load(options.data, walks) for group, walks in groups.items()}
    errors = step_errors(fit, _fit.candidates(fit, PUBLISHED), motions)
    _setup.write_tables(tables(fit, errors), options.output, options.results, {})


if __name__ == "__main__":
    _setup.run(main)
