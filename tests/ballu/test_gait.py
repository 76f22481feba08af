"""Counting of steps in walks and in motions without steps."""

from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import Float

from ballu_mjx.ballu.gait import count_steps
from ballu_mjx.ballu.model import CONTROL_TIMESTEP

TIME = np.arange(200) * CONTROL_TIMESTEP


def walk(height: float) -> Float[np.ndarray, "T 2 3"]:
    """Return positions (m) of feet that swing in turn, for half a second each, up to `height` (m)."""
    stride = np.stack([TIME, TIME - 0.5], axis=1)
    swing = np.clip(2 * (stride % 1.0), 0.0, 1.0)
    sideways = np.tile([0.05, -0.05], (len(TIME), 1))
    return np.stack([0.2 * (np.floor(stride) + swing), sideways, height * np.sin(np.pi * swing)], axis=-1)


@pytest.mark.parametrize("height", [0.05, 0.001])
def test_walking_counts_two_steps_per_second(height: float) -> None:
    """This includes feet that graze the floor."""
    assert count_steps(walk(height))[-1] == pytest.approx(2 * TIME[-1], abs=1)


def test_motions_without_alternating_feet_count_no_steps() -> None:
    rest = np.tile(walk(0.0)[:1], (len(TIME), 1, 1))
    slide = np.stack([0.3 * TIME, 0 * TIME, 0 * TIME], axis=-1)[:, None]
    hop = np.stack([0 * TIME, 0 * TIME, 0.1 * np.abs(np.sin(3 * TIME))], axis=-1)[:, None]
    limp = walk(0.05)
    limp[:, 1] = rest[:, 1]
    fly = np.array([0.0, 0.0, 0.1])
    for name, feet in {"rest": rest, "slide": rest + slide, "hop": rest + hop, "limp": limp, "fly": rest + fly}.items():
        assert count_steps(feet).tolist() == [0] * len(feet), name
