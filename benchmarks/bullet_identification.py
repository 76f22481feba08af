"""Does identification help on robots that the package's model class does not contain?

For each robot of `bullet_family`: a sweep is recorded, and identified by BALLU's own method (shipped) and by declared
parameters (general, `IDENTIFY`). Compared, with nominal actuators:

- settled angles: mean absolute error (deg) of motors and knees on commands that no fit saw, by the simulator itself;
- free walking: position RMSE (m) of open-loop replays from recorded states over 1 s and 5 s, drivetrain included
  (`identification.guard`), on gaits (near) and on what is none (far).

Bounds and priors of `IDENTIFY` are of the nominal robot alone. Choices are made on robots 0 and 1.

    python benchmarks/bullet_identification.py --robots 0 1
    python benchmarks/bullet_identification.py --quick             # one robot, short fits
    python benchmarks/bullet_identification.py --output FOLDER     # FOLDER/bullet_identification.json too
"""

from __future__ import annotations

import argparse
import dataclasses
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ballu_mjx.common import runtime

runtime.prepare()

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from bullet_family import (
    CAPTURE_TIMESTEP,
    CHOSEN_ON,
    ROBOTS,
    SWEEP_HOLD,
    draw,
    held_out_commands,
    record_sweep,
    record_walking,
    sweep_commands,
    walking_commands,
)
from common import described, machine, write
from jaxtyping import Float

from ballu_mjx.ballu.leg_parameters import IdentificationConfig
from ballu_mjx.ballu.model import SIDES, suspend
from ballu_mjx.ballu.sweep import Sweep, read_sweep
from ballu_mjx.ballu.sysid_report import mean_error
from ballu_mjx.identification.actuators import identify_actuators
from ballu_mjx.identification.declarations import declared_parameters
from ballu_mjx.identification.fit_robot import FitConfig, RobotFit, fit_robot
from ballu_mjx.identification.guard import HORIZONS, choose_actuators
from ballu_mjx.identification.parameters import IdentifiedParameters, ParameterSet
from ballu_mjx.identification.residuals import MeasuredMotion, SamplingConfig, measure
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.robots.model import ModelParameters, assets, set_fields
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.drivetrain import count_slots, drivetrain_of, filter_commands

SECONDS = 20.0
"""Of each walking recording."""
SETTLED = 50
"""Samples at the end of a hold whose mean is its settled angle."""
_DEGREE = float(np.pi / 180)


def leg_entries(side: str) -> list[dict[str, Any]]:
    """Return what is identified of a leg. Nothing is tied: legs differ."""
    knee, servo, cable = {"joint": f"knee_{side}"}, {"actuator": f"servo_{side}"}, {"tendon": f"cable_{side}"}
    command = {"command": side}
    return [
        {**knee, "field": "stiffness", "prior": 0.005},
        {**knee, "field": "damping", "bounds": [1e-4, 0.1], "prior": 0.01},
        {**knee, "field": "jnt_range", "index": 0, "bounds": [20 * _DEGREE, 35 * _DEGREE], "prior": 3 * _DEGREE,
         "name": f"knee_stop_{side}", "unit": "rad"},
        {**servo, "field": "forcerange", "bounds": [0.02, 0.34], "prior": 0.03},
        {**cable, "field": "springlength", "bounds": [0.3326, 0.3386], "prior": 1e-3},
        {**cable, "field": "stiffness", "bounds": [200.0, 8000.0], "prior": 1000.0},
        {**command, "field": "scale", "bounds": [0.5, 1.3], "prior": 0.15},
        {**command, "field": "offset", "bounds": [-0.15, 0.15], "prior": 0.05},
        {**command, "field": "delay", "bounds": [0.0, 0.12], "prior": 0.03},
        {**command, "field": "backlash", "bounds": [0.0, 0.15], "prior": 0.03},
        {**command, "field": "lag", "bounds": [0.0, 0.15], "prior": 0.03},
    ]  # fmt: skip


IDENTIFY = tuple(entry for side in SIDES for entry in leg_entries(side))


def suspended_model() -> mujoco.MjModel:
    """Return the nominal robot with its base held."""
    spec = mujoco.MjSpec.from_file(str(assets() / "ballu.xml"))
    suspend(spec)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return spec.compile()


def measured_sweep(recording: Recording, robot: RobotDescription, model: mujoco.MjModel) -> MeasuredMotion:
    """Return a sweep with the hips, which are not recorded, where the legs' weight takes them at rest."""
    hips = hanging_hips(model, recording)
    complete = dataclasses.replace(recording, joint_angles={**recording.joint_angles, **hips})
    found = measure(complete, robot, model, SamplingConfig())
    position, velocity = found.position_noise.copy(), found.velocity_noise.copy()
    for side in SIDES:
        dof = model.joint(f"hip_{side}").dofadr[0]
        position[dof], velocity[dof] = _HIP_NOISE
    return dataclasses.replace(found, position_noise=position, velocity_noise=velocity)


