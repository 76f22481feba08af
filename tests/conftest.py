"""Tests run in the environment that the commands set up, with every annotated array shape checked."""

import os
from collections.abc import Callable
from typing import TypeVar

from beartype import beartype
from jaxtyping import install_import_hook

from ballu_mjx.common import runtime

Function = TypeVar("Function", bound=Callable)


def typecheck(function: Function) -> Function:
    """beartype, but not for constructors: JAX rebuilds pytrees by them with batches, or placeholders, for arrays."""
    return function if function.__name__ == "__init__" else beartype(function)


# A test's programs run for a moment, and compiling them is most of a test run. By XLA's older fusion and without most
# optimizations a control step compiles in 4 s instead of 15. Commands that tests start inherit both.
os.environ["XLA_FLAGS"] = f"--xla_cpu_use_fusion_emitters=false {os.environ.get('XLA_FLAGS', '')}".strip()
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
runtime.prepare()
install_import_hook("ballu_mjx", f"{__name__}.typecheck")
