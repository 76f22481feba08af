"""Provenance of measured numbers: commit, package versions and machine."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import platform
import re
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

PACKAGES = (
    "ballu-mjx", "jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "optimistix", "numpy", "scipy"
)  # fmt: skip
"""Packages whose versions may change a result."""
CHANGED = "+changes"
"""Suffix of the commit if the working tree had changes."""
_ROOT = Path(__file__).parents[2]


def source_commit() -> str | None:
    """Return the commit of this package's checkout, with the suffix `CHANGED` if tracked files differ from it.

    None if the package was installed without a checkout.
    """
    commit = _git("rev-parse", "HEAD") if (_ROOT / ".git").exists() else ""
    if not commit:
        return None
    return commit + (CHANGED if _git("status", "--porcelain", "--untracked-files=no") else "")


def package_versions(packages: Sequence[str] = PACKAGES) -> dict[str, str | None]:
    """Return the installed version of each package, or None if it is not installed."""
    found: dict[str, str | None] = dict.fromkeys(packages)
    for package in packages:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found


def usable_cores() -> list[int]:
    """Return the ids of the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def describe_machine() -> dict[str, Any]:
    """Return the machine's processor, number of usable cores, memory, operating system and Python version."""
    facts: dict[str, str] = {}
    for path, name in (("/proc/cpuinfo", "model name"), ("/proc/meminfo", "MemTotal")):
        with contextlib.suppress(OSError):
            found = re.search(rf"^{name}\s*:\s*(.+)$", Path(path).read_text(), re.MULTILINE)
            facts[name] = found[1] if found else ""
    return {
        "cpu": facts.get("model name") or platform.processor() or platform.machine(),
        "architecture": platform.machine(),
        "cores": len(usable_cores()),
        "memory": facts.get("MemTotal"),
        "system": platform.system(),
        "python": platform.python_version(),
    }


def _git(*arguments: str) -> str:
    """Return the output of a git command in the checkout. Empty if the command fails or git is not installed."""
    try:
        done = subprocess.run(["git", "-C", str(_ROOT), *arguments], capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
