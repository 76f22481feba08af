"""Measure the accuracy of states that are reconstructed from recordings.

    python benchmarks/inverse_kinematics.py            # three gaits of 20 s
    python benchmarks/inverse_kinematics.py --quick

The nominal robot walks in C MuJoCo under bang-bang commands. Its motion is recorded at 100 Hz with the noise of motion
capture. Errors of positions are printed as median / 95th percentile over all control steps, errors of velocities as
root mean square:

- `recorded base`: the recording has the base's orientation.
- `no base`: the recording lacks the base's orientation.
- `exact`: as `no base`, but without noise.
- `stand-in`: a virtual robot of the family of the bundled recordings, without the base's orientation. Its states are
  compared with its own true states. The errors of its motors show how much its servos differ from the model's.

Divergence measures the use of the states as starting states. C MuJoCo starts from them ten times a second and replays
the walk. The errors are those of the balloon's position and heading after 0.25, 1 and 2 s. `crude` has the same
positions, with velocities from differences of neighbouring samples.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from pathlib import Path

from ballu_mjx.common import runtime

runtime.prepare()

import mujoco
import numpy as np
import tyro
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, load_model, standing_qpos
from ballu_mjx.ballu.reconstruct import BASE_PITCH
from ballu_mjx.ballu.recordings import make_recording
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.recordings.csv_format import read_recording, write_recording
from ballu_mjx.recordings.motion import Motion, ReconstructionParameters
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.registry import load_robot

CAPTURE_STEP = 0.01
"""Sampling interval of motion capture (s)."""
HORIZONS = (0.25, 1.0, 2.0)
"""Times (s) after which divergence is measured."""
GAITS = ((1.2, 0.4, 0.5), (1.6, 0.5, 0.4), (0.8, 0.45, 0.5))
"""Period (s), duty cycle and phase of the right leg."""
SITES = ("balloon", "base", "foot_left", "foot_right")
HIPS, KNEES, MOTORS = [8, 11], [9, 12], [10, 13]
"""Indices in qpos."""

TARGETS = {"knees deg": 1.0, "femurs deg": 1.0, "tibias deg": 1.0, "base mm": 2.0}
"""Limits of median errors on noisy recordings of the nominal robot.

With the base's orientation, `hips deg` has a limit of 1 too."""


@dataclasses.dataclass(frozen=True)
class Walk:
    """True states at 100 Hz, with the command that is held until the next."""

    command: Float[np.ndarray, "T 2"]
    qpos: Float[np.ndarray, "T nq"]
    qvel: Float[np.ndarray, "T nv"]


def walk(model: mujoco.MjModel, gait: tuple[float, float, float], duration: float) -> Walk:
    """Return a walk of the nominal robot in a gait, from standing, for `duration` (s)."""
    period, duty, phase = gait
    moment = np.arange(round(duration / CAPTURE_STEP) + 1) * CAPTURE_STEP
    turns = moment[:, None] / period + np.array([0.0, phase]) + 1e-9
    command = np.where(turns % 1.0 < duty, 1.0, 0.0)
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    qpos, qvel = [], []
    for row in command:
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        data.ctrl[:] = row
        mujoco.mj_step(model, data, round(CAPTURE_STEP / model.opt.timestep))
    return Walk(command, np.array(qpos), np.array(qvel))


def capture(
    model: mujoco.MjModel, walked: Walk, noise: ReconstructionParameters | None, base: bool, seed: int
) -> Recording:
    """Return a recording of a walk, with the noise that the reconstruction assumes, or without noise (None).

    `base` is whether the recording has the base's orientation.
    """
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    places, balloon = [], []
    for row in walked.qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        places.append([data.site(name).xpos.copy() for name in SITES])
        balloon.append(data.body("balloon").xquat.copy())
    sites = np.array(places)
    sites += rng.normal(size=sites.shape) * (noise.position_noise if noise else 0.0)

    def orientation(exact: np.ndarray) -> np.ndarray:
        error = rng.normal(size=(len(exact), 3)) * (noise.rotation_noise if noise else 0.0)
        seen = (Rotation.from_quat(exact, scalar_first=True) * Rotation.from_rotvec(error)).as_quat(scalar_first=True)
        flips = np.sum(seen[1:] * seen[:-1], axis=1) < 0
        return seen * np.concatenate([[1.0], np.cumprod(np.where(flips, -1.0, 1.0))])[:, None]

    return make_recording(
        name="walk",
        kind="free",
        robot="nominal",
        time=np.arange(len(sites)) * CAPTURE_STEP,
        command=walked.command,
        balloon_position=sites[:, 0],
        balloon_quaternion=orientation(np.array(balloon)),
        base_position=sites[:, 1],
        base_quaternion=orientation(walked.qpos[:, 3:7]) if base else None,
        foot_position=sites[:, 2:],
    )


