"""Measure accuracy and speed of the simulation for settings of solver, integrator, friction cone and time step.

    python benchmarks/accuracy.py            # the table behind the <option> line of assets/ballu.xml
    python benchmarks/accuracy.py --quick    # only the chosen setting, fewer sequences

The reference is C MuJoCo in double precision. Random bang-bang commands (each leg 0 or 1, for 0.15 to 0.8 s at a time)
drive the robot from rest for 2 s. The error is the distance (mm) of the balloon from the reference at the end, as
median and 95th percentile over the sequences:

- `tight`: the reference has the same model and time step, with the solver run to convergence.
- `quarter`: the reference has, in addition, a quarter of the time step.

The columns `C` are for C MuJoCo with the setting. The columns `MJX` are for the float32 rollouts in MJX that training
uses. Speed is in simulated seconds per second for MJX, with the batch sharded over all devices. `wall` is by wall time.
`cpu` is by processor time, which depends less on other load. The exit status is 1 if the chosen setting misses a
target.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable
from typing import Annotated

from ballu_mjx.common import runtime

runtime.prepare()

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
import tyro
from jax.sharding import PartitionSpec
from jaxtyping import Array, Float

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, load_model, standing_qpos
from ballu_mjx.sim.step import PhysicsState, control_step, count_substeps, make_data, put_model, state_at

INTEGRATORS = {"implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST, "Euler": mujoco.mjtIntegrator.mjINT_EULER}
SOLVERS = {"Newton": mujoco.mjtSolver.mjSOL_NEWTON, "CG": mujoco.mjtSolver.mjSOL_CG}
CONES = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}

DURATION = 2.0
"""Length of a sequence (s)."""
TARGETS_MM = (5.0, 20.0, 20.0)
"""Upper limits (mm): median and 95th percentile of `tight`, median of `quarter`."""
TARGET_TEXT = "tight below 5 / 20 mm, quarter below 20 mm in the median"


@dataclasses.dataclass(frozen=True)
class Setting:
    """Setting of the simulation, one line of the table. `timestep` is in s."""

    timestep: float
    integrator: str
    solver: str
    iterations: int
    ls_iterations: int
    cone: str

    def __str__(self) -> str:
        solver = f"{self.solver} {self.iterations}/{self.ls_iterations}"
        return f"{self.timestep * 1e3:5.2f} ms {self.integrator:12} {solver:12} {self.cone:9}"

    @staticmethod
    def of(model: mujoco.MjModel) -> Setting:
        """Return the setting of `model`."""
        option = model.opt

        def name(names: dict, value: int) -> str:
            return next(name for name, number in names.items() if number == value)

        return Setting(
            option.timestep,
            name(INTEGRATORS, option.integrator),
            name(SOLVERS, option.solver),
            option.iterations,
            option.ls_iterations,
            name(CONES, option.cone),
        )

    def model(self) -> mujoco.MjModel:
        """Return the robot's model with this setting."""
        model = load_model()
        model.opt.timestep = self.timestep
        model.opt.integrator = INTEGRATORS[self.integrator]
        model.opt.solver = SOLVERS[self.solver]
        model.opt.iterations = self.iterations
        model.opt.ls_iterations = self.ls_iterations
        model.opt.cone = CONES[self.cone]
        return model

    def tight(self, divide: int = 1) -> mujoco.MjModel:
        """Return the robot's model with the solver run to convergence, and with the time step divided by `divide`."""
        model = dataclasses.replace(self, timestep=self.timestep / divide, solver="Newton").model()
        model.opt.iterations, model.opt.tolerance = 100, 1e-10
        model.opt.ls_iterations, model.opt.ls_tolerance = 50, 1e-3
        return model


def table(chosen: Setting) -> list[Setting]:
    """Return the settings to compare: the chosen one, then single changes, then fast settings."""

    def vary(**changes) -> Setting:
        return dataclasses.replace(chosen, **changes)

    settings = [
        chosen,
        *(vary(iterations=n) for n in (1, 2, 3, 4, 6)),
        *(vary(ls_iterations=n) for n in (4, 6, 10, 20)),
        vary(solver="CG"),
        vary(solver="CG", iterations=8),
        vary(cone="elliptic"),
        vary(integrator="Euler"),
        *(vary(timestep=step, iterations=n) for step in (0.005, 0.01, 0.0125, 0.05 / 3, 0.025) for n in (3, 4)),
        vary(timestep=0.005, integrator="Euler", iterations=1),
        vary(timestep=0.005, integrator="Euler", iterations=2),
    ]
    return list(dict.fromkeys(settings))


