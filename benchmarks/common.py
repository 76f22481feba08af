"""What the benchmarks share: the machine's description, measurements in child processes, and where results go."""

from __future__ import annotations

import contextlib
import datetime
import importlib.metadata
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ballu_mjx.common import runtime

CHILD = "--child"
"""First argument of a script that is to measure one thing; the second is JSON."""
_PACKAGES = (
    "ballu-mjx", "jax", "mujoco", "mujoco-mjx", "brax", "pybullet", "torch", "stable-baselines3", "playground", "numpy"
)  # fmt: skip


def cores() -> list[int]:
    """Ids of the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def core_counts() -> list[int]:
    """One, its doublings, and all."""
    count, counts = 1, []
    while count < len(cores()):
        counts.append(count)
        count *= 2
    return [*counts, len(cores())]


def machine() -> dict[str, Any]:
    """What a figure's reader must know of the machine. The load tells whether others were at work at the same time."""
    facts: dict[str, str] = {}
    for path, name in (("/proc/cpuinfo", "model name"), ("/proc/meminfo", "MemTotal")):
        with contextlib.suppress(OSError):
            found = re.search(rf"^{name}\s*:\s*(.+)$", Path(path).read_text(), re.MULTILINE)
            facts[name] = found[1] if found else ""
    versions = {}
    for package in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return {
        "cpu": facts.get("model name", platform.processor()),
        "architecture": platform.machine(),
        "cores": len(cores()),
        "memory": facts.get("MemTotal"),
        "system": platform.system(),
        "python": platform.python_version(),
        "versions": versions,
        "load": os.getloadavg() if hasattr(os, "getloadavg") else None,
    }


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
