"""Compare speed and accuracy of the robot's physics in MJX, C MuJoCo and PyBullet.

Random bang-bang commands drive the robot from rest. Each engine runs on one core and on all, in separate processes:

- MJX in single precision, for batches from 1 to 8,192, sharded over one host device per core.
- C MuJoCo's `rollout` of the same model in double precision, with one thread per core, for the same batches.
- PyBullet (bullet.py), with one process per core, at Bullet's default time step and at a finer one. Springs, cables and
  lift are set from Python in every physics step.

The error of each engine is the distance (mm) of the balloon after 2 s from a reference, as median and 95th percentile
over the sequences. The reference is C MuJoCo at a quarter of the model's time step, with the solver run to convergence
(see accuracy.py). Speeds are medians of five measurements, without compiling.

`python benchmarks/physics.py`. With `--quick` it runs within minutes as a check, and its results mean little.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ballu_mjx.common import runtime

runtime.prepare()

import accuracy
import common
import jax
import jax.numpy as jnp
import numpy as np
import throughput
import tyro
from matplotlib.figure import Figure

from ballu_mjx.ballu.model import CONTROL_TIMESTEP, load_model, standing_qpos
from ballu_mjx.sim.step import count_substeps

MJX, MUJOCO, PYBULLET = "MJX", "C MuJoCo", "PyBullet"
COLOURS = {MJX: "#0072b2", MUJOCO: "#d55e00", PYBULLET: "#009e73"}
BATCHES = (1, 4, 16, 64, 256, 1024, 4096, 8192)
MEASURED_STEPS = 40_000
"""Control steps in one measurement, summed over all robots. A robot takes at least 4 and at most 40."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the comparison of engines."""

    batches: tuple[int, ...] = BATCHES
    """Numbers of robots that are simulated in parallel."""
    repeats: int = 5
    """Number of measurements of each speed."""
    sequences: int = 64
    """Number of command sequences for the measurement of accuracy."""
    output: Path = Path("runs/bench-physics")
    """Folder for physics.json and physics.png."""
    quick: bool = False
    """Use two batches, three measurements and eight sequences."""


