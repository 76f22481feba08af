"""Batches spread over all devices, and long batches in chunks of equal size, which share one compiled program."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Int


def device_shardings(devices: Sequence[Any] | None = None) -> tuple[NamedSharding, NamedSharding]:
    """Return two shardings: for arrays that every device holds, and for arrays split over the devices by the first
    axis.

    `devices` None: all local devices.
    """
    mesh = Mesh(np.array(jax.local_devices() if devices is None else devices), ("batch",))
    return NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec("batch"))


def compile_for_devices(
    function: Callable[..., Any],
    shared: int,
    over: Callable[[Callable[..., Any]], Callable[..., Any]] = jax.vmap,
    devices: Sequence[Any] | None = None,
) -> jax.stages.Wrapped:
    """Return `function`, compiled for batches (by `over`) that are spread over the devices.

    On the CPU, a device is a core. The first `shared` arguments of the returned function are the same for the whole
    batch. The other arguments and the results are arrays, or trees of arrays, whose first axis is the batch. The batch
    size must be a multiple of the number of devices.
    """
    everywhere, split = device_shardings(devices)

    @jax.jit
    def run(*arguments: Any) -> Any:
        return jax.shard_map(
            lambda common, batch: over(lambda *own: function(*common, *own))(*batch),
            mesh=everywhere.mesh,
            in_specs=(everywhere.spec, split.spec),
            out_specs=split.spec,
            check_vma=False,
        )(arguments[:shared], arguments[shared:])

    return run


def shard_over_devices(
    function: Callable[..., Any], shared: int, over: Callable[[Callable[..., Any]], Callable[..., Any]] = jax.vmap
) -> Callable[..., Any]:
    """Return a function like that of `compile_for_devices`, for batches of any size in host memory."""
    run, devices = compile_for_devices(function, shared, over), len(jax.local_devices())

    def whole(*arguments: Any) -> Any:
        common, batch = arguments[:shared], arguments[shared:]
        count = len(jax.tree.leaves(batch)[0])
        filled = np.arange(-(-count // devices) * devices) % count
        batch = jax.tree.map(lambda x: np.asarray(x)[filled], batch)
        return jax.tree.map(lambda x: np.asarray(x)[:count], run(*jax.device_get(common), *batch))

    return whole


def batch_size(count: int, most: int) -> int:
    """Return the smallest power of two that is at least `count`, or `most` if that is smaller.

    Batches of similar sizes then share a compiled program, and at most half of a batch is padding.
    """
    return min(1 << (count - 1).bit_length(), most)


def chunks(count: int, size: int) -> Iterator[tuple[Int[np.ndarray, " size"], int]]:
    """Yield the rows of each chunk of a batch, and how many of these rows count.

    All chunks have `size` rows. The last one is filled up with rows from the start of the batch.
    """
    for first in range(0, count, size):
        yield np.arange(first, first + size) % count, min(size, count - first)
