"""Run the tests in the environment that the commands set up, and check every annotated array shape."""

import os
from collections.abc import Callable
from importlib import import_module
from typing import TypeVar

import pytest
from beartype import beartype
from fast_compilation import OLDER_FUSION
from jaxtyping import install_import_hook

from ballu_mjx.common import runtime

Function = TypeVar("Function", bound=Callable)


def typecheck(function: Function) -> Function:
    """Apply beartype, except to constructors. JAX rebuilds pytrees by constructors, with batches or placeholders
    instead of arrays."""
    return function if function.__name__ == "__init__" else beartype(function)


def compile_fast() -> None:
    """Make this process compile with XLA's older fusion, and without most optimizations (see below).

    Most tests run their compiled programs only for a moment. Commands that tests start as processes compile as they do
    for users, unless the test sets variables of `fast_compilation`. Their compiled programs stay in the cache for runs
    after the tests.
    """
    runtime.prepare(brief=True)
    import jax  # only after `prepare`

    jax.jit(lambda: 0)()  # the first compilation reads the flags; later changes have no effect
    os.environ["XLA_FLAGS"] = os.environ["XLA_FLAGS"].replace(OLDER_FUSION, "").strip()


compile_fast()
# Imported without checks: its functions run for each operation of a traced program, and annotate no shapes. The checks
# would take a quarter of the tracing.
import_module("ballu_mjx.sim.vmap_last_rules")
install_import_hook("ballu_mjx", f"{__name__}.typecheck")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Enable XLA's optimizations for tests marked `optimized`, whose programs run long. Fixtures are set up later."""
    import jax  # only after `prepare`

    jax.config.update("jax_disable_most_optimizations", item.get_closest_marker("optimized") is None)
