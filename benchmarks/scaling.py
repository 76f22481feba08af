"""Measure how the speed of training depends on cores, devices, environments, episode length and recordings.

Every measurement is a separate process that runs PPO on EnvMimic with the default sizes, except for the varied one. It
reports control steps per second, including learning (medians of five training steps). The first training step compiles.
Its duration is reported separately, as is the peak resident memory. The varied quantities are:

- cores: the process is restricted to one, two, ... cores, with a host device for each.
- devices: all cores are divided into one, two, ... host devices.
- environments: from 64 to 8,192, with as many trajectory segments in a training step.
- episode length: from 1 to 10 s.
- recordings: from one to sixteen, with the bundled ones repeated.

Cores and devices are measured several times in turn, so that changes of other load affect all values alike.

`python benchmarks/scaling.py`. With `--quick` it runs within minutes as a check, and its results mean little.
"""

from __future__ import annotations

import dataclasses
import itertools
import resource
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import common
import numpy as np
import tyro
from matplotlib.figure import Figure

from ballu_mjx.common import runtime
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.simulator import Simulator

AXES = {
    "cores": "cores",
    "devices": "host devices on all cores",
    "environments": "environments",
    "episode_seconds": "mean length of an episode (s)",
    "recordings": "recordings",
}
"""Varied quantities, with the labels of their axes."""
IN_TURN = ("cores", "devices")
"""Quantities whose values are measured several times in turn."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the measurement of speed and memory."""

    environments: tuple[int, ...] = (64, 256, 1024, 4096, 8192)
    """Numbers of environments to measure."""
    episode_seconds: tuple[float, ...] = (1.0, 3.0, 10.0)
    """Mean episode lengths to measure (s)."""
    recordings: tuple[int, ...] = (1, 4, 16)
    """Numbers of recordings to measure."""
    repeats: int = 5
    """Number of timed training steps."""
    turns: int = 3
    """Number of times that cores and devices are measured in turn."""
    only: tuple[str, ...] = ()
    """Quantities to vary: cores, devices, environments, episode_seconds, recordings. Default: all."""
    output: Path = Path("runs/bench-scaling")
    """Folder for scaling.json, scaling.png and memory.png."""
    quick: bool = False
    """Vary only the number of cores, with few and short steps of 64 environments."""


