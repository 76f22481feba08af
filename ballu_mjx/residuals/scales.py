"""Scales, limits and costs of residual forces: the robot's own, or the size of what the model leaves unexplained.

That size is told by one-step inverse dynamics along the training recordings. Each control step is simulated in C MuJoCo
from its recorded state, under what the model and a base residual explain. What the velocities after it lack is averaged
over a quarter of a second, for single steps show noise. It is then shared out to the loads of a force set by least
squares in kinetic energy. What a load does to the velocities is measured by a second simulation: by mass and time alone
what acts on a stiffly driven joint, whose actuator undoes most of it within the step, would look like a small load.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Float, Int

from ballu_mjx.identification.guard import physics_commands
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import ReferenceMotions, stack_motions
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_loads import load_scales
from ballu_mjx.robots.adapter import ResidualScales
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.c_model import improved_model
from ballu_mjx.sim.force_sets import FORCE_SETS, ForceSet, check_force_set, num_loads
from ballu_mjx.sim.observation import HISTORY, commands_seen
from ballu_mjx.sim.residual import BoundResidual
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator

LIMIT_UNITS = 20.0
"""Largest output of a network, in units, where neither robot nor user says."""
UNIT_COST = 0.05
"""Reward lost per squared unit, likewise."""
_AVERAGED = 0.25
"""s."""
_STATES = 2000
"""Most states that loads are found for."""
_SHARE = 0.95
"""Larger loads count as this quantile: contacts and gaps make single ones huge."""
_LEAST = 1e-6
"""Smallest scale, as of a model that explains everything."""
_WEAK = 0.05
"""Directions that loads act in with less of the strongest one's effect are left alone."""
_NUDGE = 0.1
"""Share of a command's range by which its effect is measured; of a force, it is its size by mass and time."""

Config = TypeVar("Config", bound=ForceNetworkConfig)


def settle_scales(config: Config, simulator: Simulator | AugmentedSimulator, motions: Sequence[Motion]) -> Config:
    """Return the configuration with all scales, limit and cost as numbers.

    What is given stays. The rest is the robot's own (`RobotAdapter.residual_scales`), or follows from what
    `simulator`, with its base residual, leaves unexplained in `motions`.

    **Raises** `InputError` where the robot has nothing that the force set acts on.
    """
    augmented = simulator.with_residual(None)
    robot, forces = augmented.robot, config.forces
    check_force_set(forces, robot)
    own, vectors = robot.adapter.residual_scales(), FORCE_SETS[forces].turns
    open_force = vectors and config.force_scale is None and own is None
    open_torque = forces == "wrench" and config.torque_scale is None and own is None
    open_scales = not vectors and len(config.scales) != num_loads(forces, robot)
    found: dict[str, Any] = {}
    if open_force or open_torque or open_scales:
        size = missing_loads(augmented, motions, forces)
        found["force_scale"] = _rms(size[:3] if forces == "wrench" else size) if vectors else 1.0
        found["torque_scale"] = _rms(size[3:]) if forces == "wrench" else None
        found["scales"] = () if vectors else tuple(map(float, size))
    return _filled(config, own, found)


def _filled(config: Config, own: ResidualScales | None, found: dict[str, Any]) -> Config:
    """Return the configuration with what it leaves open filled in."""
    usual = {} if own is None else dataclasses.asdict(own)
    force = config.force_scale or usual.get("force_scale") or found.get("force_scale") or 1.0
    values = {"force_scale": force, "force_limit": LIMIT_UNITS * force, "force_cost": UNIT_COST / force**2}
    values |= {name: value for name, value in (found | usual).items() if name != "scales"}
    fields = {field.name for field in dataclasses.fields(config)}
    changes = {n: v for n, v in values.items() if n in fields and getattr(config, n) is None}
    if found.get("scales"):
        changes["scales"] = found["scales"]
    return dataclasses.replace(config, **changes)


def describe_scales(config: ForceNetworkConfig, robot: RobotDescription) -> str:
    """Return what the outputs of a network stand for, in words."""
    scales = load_scales(config, robot)
    loads = ", ".join(
        f"{name.rpartition(',')[0]} {unit:.3g}{name.rpartition(',')[2]}"
        for name, unit in zip(FORCE_SETS[config.forces].names(robot), scales.units, strict=True)
    )
    cost = getattr(config, "force_cost", None)
    costs = "" if cost is None else f" A squared unit costs {cost * scales.newtons**2:.3g} of the reward."
    return f"One unit of the network's output is: {loads}. Limit: {scales.limit:.3g} units.{costs}"


