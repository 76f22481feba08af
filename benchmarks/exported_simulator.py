"""How far an exported simulator in C MuJoCo is from ours.

`python benchmarks/exported_simulator.py RUN --recordings FOLDER ...`

From the first state of each recording, under its commands, three simulators run side by side: ours in single precision,
ours in double precision, and the exported one. The differences tell a fault of the export from the rounding of single
precision. Positions are of the tracked site, angles of its body.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from ballu_mjx.common import runtime

runtime.prepare()

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.simulators import load_simulator
from ballu_mjx.recordings.csv_format import list_recordings, read_recording
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.residuals.deploy.export import begin_rollout, export_simulator, improved_model, in_double
from ballu_mjx.residuals.deploy.residual import ImprovedSimulator
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.simulator import AugmentedSimulator, RolloutState

PAIRS = (("exported", "double"), ("exported", "single"), ("single", "double"))
"""Simulators that are compared."""
Poses = tuple[Float[np.ndarray, "runs steps 3"], Float[np.ndarray, "runs steps 4"]]
"""Of the tracked site: places (m) and quaternions."""


def rollouts(
    simulator: AugmentedSimulator,
    qpos: Float[np.ndarray, "runs nq"],
    qvel: Float[np.ndarray, "runs nv"],
    commands: Float[np.ndarray, "runs steps commands"],
) -> Float[np.ndarray, "runs steps nq"]:
    """Return generalized positions after each control step, in the precision that JAX is set to."""

    def run(qpos: Any, qvel: Any, commands: Any) -> Any:
        def step(state: RolloutState, command: Any) -> tuple[RolloutState, Any]:
            after = simulator.step(state, command).state
            return after, after.physics.qpos

        return jax.lax.scan(step, begin_rollout(simulator, qpos, qvel, commands[0])[0], commands)[1]

    return np.asarray(jax.jit(jax.vmap(run))(*map(jnp.asarray, (qpos, qvel, commands))))


def in_c(folder: Path, qpos: np.ndarray, qvel: np.ndarray, commands: np.ndarray) -> Float[np.ndarray, "runs steps nq"]:
    """Return the same of the exported simulator."""
    simulator, runs = ImprovedSimulator(folder), []
    for start, speed, sent in zip(qpos, qvel, commands, strict=True):
        simulator.reset(start, speed, sent[0])
        runs.append([simulator.step(command).qpos.copy() for command in sent])
    return np.array(runs)


def poses(robot: RobotDescription, model: mujoco.MjModel, qpos: Float[np.ndarray, "runs steps nq"]) -> Poses:
    """Return where the tracked site is, and how it is turned."""
    data, site = mujoco.MjData(model), model.site(robot.tracked).id
    places, turns = np.zeros((*qpos.shape[:2], 3)), np.zeros((*qpos.shape[:2], 4))
    for index in np.ndindex(*qpos.shape[:2]):
        data.qpos[:] = qpos[index]
        mujoco.mj_kinematics(model, data)
        places[index], turns[index] = data.site_xpos[site], data.xquat[model.site_bodyid[site]]
    return places, turns


def apart(one: Poses, other: Poses) -> tuple[Float[np.ndarray, "runs steps"], Float[np.ndarray, "runs steps"]]:
    """Return distances (mm) and angles (deg) between two simulators' poses."""
    distance = 1000 * np.linalg.norm(one[0] - other[0], axis=-1)
    # By the sine of half the angle: the cosine has no digits left for small ones.
    w, v = one[1][..., :1], one[1][..., 1:]
    turned = w * other[1][..., 1:] - other[1][..., :1] * v - np.cross(v, other[1][..., 1:])
    return distance, 2 * np.rad2deg(np.arcsin(np.minimum(np.linalg.norm(turned, axis=-1), 1.0)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="run of a residual, of identified actuators or of a policy")
    parser.add_argument("--recordings", type=Path, nargs="+", required=True, help="recordings, or folders of them")
    parser.add_argument("--count", type=int, default=10, help="recordings to use")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of a rollout")
    parser.add_argument("--output", type=Path, help="JSON file for the numbers")
    options = parser.parse_args()
    simulator = load_simulator(options.run)
    robot = simulator.robot
    steps = round(options.seconds / robot.control_timestep)
    motions = []
    for path in list_recordings(options.recordings):
        motion = reconstruct(read_recording(path, robot), robot)
        if len(motion.command) >= steps and len(motions) < options.count:
            motions.append(motion)
    if not motions:
        raise InputError(f"No recording is {options.seconds:g} s long; give longer ones, or a smaller --seconds.")
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
    seen = {name: poses(robot, model, each) for name, each in found.items()}
    report: dict[str, Any] = {"robot": robot.name, "run": str(options.run), "recordings": [m.name for m in motions]}
    print(f"{robot.name}, {len(motions)} recordings, {options.seconds:g} s\n")
    print("| simulators | after that, median | worst | largest at any time |")
    print("| --- | ---: | ---: | ---: |")
    for one, other in PAIRS:
        distance, angle = apart(seen[one], seen[other])
        report[f"{one}-{other}"] = {"mm": distance[:, -1].tolist(), "deg": angle[:, -1].tolist()}
        cells = (
            (np.median(distance[:, -1]), np.median(angle[:, -1])),
            (distance[:, -1].max(), angle[:, -1].max()),
            (distance.max(), angle.max()),
        )
        print(f"| {one} - {other} | {' | '.join(f'{mm:.2g} mm, {deg:.2g} deg' for mm, deg in cells)} |")
    print("\n| recording | " + " | ".join(f"{one} - {other}" for one, other in PAIRS) + " |")
    print("| --- |" + " ---: |" * len(PAIRS))
    for number, motion in enumerate(motions):
        pairs = [apart(seen[one], seen[other]) for one, other in PAIRS]
        said = " | ".join(f"{mm[number, -1]:.2g} mm, {deg[number, -1]:.2g} deg" for mm, deg in pairs)
        print(f"| {motion.name} | {said} |")
    if options.output is not None:
        options.output.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