def bang_bang(key: int, count: int, steps: int) -> Float[np.ndarray, "count steps 2"]:
    """Return commands that switch between 0 and 1, independently for each leg, after 3 to 16 control steps."""
    rng = np.random.default_rng(key)
    level = rng.integers(0, 2, (count, 2)).astype(float)
    left = rng.integers(3, 17, (count, 2))
    commands = np.empty((count, steps, 2))
    for step in range(steps):
        jump = left == 0
        level = np.where(jump, 1 - level, level)
        left = np.where(jump, rng.integers(3, 17, (count, 2)), left) - 1
        commands[:, step] = level
    return commands


def settled(setting: Setting) -> Float[np.ndarray, " nq"]:
    """Return the generalized position of the robot at rest with zero commands, after 4 s of damped motion."""
    model = setting.tight(4)
    data = mujoco.MjData(model)
    data.qpos[:] = standing_qpos(model)
    while data.time < 4.0:
        mujoco.mj_step(model, data)
        data.qvel *= 0.98
    return data.qpos.copy()


def balloon_positions(model: mujoco.MjModel, qpos: Float[np.ndarray, "count nq"]) -> Float[np.ndarray, "count 3"]:
    """Return the position (m, world frame) of the balloon's site for each generalized position."""
    data = mujoco.MjData(model)
    site = data.site("balloon")
    positions = []
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        positions.append(site.xpos.copy())
    return np.array(positions)


def c_rollout(
    model: mujoco.MjModel,
    qpos: Float[np.ndarray, " nq"],
    commands: Float[np.ndarray, "count steps 2"],
    threads: int,
) -> Float[np.ndarray, "count 3"]:
    """Return the final balloon positions (m), simulated by C MuJoCo on `threads` threads."""
    control = commands.repeat(count_substeps(model, CONTROL_TIMESTEP), axis=1)
    data = [mujoco.MjData(model) for _ in range(threads)]
    data[0].qpos[:] = qpos
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data[0], state, kind)
    states, _ = mujoco.rollout.rollout(model, data, np.tile(state, (len(commands), 1)), control)
    return balloon_positions(model, np.asarray(states)[:, -1, 1 : 1 + model.nq])


@dataclasses.dataclass(frozen=True)
class MjxResult:
    """Final balloon positions (m), and simulated seconds per second of wall time and of processor time."""

    positions: Float[np.ndarray, "count 3"]
    wall: float
    cpu: float


def mjx_program(
    model: mujoco.MjModel, qpos: Float[np.ndarray, " nq"], devices: int
) -> Callable[[Float[Array, "batch steps 2"]], Float[Array, "batch nq"]]:
    """Return a compiled MJX rollout in float32, from commands to final generalized positions.

    The batch is sharded over `devices`.
    """
    step_count, balloon = count_substeps(model, CONTROL_TIMESTEP), model.body("balloon").id
    mjx_model, template = put_model(model), make_data(model)
    start = state_at(jnp.asarray(qpos, jnp.float32), jnp.zeros(model.nv))

    def one(command: Float[Array, "steps 2"]) -> Float[Array, " nq"]:
        def step(state: PhysicsState, command: Float[Array, " 2"]) -> tuple[PhysicsState, None]:
            no_force = jnp.zeros((1, 6))
            state = control_step(mjx_model, template, state, command, no_force, bodies=(balloon,), count=step_count)
            return state, None

        return jax.lax.scan(step, start, command)[0].qpos

    axis_types = (jax.sharding.AxisType.Auto,)
    mesh = jax.make_mesh((devices,), ("batch",), axis_types=axis_types, devices=jax.local_devices()[:devices])
    spec = PartitionSpec("batch")
    # Sharded explicitly. Otherwise the solver's loops would wait for all devices at every iteration.
    return jax.jit(jax.shard_map(jax.vmap(one), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))


