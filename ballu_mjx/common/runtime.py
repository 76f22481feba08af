"""Start-up of the commands: what must be settled before JAX is imported.

This module imports neither JAX nor anything that does, so that a command's `main` can call `prepare` first.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import gc
import hashlib
import importlib
import importlib.metadata
import io
import logging
import os
import platform
import re
import sys
import textwrap
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from ballu_mjx.common.errors import InputError

_DEVICE_COUNT_FLAG = "--xla_force_host_platform_device_count"
_VECTOR_WIDTH_FLAG = "--xla_cpu_prefer_vector_width"
_MIN_COMPILE_SECONDS = 1.0
"""Programs that compile faster than this are not worth a file in the cache."""
_ALLOCATIONS = 100_000
"""More objects made than freed, between two looks for garbage (Python's own: 700)."""
_MOST_SAID = 300
"""Characters of an unexpected error's message: XLA's fill pages."""
_M_ARENA_MAX = -8
"""Of glibc's `mallopt`."""


def prepare() -> None:
    """Settle JAX's environment for this process, then import MJX; call it before anything else imports JAX.

    - The CPU is split into one host device per core: XLA does not spread these small operations over cores, a batch
      sharded over host devices does. A count in the user's own `XLA_FLAGS` stays, and so do all other flags there.
    - XLA is told to use vectors of 512 bits where the CPU has them (it prefers 256).
    - Compiled programs are kept in `cache_dir()`, unless `JAX_COMPILATION_CACHE_DIR` says where.
    - XLA's log is quietened on machines without an accelerator, unless `TF_CPP_MIN_LOG_LEVEL` is set: every program
      loaded from the cache otherwise prints pages about tuning flags that are no fault. Failures still arrive as
      exceptions.
    - Python looks for garbage less often: tracing MJX makes millions of objects that stay, and looking through all of
      them again and again takes time.
    - glibc keeps one heap a core (its own limit: eight a core), unless `MALLOC_ARENA_MAX` is set. Every checkpoint is
      written by threads of its own, which otherwise leave ever more heaps in pieces.
    - The package's log shows warnings as plain lines, unless it has a handler already.
    - A JAX that would hang is refused (`check_jax`), and MJX's report that Warp is not installed kept off the screen.

    Where JAX is imported already (a notebook, say), its settings stay as they are.

    **Raises**

    `InputError` from `check_jax`.
    """
    if "jax" not in sys.modules:
        os.environ["XLA_FLAGS"] = _with_flags(os.environ.get("XLA_FLAGS", ""), _cores(), _cpu_description())
        if not _accelerated():
            os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
        if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
            # Without a writable cache there is none: slower to start, no less right.
            with contextlib.suppress(OSError):
                cache_dir().mkdir(parents=True, exist_ok=True)
                os.environ["JAX_COMPILATION_CACHE_DIR"] = str(cache_dir())
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(_MIN_COMPILE_SECONDS))
    gc.set_threshold(_ALLOCATIONS, *gc.get_threshold()[1:])
    if "MALLOC_ARENA_MAX" not in os.environ:
        _libc("mallopt", _M_ARENA_MAX, _cores())
    log = logging.getLogger("ballu_mjx")
    if not log.handlers:
        log.addHandler(_PlainHandler(logging.WARNING))
        log.propagate = False
    check_jax()
    _import_mjx()


