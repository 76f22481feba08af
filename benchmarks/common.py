"""Shared parts of the benchmarks: description of the machine, measurements in child processes, and output."""

from __future__ import annotations

import datetime
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ballu_mjx.common import provenance, runtime
from ballu_mjx.common.provenance import usable_cores as cores

CHILD = "--child"
"""First argument of a script that runs as a child process for one measurement. The second is the request in JSON."""
_PACKAGES = (*provenance.PACKAGES, "pybullet", "torch", "stable-baselines3", "playground")


def core_counts() -> list[int]:
    """Return the numbers of cores to measure: the powers of two below the number of usable cores, and that number."""
    count, counts = 1, []
    while count < len(cores()):
        counts.append(count)
        count *= 2
    return [*counts, len(cores())]


def machine() -> dict[str, Any]:
    """Return a description of the machine, with package versions and load. The load shows if other work was running."""
    versions = {name: version for name, version in provenance.package_versions(_PACKAGES).items() if version}
    load = os.getloadavg() if hasattr(os, "getloadavg") else None
    return {**provenance.describe_machine(), "versions": versions, "load": load}


def described(machine: Mapping[str, Any]) -> str:
    """Return the result of `machine` as one line."""
    return f"{machine['cores']} cores of {machine['cpu']}"


def child(
    script: str, request: Mapping[str, Any], *, cores: Sequence[int] | None = None, env: Mapping[str, str] | None = None
) -> Any:
    """Run `script` in a separate process and return its answer to `request`.

    **Arguments**

    - `script`: path of a script that calls `answer`.
    - `request`: keyword arguments of its measurement.
    - `cores`: cores to which the process is restricted from its start. None for all.
    - `env`: additional environment variables.

    **Raises** `SystemExit` if the process fails. Its error output is shown.
    """

    def keep() -> None:
        if cores is not None and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, cores)

    command = [sys.executable, script, CHILD, json.dumps(request)]
    environment = {**unprepared(), **(env or {})}
    process = subprocess.run(command, stdout=subprocess.PIPE, text=True, env=environment, preexec_fn=keep, check=False)
    if process.returncode:
        raise SystemExit(f"{script}: the measurement {json.dumps(request)} failed with status {process.returncode}.")
    return json.loads(process.stdout.splitlines()[-1])


def unprepared() -> dict[str, str]:
    """Return this process's environment without the changes of `runtime.prepare`.

    A child process has its own cores and cache.
    """
    environment = dict(os.environ)
    flag = f"--xla_force_host_platform_device_count={len(cores())}"
    environment["XLA_FLAGS"] = environment.get("XLA_FLAGS", "").replace(flag, "").strip()
    if environment.get("JAX_COMPILATION_CACHE_DIR") == str(runtime.cache_dir()):
        del environment["JAX_COMPILATION_CACHE_DIR"]
    return environment


def answer(measure: Callable[..., Any]) -> bool:
    """Call `measure` with the request and print its result, if this process is a child. Return whether it is one."""
    if sys.argv[1:2] != [CHILD]:
        return False
    print("\n" + json.dumps(measure(**json.loads(sys.argv[2]))), flush=True)
    return True


def write(folder: Path, name: str, result: Mapping[str, Any]) -> None:
    """Write a benchmark's result to `name`.json in `folder`, with machine, command and time."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    when = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
    content = {"machine": machine(), "command": sys.argv, "time": when, **result}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    print(f"Written to {path}.")


def save(figure: Figure, path: Path) -> None:
    """Write a figure to `path` as PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_figure(path, dpi=120)
    print(f"Written to {path}.")


def spread(values: Sequence[float], digits: int = 0) -> str:
    """Return the text "median (minimum to maximum)" of values."""
    middle = float(np.median(values))
    return f"{middle:,.{digits}f} ({min(values):,.{digits}f} to {max(values):,.{digits}f})"
