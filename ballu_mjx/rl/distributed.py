"""One training on several machines, or by several processes of one, through `jax.distributed`.

Every process runs the same command and the same program. Each has its share of the environments on its own devices, and
gradients and statistics are means over all of them. Process 0 alone writes: metrics, checkpoints, figures.
"""

from __future__ import annotations

import dataclasses
import os
import sys
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from orbax.checkpoint import multihost

from ballu_mjx.common import runtime
from ballu_mjx.common.errors import InputError

_PATIENCE = 3_600_000
"""Milliseconds that processes wait for each other; one that died is missed after 100 s."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DistributedOptions(runtime.CommandOptions):
    """Options of trainings that may run in several processes."""

    coordinator: str | None = None
    """Train in several processes, on one machine or many: host:port of process 0, where the others find it. All get the
    same command but for --process-id. Without this option: one process."""
    num_processes: int | None = None
    """How many processes there are, with --coordinator."""
    process_id: int | None = None
    """Which of them this is, from 0 on, with --coordinator. Process 0 alone writes the run's folder."""


def join(options: DistributedOptions) -> None:
    """Find the other processes, where there are any; before anything asks JAX for its devices.

    **Raises** `InputError` for options that do not go together, and where the others cannot be found.
    """
    number, count = options.process_id, options.num_processes
    if options.coordinator is None:
        for name, given in (("--num-processes", count), ("--process-id", number)):
            if given is not None:
                raise InputError(f"{name} goes with --coordinator, where the processes meet; give that too.")
        return
    if count is None or number is None:
        raise InputError("--coordinator needs --num-processes and --process-id too.")
    if not 0 <= number < count:
        raise InputError(f"--process-id is {number}: it must be 0 to {count - 1}, for --num-processes is {count}.")
    if ":" not in options.coordinator:
        raise InputError(f"--coordinator is {options.coordinator}: give host:port, node1:29500 say.")
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(options.coordinator, count, number)
    except RuntimeError as error:
        raise InputError(
            f"--coordinator {options.coordinator}: the processes did not find each other ({error}); look whether all "
            f"{count} are running, and whether the others reach that port."
        ) from error


def leave(status: int) -> None:
    """End this process at once after an error, where it trains with others: JAX's own way out waits for these, and they
    wait for it. They end when they miss it."""
    if jax.distributed.is_initialized():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def is_first() -> bool:
    """Whether this is the process that writes; also where there is no other."""
    return jax.process_index() == 0


def meet() -> None:
    """Wait until all processes are here. Do so before they exchange anything after work of unequal length: one may find
    compiled what another must compile, and an exchange begun alone gives up after half a minute."""
    multihost.get_barrier_sync_fn()(key="ballu_mjx", timeout_ms=_PATIENCE)


def anywhere(flag: bool) -> bool:
    """Whether `flag` is set in any process. All of them must ask."""
    if jax.process_count() == 1:
        return flag
    meet()
    return bool(np.any(multihost_utils.process_allgather(np.array(flag))))


def on_host(value: Any) -> np.ndarray:
    """A copy of an array on the host, of all its parts. All processes must ask for one that is spread over them."""
    if isinstance(value, jax.Array) and not (value.is_fully_addressable or value.is_fully_replicated):
        meet()
        return np.asarray(multihost_utils.process_allgather(value, tiled=True))
    return np.array(value)
