# %% [markdown]
# # Identification of a real double pendulum: friction, motors and delay
#
# The data are public: `dfki-ric-underactuated-lab/double_pendulum` on GitHub, commit `1e8544e`, BSD-3-Clause; Wiebe et
# al., open-source dual-purpose acrobot and pendubot platform, IEEE RAM 2023. We use the ten recordings of design C.1 in
# `data/experiment_records/design_C.1/sys_id/20230629`, and ten swing-ups of the acrobot in
# `leaderboard/acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr`. `--data` is a clone of that repository, or a folder
# with the recordings that an earlier run made of its files (`sysid-20230629-HHMMSS.csv.gz`).
#
# | column of recordings | public files |
# | --- | --- |
# | `time` | resampled at 500 Hz |
# | `command_shoulder`, `command_elbow` | `tau_con1 / 20 + 0.5`, `tau_con2 / 20 + 0.5`, held between samples |
# | `shoulder`, `elbow` | `pos_meas1`, `pos_meas2` (rad) |
# | positions of `middle` and `tip`, orientation of `tip` | by forward kinematics |
#
# The model has the published masses, lengths and inertias. Masses, centres of mass and inertias of the links are
# identified too, as far as they have an effect in the plane, because the published ones were identified together with
# another friction. Six recordings are for training. Two are for validation: they chose the declared
# parameters, and they show whether identification helps. Two are for the test. For comparison, the published friction
# is replayed, too.
#
# Run `python experiments/real/double_pendulum/double_pendulum.py --data FOLDER`. `--quick` is a short trial run.

# %%
from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path("experiments/real/double_pendulum") if "ipykernel" in sys.modules else Path(__file__).parent
sys.path[1:1] = [str(FOLDER.parent), str(FOLDER.parents[1])]

import _setup

_setup.prepare()

from collections.abc import Sequence

import _fit
import _public
import numpy as np

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import Cell, Table
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.fit_robot import FitConfig, HeldOut, RobotFit, fit_robot, replay
from ballu_mjx.identification.measured_motion import MeasuredMotion, SamplingConfig, measure
from ballu_mjx.identification.window_simulator import cut_windows
from ballu_mjx.recordings.csv_format import read_recording
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import read_description

TRAINING = ("143339", "143524", "143601", "143704", "144115", "154220")
VALIDATION = ("143747", "143906")
TEST = ("144003", "154548")
SAMPLING = SamplingConfig(sample_timestep=0.02, angle_noise=np.deg2rad(0.1), position_window=0.03, rate_window=0.05)
"""The assumed angle noise of 0.1 deg is far above the encoders' noise, because the gears hide larger errors."""
PUBLISHED = {
    "shoulder_frictionloss": 0.16 * np.pi / 2,
    "elbow_frictionloss": 0.12 * np.pi / 2,
    "shoulder_damping": 0.001,
    "elbow_damping": 0.001,
}
"""Friction of the data's authors. Their model of Coulomb friction is cf atan(100 v)."""


SOURCES = {
    f"sysid-20230629-{time}": f"data/experiment_records/design_C.1/sys_id/20230629/20230629-{time}/trajectory.csv"
    for time in (*TRAINING, *VALIDATION, *TEST)
}
"""Paths of the public files, by name of the recording."""
SWING_UPS = {
    f"acrobot-ilqr_tvlqr_lqr-experiment{number:02d}": (
        f"leaderboard/acrobot/real_hardware_v2/src_data/ilqr_tvlqr_lqr/experiment{number:02d}/trajectory.csv"
    )
    for number in range(1, 11)
}
"""The same for the swing-ups."""
TIMESTEP = 0.002
"""Time between two samples of the recordings (s)."""
TORQUE = 10.0
"""Torque at a command of 1 (N m)."""
HORIZONS = (0.4, 1.0)
"""Horizons of the errors on held-out recordings (s)."""
SWING_UP_HORIZON = 0.4
"""Horizon of the errors on swing-ups (s)."""
INTERVAL = 0.2
"""Time between the starts of two replays (s)."""


def prepare(data: Path, made: Path) -> Path:
    """Return the folder with all recordings, which are written to `made` if `data` has public files instead.

    Swing-ups that `data` lacks are left out.

    **Raises** `InputError` from `_public.recordings_of`.
    """
    swings = {
        name: source
        for name, source in SWING_UPS.items()
        if (data / f"{name}.csv.gz").is_file() or _public.public_file(data, source)
    }
    robot = read_description(FOLDER / "double_pendulum.robot.json")
    return _public.recordings_of(data, made, SOURCES | swings, convert, robot)


def convert(path: Path, name: str) -> Recording:
    """Return a run of the public data as a recording at 500 Hz.

    **Raises** `InputError` if the file lacks a column, or if its times do not increase.
    """
    robot = read_description(FOLDER / "double_pendulum.robot.json")
    columns = _public.read_columns(path, ("time", "pos_meas1", "pos_meas2", "tau_con1", "tau_con2"))
    time = columns["time"] - columns["time"][0]
    if not (np.diff(time) > 0).all():
        row = int(np.argmin(np.diff(time) > 0)) + 3
        raise InputError(f"{path}, column time, row {row}: times must increase; download the file again.")
    even = np.arange(0.0, time[-1], TIMESTEP)
    last = np.searchsorted(time, even, side="right") - 1
    angles = {
        joint: np.interp(even, time, columns[column])
        for joint, column in (("shoulder", "pos_meas1"), ("elbow", "pos_meas2"))
    }
    recording = Recording(
        name=name,
        kind="free",
        robot="DFKI double pendulum C.1",
        notes=f"dfki-ric-underactuated-lab/double_pendulum 1e8544e {path.parent.name}/{path.name}, BSD-3-Clause",
        time=even,
        command=np.stack([columns[f"tau_con{k}"][last] for k in (1, 2)], axis=1) / (2 * TORQUE) + 0.5,
        joint_angles=angles,
    )
    return _public.with_kinematics(recording, robot, robot.load_model())


