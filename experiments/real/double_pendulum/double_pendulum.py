# %% [markdown]
# # Identification of a real double pendulum: friction, motors and delay
#
# The data are public: `dfki-ric-underactuated-lab/double_pendulum` on GitHub, commit `1e8544e`, BSD-3-Clause; Wiebe et
# al., open-source dual-purpose acrobot and pendubot platform, IEEE RAM 2023. We use the ten recordings of design C.1 in
# `data/experiment_records/design_C.1/sys_id/20230629`. `--data` is a folder with these as recordings in the project's
# format (`docs/data.md`), named `sysid-20230629-HHMMSS.csv.gz`. The columns `shoulder` and `elbow` are `pos_meas1` and
# `pos_meas2` (rad). The columns `command_shoulder` and `command_elbow` are `tau_con / 20 + 0.5`. The positions of
# `middle` and `tip` are computed by forward kinematics.
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
import numpy as np

from ballu_mjx.common.results import Cell, Table
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.fit_robot import FitConfig, HeldOut, RobotFit, fit_robot, replay
from ballu_mjx.identification.measured_motion import MeasuredMotion, SamplingConfig, measure
from ballu_mjx.identification.window_simulator import cut_windows
from ballu_mjx.recordings.csv_format import read_recording
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


HORIZONS = (0.4, 1.0)
"""Horizons of the errors on held-out recordings (s)."""
SWING_UP_HORIZON = 0.4
"""Horizon of the errors on swing-ups (s)."""
INTERVAL = 0.2
"""Time between the starts of two replays (s)."""


def load(data: Path, names: tuple[str, ...]) -> list[MeasuredMotion]:
    """Read and measure recordings, given the times in their names."""
    return read([data / f"sysid-20230629-{name}.csv.gz" for name in names])


def load_swing_ups(data: Path) -> list[MeasuredMotion]:
    """Read and measure the swing-ups, if there are any."""
    return read(swing_ups(data))


def swing_ups(data: Path) -> list[Path]:
    """Return the recorded swing-ups of the acrobot under the controller `ilqr_tvlqr_lqr`."""
    return sorted(data.glob("acrobot-ilqr_tvlqr_lqr-experiment*.csv.gz"))


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
    fit = identify(options.data, quick=options.quick)
    _fit.show(fit)
    print(f"validation, score: nominal {fit.nominal.score:.3g}, identified {fit.identified.score:.3g}")
    horizons = HORIZONS[:1] if options.quick else HORIZONS
    motions = load(options.data, (*VALIDATION, *TEST))
    tables = {f"after_{1000 * seconds:.0f}_ms": held_out_table(fit, motions, seconds) for seconds in horizons}
    if swing_ups := [] if options.quick else load_swing_ups(options.data):
        tables["swing_ups"] = swing_up_table(fit, swing_ups)
    tables["parameters"] = _fit.parameter_table(fit, PUBLISHED)
    _setup.write_tables(tables, options.output, options.results, {})


if __name__ == "__main__":
    _setup.run(main)
