"""Batches over all devices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def shard_over_devices(
    function: Callable[..., Any], shared: int, over: Callable[[Callable[..., Any]], Callable[..., Any]] = jax.vmap
) -> Callable[..., Any]:
    """`function`, compiled for batches (by `over`) and spread over the devices.

    Of its arguments the first `shared` are the same for all; the others, like what it returns, are arrays (or trees of
    them), along whose first axis it runs.
    """
    devices = jax.local_devices()
    mesh = jax.sharding.Mesh(np.array(devices), ("batch",))
    spec = jax.sharding.PartitionSpec

    @jax.jit
    def run(common: tuple, batch: tuple) -> Any:
        return jax.shard_map(
            lambda common, batch: over(lambda *own: function(*common, *own))(*batch),
            mesh=mesh,
            in_specs=(spec(), spec("batch")),
            out_specs=spec("batch"),
            check_vma=False,
        )(common, batch)

    def whole(*arguments: Any) -> Any:
        common, batch = arguments[:shared], arguments[shared:]
        count = len(jax.tree.leaves(batch)[0])
        filled = np.arange(-(-count // len(devices)) * len(devices)) % count
        batch = jax.tree.map(lambda x: np.asarray(x)[filled], batch)
        return jax.tree.map(lambda x: np.asarray(x)[:count], run(jax.device_get(common), batch))

    return whole
