"""A two-joint servo arm on a stand, and the true arm in C MuJoCo. The true arm has other parameters, and a drivetrain
that the arm's model lacks.

`python tests/servo_arm.py FOLDER` writes the files of the example in docs/identify.md.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

if __name__ == "__main__":  # before JAX is imported
    from ballu_mjx.common import runtime

    runtime.prepare()

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float
from robot_files import write_robot

from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.parameters import IdentifiedParameters
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.drivetrain import count_slots, filter_commands

_MODEL = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.005" integrator="implicitfast" iterations="6" ls_iterations="10"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.2" armature="0.01" range="-2 2"/>
      <inertial pos="0 0 -0.1" mass="0.3" diaginertia="0.002 0.002 0.0003"/>
      <site name="tip" pos="0 0 -0.2"/>
      <body name="lower" pos="0 0 -0.2">
        <joint name="elbow" axis="0 1 0" damping="0.1" armature="0.005" range="-2 2"/>
        <inertial pos="0 0 -0.08" mass="0.15" diaginertia="0.0006 0.0006 0.0001"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="one" joint="shoulder" kp="6" kv="0.1" ctrlrange="-1 1"/>
    <position name="two" joint="elbow" kp="4" kv="0.1" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""
IDENTIFY = [
    {"joint": "elbow", "field": "damping", "bounds": [0.01, 1]},
    {"body": "lower", "field": "mass", "name": "mass"},
    *({"command": "shoulder", "field": field} for field in ("delay", "backlash", "scale")),
]
TRUTH = {
    "elbow_damping": 0.18,
    "mass": 0.2,
    "shoulder_delay": 0.073,
    "shoulder_backlash": 0.12,
    "shoulder_scale": 0.8,
}


def write_arm(folder: Path, model: str = _MODEL) -> RobotDescription:
    """Write the model and its description to `folder`. Return the description."""
    commands = {"shoulder": "one", "elbow": "two"}
    keys = {"tracked": "tip", "commands": commands, "joints": list(commands), "identify": IDENTIFY}
    return write_robot(folder, "arm", model, **keys)


def identified(robot: RobotDescription, **values: float) -> IdentifiedParameters:
    """Return the nominal parameters with `values` in place of those that they name."""
    declared = declared_parameters(robot, robot.load_model())
    vector = declared.nominal.copy()
    for name, value in values.items():
        vector[declared.names.index(name)] = value
    return IdentifiedParameters(jnp.asarray(vector), declared)


def wandering(seed: int, steps: int, hold: int = 5) -> Float[np.ndarray, "steps 2"]:
    """Return commands at the control rate, each held for `hold` control steps, with four decimals."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1, 1, (steps // hold + 1, 2)), hold, axis=0)[:steps].round(4)


def true_path(
    robot: RobotDescription,
    parameters: IdentifiedParameters,
    commands: Float[np.ndarray, "steps 2"],
    friction: float = 0.0,
) -> tuple[Float[np.ndarray, "physics 2"], Float[np.ndarray, "physics 2"]]:
    """Return qpos and qvel after each physics step of C MuJoCo, from the rest pose, with 10 physics steps per command.

    `friction`: largest offset (rad) from its target at which dry friction can hold each joint. The arm's model lacks
    dry friction.
    """
    model = robot.load_model(parameters)
    model.dof_frictionloss[:] = friction * -model.actuator_biasprm[:, 1]
    model.opt.iterations, model.opt.tolerance = 50, 0
    timestep = float(model.opt.timestep)
    with jax.enable_x64(True):
        fine = jnp.asarray(np.repeat(commands, 10, axis=0))
        ctrl = np.asarray(filter_commands(parameters.drivetrain(), fine, timestep, count_slots(0.1, timestep)))
    data = mujoco.MjData(model)
    states = []
    for now in ctrl:
        data.ctrl[:] = now
        mujoco.mj_step(model, data)
        states.append((data.qpos.copy(), data.qvel.copy()))
    qpos, qvel = zip(*states, strict=True)
    return np.array(qpos), np.array(qvel)


def record_arm(
    folder: Path,
    robot: RobotDescription,
    name: str,
    seed: int,
    kind: str = "free",
    *,
    truth: Mapping[str, float] = TRUTH,
    noise: float = 0.2,
    friction: float = 0.0,
    still: Sequence[int] = (),
) -> Path:
    """Write a recording of 6 s of the true arm at 100 Hz. Suspended recordings contain only joint angles.

    **Arguments**

    - `still`: indices of the commands that stay 0.
    - `noise`: standard deviation of the joint angles' noise (deg).
    - `friction`: as in `true_path`, but in deg.
    """
    seconds, free = 6.0, kind == "free"
    commands = wandering(seed, round(seconds / 0.05), hold=8)
    commands[:, list(still)] = 0.0
    qpos, _ = true_path(robot, identified(robot, **truth), commands, np.deg2rad(friction))
    qpos = np.concatenate([np.zeros((1, 2)), qpos[:-1]])[::2]
    rng = np.random.default_rng(seed)
    places = "tip_x,tip_y,tip_z,tip_qw,tip_qx,tip_qy,tip_qz," if free else ""
    rows = [f"time,command_shoulder,command_elbow,{places}shoulder,elbow"]
    for sample, angles in enumerate(qpos):
        half, turn = angles[0] / 2, angles[0]
        tip = (-0.2 * np.sin(turn), 0, 1 - 0.2 * np.cos(turn), np.cos(half), 0, np.sin(half), 0)
        measured = angles + np.deg2rad(noise) * rng.normal(size=2)
        cells = (sample * 0.01, *commands[sample // 5], *(tip if free else ()), *measured)
        rows.append(",".join(f"{cell:.6f}" for cell in cells))
    path = folder / f"{name}.csv"
    path.write_text("\n".join(rows) + "\n")
    keys = {"format": "ballu-recording/1", "kind": kind, "robot": "arm", "notes": ""}
    path.with_suffix(".json").write_text(json.dumps(keys))
    return path


def write_example(folder: Path, friction: float = 0.0) -> None:
    """Write the files of docs/identify.md: the model, its description, two recordings and one for validation."""
    folder.mkdir(parents=True, exist_ok=True)
    robot = write_arm(folder)
    for seed, use in enumerate(("recordings", "recordings", "validation")):
        (folder / use).mkdir(exist_ok=True)
        record_arm(folder / use, robot, f"motion-{seed}", seed, "suspended", friction=friction)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write the example of docs/identify.md to a folder.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--friction", type=float, default=0.0, help="dry friction (deg) that the model lacks")
    options = parser.parse_args()
    write_example(options.folder, options.friction)