def errors(walked: Walk, motion: Motion) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the absolute errors of positions, and the errors of velocities, by name."""
    every = round(CONTROL_TIMESTEP / CAPTURE_STEP)
    qpos, qvel = walked.qpos[::every][: len(motion.qpos)], walked.qvel[::every][: len(motion.qpos)]
    turn = Rotation.from_quat(qpos[:, 3:7], scalar_first=True).inv() * Rotation.from_quat(
        motion.qpos[:, 3:7], scalar_first=True
    )
    x, pitch, z = turn.as_rotvec(degrees=True).T
    degrees = np.rad2deg(motion.qpos - qpos)
    # Angles about the common axis of hips and knees. The rest of a direction's error is the base's roll and yaw.
    femur = degrees[:, HIPS] + pitch[:, None]
    tibia = femur + degrees[:, KNEES]
    rate = motion.qvel - qvel
    positions = {
        "base mm": 1e3 * np.linalg.norm(motion.qpos[:, :3] - qpos[:, :3], axis=1),
        "base pitch deg": pitch,
        "base roll, yaw deg": np.stack([x, z]),
        "knees deg": degrees[:, KNEES],
        "femurs deg": np.hypot(femur, x[:, None]),
        "tibias deg": np.hypot(tibia, x[:, None]),
        "hips deg": degrees[:, HIPS],
        "neck deg": degrees[:, 7],
        "motors deg": degrees[:, MOTORS],
    }
    velocities = {
        "base mm/s": 1e3 * rate[:, :3],
        "base roll, yaw rad/s": rate[:, [3, 5]],
        "base pitch rad/s": rate[:, 4],
        "hips rad/s": rate[:, [7, 10]],
        "knees rad/s": rate[:, [8, 11]],
        "motors rad/s": rate[:, [9, 12]],
    }
    return {name: np.abs(value).ravel() for name, value in positions.items()}, velocities


def replay(
    model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, commands: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the balloon's position (m) and heading (rad) at each horizon. A command is held for its control step."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    substeps = round(CONTROL_TIMESTEP / model.opt.timestep)
    ends = [round(horizon / CONTROL_TIMESTEP) for horizon in HORIZONS]
    place, heading = [], []
    for step, command in enumerate(commands[: ends[-1]], start=1):
        data.ctrl[:] = command
        mujoco.mj_step(model, data, substeps)
        if step in ends:
            mujoco.mj_kinematics(model, data)
            place.append(data.site("balloon").xpos.copy())
            x = data.body("balloon").xmat.reshape(3, 3)[:, 0]
            heading.append(np.arctan2(x[1], x[0]))
    return np.array(place), np.array(heading)


def divergence(model: mujoco.MjModel, walked: Walk, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of distance (mm) and heading (deg) of replays from `motion`, each [starts, horizons].

    They are relative to replays from the true states.
    """
    every = round(CONTROL_TIMESTEP / CAPTURE_STEP)
    distance, turn = [], []
    for k in range(0, len(motion.command) - round(HORIZONS[-1] / CONTROL_TIMESTEP), 2):
        commands = motion.command[k:]
        place, heading = replay(model, motion.qpos[k], motion.qvel[k], commands)
        true_place, true_heading = replay(model, walked.qpos[every * k], walked.qvel[every * k], commands)
        distance.append(1e3 * np.linalg.norm(place - true_place, axis=1))
        turn.append(np.abs(np.rad2deg(np.angle(np.exp(1j * (heading - true_heading))))))
    return np.array(distance), np.array(turn)


def crude(model: mujoco.MjModel, motion: Motion, recording: Recording) -> Motion:
    """Return `motion` with velocities from differences of neighbouring unfiltered samples, at the recording's rate."""
    unfiltered = ReconstructionParameters(position_window=0.05, rate_window=0.05, rotation_window=0.05)
    return dataclasses.replace(motion, qvel=reconstruct(recording, load_robot(), model, unfiltered).qvel)


def spread(values: np.ndarray, digits: int = 2) -> str:
    """Return the text "median / 95th percentile" of values."""
    return f"{np.median(values):.{digits}f} / {np.percentile(values, 95):.{digits}f}"


def table(columns: dict[str, dict[str, str]]) -> None:
    """Print a table with one row per quantity and one column per case."""
    rows = list(dict.fromkeys(name for column in columns.values() for name in column))
    width = max(16, *(len(cell) + 2 for column in columns.values() for cell in column.values()))
    print(f"{'':24}" + "".join(f"{case:>{width}}" for case in columns))
    for row in rows:
        print(f"{row:24}" + "".join(f"{column.get(row, ''):>{width}}" for column in columns.values()))


