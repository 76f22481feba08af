"""Environment variables of processes that compile fast. Their programs round differently."""

from __future__ import annotations

from ballu_mjx.common import compiler_options

OLDER_FUSION = " ".join(f"--{name}={str(on).lower()}" for name, on in compiler_options.OLDER_FUSION.items())
"""XLA's older fusion. A control step compiles in 4 s with it, and in 15 s otherwise."""
BRIEF = {"XLA_FLAGS": OLDER_FUSION}
"""What `runtime.prepare` sets for --quick."""
FAST = {**BRIEF, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
"""For programs that run for a moment: without optimizations they take up to thirty times as long."""
