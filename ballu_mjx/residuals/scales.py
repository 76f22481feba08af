"""Scales, limits and costs of residual loads, from the loads that the model lacks.

The lacking loads are estimated by one-step inverse dynamics along the training recordings:

1. Each control step is simulated in C MuJoCo from its recorded state, with the base residual if there is one.
2. The error of the velocities after the step is averaged over 0.25 s, because single steps are dominated by noise.
3. The loads of the force set that explain the averaged error are found by least squares in kinetic energy.

EnvMimic's policy starts at the mean of these loads, which is large where a weight or a lift is wrong. Scales are the
RMS of the loads, rounded to 1, 2 or 5 times a power of ten. The RMS includes the mean: one-step inverse dynamics can be
wrong by a large part of it, and a policy must be able to correct this.

The effect of a load on the velocities is measured by a second simulation with this load. Mass and time alone do not
give it: a stiff actuator undoes most of a load on its joint within the step, so the load would be underestimated.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation

from ballu_mjx.identification.actuator_choice import physics_commands, without_warnings
from ballu_mjx.recordings.motion import Motion
from ballu_mjx.recordings.reference import ReferenceMotions, stack_motions
from ballu_mjx.residuals.network_config import ForceNetworkConfig
from ballu_mjx.residuals.network_loads import check_load_options, load_scales
from ballu_mjx.robots.description import RobotDescription
from ballu_mjx.sim.c_model import improved_model
from ballu_mjx.sim.force_sets import FORCE_SETS, ForceSet
from ballu_mjx.sim.observation import HISTORY, ObservationLayout, commands_seen
from ballu_mjx.sim.residual import BoundResidual
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator

LIMIT_UNITS = 20.0
"""Default limit of a network's outputs, in units."""
UNIT_COST = 0.05
"""Default cost of a squared unit of a network's output, in reward."""
_AVERAGING_TIME = 0.25
"""Time over which errors of velocities are averaged (s)."""
_STATES = 2000
"""Number of states for which loads are estimated, if the recordings have as many. Up to twice as many are used."""
_QUANTILE = 0.95
"""Quantile to which larger loads are clipped. Contacts and gaps in recordings make single loads huge."""
_SMALLEST_SCALE = 1e-6
"""Smallest scale of a load, for a model that explains everything."""
_WEAKEST = 0.05
"""Smallest singular value of the loads' effects that counts, as a fraction of the largest one. Effects are relative to
those on a robot that is free to move. Combinations of loads with a smaller effect are set to 0."""
_PERTURBATION = 0.1
"""Change of a command for the measurement of its effect, as a fraction of its range."""

Config = TypeVar("Config", bound=ForceNetworkConfig)


def resolve_scales(config: Config, simulator: Simulator | AugmentedSimulator, motions: Sequence[Motion]) -> Config:
    """Return the configuration with numbers for all scales, the limit and the cost.

    Values that are given stay. The others are derived from the loads that `simulator`, with its base residual, leaves
    unexplained in `motions`.

    **Raises** `InputError` if the robot has nothing on which the force set can act, or if given values do not fit it.
    """
    augmented = simulator.with_residual(None)
    robot, forces = augmented.robot, config.forces
    check_load_options(config, robot)
    vectors = FORCE_SETS[forces].turns
    open_force = vectors and config.force_scale is None
    open_torque = forces == "wrench" and config.torque_scale is None
    open_scales = not vectors and not config.scales
    found: dict[str, Any] = {}
    if open_force or open_torque or open_scales or not config.expected_loads:
        missing = missing_loads(augmented, motions, forces, heading_frame=config.heading_frame)
        size = missing.rms
        found["force_scale"] = round_scale(_rms(size[:3] if forces == "wrench" else size)) if vectors else 1.0
        found["torque_scale"] = round_scale(_rms(size[3:])) if forces == "wrench" else None
        found["scales"] = () if vectors else tuple(map(round_scale, size))
        found["expected_loads"] = tuple(map(float, missing.mean))
    return _filled(config, found)


def round_scale(size: float) -> float:
    """Return the nearest of 1, 2 and 5 times powers of ten, on a logarithmic scale.

    Scales are constants of compiled programs. Recordings with similar loads thereby share these programs.
    """
    decade = math.floor(math.log10(size))
    candidates = [float(f"{digit}e{decade}") for digit in (1, 2, 5, 10)]
    return min(candidates, key=lambda each: abs(math.log(each / size)))


