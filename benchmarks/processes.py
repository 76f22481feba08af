"""Compare a training in several processes with the same training in one process.

`python -m ballu_mjx.train envmimic` runs twice for every seed. The first run is one process with all cores. The second
is one process per core (at least two), each restricted to its core. They connect over the loopback interface
(`--coordinator`). The plot shows both learning curves, as mean and range over seeds. If several processes learn the
same as one, their means differ by about one standard error, which follows from the spread over seeds. The difference is
printed in standard errors, along with the speeds.

`python benchmarks/processes.py`. With `--quick` it runs within minutes as a check, and its results mean little.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import common
import numpy as np
import tyro
from jaxtyping import Float
from matplotlib.figure import Figure

from ballu_mjx.common import runtime

KINDS = {"one": "one process", "several": "a process a core"}
COLOURS = {"one": "#0072b2", "several": "#d55e00"}
CURVES = {"reward": "reward per control step", "validation_error": "validation error"}


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the comparison between one process and several."""

    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds. Each kind of training runs once for every seed."""
    steps: int = 1_000_000
    """Control steps of each training."""
    output: Path = Path("runs/bench-processes")
    """Folder for processes.json, processes.png and the runs. Earlier runs in it are replaced."""
    quick: bool = False
    """Use one seed and `train envmimic --quick`."""


@contextlib.contextmanager
def started(command: list[str], log: Path, cores: list[int]) -> Iterator[subprocess.Popen[bytes]]:
    """Run a process that is restricted to `cores`. It is ended when the context ends."""

    def keep() -> None:
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, cores)

    with log.open("wb") as file:
        process = subprocess.Popen(
            command, stdout=file, stderr=subprocess.STDOUT, env=common.unprepared(), preexec_fn=keep
        )
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def train(kind: str, seed: int, options: Options) -> list[dict[str, Any]]:
    """Train in one process or in several, and return the rows of the run's `metrics.jsonl`.

    **Raises** `SystemExit` naming the log if a process fails.
    """
    from ballu_mjx.runs.metrics import read_metrics

    folder = options.output / f"{kind}-seed-{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "ballu_mjx.train", "envmimic", "--seed", str(seed), "--output", str(folder)]
    sizes = ["--num-timesteps", str(options.steps), "--validate-every", str(max(options.steps // 8, 1))]
    command += ["--quick"] if options.quick else sizes
    cores, each = common.cores(), [[]]
    if kind == "several":
        count = max(2, len(cores))
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            coordinator = f"127.0.0.1:{free.getsockname()[1]}"
        together = ["--coordinator", coordinator, "--num-processes", str(count)]
        each = [[*together, "--process-id", str(number)] for number in range(count)]
    with contextlib.ExitStack() as running:
        processes = []
        for number, more in enumerate(each):
            log = options.output / f"{folder.name}-{number}.log"
            kept = cores if kind == "one" else [cores[number % len(cores)]]
            processes.append((running.enter_context(started([*command, *more], log, kept)), log))
        for process, log in processes:
            if process.wait():
                raise SystemExit(f"The training failed with status {process.returncode}; {log} says why.")
    return read_metrics(folder)


def curve(rows: list[dict[str, Any]], name: str) -> tuple[Float[np.ndarray, " steps"], Float[np.ndarray, " steps"]]:
    """Return the control steps and values of the metric `name`."""
    found = [(row["step"], row[name]) for row in rows if name in row]
    steps, values = np.array(found, float).T
    return steps, values


def apart(one: Float[np.ndarray, "seeds steps"], several: Float[np.ndarray, "seeds steps"]) -> float:
    """Return the difference of the means over seeds in standard errors, both as root mean squares over steps.

    It is about 1 if both are samples of the same distribution.
    """
    variance = sum(values.var(axis=0, ddof=1) / len(values) for values in (one, several))
    difference = one.mean(axis=0) - several.mean(axis=0)
    return float(np.sqrt(np.mean(difference**2) / np.mean(variance)))


def plot(path: Path, found: dict[str, list[list[dict[str, Any]]]], machine: str) -> None:
    """Plot mean and range over seeds, with one panel per metric."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    for axes, (name, label) in zip(figure.subplots(1, len(CURVES)), CURVES.items(), strict=True):
        for kind, runs_of_kind in found.items():
            steps = curve(runs_of_kind[0], name)[0]
            values = np.array([curve(rows, name)[1] for rows in runs_of_kind])
            axes.plot(steps / 1e3, values.mean(axis=0), color=COLOURS[kind], label=KINDS[kind])
            axes.fill_between(steps / 1e3, values.min(axis=0), values.max(axis=0), color=COLOURS[kind], alpha=0.2)
        axes.set(xlabel="control steps (thousands)", ylabel=label)
        axes.grid(alpha=0.3)
        axes.legend()
    figure.suptitle(f"{machine}, train envmimic, mean and range over seeds", fontsize=9)
    common.save(figure, path)


def main(options: Options) -> None:
    runtime.prepare()
    if options.quick:
        options = dataclasses.replace(options, seeds=options.seeds[:1])
    found: dict[str, list[list[dict[str, Any]]]] = {kind: [] for kind in KINDS}
    rates: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for seed in options.seeds:
        for kind in KINDS:
            rows = train(kind, seed, options)
            found[kind].append(rows)
            rates[kind].append(float(np.median(curve(rows, "steps_per_second")[1][1:])))
            last = ", ".join(f"{name.replace('_', ' ')} {curve(rows, name)[1][-1]:.3f}" for name in CURVES)
            print(
                f"{KINDS[kind]:18} seed {seed}: {rates[kind][-1]:,.0f} control steps/s, at the end {last}", flush=True
            )
    result: dict[str, Any] = {"quick": options.quick, "steps_per_second": rates, "runs": found}
    ratios = [several / one for one, several in zip(*rates.values(), strict=True)]
    print(f"A process a core against one: {common.spread(ratios, 2)} of its rate")
    if len(options.seeds) > 1:
        for name in CURVES:
            one, several = (np.array([curve(rows, name)[1] for rows in found[kind]]) for kind in KINDS)
            result[f"{name}_apart"] = apart(one, several)
            print(f"{CURVES[name]}: the means are {result[f'{name}_apart']:.2f} standard errors apart")
    common.write(options.output, "processes", result)
    plot(options.output / "processes.png", found, common.described(common.machine()))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
