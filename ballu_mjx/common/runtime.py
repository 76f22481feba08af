"""Start-up of the commands: settings that must be made before JAX is imported.

This module imports neither JAX nor a module that does, so that a command's `main` can call `prepare` first.
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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from ballu_mjx.common.compiler_options import OLDER_FUSION
from ballu_mjx.common.errors import InputError

_DEVICE_COUNT_FLAG = "--xla_force_host_platform_device_count"
_VECTOR_WIDTH_FLAG = "--xla_cpu_prefer_vector_width"
_MIN_COMPILE_SECONDS = 1.0
"""Shortest compilation (s) whose program is stored in the cache."""
_ALLOCATIONS = 100_000
"""Surplus of created over freed objects that starts a garbage collection (Python's default: 700)."""
_LONGEST_MESSAGE = 300
"""Largest number of characters that are shown of an unexpected error's message. XLA's messages fill pages."""
_M_ARENA_MAX = -8
"""Option of glibc's `mallopt` for the largest number of heaps."""


def prepare(*, brief: bool = False, joins: bool = False) -> None:
    """Configure JAX for this process, then import MJX. Call this function before anything else imports JAX.

    If `brief` is true, programs compile in less time and run longer (`compiler_options.OLDER_FUSION`). If `joins` is
    true, this process joins others before JAX starts its backend, and `distributed.join` checks JAX.

    - The CPU is split into one host device per core. XLA does not spread these small operations over cores, but a
      batch that is sharded over host devices uses all of them. A device count in the user's `XLA_FLAGS` is kept, and
      so are all other flags there.
    - XLA uses vectors of 512 bits if the CPU has them (its default is 256).
    - Compiled programs are cached in `cache_dir()`, unless `JAX_COMPILATION_CACHE_DIR` names another folder.
    - XLA's log is silenced on machines without an accelerator, unless `TF_CPP_MIN_LOG_LEVEL` is set. Every program
      loaded from the cache would otherwise print pages of harmless messages about tuning flags. Failures still raise
      exceptions.
    - Python's garbage collector runs less often. Tracing MJX creates millions of objects that stay alive, and scanning
      all of them repeatedly takes time.
    - glibc keeps at most one heap per core (its default is eight per core), unless `MALLOC_ARENA_MAX` is set. Every
      checkpoint is written by new threads, which would otherwise leave more and more fragmented heaps.
    - The package's log prints warnings as plain lines, unless it already has a handler.
    - A JAX version that would hang is refused, and a slow one is reported (`check_jax`).
    - MJX's message that Warp is not installed is suppressed.

    If JAX is already imported (in a notebook, for example), its settings are not changed.

    **Raises**

    `InputError` from `check_jax`.
    """
    if "jax" not in sys.modules:
        fusion = OLDER_FUSION if brief else {}
        os.environ["XLA_FLAGS"] = _with_flags(os.environ.get("XLA_FLAGS", ""), _cores(), _cpu_description(), fusion)
        if not _accelerated():
            os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
        if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
            # Without a writable folder there is no cache: the start is slower, and results are the same.
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
    if not joins:
        check_jax()
    _import_mjx()


class _PlainHandler(logging.Handler):
    """Log handler that prints messages to standard error without decoration."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), file=sys.stderr)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CommandOptions:
    """Options of every command."""

    debug: bool = False
    """Print the Python traceback of an error instead of one sentence, to see where in the code it occurred."""


def exit_status(command: Callable[[], int | None], arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status.

    The status is the command's own (0 for None), 2 for unusable input, or 1 for errors of the system or of this
    package. It is 130 after an interrupt, and 141 if the reader of the output has closed it.

    Errors are printed as one sentence, or with their traceback if `arguments` (None: those of this process) contain
    --debug. This option is read here because parsing the options may itself fail.
    """
    debug = "--debug" in (sys.argv[1:] if arguments is None else arguments)
    try:
        status = command() or 0
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader, for example `head`, has ended; Python must not flush the rest at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except Exception as error:
        if debug:
            traceback.print_exc()
        else:
            print(_error_message(error), file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1


def check_jax() -> None:
    """Refuse a JAX that is known to deadlock on the backend in use. Warn of one that is slow there.

    JAX 0.10 never returns from `vmap(mjx.step)` with a batch of 512 on the CPU. With JAX 0.11, training takes five
    times as long there as with 0.9.2. Their accelerator backends work.

    **Raises**

    `InputError` with the fix.
    """
    version = importlib.metadata.version("jax")
    release = tuple(int(part) for part in version.split(".")[:2])
    if release < (0, 10):
        return
    import jax  # imported late, because asking for the backend starts it

    if jax.default_backend() != "cpu":
        return
    fix = 'run `pip install "jax>=0.9.2,<0.10" "jaxlib>=0.9.2,<0.10"` (constraints.txt pins a version that works).'
    if release == (0, 10):
        raise InputError(f"jax {version} deadlocks on the CPU in this workload: {fix}")
    logging.getLogger("ballu_mjx").warning(
        "jax %s trains several times slower on the CPU than jax 0.9.2: %s", version, fix
    )


def cache_dir() -> Path:
    """Return the folder for compiled programs: in the user's cache, one for each version of jaxlib and kind of CPU.

    A program that was compiled on another CPU may crash with an illegal instruction.
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
    """Return free memory to the system. glibc would otherwise keep it, for example after compiling."""
    _libc("malloc_trim", 0)


def _libc(name: str, *arguments: int) -> None:
    """Call a function of glibc, if it is the C library."""
    if platform.libc_ver()[0] == "glibc":
        getattr(ctypes.CDLL(None), name)(*arguments)


def _error_message(error: Exception) -> str:
    """Return an error as one sentence."""
    if isinstance(error, InputError):
        return str(error)
    text = " ".join(str(error).split())
    if isinstance(error, OSError):
        return f"The operating system reports: {text}; fix that, or run again with --debug to see where it happened."
    what = f"{type(error).__name__}: {textwrap.shorten(text, _LONGEST_MESSAGE)}" if text else type(error).__name__
    return f"This is a fault of ballu_mjx, not of your input: {what}; run again with --debug and report it."


def _with_flags(flags: str, count: int, cpu: str, options: Mapping[str, bool]) -> str:
    """Return XLA's `flags` with `options` and `count` host devices, and with vectors of 512 bits if the CPU has them.

    `cpu` is the CPU's description. Options that `flags` already set are not changed.
    """
    wanted = {_DEVICE_COUNT_FLAG: str(count)}
    wanted |= {f"--{name}": str(value).lower() for name, value in options.items()}
    if re.search(r"\bavx512f\b", cpu):
        wanted[_VECTOR_WIDTH_FLAG] = "512"
    return " ".join([flags, *(f"{flag}={value}" for flag, value in wanted.items() if flag not in flags)]).strip()


def _cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _accelerated() -> bool:
    """Return whether JAX may find an accelerator: a plugin is installed, and the user has not chosen the CPU."""
    if os.environ.get("JAX_PLATFORMS") == "cpu":
        return False
    return bool(importlib.metadata.entry_points(group="jax_plugins"))


def _cpu_description() -> str:
    """Return the model and the instruction sets of the CPU, as far as the system reports them."""
    with contextlib.suppress(OSError):
        text = Path("/proc/cpuinfo").read_text()
        fields = re.findall(r"^(?:model name|flags|CPU part|Features)\s*:.*$", text.split("\n\n")[0], re.MULTILINE)
        if fields:
            return platform.machine() + "".join(fields)
    return platform.machine() + platform.processor()


def _import_mjx() -> None:
    """Import MJX without its messages that Warp is not installed. This package does not use Warp."""
    if "mujoco.mjx" in sys.modules:
        return
    output = io.StringIO()
    try:
        with contextlib.redirect_stdout(output):
            importlib.import_module("mujoco.mjx")
    finally:
        for line in output.getvalue().splitlines():
            if not line.startswith(("Failed to import warp:", "Failed to import mujoco_warp:")):
                print(line)
