"""A recording as simulator states at the control rate, and the noise and filters of its reconstruction."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class ReconstructionParameters:
    """Noise that weighs the measurements, and widths of the filters.

    The widths were chosen on noisy recordings of the nominal BALLU by how far a simulator, started from the states
    found, goes astray (`benchmarks/inverse_kinematics.py`). Errors of velocity cost far more than those of position.
    """

    position_noise: float = 5e-4
    """Standard deviation (m) of a measured position, per axis."""
    rotation_noise: float = float(np.deg2rad(0.3))
    """Standard deviation (rad) of a measured orientation, per axis."""
    joint_noise: float = float(np.deg2rad(0.3))
    """Standard deviation of a measured joint angle (rad; of a slide, m)."""
    position_window: float = 0.09
    """Width (s) of the Savitzky-Golay filter for the root's place and all joints."""
    rate_window: float = 0.19
    """The same for their velocities. One width for the root and all joints, so that a point in contact with the ground
    has a velocity of 0. A narrower filter follows sudden stops better, but noise in a velocity does more harm."""
    rotation_window: float = 0.31
    """The same for the tracked body's orientation and its rate."""
    order: int = 3
    """Order of the filters' polynomials."""


@dataclasses.dataclass(frozen=True, eq=False)
class MeasurementGrid:
    """A free recording at uniform times from 0, `step` (s) apart; `samples_per_step` of them to a control step."""

    step: float
    samples_per_step: int
    command: Float[np.ndarray, "T commands"]
    """Mean of the held commands until the next sample."""
    positions: Mapping[str, Float[np.ndarray, "T 3"]]
    """m, by site, the tracked one first."""
    orientations: Mapping[str, Float[np.ndarray, "T 4"]]
    """w, x, y, z, by site, the tracked one first."""
    joint_angles: Mapping[str, Float[np.ndarray, " T"]]
    """rad or m, by joint; continuous where the recording counts turns from 0 again."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """A recording as states and commands at the control rate.

    A simulator set to `(qpos[k], qvel[k])` and driven by `command[k]` goes from `time[k]` to `time[k + 1]`.
    """

    name: str
    """The recording's."""
    time: Float[np.ndarray, " states"]
    """s, from 0 in control steps; one more entry than commands."""
    command: Float[np.ndarray, "steps commands"]
    """Mean over each control step of the held commands, in the actuators' units."""
    qpos: Float[np.ndarray, "states nq"]
    """MuJoCo's generalized positions (m, unit quaternion w x y z, rad)."""
    qvel: Float[np.ndarray, "states nv"]
    """MuJoCo's generalized velocities; the free joint's linear one in the world's frame, the angular in the body's."""
    residual_mm: Mapping[str, float]
    """Root-mean-square distance (mm) between measured and fitted places before smoothing, by site."""
    interpolated: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Samples that the recording's reader filled in, by column."""
    robot: str = ""
    """Which robot was recorded."""
    joints: tuple[str, ...] = ()
    """The joints whose positions the recording holds; others are inferred."""
    uncertainty: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """What the robot's adapter states about its own part of the reconstruction, by name."""