def _filled(config: Config, found: dict[str, Any]) -> Config:
    """Return the configuration with its open values filled in from the scales that were `found`."""
    force = config.force_scale or found.get("force_scale") or 1.0
    values = {"force_scale": force, "force_limit": LIMIT_UNITS * force, "force_cost": UNIT_COST / force**2}
    fields = {field.name for field in dataclasses.fields(config)}
    changes = {n: v for n, v in (values | found).items() if n in fields and getattr(config, n) in (None, ())}
    return dataclasses.replace(config, **changes)


def describe_scales(config: ForceNetworkConfig, robot: RobotDescription) -> str:
    """Return the scales, limit and cost of a network's outputs, as text."""
    scales = load_scales(config, robot)
    loads = ", ".join(
        f"{name.rpartition(',')[0]} {unit:.3g}{name.rpartition(',')[2]}"
        for name, unit in zip(FORCE_SETS[config.forces].names(robot), scales.units, strict=True)
    )
    cost = getattr(config, "force_cost", None)
    costs = "" if cost is None else f" A squared unit costs {cost * scales.newtons**2:.3g} of the reward."
    mean = np.array(config.expected_loads) / scales.units
    lacking = f" The model lacks {', '.join(f'{each:.2g}' for each in mean)} units on average." if mean.any() else ""
    return f"One unit of the network's output is: {loads}. Limit: {scales.limit:.3g} units.{lacking}{costs}"


class MissingLoads(NamedTuple):
    """Loads (N, N m, commands' units) that a simulator leaves unexplained in recorded motions."""

    mean: Float[np.ndarray, " loads"]
    """Mean over the states."""
    rms: Float[np.ndarray, " loads"]
    """Root mean square over the states, which includes the mean."""


