"""Options of XLA's compiler."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping

OLDER_FUSION: Mapping[str, bool] = (
    {"xla_cpu_use_fusion_emitters": False} if importlib.metadata.version("jax").startswith("0.9.") else {}
)
"""XLA's older fusion on the CPU, which compiles faster. JAX 0.10 does not have it, and XLA refuses unknown options."""
FOR_ONE_RUN: Mapping[str, bool | int] = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    **OLDER_FUSION,
}
"""Options of `jax.jit` for programs that run once, such as those of starting states.

They compile in a quarter of the time, and run several times as long."""