def mjx_rollout(
    model: mujoco.MjModel, qpos: Float[np.ndarray, " nq"], commands: Float[np.ndarray, "count steps 2"], batch: int
) -> MjxResult:
    """Return positions and speed of `mjx_program` on all devices. The sequences are repeated to fill `batch`."""
    devices = jax.device_count()
    batch = -(-batch // devices) * devices
    rollout = mjx_program(model, qpos, devices)
    inputs = jnp.asarray(np.resize(commands, (batch, *commands.shape[1:])), jnp.float32)
    final = np.asarray(rollout(inputs))
    clock, processor = [], []
    for _ in range(3):
        start_clock, start_processor = time.perf_counter(), time.process_time()
        jax.block_until_ready(rollout(inputs))
        clock.append(time.perf_counter() - start_clock)
        processor.append(time.process_time() - start_processor)
    simulated = batch * commands.shape[1] * CONTROL_TIMESTEP
    return MjxResult(
        positions=balloon_positions(model, final[: len(commands)]),
        wall=simulated / min(clock),
        cpu=simulated / min(processor) * devices,
    )


def distances(a: Float[np.ndarray, "count 3"], b: Float[np.ndarray, "count 3"]) -> tuple[float, float]:
    """Return the median and the 95th percentile of the distance (mm). A diverged rollout has an infinite distance."""
    distance = np.linalg.norm(a - b, axis=1) * 1e3
    distance = np.where(np.isfinite(distance), distance, np.inf)
    return float(np.median(distance)), float(np.percentile(distance, 95, method="higher"))


def main(
    quick: bool = False,
    sequences: int = 64,
    batch: int = 512,
    seed: int = 0,
    mjx_too: Annotated[bool, tyro.conf.arg(name="mjx")] = True,
) -> None:
    """Print a table of accuracy and speed.

    Args:
        quick: Use only the chosen setting, 16 sequences and a small batch. The result means little.
        sequences: Number of random command sequences.
        batch: Number of environments in MJX for the measurement of speed.
        seed: Seed of the commands.
        mjx_too: Measure MJX as well. Without it, only C MuJoCo is measured, within seconds.
    """
    if quick:
        sequences, batch = 16, 32
    mujoco.set_mju_user_warning(lambda _: None)  # Diverging settings are part of the table.
    chosen = Setting.of(load_model())
    settings = [chosen] if quick else table(chosen)
    steps = round(DURATION / CONTROL_TIMESTEP)
    commands, qpos = bang_bang(seed, sequences, steps), settled(chosen)
    threads, missed = jax.device_count(), False

    print(f"{sequences} sequences of {DURATION} s, seed {seed}; millimetres as median / 95 %; the first line is chosen")
    if quick:
        print("--quick: these numbers mean little")
    head = f"{'setting':42}{'C tight':>16}{'C quarter':>16}"
    print(head + (f"{'MJX tight':>16}{'MJX quarter':>16}{'wall':>7}{'cpu':>7}" if mjx_too else ""))
    for setting in settings:
        tight = c_rollout(setting.tight(), qpos, commands, threads)
        quarter = c_rollout(setting.tight(4), qpos, commands, threads)
        ends = [c_rollout(setting.model(), qpos, commands, threads)]
        speed = ""
        if mjx_too:
            result = mjx_rollout(setting.model(), qpos, commands, batch)
            ends.append(result.positions)
            speed = f"{result.wall:7.0f}{result.cpu:7.0f}"
        cells = [distances(end, judge) for end in ends for judge in (tight, quarter)]
        text = "".join(f"{f'{median:.1f} / {high:.1f}':>16}" for median, high in cells)
        print(f"{setting!s:42}{text}{speed}", flush=True)
        if setting == chosen:
            measured = [(*cells[i], cells[i + 1][0]) for i in range(0, len(cells), 2)]
            missed = not all(value < target for m in measured for value, target in zip(m, TARGETS_MM, strict=True))
    print(f"Targets for the chosen setting, {TARGET_TEXT}: {'MISSED' if missed else 'met'}")
    if missed and not quick:
        sys.exit(1)


if __name__ == "__main__":
    tyro.cli(main)