def commands_for(batch: int) -> np.ndarray:
    """Return the commands (batch, steps, 2) of a measurement."""
    steps = int(np.clip(MEASURED_STEPS // batch, 4, 40))
    return accuracy.bang_bang(0, batch, steps)


def measure(engine: str, **request: Any) -> Any:
    """Return the measurement of a child process."""
    return {MJX: mjx_rates, MUJOCO: mujoco_rates, PYBULLET: pybullet_rates, "errors": errors}[engine](**request)


def mjx_rates(batches: Sequence[int], repeats: int) -> list[list[float]]:
    """Return control steps per second of MJX on all devices, by batch."""
    setting = accuracy.Setting.of(load_model())
    model, qpos = setting.model(), accuracy.settled(setting)
    found = []
    for batch in batches:
        program = accuracy.mjx_program(model, qpos, min(jax.local_device_count(), batch))
        commands = jnp.asarray(commands_for(batch), jnp.float32)
        jax.block_until_ready(program(commands))
        rates = []
        for _ in range(repeats):
            began = time.perf_counter()
            jax.block_until_ready(program(commands))
            rates.append(commands.shape[0] * commands.shape[1] / (time.perf_counter() - began))
        found.append(rates)
    return found


def mujoco_rates(batches: Sequence[int], repeats: int) -> list[list[float]]:
    """Return control steps per second of C MuJoCo with one thread per core, by batch."""
    model, threads = load_model(), len(common.cores())
    return [throughput.rollout_rates(model, threads, repeats, commands_for(batch)) for batch in batches]


def pybullet_rates(timestep: float, repeats: int, steps: int) -> list[float]:
    """Return control steps per second of PyBullet with one process per core, from measurements of `steps` steps."""
    context = multiprocessing.get_context("spawn")
    count = len(common.cores())
    barrier = context.Barrier(count)
    with context.Pool(count, _share, (barrier,)) as pool:
        took = pool.map(_pybullet_seconds, [(timestep, repeats, steps)] * count, chunksize=1)
    return [count * steps / seconds for seconds in np.max(took, axis=0).tolist()]


_barrier: Any = None


def _share(barrier: Any) -> None:
    """Store the barrier in a worker process, which can receive it only at its start."""
    global _barrier
    _barrier = barrier


def _pybullet_seconds(request: tuple[float, int, int]) -> list[float]:
    """Return the seconds of each measurement in one process. All processes start a measurement together."""
    import bullet

    timestep, repeats, steps = request
    model = load_model()
    world = bullet.Robot(model, timestep)
    commands = accuracy.bang_bang(0, 1, steps)[0].tolist()
    start = standing_qpos(model)
    found = []
    for _ in range(repeats + 1):
        world.reset(start)
        _barrier.wait()
        began = time.perf_counter()
        for command in commands:
            world.step(command)
        found.append(time.perf_counter() - began)
    world.close()
    return found[1:]


def errors(sequences: int) -> dict[str, tuple[float, float]]:
    """Return the median and the 95th percentile of each engine's error (mm)."""
    import bullet

    setting = accuracy.Setting.of(load_model())
    steps = round(accuracy.DURATION / CONTROL_TIMESTEP)
    commands, qpos = accuracy.bang_bang(0, sequences, steps), accuracy.settled(setting)
    model, threads = setting.model(), len(common.cores())
    judge = accuracy.c_rollout(setting.tight(4), qpos, commands, threads)
    ends = {
        MUJOCO: accuracy.c_rollout(model, qpos, commands, threads),
        MJX: accuracy.mjx_rollout(model, qpos, commands, sequences).positions,
    }
    for timestep in bullet.TIMESTEPS:
        world = bullet.Robot(model, timestep)
        final = []
        for sequence in commands.tolist():
            world.reset(qpos)
            for command in sequence:
                world.step(command)
            final.append(world.qpos())
        world.close()
        ends[_bullet_name(timestep)] = accuracy.balloon_positions(model, np.array(final))
    return {name: accuracy.distances(end, judge) for name, end in ends.items()}


def _bullet_name(timestep: float) -> str:
    return f"{PYBULLET}, {timestep * 1e3:.3g} ms"


def plot(path: Path, rows: list[dict[str, Any]], errors: dict[str, tuple[float, float]], machine: str) -> None:
    """Plot simulated seconds per second over batch size. Engines without batches are horizontal lines."""
    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.subplots()
    counts = sorted({row["cores"] for row in rows})
    styles = {count: style for count, style in zip(counts, ("--", "-.", ":", (0, (1, 3)), "-"), strict=False)}
    styles[counts[-1]] = "-"
    for name in errors:
        for count in counts:
            mine = [row for row in rows if (row["engine"], row["cores"]) == (name, count)]
            speed = [np.median(row["control_steps_per_second"]) * CONTROL_TIMESTEP for row in mine]
            where = f"{count} core{'s' * (count > 1)}, {errors[name][0]:.1f} / {errors[name][1]:.1f} mm"
            look: dict[str, Any] = {"color": COLOURS[name.split(",")[0]], "linestyle": styles[count]}
            if mine[0]["batch"] is None:
                finer = {"linewidth": 0.8} if "1 ms" in name else {}
                axes.axhline(speed[0], label=f"{name}, {where}", **look, **finer)
            else:
                axes.plot([row["batch"] for row in mine], speed, marker="o", label=f"{name}, {where}", **look)
    axes.set(xscale="log", yscale="log", xlabel="robots side by side", ylabel="simulated seconds per second")
    axes.set_title(f"{machine}; errors after 2 s, median / 95 %", fontsize=9)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    common.save(figure, path)


def main(options: Options) -> None:
    if options.quick:
        options = dataclasses.replace(options, batches=(1, 64), repeats=3, sequences=8)
    import bullet

    model = load_model()
    count = count_substeps(model, CONTROL_TIMESTEP)
    found = common.child(__file__, {"engine": "errors", "sequences": options.sequences})
    rows: list[dict[str, Any]] = []
    print(f"{'':28}{'cores':>6}{'batch':>7}{'control steps/s':>34}{'physics steps/s':>17}{'simulated s/s':>15}  error")

    def add(name: str, threads: int, batch: int | None, rates: list[float], substeps: int) -> None:
        rows.append({"engine": name, "cores": threads, "batch": batch, "control_steps_per_second": rates})
        middle = float(np.median(rates))
        rows[-1] |= {"physics_steps_per_second": middle * substeps}
        rows[-1] |= {"simulated_seconds_per_second": middle * CONTROL_TIMESTEP}
        error = "{:.1f} / {:.1f} mm".format(*found[name])
        speed = f"{middle * substeps:>17,.0f}{middle * CONTROL_TIMESTEP:>15,.1f}"
        print(f"{name:28}{threads:>6}{batch or '':>7}{common.spread(rates):>34}{speed}  {error}", flush=True)

    request = {"batches": options.batches, "repeats": options.repeats}
    for threads in dict.fromkeys((1, len(common.cores()))):
        used = common.cores()[:threads]
        for engine in (MUJOCO, MJX):
            answers = common.child(__file__, {"engine": engine, **request}, cores=used)
            for batch, rates in zip(options.batches, answers, strict=True):
                add(engine, threads, batch, rates, count)
        for timestep in bullet.TIMESTEPS:
            steps = 40 if options.quick else 200
            one = {"engine": PYBULLET, "timestep": timestep, "repeats": options.repeats, "steps": steps}
            rates = common.child(__file__, one, cores=used)
            add(_bullet_name(timestep), threads, None, rates, round(CONTROL_TIMESTEP / timestep))
    result = {"quick": options.quick, "time_step": model.opt.timestep, "errors_mm": found, "rows": rows}
    common.write(options.output, "physics", result)
    plot(options.output / "physics.png", rows, found, common.described(common.machine()))


if __name__ == "__main__" and not common.answer(measure):
    main(tyro.cli(Options, description=__doc__))