_HIP_NOISE = 5 * _DEGREE, 0.5
"""rad, rad/s: legs swing about where they would rest."""


def hanging_hips(model: mujoco.MjModel, recording: Recording) -> dict[str, Float[np.ndarray, " T"]]:
    """Return the hips' angles (rad) at which a leg's centre of mass is below its hip."""
    data, found = mujoco.MjData(model), {}
    for side in SIDES:
        knees = np.linspace(0.2, 1.9, 60)
        angles = np.zeros(len(knees))
        knee = model.joint(f"knee_{side}").qposadr[0]
        body = model.body(f"femur_{side}").id
        for number, angle in enumerate(knees):
            data.qpos[:] = 0.0
            data.qpos[knee] = angle
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            x, _, z = data.subtree_com[body] - data.xanchor[model.joint(f"hip_{side}").id]
            angles[number] = -np.arctan2(-x, -z)
        found[f"hip_{side}"] = np.interp(recording.joint_angles[f"knee_{side}"], knees, angles)
    return found


def settled(
    recording: Recording, actuators: ModelParameters | None, model: mujoco.MjModel
) -> Float[np.ndarray, "holds 2 2"]:
    """Return settled angles (rad; motor and knee, left and right) of C MuJoCo under a recording's commands, with the
    drivetrain where the parameters have one."""
    if actuators is not None:
        full = load_robot().load_model(actuators)
        model = suspended_model()
        copy_numbers(full, model)
    every = round(CAPTURE_TIMESTEP / model.opt.timestep)
    commands = np.repeat(recording.command, every, axis=0)
    if (drivetrain := drivetrain_of(actuators)) is not None:
        slots = count_slots(float(np.max(drivetrain.delay)), model.opt.timestep)
        commands = np.asarray(filter_commands(drivetrain, jnp.asarray(commands), model.opt.timestep, slots))
    data = mujoco.MjData(model)
    angles = [f"{kind}_{side}" for kind in ("motor", "knee") for side in SIDES]
    places = [model.joint(name).qposadr[0] for name in angles]
    data.ctrl[:] = commands[0]
    for kind in ("hip", "knee"):
        for side in SIDES:
            stop = model.joint(f"knee_{side}").range[0]
            data.qpos[model.joint(f"{kind}_{side}").qposadr[0]] = stop if kind == "knee" else -0.3
    mujoco.mj_step(model, data, 1000)
    seen = []
    for command in commands:
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
        seen.append(data.qpos[places].copy())
    holds = np.array(seen)[::every].reshape(-1, round(SWEEP_HOLD / CAPTURE_TIMESTEP), 2, 2)
    return holds[:, -SETTLED:].mean(axis=1)


def copy_numbers(full: mujoco.MjModel, held: mujoco.MjModel) -> None:
    """Give the held robot the numbers of joints, servos and cables of the free one, by name."""
    for number in range(held.njnt):
        name = held.joint(number).name
        one, other = held.joint(number), full.joint(name)
        for field in ("stiffness", "range"):
            getattr(one, field)[:] = getattr(other, field)
        for field in ("damping", "armature", "frictionloss"):
            getattr(one, field)[:] = getattr(other, field)
        held.qpos_spring[one.qposadr] = full.qpos_spring[other.qposadr]
    names = ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "tendon_lengthspring", "tendon_stiffness")
    set_fields(held, {name: getattr(full, name) for name in (*names, "tendon_damping", "tendon_frictionloss")})


def walking(recordings: Mapping[str, Recording], actuators: ModelParameters | None) -> list[Motion]:
    """Return recorded states, with the motors where these actuators take them, drivetrain included."""
    robot = load_robot()
    model, drivetrain, found = robot.load_model(actuators), drivetrain_of(actuators), []
    for recording in recordings.values():
        driven = recording
        if drivetrain is not None:
            slots = count_slots(float(np.max(drivetrain.delay)), CAPTURE_TIMESTEP)
            ctrl = filter_commands(drivetrain, jnp.asarray(recording.command), CAPTURE_TIMESTEP, slots)
            driven = dataclasses.replace(recording, command=np.asarray(ctrl, float))
        motion = reconstruct(driven, robot, model)
        own = recording.command[:: round(robot.control_timestep / CAPTURE_TIMESTEP)][: len(motion.command)]
        found.append(dataclasses.replace(motion, command=own))
    return found


