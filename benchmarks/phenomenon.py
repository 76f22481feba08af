"""Measure the difference between the virtual robot and the vanilla simulator.

1. Yaw after 20 s, averaged over a gait and its left-right mirrored copy. In a symmetric simulator the average is 0. The
   robot turns.
2. RMSE of vanilla over a horizon of 10 s, started from recorded states, for each recording. It is repeated with the
   robot's true actuator parameters, the result of a perfect identification. The remaining error is due to air, balloon
   offset, friction, backlash and latency.

`python benchmarks/phenomenon.py`
"""

from __future__ import annotations

import argparse
import multiprocessing

from ballu_mjx.common import runtime

runtime.prepare()

import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout
from scipy.spatial.transform import Rotation

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, load_model, standing_qpos
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.recordings.csv_format import list_bundled, read_recording
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.step import count_substeps

SECONDS = 20.0
"""Length of a gait's recording (s)."""
GAITS = ((0.7, 0.40, 1.0), (0.9, 0.35, 0.9), (1.1, 0.45, 0.8), (1.3, 0.40, 1.0), (1.6, 0.30, 0.8), (1.9, 0.40, 0.7))
"""Period (s), duty cycle and amplitude of bang-bang gaits, with the legs half a period apart."""
HORIZON = 10.0
"""Length of a replay (s)."""


def gait_commands(gait: tuple[float, float, float]) -> Float[np.ndarray, "steps 2"]:
    """Return the commands of a gait at the control rate."""
    period, duty, high = gait
    phase = np.arange(round(SECONDS / CONTROL_TIMESTEP))[:, None] * CONTROL_TIMESTEP / period
    return np.where((phase + np.array([0.0, 0.5])) % 1.0 < duty - 1e-9, high, 0.0)


def yaw(qpos: Float[np.ndarray, "states nq"]) -> Float[np.ndarray, " states"]:
    """Return the unwrapped yaw of the base (deg)."""
    rotation = Rotation.from_quat(qpos[:, 3:7], scalar_first=True)
    return np.rad2deg(np.unwrap(rotation.as_euler("ZYX")[:, 0]))


def robot_yaw(seed: int, trial: int, commands: Float[np.ndarray, "steps 2"]) -> float:
    """Return the change of the virtual robot's yaw (deg) over the commands."""
    virtual, circumstances = virtual_robot.draw_robot(seed), virtual_robot.draw_trial(trial)
    qpos, _ = virtual_robot.record_truth(virtual, circumstances, virtual_robot.open_loop(commands), SECONDS)
    turned = yaw(qpos)
    return float(turned[-1] - turned[0])


def replay(
    model: mujoco.MjModel, starts: list[tuple[np.ndarray, np.ndarray]], commands: Float[np.ndarray, "runs steps 2"]
) -> Float[np.ndarray, "runs steps nq"]:
    """Return the generalized positions at the end of every control step, simulated in C MuJoCo."""
    spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
    data = mujoco.MjData(model)
    states = np.zeros((len(starts), mujoco.mj_stateSize(model, spec)))
    for row, (qpos, qvel) in enumerate(starts):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_getState(model, data, states[row], spec)
    count = count_substeps(model, CONTROL_TIMESTEP)
    workers = [mujoco.MjData(model) for _ in range(2)]
    simulated = np.asarray(rollout.rollout(model, workers, states, np.repeat(commands, count, axis=1))[0])
    return simulated[:, count - 1 :: count, 1 : 1 + model.nq]


