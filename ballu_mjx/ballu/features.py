"""Parts of BALLU's observation by name."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def foot_positions(features: Float[np.ndarray, "*states 27"]) -> Float[np.ndarray, "*states 2 3"]:
    """Positions (m, world) of BALLU's left and right foot in `features`."""
    return np.stack([features[..., 15:18], features[..., 21:24]], axis=-2)