def open_loop(recordings: Mapping[str, Recording], actuators: ModelParameters) -> dict[str, dict[str, float]]:
    """Return nominal and identified position RMSE (m) by group and horizon, each from its own reconstruction."""
    robot = load_robot()
    own = choose_actuators(robot, actuators, walking(recordings, actuators), HORIZONS).rows
    plain = choose_actuators(robot, actuators, walking(recordings, None), HORIZONS).rows
    return {
        f"{one.group} {one.horizon:g} s": {"nominal": other.nominal.position, "identified": one.identified.position}
        for one, other in zip(own, plain, strict=True)
    }


def fit_general(sweep: Recording, model: mujoco.MjModel, *, quick: bool) -> tuple[RobotFit, IdentifiedParameters]:
    """Identify `IDENTIFY` from a sweep, and return the values also as the free robot's."""
    robot = dataclasses.replace(load_robot(), identify=IDENTIFY)
    held = declared_parameters(robot, model)
    config = FitConfig(window_seconds=SWEEP_HOLD, starts=1, steps=5 if quick else 15)
    fit = fit_robot(held, [measured_sweep(sweep, robot, model)], None, config)
    free: ParameterSet = declared_parameters(robot, robot.load_model())
    assert free.names == held.names
    return fit, IdentifiedParameters(jnp.asarray(fit.values), free)


def examine(seed: int, *, quick: bool) -> dict[str, Any]:
    """Return all numbers of one robot."""
    bullet, model, robot = draw(seed), suspended_model(), load_robot()
    sweep = record_sweep(bullet, sweep_commands(), "sweep", seed)
    held_out = record_sweep(bullet, held_out_commands(seed), "held-out", seed + 100)
    recordings = {
        name: record_walking(bullet, commands, name, seed) for name, commands in walking_commands(SECONDS).items()
    }
    truth: Sweep = read_sweep({Path("held-out.csv"): held_out}, levels=10)
    errors = {"nominal": mean_error(settled(held_out, None, model), truth)}
    ways: dict[str, Any] = {}
    began = time.perf_counter()
    general, parameters = fit_general(sweep, model, quick=quick)
    errors["general"] = mean_error(settled(held_out, parameters, model), truth)
    seconds = {"general": time.perf_counter() - began}
    ways["general"] = open_loop(recordings, parameters)
    print(f"{bullet.name}: settled {errors}; general {ways['general']}", flush=True)
    began = time.perf_counter()
    config = IdentificationConfig(starts=2, draws=16, motion=not quick)
    shipped = identify_actuators([sweep], robot, config).parameters
    seconds["shipped"] = time.perf_counter() - began
    errors["shipped"] = mean_error(settled(held_out, shipped, model), truth)
    ways["shipped"] = open_loop(recordings, shipped)
    print(f"{bullet.name}: settled {errors}; shipped {ways['shipped']}", flush=True)
    rows = zip(general.parameters.names, general.values, general.standard_errors, strict=True)
    return {
        "robot": dataclasses.asdict(bullet),
        "settled_deg": errors,
        "open_loop_m": ways,
        "seconds": seconds,
        "parameters": {name: {"value": float(v), "standard_error": float(e)} for name, v, e in rows},
        "at_bounds": list(general.at_bounds),
        "creep": read_sweep({Path("sweep.csv"): sweep}).creep,
    }


def table(results: Mapping[int, Mapping[str, Any]]) -> str:
    """Return errors and ratios to nominal as text."""
    lines = [f"{'robot':8}{'quantity':24}{'nominal':>10}{'shipped':>10}{'general':>10}{'ratio':>8}{'target':>8}"]
    for seed, result in results.items():
        errors = result["settled_deg"]
        rows = [("settled angles (deg)", errors["nominal"], errors["shipped"], errors["general"], 0.25)]
        for name, general in result["open_loop_m"]["general"].items():
            shipped = result["open_loop_m"]["shipped"][name]["identified"]
            rows.append((f"position {name} (m)", general["nominal"], shipped, general["identified"], 0.6))
        for name, nominal, shipped, general, target in rows:
            cells = f"{nominal:>10.3f}{shipped:>10.3f}{general:>10.3f}{general / nominal:>8.2f}{target:>8.2f}"
            lines.append(f"{seed:<8}{name:24}{cells}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=None, choices=list(ROBOTS))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    robots = arguments.robots or (CHOSEN_ON[:1] if arguments.quick else list(ROBOTS))
    results = {}
    for seed in robots:
        results[seed] = examine(seed, quick=arguments.quick)
        said = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
        if arguments.output:
            write(arguments.output, "bullet_identification", {"commit": said.stdout.strip(), "robots": results})
    print(f"\n{described(machine())}; JAX {jax.__version__}, MuJoCo {mujoco.__version__}\n{table(results)}")


if __name__ == "__main__":
    main()
