"""Tests run in the environment that the commands set up, with every annotated array shape checked."""

import os
from collections.abc import Callable
from typing import TypeVar

from beartype import beartype
from jaxtyping import install_import_hook

from ballu_mjx import runtime

Function = TypeVar("Function", bound=Callable)


def typecheck(function: Function) -> Function:
    """beartype, but not for constructors: JAX rebuilds pytrees by them with batches, or placeholders, for arrays."""
    return function if function.__name__ == "__init__" else beartype(function)


# Most of a test run is compiling small programs that run for a moment: compiled without optimization, in this process
# and in the commands that tests start, they take a third of the time.
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0".strip()
runtime.prepare()
install_import_hook("ballu_mjx", f"{__name__}.typecheck")