def gather(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return the arrays of all parts, concatenated by name."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def main(quick: bool = False, duration: float = 20.0, seed: int = 0) -> None:
    """Print tables of the errors of reconstructed states.

    Args:
        quick: Use one gait of 6 s. The result means little.
        duration: Length of each gait (s).
        seed: Seed of the noise.
    """
    gaits = GAITS[:1] if quick else GAITS
    duration = 6.0 if quick else duration
    model, noise = load_model(), ReconstructionParameters()
    walks = [walk(model, gait, duration) for gait in gaits]
    print(
        f"{len(gaits)} gaits of {duration} s, {noise.position_noise * 1e3} mm and "
        f"{np.rad2deg(noise.rotation_noise):.1f} deg of noise, seed {seed}; median / 95 %"
    )
    if quick:
        print("--quick: these numbers mean little")

    columns: dict[str, dict[str, str]] = {}
    medians: dict[str, dict[str, float]] = {}
    runs: dict[str, tuple[list[Walk], list[Motion]]] = {}
    crudes: list[Motion] = []
    for case, level, base in (("recorded base", noise, True), ("no base", noise, False), ("exact", None, False)):
        recordings = [capture(model, walked, level, base, seed + i) for i, walked in enumerate(walks)]
        start = time.perf_counter()
        motions = [reconstruct(recordings[0], load_robot(), model)]
        first = time.perf_counter() - start
        start = time.perf_counter()
        motions = [reconstruct(recording, load_robot(), model) for recording in recordings]
        each = (time.perf_counter() - start) / len(recordings)
        print(f"{case}: {first:.1f} s for the first recording, {each:.1f} s for each after", flush=True)
        runs[case] = walks, motions
        if case == "no base":
            crudes = [crude(model, *pair) for pair in zip(motions, recordings, strict=True)]

    trials = [virtual_robot.draw_trial(seed + i) for i in range(len(gaits))]
    stand_in = virtual_robot.draw_robot(seed)
    seen, true = [], []
    for walked, trial in zip(walks, trials, strict=True):
        every = round(CONTROL_TIMESTEP / CAPTURE_STEP)
        commands = walked.command[:-1:every]
        recording = virtual_robot.record(stand_in, trial, virtual_robot.open_loop(commands), duration, "stand-in")
        filled = fill(dataclasses.replace(recording, orientations={}))
        qpos, qvel = virtual_robot.record_truth(stand_in, trial, virtual_robot.open_loop(commands), duration)
        seen.append(reconstruct(filled, load_robot(), model))
        true.append(Walk(walked.command, qpos, qvel))
    runs["stand-in"] = true, seen

    for case, (truths, motions) in runs.items():
        pairs = [errors(truth, motion) for truth, motion in zip(truths, motions, strict=True)]
        positions, velocities = gather([p for p, _ in pairs]), gather([v for _, v in pairs])
        medians[case] = {name: float(np.median(value)) for name, value in positions.items()}
        said = np.rad2deg(np.mean([motion.uncertainty[BASE_PITCH] for motion in motions]))
        residuals = {name: np.mean([m.fit_error_mm[name] for m in motions]) for name in motions[0].fit_error_mm}
        columns[case] = {
            **{name: spread(value) for name, value in positions.items()},
            "pitch, as reported deg": f"{said:.2f}",
            **{f"{name} rms": f"{np.sqrt(np.mean(value**2)):.3f}" for name, value in velocities.items()},
            **{f"residual {name} mm": f"{value:.2f}" for name, value in residuals.items()},
        }
    table(columns)

    print("\ndivergence of the simulator from the truth, started from the states found")
    columns = {}
    starts = {case: run[1] for case, run in runs.items() if case != "stand-in"} | {"crude": crudes}
    for case, motions in starts.items():
        results = [divergence(model, truth, motion) for truth, motion in zip(walks, motions, strict=True)]
        distance, turn = (np.concatenate(part) for part in zip(*results, strict=True))
        columns[case] = {
            **{f"balloon {h} s, mm": spread(distance[:, i], 1) for i, h in enumerate(HORIZONS)},
            **{f"heading {h} s, deg": spread(turn[:, i], 1) for i, h in enumerate(HORIZONS)},
        }
    table(columns)

    print()
    for case in ("recorded base", "no base"):
        limits = TARGETS | ({"hips deg": 1.0} if case == "recorded base" else {})
        missed = [name for name, limit in limits.items() if medians[case][name] > limit]
        print(f"targets (medians) {limits}, {case}: {'MISSED: ' + ', '.join(missed) if missed else 'met'}")


def fill(recording: Recording) -> Recording:
    """Return a recording after writing and reading it as a file, which interpolates gaps as in users' recordings."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.csv"
        write_recording(recording, path, load_robot())
        return read_recording(path, load_robot())


if __name__ == "__main__":
    tyro.cli(main)
