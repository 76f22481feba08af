"""What the benchmarks share: the machine's description, measurements in child processes, and where results go."""

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
"""First argument of a script that is to measure one thing; the second is JSON."""
_PACKAGES = (*provenance.PACKAGES, "pybullet", "torch", "stable-baselines3", "playground")


def core_counts() -> list[int]:
    """One, its doublings, and all."""
    count, counts = 1, []
    while count < len(cores()):
        counts.append(count)
        count *= 2
    return [*counts, len(cores())]


def machine() -> dict[str, Any]:
    """What a figure's reader must know of the machine. The load tells whether others were at work at the same time."""
    versions = {name: version for name, version in provenance.package_versions(_PACKAGES).items() if version}
    load = os.getloadavg() if hasattr(os, "getloadavg") else None
    return {**provenance.describe_machine(), "versions": versions, "load": load}


def described(machine: Mapping[str, Any]) -> str:
    """`machine()` in a line."""
    return f"{machine['cores']} cores of {machine['cpu']}"


def child(
    script: str, request: Mapping[str, Any], *, cores: Sequence[int] | None = None, env: Mapping[str, str] | None = None
) -> Any:
    """What `script` answers to `request` in a process of its own, kept to `cores` (None: all) from its start on.

    **Raises** `SystemExit` where it fails, its own words shown.
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
    """This process's environment without what `runtime.prepare` set in it: a child has its own cores and cache."""
    environment = dict(os.environ)
    flag = f"--xla_force_host_platform_device_count={len(cores())}"
    environment["XLA_FLAGS"] = environment.get("XLA_FLAGS", "").replace(flag, "").strip()
    if environment.get("JAX_COMPILATION_CACHE_DIR") == str(runtime.cache_dir()):
        del environment["JAX_COMPILATION_CACHE_DIR"]
    return environment


def answer(measure: Callable[..., Any]) -> bool:
    """Where this process is a child: answer its request, the keyword arguments of `measure`; returns whether it is."""
    if sys.argv[1:2] != [CHILD]:
        return False
    print("\n" + json.dumps(measure(**json.loads(sys.argv[2]))), flush=True)
    return True


def write(folder: Path, name: str, result: Mapping[str, Any]) -> None:
    """Write a benchmark's result into `folder` as NAME.json, with machine, command and time."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    when = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
    content = {"machine": machine(), "command": sys.argv, "time": when, **result}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    print(f"Written to {path}.")


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_figure(path, dpi=120)
    print(f"Written to {path}.")


def spread(values: Sequence[float], digits: int = 0) -> str:
    """Median (least to most)."""
    middle = float(np.median(values))
    return f"{middle:,.{digits}f} ({min(values):,.{digits}f} to {max(values):,.{digits}f})"
