"""Access to parts of BALLU's observation features."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def foot_positions(features: Float[np.ndarray, "*states 27"]) -> Float[np.ndarray, "*states 2 3"]:
    """Return the positions (m, world frame) of the left and the right foot from observation features."""
    return np.stack([features[..., 15:18], features[..., 21:24]], axis=-2)
