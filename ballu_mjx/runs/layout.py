"""Names and formats of the files in a run's folder."""

from __future__ import annotations

import reprlib
from typing import Any, Literal

RUN_FORMAT = "ballu-run/2"
"""Format of a run's folder. Checkpoints of version 1 held only parameters."""
CHECKPOINTS_KEPT = 3
"""Number of latest checkpoints with a score that are kept."""

Which = Literal["best", "last"] | int
"""Choice of a checkpoint: the best, the last, or that of a step."""

READABLE_FORMATS = ("ballu-run/1", RUN_FORMAT)
CONFIG_FILE, METRICS_FILE, LOCK_FILE, CHECKPOINTS_FOLDER = "config.json", "metrics.jsonl", ".lock", "checkpoints"
PARAMS_FOLDER, TRAINING_FOLDER, RECORD_FILE = "params", "training", "record.json"
NO_SCORE = 1e30
"""Score of a checkpoint whose validation score is not finite."""
MAX_STEPS = 2**63
"""Upper bound of a step number (exclusive)."""


def shorten_value(value: Any) -> str:
    """Return a value from JSON as short text for a message."""
    return reprlib.repr(value)
