"""Measure if identification improves the simulation of robots outside of the package's model class.

For each robot of `bullet_family`, a sweep is recorded and identified as in `train sysid`. The identified actuators are
compared with the nominal ones:

- settled angles: mean absolute error (deg) of simulated motors and knees, on commands that the fit did not use.
- free walking: position RMSE (m) of open-loop replays from recorded states over 1 s and 5 s, with the drivetrain
  (`identification.actuator_choice`). Near recordings are of gaits, far ones of other commands.
- the choice of `--actuators auto`, from a replay of other recordings.

Choices in the package were based on robots 0, 1 and 2. All five take about an hour on two cores.

`--true-legs` identifies nothing. It replays walks with the robots' true legs and drivetrains, as far as the package's
model can represent them. The remaining error is due to air, contact and the form of the mechanism, which no sweep
shows. It takes minutes.

    python benchmarks/bullet_identification.py
    python benchmarks/bullet_identification.py --robots 0 1
    python benchmarks/bullet_identification.py --true-legs
    python benchmarks/bullet_identification.py --quick             # one robot, fitted to settled angles only
    python benchmarks/bullet_identification.py --output FOLDER     # skip robots whose results are there already
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ballu_mjx.common import runtime

runtime.prepare()

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from bullet_family import (
    ARM_LENGTH,
    CAPTURE_TIMESTEP,
    CHOSEN_ON,
    ROBOTS,
    SPRING_PRELOAD,
    SWEEP_HOLD,
    BulletRobot,
    draw,
    held_out_commands,
    record_sweep,
    record_walking,
    sweep_commands,
    walking_commands,
)
from common import described, write
from jaxtyping import Float

from ballu_mjx.ballu.actuators import ActuatorParameters
from ballu_mjx.ballu.actuators_file import actuators_to_json
from ballu_mjx.ballu.gaits import Gait
from ballu_mjx.ballu.leg_fit import Identifier
from ballu_mjx.ballu.leg_parameters import IdentificationConfig, largest_motor_gain
from ballu_mjx.ballu.leg_results import Identification
from ballu_mjx.ballu.model import SIDES, load_suspended_leg, suspend
from ballu_mjx.ballu.sweep import Sweep, read_sweep
from ballu_mjx.ballu.sysid_report import identification_details
from ballu_mjx.common import provenance
from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import Table, write_results
from ballu_mjx.identification.actuator_choice import HORIZONS, choose_actuators
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.model import ModelParameters, assets, set_fields
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.drivetrain import count_slots, drivetrain_of, filter_commands

SECONDS = 20.0
"""Length of each walking recording (s)."""
ANGLES = [f"{kind}_{side}" for kind in ("motor", "knee") for side in SIDES]
SETTLED = 50
"""Number of samples at the end of a hold whose mean is its settled angle."""


def suspended_model() -> mujoco.MjModel:
    """Return the model of the nominal robot with a fixed base."""
    spec = mujoco.MjSpec.from_file(str(assets() / "ballu.xml"))
    suspend(spec)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return spec.compile()


def settled(
    recording: Recording, actuators: ModelParameters | None, model: mujoco.MjModel
) -> Float[np.ndarray, "holds 2 2"]:
    """Return settled angles (rad; motor and knee, left and right) of C MuJoCo with a recording's commands.

    The drivetrain is simulated if the parameters include one.
    """
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
    places = [model.joint(name).qposadr[0] for name in ANGLES]
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
    return hold_means(np.array(seen)[::every])


def hold_means(angles: Float[np.ndarray, "samples 4"]) -> Float[np.ndarray, "holds 2 2"]:
    """Return the means of `ANGLES` at the end of each hold. Some joints still creep at that time."""
    holds = angles.reshape(-1, round(SWEEP_HOLD / CAPTURE_TIMESTEP), 2, 2)
    return holds[:, -SETTLED:].mean(axis=1)


def copy_numbers(full: mujoco.MjModel, held: mujoco.MjModel) -> None:
    """Copy the parameters of joints, servos and cables from the free robot's model to the fixed one's."""
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
    held.opt.iterations = full.opt.iterations


def validation_commands() -> dict[str, Float[np.ndarray, "steps 2"]]:
    """Return the commands of the validation recordings, by name."""
    steps = round(SECONDS / load_robot().control_timestep)
    rng = np.random.default_rng(46)
    held = np.repeat(np.round(rng.uniform(size=(steps // 12 + 1, 2)), 4), 12, axis=0)[:steps]
    return {"near-3": Gait(1.3, 0.5, (0.5, 0.5), (0.8, 0.8)).commands(SECONDS), "far-3": held}


def walking(recordings: Mapping[str, Recording], actuators: ModelParameters | None) -> list[Motion]:
    """Return recorded states. Their motor angles follow from these actuators, including the drivetrain."""
    robot = load_robot()
    model, drivetrain = robot.load_model(actuators), drivetrain_of(actuators)
    return [reconstruct(recording, robot, model, drivetrain=drivetrain) for recording in recordings.values()]


def open_loop(recordings: Mapping[str, Recording], actuators: ModelParameters) -> dict[str, dict[str, float]]:
    """Return nominal and identified position RMSE (m), by group and horizon.

    Each starts from states that were reconstructed with its own actuators.
    """
    robot = load_robot()
    own = choose_actuators(robot, actuators, walking(recordings, actuators), HORIZONS).rows
    plain = choose_actuators(robot, actuators, walking(recordings, None), HORIZONS).rows
    return {
        f"{one.group} {one.horizon:g} s": {"nominal": other.nominal.position, "identified": one.identified.position}
        for one, other in zip(own, plain, strict=True)
    }


def true_actuators(robot: BulletRobot) -> ActuatorParameters:
    """Return the robot's true parameters in the package's model.

    The compliance of an arm is the inverse of the servo's gain, or of the largest gain that is stable at the package's
    time step. The limit of a cable's tension has no counterpart. The
    closest parameter is the servo torque that causes this tension at the arm's full length.
    """
    values = {
        "knee_spring_stiffness": robot.spring_stiffness,
        "motor_gain": np.minimum(1 / np.array(robot.arm_yield), largest_motor_gain(load_suspended_leg(SIDES[0]))),
        "default_motor_angle": robot.arm_zero,
        "default_knee_angle": robot.knee_stop,
        "torque_limit": ARM_LENGTH * np.array(robot.cable_limit),
        "cable_slack": robot.cable_slack,
        "motor_travel": robot.arm_travel,
        "cable_stiffness": robot.cable_stiffness,
        "knee_spring_reference": np.array(robot.knee_stop) - SPRING_PRELOAD,
        "knee_damping": robot.knee_damping,
        "knee_friction": (0.0, 0.0),
        "motor_friction": (0.0, 0.0),
        "delay": (robot.delay, robot.delay),
        "lag": robot.arm_lag,
        "backlash": robot.play,
    }
    return ActuatorParameters(**{name: jnp.asarray(pair, jnp.float32) for name, pair in values.items()})


def record(seed: int, commands: Mapping[str, Float[np.ndarray, "steps 2"]]) -> dict[str, Recording]:
    """Return free recordings of a robot, by name."""
    return {name: record_walking(draw(seed), own, name, seed) for name, own in commands.items()}


def examine(seed: int, identify: Callable[[Sweep], Identification]) -> dict[str, Any]:
    """Return all results of one robot."""
    bullet, model = draw(seed), suspended_model()
    sweep = read_sweep({Path("sweep.csv"): record_sweep(bullet, sweep_commands(), "sweep", seed)})
    held_out = record_sweep(bullet, held_out_commands(seed), "held-out", seed + 100)
    truth = hold_means(np.stack([held_out.joint_angles[name] for name in ANGLES], axis=1))
    began = time.perf_counter()
    found = identify(sweep)
    seconds = time.perf_counter() - began
    actuators = found.parameters
    errors = {
        name: float(np.rad2deg(np.mean(np.abs(settled(held_out, parameters, model) - truth))))
        for name, parameters in (("nominal", None), ("identified", actuators))
    }
    choice = choose_actuators(load_robot(), actuators, walking(record(seed, validation_commands()), actuators))
    rows = zip(found.fits, SIDES, strict=True)
    result = {
        "robot": dataclasses.asdict(bullet),
        "settled_deg": errors,
        "open_loop_m": open_loop(record(seed, walking_commands(SECONDS)), actuators),
        "choice": {"ratio": choice.ratio, "takes": "identified" if choice.improves else "nominal"},
        "seconds": seconds,
        "parameters": actuators_to_json(actuators),
        **identification_details(found),
        "selection": None if found.selection is None else found.selection._asdict(),
        "scatter_deg": {side: float(np.rad2deg(fit.residual)) for fit, side in rows},
        "creep": sweep.creep,
    }
    print(table({seed: result}).to_markdown(), flush=True)
    return result


def compared(row: Mapping[str, float], form: str) -> str:
    """Return a text of nominal and identified errors, with their ratio in brackets."""
    nominal, identified = row["nominal"], row["identified"]
    return f"{nominal:{form}} -> {identified:{form}} ({identified / nominal:.2f})"


def table(results: Mapping[int, Mapping[str, Any]]) -> Table:
    """Return a table of errors of nominal and identified actuators, with their ratio in brackets."""
    groups = list(next(iter(results.values()))["open_loop_m"])
    heads = ("robot", "settled angles (deg)", *(f"{group} (m)" for group in groups), "validation ratio, and choice")
    return Table(
        heads,
        tuple(
            (
                str(seed),
                compared(result["settled_deg"], ".2f"),
                *(compared(result["open_loop_m"][group], ".3f") for group in groups),
                f"{result['choice']['ratio']:.2f}, {result['choice']['takes']}",
            )
            for seed, result in results.items()
        ),
    )


def true_legs_table(robots: Sequence[int]) -> Table:
    """Return a table of walking errors (m) of nominal and true legs, with their ratio in brackets."""
    errors = {seed: open_loop(record(seed, walking_commands(SECONDS)), true_actuators(draw(seed))) for seed in robots}
    groups = list(next(iter(errors.values())))
    made = tuple((str(seed), *(compared(rows[group], ".3f") for group in groups)) for seed, rows in errors.items())
    return Table(("robot", *(f"{group} (m)" for group in groups)), made)


OUTPUT = Path("runs/bench-bullet_identification")
"""Default folder of the results."""


def read_earlier(path: Path, robots: Sequence[int], commit: str) -> dict[str, Any]:
    """Return the results of an interrupted run, to continue it. They are empty if there is none.

    **Raises** `InputError` if robots are missing and the code has changed since.
    """
    if not path.exists():
        return {"commit": commit, "robots": {}}
    earlier = json.loads(path.read_text(encoding="utf-8"))
    earlier["robots"] = {int(seed): result for seed, result in earlier["robots"].items()}
    changed = earlier["commit"] != commit or provenance.CHANGED in commit
    if changed and not set(robots) <= set(earlier["robots"]):
        raise InputError(
            f"{path} is of commit {earlier['commit']}, and this is {commit}; give an empty folder, or commit changes."
        )
    return earlier


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=None, choices=list(ROBOTS), help="seeds (all)")
    parser.add_argument("--quick", action="store_true", help="one robot, fitted to settled angles only")
    parser.add_argument("--true-legs", action="store_true", help="use the true legs instead of identifying them")
    parser.add_argument("--output", type=Path, help=f"folder for the results ({OUTPUT}, with -quick under --quick)")
    parser.add_argument("--results", type=Path, help="JSON file to write the table to")
    arguments = parser.parse_args()
    robots = arguments.robots or (CHOSEN_ON[:1] if arguments.quick else list(ROBOTS))
    if arguments.true_legs:
        found = true_legs_table(robots)
        print(found.to_markdown())
        if arguments.results is not None:
            write_results(arguments.results, {"walking": found}, "Simulated data", seeds={"robot": robots})
        return
    config = IdentificationConfig(motion=not arguments.quick)
    compiled: list[Identifier] = []

    def identify(sweep: Sweep) -> Identification:
        with jax.enable_x64(True):
            if not compiled:  # One program serves all sweeps of a size.
                compiled.append(Identifier(config, sweep, silent))
            return compiled[0].run(sweep, silent)

    output = arguments.output or (OUTPUT.with_name(f"{OUTPUT.name}-quick") if arguments.quick else OUTPUT)
    path = output / "bullet_identification.json"
    earlier = read_earlier(path, robots, provenance.source_commit() or "")
    for seed in robots:
        if seed not in earlier["robots"]:
            earlier["robots"][seed] = examine(seed, identify)
            write(output, "bullet_identification", {key: earlier[key] for key in ("commit", "robots")})
    found = table({seed: earlier["robots"][seed] for seed in robots})
    stored = json.loads(path.read_text(encoding="utf-8"))
    print(f"\n{described(stored['machine'])}; commit {stored['commit']}\n{found.to_markdown()}")
    if arguments.results is not None:
        about = {key: value for key, value in stored["machine"].items() if key not in ("versions", "load")}
        measured = {"commit": stored["commit"], "machine": about, "versions": stored["machine"]["versions"]}
        data = f"Development data: choices were made on robots {', '.join(map(str, CHOSEN_ON))}"
        write_results(arguments.results, {"errors": found}, data, seeds={"robot": robots}, measured=measured)


def silent(stage: str, iteration: int, steps: int, value: float) -> None:
    """Ignore progress."""


if __name__ == "__main__":
    main()
