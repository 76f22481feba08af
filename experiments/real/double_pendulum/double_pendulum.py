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
# The model has the published masses, lengths and inertias. The strength of the motors is identified, because it may
# differ from the nominal one. Six recordings are for training. Two are for validation: they chose the declared
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

import _fit
import numpy as np

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


def load(data: Path, names: tuple[str, ...]) -> list[MeasuredMotion]:
    """Read and measure recordings, given the times in their names."""
    return read([data / f"sysid-20230629-{name}.csv.gz" for name in names])


def load_swing_ups(data: Path) -> list[MeasuredMotion]:
    """Read and measure the swing-ups of the acrobot under the controller `ilqr_tvlqr_lqr`, if there are any."""
    return read(sorted(data.glob("acrobot-ilqr_tvlqr_lqr-experiment*.csv.gz")))


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


def row(name: str, found: HeldOut, motions: int) -> str:
    """Return a table row with the median absolute errors (deg) of both joints at the end of the windows.

    The first cell is over all recordings, the others are for each one.
    """
    each = [np.median(np.abs(found.errors[found.motion == number, -1, :2]), axis=0) for number in range(motions)]
    cells = [np.rad2deg(found.final_median[:2]), *map(np.rad2deg, each)]
    return f"| {name} | " + " | ".join(f"{q1:.2f} / {q2:.2f}" for q1, q2 in cells) + " |"


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
    options = _fit.parse("Identify a geared double pendulum, and test on runs that the fit has not seen.")
    fit = identify(options.data, quick=options.quick)
    _fit.show(fit)
    print(f"validation, score: nominal {fit.nominal.score:.3g}, identified {fit.identified.score:.3g}")
    points = _fit.candidates(fit, PUBLISHED)
    for seconds in (0.4,) if options.quick else (0.4, 1.0):
        print(f"\nMedian |error| after {seconds:g} s, deg, shoulder / elbow: all, validation, test\n")
        motions = load(options.data, (*VALIDATION, *TEST))
        found = replay(fit.parameters, motions, list(points.values()), seconds, 0.2)
        for name, errors in zip(points, found, strict=True):
            print(row(name, errors, len(motions)))
    if swing_ups := [] if options.quick else load_swing_ups(options.data):
        print("\nSwing-ups of the acrobot (other motions, another controller): tip after 0.4 s, m, median and 90 %\n")
        found = replay(fit.parameters, swing_ups, list(points.values()), 0.4, 0.2)
        for name, errors in zip(points, found, strict=True):
            middle, most = np.percentile(tip_errors(errors, swing_ups, 0.4, 0.2), [50, 90])
            print(f"| {name} | {middle:.4f} | {most:.4f} |")


if __name__ == "__main__":
    _setup.run(main)