class _PlainHandler(logging.Handler):
    """Shows messages on the standard error as they are."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), file=sys.stderr)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CommandOptions:
    """Options of every command."""

    debug: bool = False
    """Show errors with their traceback: where in the code they came from."""


def exit_status(command: Callable[[], int | None], arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns its own exit status (None: 0), 2 for input that cannot be used, 1 for what the system
    refuses and for faults of this package, 130 when interrupted, and 141 where nobody reads on.

    Errors are told on the terminal in a sentence, or by their traceback where `arguments` (None: the process's own)
    hold --debug. That is read here, for options may fail before they are parsed.
    """
    debug = "--debug" in (sys.argv[1:] if arguments is None else arguments)
    try:
        status = command() or 0
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader, `head` say, has seen enough; Python must not flush the rest at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except Exception as error:
        if debug:
            traceback.print_exc()
        else:
            print(_told(error), file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1


def check_jax() -> None:
    """Refuse a JAX that is known to deadlock on the backend in use.

    JAX 0.10 never returns from `vmap(mjx.step)` at batch 512 on the CPU; its accelerator backends work.

    **Raises**

    `InputError` with the mend.
    """
    version = importlib.metadata.version("jax")
    if version.split(".")[:2] != ["0", "10"]:
        return
    import jax  # only now: asking for the backend starts it

    if jax.default_backend() == "cpu":
        raise InputError(
            f"jax {version} deadlocks on the CPU in this workload: run "
            '`pip install "jax>=0.9.2,<0.10" "jaxlib>=0.9.2,<0.10"` (constraints.txt pins a version that works).'
        )


def cache_dir() -> Path:
    """Folder for compiled programs: in the user's cache, one for each jaxlib and each kind of CPU.

    A program compiled on another CPU may die of an illegal instruction.
    """
    if root := os.environ.get("XDG_CACHE_HOME"):
        base = Path(root)
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path.home() / ".cache"
    cpu = hashlib.sha256(_cpu_description().encode()).hexdigest()[:12]
    return base / "ballu_mjx" / f"jaxlib-{importlib.metadata.version('jaxlib')}-{cpu}"


def release_memory() -> None:
    """Give memory that is free, such as compiling leaves, back to the system, where glibc otherwise keeps it."""
    _libc("malloc_trim", 0)


def _libc(name: str, *arguments: int) -> None:
    """Call a function of glibc, where there is one."""
    if platform.libc_ver()[0] == "glibc":
        getattr(ctypes.CDLL(None), name)(*arguments)


def _told(error: Exception) -> str:
    """An error in a sentence."""
    if isinstance(error, InputError):
        return str(error)
    said = " ".join(str(error).split())
    if isinstance(error, OSError):
        return f"The system refused: {said}; mend that, or run again with --debug to see what asked for it."
    what = f"{type(error).__name__}: {textwrap.shorten(said, _MOST_SAID)}" if said else type(error).__name__
    return f"This is a fault of ballu_mjx, not of your input: {what}; run again with --debug and report it."


def _with_flags(flags: str, count: int, cpu: str) -> str:
    """XLA's `flags` with `count` host devices and, where `cpu` (its description) has them, vectors of 512 bits added,
    each unless the flags name it."""
    wanted = {_DEVICE_COUNT_FLAG: count}
    if re.search(r"\bavx512f\b", cpu):
        wanted[_VECTOR_WIDTH_FLAG] = 512
    return " ".join([flags, *(f"{flag}={value}" for flag, value in wanted.items() if flag not in flags)]).strip()


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _accelerated() -> bool:
    """Whether JAX may find an accelerator: a plugin for one is installed, and the user has not asked for the CPU."""
    if os.environ.get("JAX_PLATFORMS") == "cpu":
        return False
    return bool(importlib.metadata.entry_points(group="jax_plugins"))


def _cpu_description() -> str:
    """Model and instruction sets of the CPU, as far as the system tells."""
    with contextlib.suppress(OSError):
        text = Path("/proc/cpuinfo").read_text()
        fields = re.findall(r"^(?:model name|flags|CPU part|Features)\s*:.*$", text.split("\n\n")[0], re.MULTILINE)
        if fields:
            return platform.machine() + "".join(fields)
    return platform.machine() + platform.processor()


def _import_mjx() -> None:
    """Import MJX without the lines it prints where Warp, which this package does not use, is not installed."""
    if "mujoco.mjx" in sys.modules:
        return
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said):
            importlib.import_module("mujoco.mjx")
    finally:
        for line in said.getvalue().splitlines():
            if not line.startswith(("Failed to import warp:", "Failed to import mujoco_warp:")):
                print(line)
