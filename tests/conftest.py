"""Tests run in the environment that the commands set up, with every annotated array shape checked."""

import os
from collections.abc import Callable
from importlib.metadata import version
from typing import TypeVar

import pytest
from beartype import beartype
from jaxtyping import install_import_hook

from ballu_mjx.common import runtime

Function = TypeVar("Function", bound=Callable)


def typecheck(function: Function) -> Function:
    """beartype, but not for constructors: JAX rebuilds pytrees by them with batches, or placeholders, for arrays."""
    return function if function.__name__ == "__init__" else beartype(function)


# JAX 0.10 has no such flag, and XLA refuses what it does not know.
_OLDER_FUSION = "--xla_cpu_use_fusion_emitters=false" if version("jax").startswith("0.9.") else ""


def compile_fast() -> None:
    """Settle how this process compiles: by XLA's older fusion, and without most optimizations (see below). A control
    step then compiles in 4 s instead of 15, and most tests run what they compile for a moment.

    Commands that tests start compile as users' do, and leave in the cache what runs after the tests.
    """
    os.environ["XLA_FLAGS"] = f"{_OLDER_FUSION} {os.environ.get('XLA_FLAGS', '')}".strip()
    runtime.prepare()
    import jax  # not before `prepare`

    jax.jit(lambda: 0)()  # reads the flags, once and for all
    os.environ["XLA_FLAGS"] = os.environ["XLA_FLAGS"].replace(_OLDER_FUSION, "").strip()


compile_fast()
install_import_hook("ballu_mjx", f"{__name__}.typecheck")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Before the test's fixtures: programs of tests marked `optimized` run long enough to be worth it."""
    import jax  # not before `prepare`

    jax.config.update("jax_disable_most_optimizations", item.get_closest_marker("optimized") is None)