def load(data: Path, names: tuple[str, ...]) -> list[MeasuredMotion]:
    """Read and measure recordings, given the times in their names."""
    return read([data / f"sysid-20230629-{name}.csv.gz" for name in names])


def load_swing_ups(data: Path) -> list[MeasuredMotion]:
    """Read and measure the swing-ups, if there are any."""
    return read(swing_ups(data))


def swing_ups(data: Path) -> list[Path]:
    """Return the recorded swing-ups of the acrobot under the controller `ilqr_tvlqr_lqr`."""
    return [path for name in SWING_UPS if (path := data / f"{name}.csv.gz").is_file()]


def read(paths: list[Path]) -> list[MeasuredMotion]:
    """Read recordings, and compute their measured motions."""
    robot = read_description(FOLDER / "double_pendulum.robot.json")
    return [measure(read_recording(path, robot), robot, robot.load_model(), SAMPLING) for path in paths]


def identify(data: Path, *, quick: bool) -> RobotFit:
    """Fit the declared parameters."""
    robot = read_description(FOLDER / "double_pendulum.robot.json")
    parameters = declared_parameters(robot, robot.load_model())
    training = load(data, TRAINING[:1] if quick else TRAINING)
    config = FitConfig(
        window_seconds=0.4 if quick else 1.0,
        interval_seconds=2.0 if quick else 1.0,
        starts=1 if quick else 2,
        steps=2 if quick else 15,
    )
    return fit_robot(parameters, training, load(data, VALIDATION), config, _fit.report)


def median_errors(found: HeldOut, recordings: Sequence[int]) -> str:
    """Return the median absolute errors (deg) of shoulder and elbow at the end of the windows of some recordings."""
    ends = found.errors[np.isin(found.motion, recordings), -1, :2]
    return " / ".join(f"{error:.2f}" for error in np.rad2deg(np.median(np.abs(ends), axis=0)))


def held_out_table(fit: RobotFit, motions: list[MeasuredMotion], seconds: float) -> Table:
    """Return the errors after a horizon (s) on `motions`, those of the validation and of the test."""
    points = _fit.candidates(fit, PUBLISHED)
    found = replay(fit.parameters, motions, list(points.values()), seconds, INTERVAL)
    groups = [range(len(motions)), *([number] for number in range(len(motions)))]
    rows = [
        (name, *(median_errors(errors, numbers) for numbers in groups))
        for name, errors in zip(points, found, strict=True)
    ]
    uses = [f"{name} ({use})" for use, each in (("validation", VALIDATION), ("test", TEST)) for name in each]
    return Table((f"after {seconds:g} s: shoulder / elbow (deg)", "all four", *uses), tuple(rows))


def swing_up_table(fit: RobotFit, motions: list[MeasuredMotion]) -> Table:
    """Return the errors of the tip after `SWING_UP_HORIZON` on swing-ups."""
    points = _fit.candidates(fit, PUBLISHED)
    found = replay(fit.parameters, motions, list(points.values()), SWING_UP_HORIZON, INTERVAL)
    rows = []
    for name, errors in zip(points, found, strict=True):
        ends = np.percentile(tip_errors(errors, motions, SWING_UP_HORIZON, INTERVAL), [50, 90])
        rows.append((name, *(Cell((float(error),), ".4f") for error in ends)))
    return Table((f"swing-ups: tip after {SWING_UP_HORIZON:g} s", "median (m)", "90th percentile (m)"), tuple(rows))


def tip_errors(found: HeldOut, motions: list[MeasuredMotion], seconds: float, interval: float) -> np.ndarray:
    """Return the distance (m) between simulated and recorded tip at the end of each window; infinite if it diverged."""
    windows = cut_windows(motions, seconds, interval)
    ends = zip(windows.motion, windows.first + windows.samples - 1, strict=True)
    recorded = np.array([motions[motion].qpos[sample] for motion, sample in ends])
    distance = np.linalg.norm(tip(recorded + found.errors[:, -1, :2]) - tip(recorded), axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def tip(angles: np.ndarray) -> np.ndarray:
    """Return the position of the tip (m) in the plane of motion, from the joint angles (rad, shape (..., 2))."""
    upper, lower = angles[..., 0], angles.sum(axis=-1)
    return np.stack([0.2 * np.sin(upper) + 0.3 * np.sin(lower), -0.2 * np.cos(upper) - 0.3 * np.cos(lower)], axis=-1)


# %%
def main() -> None:
    description = "Identify a geared double pendulum, and test on runs that the fit has not seen."
    options = _fit.parse(description, Path("runs/double_pendulum"))
    data = prepare(options.data, options.output / "recordings")
    fit = identify(data, quick=options.quick)
    _fit.show(fit)
    print(f"validation, score: nominal {fit.nominal.score:.3g}, identified {fit.identified.score:.3g}")
    horizons = HORIZONS[:1] if options.quick else HORIZONS
    motions = load(data, (*VALIDATION, *TEST))
    tables = {f"after_{1000 * seconds:.0f}_ms": held_out_table(fit, motions, seconds) for seconds in horizons}
    if swing_ups := [] if options.quick else load_swing_ups(data):
        tables["swing_ups"] = swing_up_table(fit, swing_ups)
    tables["parameters"] = _fit.parameter_table(fit, PUBLISHED)
    _setup.write_tables(tables, options.output, options.results, {})


if __name__ == "__main__":
    _setup.run(main)