def missing_loads(
    simulator: Simulator | AugmentedSimulator, motions: Sequence[Motion], forces: ForceSet
) -> Float[np.ndarray, " loads"]:
    """Return the root mean square of the loads (N, N m, commands' units) that the model leaves unexplained in recorded
    motions, as it stands and with its base residual."""
    augmented = simulator.with_residual(None)
    plain, robot, model = augmented.simulator, augmented.robot, improved_model(augmented)
    every = max(sum(len(motion.command) for motion in motions) // _STATES, 1)
    window = max(round(_AVERAGED / robot.control_timestep), 1)
    reference, _ = stack_motions(plain, motions)
    found = []
    for number, motion in enumerate(motions):
        applied, sent = _base_residual(augmented, model, reference, number, motion)
        after = _step(plain, model, motion, sent, applied)
        lacking = _averaged(motion.qvel[1:] - after, window)[::every]
        here = np.arange(0, len(motion.command), every)
        mass, acts = _inertia(robot, model, motion.qpos[here], forces)
        root = np.linalg.cholesky(mass).swapaxes(1, 2)
        if acts is None:
            low, high = np.array(robot.command_ranges).T
            nudges = _NUDGE * (high - low) * np.where(sent > (low + high) / 2, -1.0, 1.0)
        else:
            guess = _shared_out(root, np.linalg.solve(mass, acts) * robot.control_timestep, lacking)
            nudges = np.broadcast_to(_size(guess), (len(motion.command), acts.shape[2]))
        effects = []
        for place, nudge in enumerate(nudges.T):
            command, pushed = sent.copy(), applied.copy()
            if acts is None:
                command[:, place] += nudge
            else:
                pushed[here] += acts[:, :, place] * nudge[here, None]
            moved = _step(plain, model, motion, command, pushed, here)
            effects.append((moved - after[here]) / nudge[here, None])
        found.append(_shared_out(root, np.stack(effects, axis=2), lacking))
    return _size(np.concatenate(found))


def _size(loads: Float[np.ndarray, "states loads"]) -> Float[np.ndarray, " loads"]:
    """Return root mean squares over states, large values cut off and missing ones left out."""
    size = np.abs(loads[np.isfinite(loads).all(axis=1)])
    if not len(size):
        return np.full(loads.shape[1], _LEAST)
    size = np.minimum(size, np.quantile(size, _SHARE, axis=0))
    return np.maximum(np.sqrt(np.mean(size**2, axis=0)), _LEAST)


def _rms(values: Float[np.ndarray, " loads"]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _step(
    simulator: Simulator,
    model: mujoco.MjModel,
    motion: Motion,
    command: Float[np.ndarray, "steps commands"],
    applied: Float[np.ndarray, "steps nv"],
    here: Int[np.ndarray, " chosen"] | slice = slice(None),
) -> Float[np.ndarray, "chosen nv"]:
    """Return velocities after the control steps `here`, from the recorded state before; NaN where a simulation broke
    down."""
    substeps, kind = simulator.substeps, mujoco.mjtState
    ctrl = physics_commands(simulator.actuators, command, substeps, float(model.opt.timestep))
    forces = np.repeat(applied[:, None], substeps, axis=1)
    control = np.concatenate([ctrl.reshape(len(command), substeps, -1), forces], axis=2)[here]
    data = mujoco.MjData(model)
    initial = np.zeros((len(control), mujoco.mj_stateSize(model, kind.mjSTATE_FULLPHYSICS)))
    for row, qpos, qvel in zip(initial, motion.qpos[:-1][here], motion.qvel[:-1][here], strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_getState(model, data, row, kind.mjSTATE_FULLPHYSICS)
    specification = int(kind.mjSTATE_CTRL) | int(kind.mjSTATE_QFRC_APPLIED)
    state, _ = mujoco.rollout.rollout(model, data, initial, control, control_spec=specification)
    last = np.asarray(state, float)[:, -1]
    expected = substeps * model.opt.timestep
    # MuJoCo begins anew where a simulation breaks down, and its clock with it.
    last[np.abs(last[:, 0] - expected) > 1e-6 * expected] = np.nan
    return last[:, 1 + model.nq : 1 + model.nq + model.nv]


def _averaged(values: Float[np.ndarray, "steps nv"], window: int) -> Float[np.ndarray, "steps nv"]:
    """Return running means over so many steps, of what is finite."""
    good = np.asarray(np.isfinite(values).all(axis=1))
    ones = np.ones(min(window, len(values)))
    count = np.convolve(good, ones, mode="same")
    sums = [np.convolve(column, ones, mode="same") for column in np.where(good[:, None], values, 0.0).T]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.array(sums).T / np.asarray(count)[:, None]


def _base_residual(
    simulator: AugmentedSimulator, model: mujoco.MjModel, reference: ReferenceMotions, number: int, motion: Motion
) -> tuple[Float[np.ndarray, "steps nv"], Float[np.ndarray, "steps commands"]]:
    """Return what the base residual does in recorded states that have a history: generalized forces, and the commands
    that it makes of the recorded ones, as their mean over each control step."""
    applied, sent = np.zeros((len(motion.command), model.nv)), motion.command.copy()
    if simulator.residual is None:
        return applied, sent
    bound: BoundResidual = simulator.residual

    def ask(time: Array) -> tuple[Array, Array, Array]:
        history = jax.lax.dynamic_slice_in_dim(reference.features[number], time - HISTORY + 1, HISTORY)
        seen = history, commands_seen(reference.command[number], time)
        wrench, along, change = bound.act(*seen)
        command = bound.model.command(bound.params, seen[1]).mean(axis=0) + (0.0 if change is None else change)
        return wrench, jnp.zeros(model.nv) if along is None else along, command

    times = np.arange(HISTORY - 1, len(motion.command))
    wrenches, along, commands = map(np.asarray, jax.jit(jax.vmap(ask))(times))
    sent[times] = np.clip(commands, *np.array(simulator.robot.command_ranges).T)
    data = mujoco.MjData(model)
    for time, wrench, joint in zip(times, wrenches, along, strict=True):
        data.qpos[:] = motion.qpos[time]
        applied[time] = joint + _jacobians(simulator.robot, model, data, len(wrench)).T @ wrench.ravel()
    return applied, sent


def _jacobians(
    robot: RobotDescription, model: mujoco.MjModel, data: mujoco.MjData, loaded: int
) -> Float[np.ndarray, "loads nv"]:
    """Return the Jacobian of forces and torques, six rows for the tracked body and for each point."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    found = np.zeros((loaded, 2, 3, model.nv))
    for number, name in enumerate((robot.tracked, *robot.points)[:loaded]):
        site = model.site(name).id
        if number:
            mujoco.mj_jacSite(model, data, *found[number], site)
        else:
            mujoco.mj_jacBodyCom(model, data, *found[number], int(model.site_bodyid[site]))
    return found.reshape(-1, model.nv)


def _inertia(
    robot: RobotDescription, model: mujoco.MjModel, qpos: Float[np.ndarray, "states nq"], forces: ForceSet
) -> tuple[Float[np.ndarray, "states nv nv"], Float[np.ndarray, "states nv loads"] | None]:
    """Return mass matrices, and the generalized forces of unit loads; None of changes of commands."""
    data, mass, acts = mujoco.MjData(model), np.zeros((len(qpos), model.nv, model.nv)), []
    along = np.eye(model.nv)[[joint.place for joint in robot.force_joints.values()]]
    for state, own in zip(qpos, mass, strict=True):
        data.qpos[:] = state
        rows = _jacobians(robot, model, data, 1 + len(robot.points)).reshape(-1, 2, 3, model.nv)
        mujoco.mj_crb(model, data)
        mujoco.mj_fullM(model, data, own)
        units = {"force": rows[0, 0], "wrench": rows[0].reshape(6, -1), "multi": rows[:, 0].reshape(-1, model.nv)}
        acts.append(units.get(forces, along).T)
    return mass, None if forces == "commands" else np.array(acts)


def _shared_out(
    root: Float[np.ndarray, "states nv nv"],
    effects: Float[np.ndarray, "states nv loads"],
    lacking: Float[np.ndarray, "states nv"],
) -> Float[np.ndarray, "states loads"]:
    """Return the loads that explain best, by kinetic energy, what velocities lack after control steps; NaN where that
    or the loads' `effects` on velocities are unknown. `root` times its transpose is the mass matrix, transposed."""
    good = np.isfinite(lacking).all(axis=1) & np.isfinite(effects).all(axis=(1, 2))
    found = np.full((len(lacking), effects.shape[2]), np.nan)
    inverse = np.linalg.pinv(root[good] @ effects[good], rcond=_WEAK)
    found[good] = (inverse @ (root[good] @ lacking[good, :, None]))[..., 0]
    return found
