"""Traced programs of a robot's step, stored on disk beside XLA's compiled ones.

Tracing MJX for a model takes seconds, in every process and for every batch size. XLA's cache does not avoid it, because
its keys are hashes of the traced program. Here the key is a hash of everything that determines the program: its name,
the static values and fields of its arguments, their shapes and types, the versions of JAX and MuJoCo, JAX's precision,
and the source of this package's physics. The format is that of `jax.export`.
"""

from __future__ import annotations

import contextlib
import enum
import functools
import hashlib
import importlib.metadata
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import PyTree

from ballu_mjx.common import files

_PHYSICS = ("common", "robots", "sim")
"""Folders of this package that stored programs depend on."""
_FOLDER = "traced"
"""Name of the folder in JAX's compilation cache."""


def cached_program(
    key: tuple[Any, ...], function: Callable[..., PyTree], arguments: Sequence[PyTree]
) -> Callable[..., PyTree]:
    """Return `function` for arguments like `arguments`, from the disk if its program is there. Store it otherwise.

    If JAX's compilation cache is off or not a local folder, return `function` itself.

    **Arguments**

    - `key`: values that determine `function`: numbers, strings, arrays, tree structures, and tuples of these. If a
      value is of another kind, return `function` itself.
    - `function`: maps arrays in tuples, lists and dicts to the same. If it has an operation without a portable form,
      return `function` itself.
    """
    folder = _cache_folder()
    if folder is None:
        return function
    shapes = shapes_of(tuple(arguments))
    leaves, tree = jax.tree.flatten(shapes)
    name = _hash((_versions(), _precision(), key, tree, tuple((x.shape, x.dtype.name) for x in leaves)))
    if name is None:
        return function
    path = folder / f"{name}.jax"
    content = _read(path)
    if content is None:
        try:
            content = bytes(export.export(jax.jit(function))(*shapes).serialize())
        except (ValueError, NotImplementedError):  # an operation without a portable form
            return function
        with contextlib.suppress(OSError):  # without a writable folder, the next process traces it again
            path.parent.mkdir(parents=True, exist_ok=True)
            files.write(path, hashlib.sha256(content).digest() + content)
    _load_lapack()
    return export.deserialize(bytearray(content)).call


def _cache_folder() -> Path | None:
    config: Any = jax.config
    folder = config.jax_compilation_cache_dir
    if not folder or not config.jax_enable_compilation_cache or "://" in folder:
        return None
    return Path(folder) / _FOLDER


def _read(path: Path) -> bytes | None:
    """Return the program in a file. None if the file is missing or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, program = content[:_DIGEST_SIZE], content[_DIGEST_SIZE:]
    return program if hashlib.sha256(program).digest() == digest else None


_DIGEST_SIZE = hashlib.sha256().digest_size


def shapes_of(arguments: PyTree) -> PyTree:
    """Return shapes and types of arrays."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), arguments)


@functools.cache
def _load_lapack() -> None:
    """Make JAX load its LAPACK routines. It does so when it lowers one; a loaded program would crash without them."""
    jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), jnp.float32))


class _Unknown(Exception):
    """A value whose content cannot be hashed."""


def _hash(value: Any) -> str | None:
    """Return a hash of a static value. None if a part of it is of an unknown kind."""
    digest = hashlib.sha256()
    try:
        _feed(digest.update, value)
    except _Unknown:
        return None
    return digest.hexdigest()[:32]


def _feed(update: Callable[[bytes], None], value: Any) -> None:
    """Pass the content of a static value to `update`."""
    if type(value).__name__ == "_NumPyArrayHashWrapper":  # how MJX wraps the static arrays of its trees
        _feed(update, value.array)
    elif isinstance(value, jax.tree_util.PyTreeDef):
        _feed(update, (*(value.node_data() or ()), *value.children()))
    elif isinstance(value, tuple | list):
        update(f"({len(value)} ".encode())
        for each in value:
            _feed(update, each)
    elif isinstance(value, np.ndarray) and not value.dtype.hasobject:
        update(f"{value.shape} {value.dtype} ".encode() + value.tobytes())
    elif isinstance(value, type):
        update(f"{value.__module__}.{value.__qualname__} ".encode())
    elif value is None or isinstance(value, bool | int | float | str | bytes | enum.Enum | np.generic):
        update(f"{type(value).__name__} {value!r} ".encode())
    else:
        raise _Unknown


def _precision() -> tuple[Any, ...]:
    config: Any = jax.config
    return bool(config.jax_enable_x64), config.jax_default_matmul_precision


@functools.cache
def _versions() -> str:
    """Return the versions of the libraries, and a hash of the source of the package's physics."""
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    for folder in _PHYSICS:
        for path in sorted((root / folder).glob("*.py")):
            digest.update(path.read_bytes())
    names = "jax", "jaxlib", "mujoco", "mujoco-mjx"
    return " ".join([*map(importlib.metadata.version, names), digest.hexdigest()])