def measure(environments: int, episode_seconds: float | None, recordings: int | None, repeats: int) -> dict[str, Any]:
    """Return steps per second, duration of the first step (s) and peak memory (bytes). A child process calls this."""
    runtime.prepare()
    import jax

    from ballu_mjx.ballu.model import load_model
    from ballu_mjx.recordings.csv_format import list_bundled, read_recording
    from ballu_mjx.recordings.reconstruct import reconstruct
    from ballu_mjx.residuals.envmimic import EnvMimicConfig, EnvMimicEnv
    from ballu_mjx.rl import learner, ppo, training_state

    model = load_model()
    paths = list_bundled("training")
    paths = list(itertools.islice(itertools.cycle(paths), recordings or len(paths)))
    known = {path: reconstruct(read_recording(path, load_robot()), load_robot(), model) for path in set(paths)}
    config = EnvMimicConfig()
    if episode_seconds is not None:
        config = dataclasses.replace(config, episode_seconds=episode_seconds)
    env = EnvMimicEnv(Simulator(load_robot(), model=model), [known[path] for path in paths], config)
    sizes = ppo.PPOConfig(num_envs=environments)
    sizes = dataclasses.replace(sizes, batch_size=max(environments // sizes.num_minibatches, jax.local_device_count()))
    each = sizes.batch_size * sizes.num_minibatches * sizes.unroll_length
    sizes = dataclasses.replace(sizes, num_timesteps=(repeats + 1) * each)
    rates: list[float] = []

    def note(step: int, state: training_state.TrainingState, metrics: dict[str, float]) -> None:
        if metrics:
            rates.append(metrics["steps_per_second"])

    began = time.perf_counter()
    learner.train(env, sizes, note)
    first = time.perf_counter() - began - sum(each / rate for rate in rates[1:])
    return {
        "steps_per_second": rates[1:],
        "first_seconds": first,
        "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024),
        "devices": jax.local_device_count(),
    }


def merged(answers: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the result of all turns. The duration of the first step is that of the first turn, which compiles."""
    return {
        "steps_per_second": [rate for answer in answers for rate in answer["steps_per_second"]],
        "first_seconds": answers[0]["first_seconds"],
        "peak_bytes": max(answer["peak_bytes"] for answer in answers),
        "devices": answers[0]["devices"],
    }


def speedups(fewest: Sequence[Mapping[str, Any]], most: Sequence[Mapping[str, Any]]) -> list[float]:
    """Return the ratio of speeds for each turn."""

    def speed(answer: Mapping[str, Any]) -> float:
        return float(np.median(answer["steps_per_second"]))

    return [speed(b) / speed(a) for a, b in zip(fewest, most, strict=True)]


def plot_speed(path: Path, rows: list[dict[str, Any]], machine: str) -> None:
    """Plot the speed, with one panel per varied quantity."""
    shown = [axis for axis in AXES if any(row["axis"] == axis for row in rows)]
    figure = Figure(figsize=(4.0 * len(shown), 3.6), layout="constrained")
    for axes, axis in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        mine = [row for row in rows if row["axis"] == axis]
        values = [row["value"] for row in mine]
        speed = [float(np.median(row["steps_per_second"])) for row in mine]
        axes.plot(values, speed, color="#0072b2", marker="o")
        if axis == "cores":
            axes.plot(values, [speed[0] * value / values[0] for value in values], "--", color="gray", linewidth=0.8)
        if axis != "devices" and axis != "cores":
            axes.set_xscale("log")
        axes.set(xlabel=AXES[axis], ylabel="control steps per second", ylim=(0, None))
        axes.grid(alpha=0.3)
    figure.suptitle(f"{machine}, PPO on EnvMimic", fontsize=9)
    common.save(figure, path)


def plot_memory(path: Path, rows: list[dict[str, Any]], machine: str) -> None:
    """Plot peak memory over the number of environments."""
    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axes = figure.subplots()
    held = [row["peak_bytes"] / 1e9 for row in rows]
    axes.plot([row["value"] for row in rows], held, color="#0072b2", marker="o")
    axes.set(xscale="log", xlabel="environments", ylabel="peak resident memory (GB)", ylim=(0, None))
    axes.set_title(f"{machine}, PPO on EnvMimic", fontsize=9)
    axes.grid(alpha=0.3)
    common.save(figure, path)


def main(options: Options) -> None:
    usual = 1024
    if options.quick:
        options = dataclasses.replace(options, repeats=2, turns=1, only=options.only or ("cores",), environments=(64,))
        usual = 64
    counts = common.core_counts()
    varied: dict[str, tuple[float, ...]] = {
        "cores": tuple(counts),
        "devices": tuple(counts),
        "environments": options.environments,
        "episode_seconds": options.episode_seconds,
        "recordings": options.recordings,
    }
    rows: list[dict[str, Any]] = []
    print(f"{'':42}{'control steps/s':>32}{'first step':>12}{'memory':>10}")
    for axis, values in varied.items():
        if options.only and axis not in options.only:
            continue
        answers: dict[float, list[dict[str, Any]]] = {value: [] for value in values}
        for value in values * (options.turns if axis in IN_TURN else 1):
            request: dict[str, Any] = {"environments": usual, "episode_seconds": None, "recordings": None}
            if axis in request:
                request[axis] = value
            request["repeats"] = options.repeats
            used = common.cores()[: int(value)] if axis == "cores" else None
            flags = f"--xla_force_host_platform_device_count={int(value)}" if axis == "devices" else ""
            found = common.child(__file__, request, cores=used, env={"XLA_FLAGS": flags} if flags else None)
            answers[value].append(found)
            speed = common.spread(found["steps_per_second"])
            memory = f"{found['peak_bytes'] / 1e9:.2f} GB"
            print(f"{f'{value:g} {AXES[axis]}':42}{speed:>32}{found['first_seconds']:>10.0f} s{memory:>10}", flush=True)
        rows += [{"axis": axis, "value": value, **merged(each)} for value, each in answers.items()]
        if axis in IN_TURN and len(values) > 1:
            ratios = speedups(answers[values[0]], answers[values[-1]])
            print(f"{values[-1]:g} against {values[0]:g} {AXES[axis]}: {common.spread(ratios, 2)}, by turn", flush=True)
    common.write(options.output, "scaling", {"quick": options.quick, "environments": usual, "rows": rows})
    machine = common.described(common.machine())
    plot_speed(options.output / "scaling.png", rows, machine)
    if over := [row for row in rows if row["axis"] == "environments"]:
        plot_memory(options.output / "memory.png", over, machine)


if __name__ == "__main__" and not common.answer(measure):
    main(tyro.cli(Options, description=__doc__))
