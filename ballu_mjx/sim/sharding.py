"""Batches over all devices, and long batches in chunks of one size, for which one program is compiled."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Int


def device_shardings(devices: Sequence[Any] | None = None) -> tuple[NamedSharding, NamedSharding]:
    """Return where arrays lie that every device has, and those whose first axis is spread over them; None: all local
    devices."""
    mesh = Mesh(np.array(jax.local_devices() if devices is None else devices), ("batch",))
    return NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec("batch"))


def compile_for_devices(
    function: Callable[..., Any],
    shared: int,
    over: Callable[[Callable[..., Any]], Callable[..., Any]] = jax.vmap,
    devices: Sequence[Any] | None = None,
) -> jax.stages.Wrapped:
    """Return `function`, compiled for batches (by `over`) and spread over the devices: one core a device, on the CPU.

    Of its arguments the first `shared` are the same for all. The others, like what it returns, are arrays (or trees of
    them), along whose first axis it runs; their length is a multiple of the number of devices.
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
    """Return the same as `compile_for_devices` for batches of any length, on the host before and after."""
    run, devices = compile_for_devices(function, shared, over), len(jax.local_devices())

    def whole(*arguments: Any) -> Any:
        common, batch = arguments[:shared], arguments[shared:]
        count = len(jax.tree.leaves(batch)[0])
        filled = np.arange(-(-count // devices) * devices) % count
        batch = jax.tree.map(lambda x: np.asarray(x)[filled], batch)
        return jax.tree.map(lambda x: np.asarray(x)[:count], run(*jax.device_get(common), *batch))

    return whole


def chunks(count: int, size: int) -> Iterator[tuple[Int[np.ndarray, " size"], int]]:
    """Yield a batch's rows in chunks of one size, the last filled up from the start, and how many of each count."""
    for first in range(0, count, size):
        yield np.arange(first, first + size) % count, min(size, count - first)