def standing(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the state after two seconds of standing with zero commands."""
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    mujoco.mj_step(model, data, round(2.0 / model.opt.timestep))
    return data.qpos.copy(), data.qvel.copy()


def horizon_errors(model: mujoco.MjModel, motion: Motion) -> tuple[float, float]:
    """Return position RMSE (m) and yaw RMSE (deg) of the base over the horizon, averaged over starts 1 s apart."""
    steps, interval = round(HORIZON / CONTROL_TIMESTEP), round(1.0 / CONTROL_TIMESTEP)
    firsts = range(2, len(motion.command) - steps + 1, interval)
    commands = np.stack([motion.command[first : first + steps] for first in firsts])
    runs = replay(model, [(motion.qpos[first], motion.qvel[first]) for first in firsts], commands)
    position, turn = [], []
    for first, run in zip(firsts, runs, strict=True):
        recorded = motion.qpos[first + 1 : first + steps + 1]
        position.append(np.sqrt(np.mean(np.sum((run[:, :3] - recorded[:, :3]) ** 2, axis=1))))
        difference = np.deg2rad(yaw(run) - yaw(recorded))
        turn.append(np.rad2deg(np.sqrt(np.mean(np.arctan2(np.sin(difference), np.cos(difference)) ** 2))))
    return float(np.mean(position)), float(np.mean(turn))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", type=int, default=0, help="seed of the virtual robot; 0 is the bundled one")
    parser.add_argument("--quick", action="store_true", help="two gaits, and one recording of each split")
    arguments = parser.parse_args()
    gaits = GAITS[:2] if arguments.quick else GAITS

    jobs = []
    for trial, gait in enumerate(gaits):
        commands = gait_commands(gait)
        jobs += [(arguments.robot, 1000 + 2 * trial, commands), (arguments.robot, 1001 + 2 * trial, commands[:, ::-1])]
    with multiprocessing.get_context("spawn").Pool() as pool:
        turned = np.reshape(pool.starmap(robot_yaw, jobs), (-1, 2)).mean(axis=1)
    vanilla = load_model()
    both = np.stack([job[2] for job in jobs])
    simulated = replay(vanilla, [standing(vanilla)] * len(both), both)
    vanilla_turned = np.reshape([yaw(run)[-1] for run in simulated], (-1, 2)).mean(axis=1)
    print(f"Yaw after {SECONDS:g} s, mean of a gait and its mirrored copy (deg)")
    print(f"{'period (s)':>12}{'duty':>8}{'height':>8}{'robot':>10}{'vanilla':>10}")
    for gait, ours, theirs in zip(gaits, turned, vanilla_turned, strict=True):
        print(f"{gait[0]:>12g}{gait[1]:>8g}{gait[2]:>8g}{ours:>10.1f}{theirs:>10.1f}")
    print(f"robot at 30 deg or more: {np.sum(np.abs(turned) >= 30)} of {len(gaits)}; ", end="")
    print(f"vanilla at 5 deg or less: {np.sum(np.abs(vanilla_turned) <= 5)} of {len(gaits)}\n")

    if arguments.robot != 0:
        return
    known = load_model(virtual_robot.draw_robot(arguments.robot).actuators)
    print(f"RMSE over {HORIZON:g} s from recorded states, mean over starts: position (m) and yaw (deg)")
    print(f"{'recording':>26}{'vanilla':>18}{'true actuators':>20}")
    wide = []
    for split in ("validation", "test", "training"):
        paths = list_bundled(split)
        for path in paths[:1] if arguments.quick else paths:
            motion = reconstruct(read_recording(path, load_robot()), load_robot(), vanilla)
            (p, y), (q, z) = horizon_errors(vanilla, motion), horizon_errors(known, motion)
            wide.append((p >= 0.2, y >= 10.0, q / p, z / y))
            print(f"{split + ' ' + motion.name:>26}{p:>10.3f} m{y:>6.1f}{q:>12.3f} m{z:>6.1f}")
    table = np.array(wide, float)
    print(f"vanilla at 0.2 m or more: {table[:, 0].sum():.0f} of {len(table)}, ", end="")
    print(f"at 10 deg or more: {table[:, 1].sum():.0f} of {len(table)}")
    print(f"left with the true actuators (median): {np.median(table[:, 2]):.2f} of the position error, ", end="")
    print(f"{np.median(table[:, 3]):.2f} of the yaw error")


if __name__ == "__main__":
    main()
