"""Environment variables of processes that compile fast. Their programs run longer and round differently."""

from __future__ import annotations

from importlib.metadata import version

# JAX 0.10 does not have this flag, and XLA refuses unknown flags.
OLDER_FUSION = "--xla_cpu_use_fusion_emitters=false" if version("jax").startswith("0.9.") else ""
"""XLA's older fusion. A control step compiles in 4 s with it, and in 15 s otherwise."""
ENVIRONMENT = {"XLA_FLAGS": OLDER_FUSION, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
