"""Start-up of the commands. Tests of the environment run in a new process."""

from __future__ import annotations

import logging
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import pytest

from ballu_mjx.common import runtime
from ballu_mjx.common.compiler_options import OLDER_FUSION
from ballu_mjx.common.errors import InputError

SET_BY_PREPARE = (
    "XLA_FLAGS",
    "TF_CPP_MIN_LOG_LEVEL",
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "MALLOC_ARENA_MAX",
)
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
THREADS = 2 * CORES + 5
PREPARE = "from ballu_mjx.common import runtime; runtime.prepare(); import jax\n"
COMPILE = "import jax.numpy as jnp; jax.jit(lambda x: jnp.linalg.cholesky(x @ x.T + jnp.eye(3)))(jnp.ones((3, 3)))"


def python(code: str, cache: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `code` in a process that has the variables in `environment`, but no others that `prepare` sets."""
    inherited = {name: value for name, value in os.environ.items() if name not in SET_BY_PREPARE}
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**inherited, "JAX_PLATFORMS": "cpu", "XDG_CACHE_HOME": str(cache), **environment},
        capture_output=True,
        text=True,
        check=True,
    )


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("", CORES),
        ("--xla_force_host_platform_device_count=3 --xla_cpu_enable_fast_math=false", 3),
    ],
)
def test_one_host_device_per_core_unless_the_user_sets_a_number(flags: str, expected: int, tmp_path: Path) -> None:
    out = python(PREPARE + "print(jax.device_count())", tmp_path, XLA_FLAGS=flags).stdout
    assert out == f"{expected}\n"


def test_other_xla_flags_of_the_user_are_kept(tmp_path: Path) -> None:
    flag = "--xla_cpu_enable_fast_math=false"
    out = python(PREPARE + "import os; print(os.environ['XLA_FLAGS'])", tmp_path, XLA_FLAGS=flag).stdout
    assert out.startswith(f"{flag} --xla_force_host_platform_device_count=")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have one heap")
@pytest.mark.parametrize(("environment", "heaps"), [({}, CORES), ({"MALLOC_ARENA_MAX": "5"}, 5)])
def test_threads_share_one_heap_per_core_unless_the_user_sets_a_number(
    environment: dict[str, str], heaps: int, tmp_path: Path
) -> None:
    report = tmp_path / "heaps.xml"
    code = PREPARE + (
        "import ctypes, threading\n"
        "libc = ctypes.CDLL(None)\n"
        "libc.fopen.restype = libc.malloc.restype = ctypes.c_void_p\n"
        f"together = threading.Barrier({THREADS})\n"
        "def allocate():\n"
        "    libc.malloc(5000)\n"
        "    together.wait()\n"
        f"threads = [threading.Thread(target=allocate) for _ in range({THREADS})]\n"
        "for thread in threads: thread.start()\n"
        "for thread in threads: thread.join()\n"
        f"file = ctypes.c_void_p(libc.fopen({str(report)!r}.encode(), b'w'))\n"
        "libc.malloc_info(0, file)\n"
        "libc.fclose(file)\n"
    )
    python(code, tmp_path, **environment)
    assert report.read_text().count("<heap ") == heaps


def test_nothing_is_printed_with_a_cold_or_a_warm_cache(tmp_path: Path) -> None:
    code = PREPARE + "from ballu_mjx.sim import step\n" + COMPILE
    for _ in range(2):
        done = python(code, tmp_path, JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="0")
        assert (done.stdout, done.stderr) == ("", "")


@pytest.mark.parametrize(
    ("flags", "cpu", "width"),
    [("", "fma avx2 avx512f", "512"), ("", "fma avx2", None), ("--xla_cpu_prefer_vector_width=128", "avx512f", "128")],
)
def test_vectors_of_512_bits_are_used_on_cpus_with_avx512(flags: str, cpu: str, width: str | None) -> None:
    found = re.findall(r"--xla_cpu_prefer_vector_width=(\d+)", runtime._with_flags(flags, 2, cpu, {}))
    assert found == ([] if width is None else [width])


@pytest.mark.skipif(not OLDER_FUSION, reason="this version of XLA does not have the older fusion")
@pytest.mark.parametrize(
    ("brief", "chosen", "values"),
    [(True, "", ["false"]), (False, "", []), (True, "--xla_cpu_use_fusion_emitters=true", ["true"])],
)
def test_brief_runs_compile_with_the_older_fusion_unless_the_user_chose(
    tmp_path: Path, brief: bool, chosen: str, values: list[str]
) -> None:
    code = f"import os; from ballu_mjx.common import runtime; runtime.prepare(brief={brief}); "
    code += "import jax; jax.jit(lambda: 0)(); print(os.environ['XLA_FLAGS'])"
    done = python(code, tmp_path, XLA_FLAGS=chosen)
    assert re.findall(r"--xla_cpu_use_fusion_emitters=(\w+)", done.stdout) == values


def test_compiled_programs_are_stored_in_the_cache_folder(tmp_path: Path) -> None:
    at_once = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    code = PREPARE + COMPILE + "; print(runtime.cache_dir())"
    folder = Path(python(code, tmp_path, **at_once).stdout.strip())
    assert folder.is_relative_to(tmp_path)
    assert any(path.stat().st_size > 0 for path in folder.iterdir())

    chosen = tmp_path / "chosen"
    python(code, tmp_path / "unused", JAX_COMPILATION_CACHE_DIR=str(chosen), **at_once)
    assert any(chosen.iterdir())
    assert not (tmp_path / "unused").exists()


def test_unwritable_cache_is_ignored(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    done = python(PREPARE + COMPILE + "; print('done')", blocked)
    assert (done.stdout, done.stderr) == ("done\n", "")


def test_importing_runtime_changes_no_setting(tmp_path: Path) -> None:
    code = (
        "import os, sys; from ballu_mjx.common import runtime; print('jax' in sys.modules, os.environ.get('XLA_FLAGS'))"
    )
    assert python(code, tmp_path).stdout == "False None\n"


@pytest.mark.parametrize(("jax", "cpu"), [("0.9.3", "A"), ("0.9.2", "B")])
def test_another_jaxlib_or_cpu_has_another_cache_folder(jax: str, cpu: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime.importlib.metadata, "version", lambda _: "0.9.2")
    monkeypatch.setattr(runtime, "_cpu_description", lambda: "A")
    before = runtime.cache_dir()
    monkeypatch.setattr(runtime.importlib.metadata, "version", lambda _: jax)
    monkeypatch.setattr(runtime, "_cpu_description", lambda: cpu)
    assert runtime.cache_dir() != before


@pytest.mark.parametrize("version", ["0.10.0", "0.10.1", "0.10.2"])
def test_jax_versions_that_deadlock_are_refused_on_the_cpu_only(version: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime.importlib.metadata, "version", lambda _: version)
    monkeypatch.setattr("jax.default_backend", lambda: "cpu")
    with pytest.raises(InputError, match="deadlocks.*pip install") as refused:
        runtime.check_jax()
    assert version in str(refused.value) and "\n" not in str(refused.value)
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")
    runtime.check_jax()


@pytest.mark.parametrize(
    ("version", "backend", "warned"),
    [("0.9.2", "cpu", False), ("0.11.0", "cpu", True), ("1.0.0", "cpu", True), ("0.11.0", "gpu", False)],
)
def test_newer_jax_versions_are_accepted_with_a_warning_on_the_cpu(
    version: str, backend: str, warned: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(runtime.importlib.metadata, "version", lambda _: version)
    monkeypatch.setattr("jax.default_backend", lambda: backend)
    monkeypatch.setattr(logging.getLogger("ballu_mjx"), "propagate", True)
    runtime.check_jax()
    assert ("slower on the CPU" in caplog.text) == warned