def missing_loads(
    simulator: Simulator | AugmentedSimulator,
    motions: Sequence[Motion],
    forces: ForceSet,
    *,
    heading_frame: bool = True,
) -> MissingLoads:
    """Return the loads that a simulator leaves unexplained in recorded motions. A base residual acts, too.

    Vectors are in the tracked body's heading frame, or else in the world frame (`network_loads.world_loads`).
    """
    augmented = simulator.with_residual(None)
    plain, robot, model = augmented.simulator, augmented.robot, improved_model(augmented)
    every = max(sum(len(motion.command) for motion in motions) // _STATES, 1)
    window = max(round(_AVERAGING_TIME / robot.control_timestep), 1)
    reference, _ = stack_motions(plain, motions)
    yaws = np.asarray(reference.features)[:, :, ObservationLayout.yaw]  # JAX would compile a program for each slice
    found = []
    for number, motion in enumerate(motions):
        applied, sent = _base_residual(augmented, model, reference, number, motion)
        after = _step(plain, model, motion, sent, applied)
        missing = _averaged(motion.qvel[1:] - after, window)[::every]
        here = np.arange(0, len(motion.command), every)
        mass, acts = _inertia(robot, model, motion.qpos[here], forces)
        root = np.linalg.cholesky(mass).swapaxes(1, 2)
        if acts is None:
            low, high = np.array(robot.command_ranges).T
            changes = _PERTURBATION * (high - low) * np.where(sent > (low + high) / 2, -1.0, 1.0)
            sizes = np.broadcast_to(1 / (high - low), (len(here), len(robot.commands)))
        else:
            # The loads are perturbed by their size according to mass and time alone.
            free = np.linalg.solve(mass, acts) * robot.control_timestep
            sizes = np.linalg.norm(root @ free, axis=1)
            if FORCE_SETS[forces].turns:  # the axes of a vector have one unit
                sizes = sizes.reshape(len(here), -1, 3).max(axis=2).repeat(3, axis=1)
            # A load without an effect, such as a torque on a robot of slides, does not become large by scaling.
            sizes = np.maximum(sizes, np.maximum(1e-6 * sizes.max(axis=1, keepdims=True), np.finfo(float).tiny))
            guess = _solve_loads(root, free, missing, sizes)
            changes = np.broadcast_to(_summarize(guess).rms, (len(motion.command), acts.shape[2]))
        effects = []
        for load, change in enumerate(changes.T):
            command, force = sent.copy(), applied.copy()
            if acts is None:
                command[:, load] += change
            else:
                force[here] += acts[:, :, load] * change[here, None]
            moved = _step(plain, model, motion, command, force, here)
            effects.append((moved - after[here]) / change[here, None])
        loads = _solve_loads(root, np.stack(effects, axis=2), missing, sizes)
        if FORCE_SETS[forces].turns and heading_frame and not robot.anchored:
            to_heading = Rotation.from_euler("z", -yaws[number, here, None]).as_matrix()
            loads = (loads.reshape(len(here), -1, 3) @ to_heading.swapaxes(1, 2)).reshape(len(here), -1)
        found.append(loads)
    return _summarize(np.concatenate(found))


def _summarize(loads: Float[np.ndarray, "states loads"]) -> MissingLoads:
    """Return mean and size of each load over the states. Large values are clipped, and states with NaN are left out."""
    good = loads[np.isfinite(loads).all(axis=1)]
    if not len(good):
        smallest = np.full(loads.shape[1], _SMALLEST_SCALE)
        return MissingLoads(0.0 * smallest, smallest)
    largest = np.quantile(np.abs(good), _QUANTILE, axis=0)
    good = np.clip(good, -largest, largest)
    rms = np.sqrt(np.mean(good**2, axis=0))
    return MissingLoads(good.mean(axis=0), np.maximum(rms, _SMALLEST_SCALE))


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
    """Simulate the control steps `here` from their recorded states, and return the velocities after them.

    Velocities are NaN if a simulation diverged.
    """
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
    with without_warnings():
        state, _ = mujoco.rollout.rollout(model, data, initial, control, control_spec=specification)
    last = np.asarray(state, float)[:, -1]
    expected = substeps * model.opt.timestep
    # MuJoCo resets a simulation that diverges, so its time is then too short.
    last[np.abs(last[:, 0] - expected) > 1e-6 * expected] = np.nan
    return last[:, 1 + model.nq : 1 + model.nq + model.nv]


def _averaged(values: Float[np.ndarray, "steps nv"], window: int) -> Float[np.ndarray, "steps nv"]:
    """Return running means over `window` steps. Steps with values that are not finite are left out."""
    good = np.asarray(np.isfinite(values).all(axis=1))
    ones = np.ones(min(window, len(values)))
    count = np.convolve(good, ones, mode="same")
    sums = [np.convolve(column, ones, mode="same") for column in np.where(good[:, None], values, 0.0).T]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.array(sums).T / np.asarray(count)[:, None]


def _base_residual(
    simulator: AugmentedSimulator, model: mujoco.MjModel, reference: ReferenceMotions, number: int, motion: Motion
) -> tuple[Float[np.ndarray, "steps nv"], Float[np.ndarray, "steps commands"]]:
    """Return the generalized forces and the commands with the base residual, for each recorded control step.

    Commands are means over a control step. For states without a history, forces are 0 and commands are the recorded
    ones.
    """
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
    """Return the Jacobian of the tracked body and of the points, in the state `data.qpos`.

    It has six rows for the tracked body and for each point: three translations (world frame) and three rotations.
    `loaded` is the number of rows of the wrench: 1 for the tracked body alone.
    """
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
    """Return mass matrices, and the generalized forces of unit loads. The latter are None for changes of commands."""
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


def _solve_loads(
    root: Float[np.ndarray, "states nv nv"],
    effects: Float[np.ndarray, "states nv loads"],
    missing: Float[np.ndarray, "states nv"],
    sizes: Float[np.ndarray, "states loads"],
) -> Float[np.ndarray, "states loads"]:
    """Return the loads that best explain the errors of velocities after control steps, by kinetic energy.

    **Arguments**

    - `root`: transposed Cholesky factors of the mass matrices.
    - `effects`: derivatives of the velocities with respect to the loads.
    - `missing`: recorded velocities minus simulated velocities.
    - `sizes`: effects of unit loads that count as large. They make loads of different units comparable.

    **Returns** the loads. They are NaN if `effects` or `missing` are not finite.
    """
    good = np.isfinite(missing).all(axis=1) & np.isfinite(effects).all(axis=(1, 2))
    found = np.full((len(missing), effects.shape[2]), np.nan)
    inverse = np.linalg.pinv(root[good] @ effects[good] / sizes[good, None], rcond=_WEAKEST)
    found[good] = (inverse @ (root[good] @ missing[good, :, None]))[..., 0] / sizes[good]
    return found
