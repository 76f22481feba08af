"""Names and formats within a run's folder."""

from __future__ import annotations

import reprlib
from typing import Any

try:
    import fcntl
except ImportError:  # Windows, where runs are not locked
    fcntl = None


RUN_FORMAT = "ballu-run/2"
"""Version 1 had checkpoints of parameters alone."""
KEPT = 3
"""Latest checkpoints that are kept."""

READABLE_FORMATS = ("ballu-run/1", RUN_FORMAT)
CONFIG_FILE, METRICS_FILE, LOCK_FILE, CHECKPOINTS_FOLDER = "config.json", "metrics.jsonl", ".lock", "checkpoints"
PARAMS_FOLDER, TRAINING_FOLDER, RECORD_FILE = "params", "training", "record.json"
NO_SCORE = 1e30
MOST_STEPS = 2**63


def shorten_value(value: Any) -> str:
    """A value from JSON in a sentence."""
    return reprlib.repr(value)
