"""Tests run in the environment that the commands set up, with every annotated array shape checked."""

import os
from collections.abc import Callable
from typing import TypeVar

import pytest
from beartype import beartype
from jaxtyping import install_import_hook

from ballu_mjx.common import runtime

Function = TypeVar("Function", bound=Callable)


def typecheck(function: Function) -> Function:
    """beartype, but not for constructors: JAX rebuilds pytrees by them with batches, or placeholders, for arrays."""
    return function if function.__name__ == "__init__" else beartype(function)


# Most tests run what they compile for a moment. By XLA's older fusion, here and in commands that tests start, and
# without most optimizations, here alone, a control step compiles in 4 s instead of 15.
os.environ["XLA_FLAGS"] = f"--xla_cpu_use_fusion_emitters=false {os.environ.get('XLA_FLAGS', '')}".strip()
runtime.prepare()
install_import_hook("ballu_mjx", f"{__name__}.typecheck")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Before the test's fixtures: programs of tests marked `optimized` run long enough to be worth it."""
    import jax  # not before `prepare`

    jax.config.update("jax_disable_most_optimizations", item.get_closest_marker("optimized") is None)
