"""Tests run in the environment that the commands set up, with every annotated array shape checked."""

from collections.abc import Callable
from typing import TypeVar

from beartype import beartype
from jaxtyping import install_import_hook

from ballu_mjx.common import runtime

Function = TypeVar("Function", bound=Callable)


def typecheck(function: Function) -> Function:
    """beartype, but not for constructors: JAX rebuilds pytrees by them with batches, or placeholders, for arrays."""
    return function if function.__name__ == "__init__" else beartype(function)


runtime.prepare()
install_import_hook("ballu_mjx", f"{__name__}.typecheck")
