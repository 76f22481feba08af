"""Training in several processes, on one machine or on several, with `jax.distributed`.

Every process runs the same command and the same program. Each simulates its share of the environments on its own
devices. Gradients and statistics are averaged over all processes. Only process 0 writes metrics, checkpoints and
figures.
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
"""Timeout (ms) of processes that wait for each other. JAX notices a dead process after 100 s."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DistributedOptions(runtime.CommandOptions):
    """Options of a training that can run in several processes."""

    coordinator: str | None = None
    """Train in several processes, on one machine or on several. The value is host:port of process 0, to which the
    others connect. Start all processes with the same command except for --process-id. Default: one process."""
    num_processes: int | None = None
    """Number of processes. Required with --coordinator."""
    process_id: int | None = None
    """Index of this process, from 0 on. Required with --coordinator. Only process 0 writes the run's folder."""


def join(options: DistributedOptions) -> None:
    """Connect to the other processes, if there are any. Call this before anything asks JAX for its devices.

    **Raises** `InputError` if options contradict each other, or if the processes cannot connect.
    """
    number, count = options.process_id, options.num_processes
    if options.coordinator is None:
        for name, given in (("--num-processes", count), ("--process-id", number)):
            if given is not None:
                raise InputError(f"{name} needs --coordinator, the address of process 0; give that too.")
        return
    if count is None or number is None:
        raise InputError("--coordinator needs --num-processes and --process-id too.")
    if not 0 <= number < count:
        raise InputError(f"--process-id is {number}: it must be 0 to {count - 1}, because --num-processes is {count}.")
    if ":" not in options.coordinator:
        raise InputError(f"--coordinator is {options.coordinator}: give host:port, for example node1:29500.")
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(options.coordinator, count, number)
    except RuntimeError as error:
        raise InputError(
            f"--coordinator {options.coordinator}: the processes could not connect ({error}); check that all {count} "
            "are running, and that the others can reach that port."
        ) from error
    runtime.check_jax()  # starts the backend


def leave(status: int) -> None:
    """End this process at once after an error if it trains together with others, with exit status `status`.

    A normal exit would deadlock: JAX waits for the other processes, and these wait for this one. The others end when
    JAX notices that this process is gone.
    """
    if jax.distributed.is_initialized():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def is_first() -> bool:
    """Return whether this is process 0, which writes. True also in a training with one process."""
    return jax.process_index() == 0


def meet() -> None:
    """Wait until all processes have called this function.

    Call it before an exchange that follows work of unequal length. For example, one process may find a program in the
    cache that another must compile. An exchange times out after half a minute if a process is late.
    """
    multihost.get_barrier_sync_fn()(key="ballu_mjx", timeout_ms=_PATIENCE)


def anywhere(flag: bool) -> bool:
    """Return whether `flag` is true in any process. All processes must call this function."""
    if jax.process_count() == 1:
        return flag
    meet()
    return bool(np.any(multihost_utils.process_allgather(np.array(flag))))


def on_host(value: Any) -> np.ndarray:
    """Return a copy of the whole array on the host.

    If the array is distributed over processes, all of them must call this function.
    """
    if isinstance(value, jax.Array) and not (value.is_fully_addressable or value.is_fully_replicated):
        meet()
        return np.asarray(multihost_utils.process_allgather(value, tiled=True))
    return np.array(value)
