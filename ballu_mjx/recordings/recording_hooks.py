"""Hooks by which a robot's adapter extends the recording stage with knowledge of this robot's recordings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.recordings.recording import Recording
from ballu_mjx.robots.description import RobotDescription

if TYPE_CHECKING:
    from ballu_mjx.recordings.inverse_kinematics import KinematicFit
    from ballu_mjx.recordings.motion import MeasurementGrid


class RecordingHooks:
    """Default hooks. An adapter that changes some of them derives from this class and from `RobotAdapter`."""

    def check_recording(self, path: Path, recording: Recording) -> None:
        """Check conditions that only this robot's recordings must satisfy.

        **Raises** `InputError` that names file, column, row and fix (`validation.refuse_recording`).
        """
        del path, recording

    # ---- reconstruction ----

    @property
    def completed_joints(self) -> tuple[str, ...]:
        """Return the joints that `complete_joints` infers. No measurement needs to show them."""
        return ()

    def complete_positions(self, fit: KinematicFit) -> KinematicFit:
        """Return a fit that uses more than the measurements of single samples. Smoothing follows."""
        return fit

    def complete_joints(
        self,
        model: mujoco.MjModel,
        grid: MeasurementGrid,
        qpos: Float[np.ndarray, "T nq"],
        qvel: Float[np.ndarray, "T nv"],
    ) -> tuple[Float[np.ndarray, "T nq"], Float[np.ndarray, "T nv"]]:
        """Return smoothed states in which joints that follow from the commands are filled in."""
        del model, grid
        return qpos, qvel

    # ---- import ----

    @property
    def origin(self) -> str | None:
        """Return the site that is above the origin when an imported recording starts. None for the tracked site."""
        return None

    @property
    def floors(self) -> Mapping[str, Mapping[str, float]]:
        """Return ways to locate the floor, by their name in mapping files.

        Each way lists sites, with the height (m) of each above the floor while it touches the floor.
        """
        return {}

    def response(
        self, recording: Recording, time: Float[np.ndarray, " N"], command: Float[np.ndarray, "N commands"]
    ) -> tuple[Float[np.ndarray, "T signals"], Float[np.ndarray, " n"], Float[np.ndarray, "n signals"]] | None:
        """Return recorded and predicted signals that respond to commands, to find the offset between two clocks.

        `command` was sent at `time` (s, log's clock). The result consists of the recorded signals at the recording's
        times, the times (s, log's clock) of the prediction, and the same signals as a model predicts them. It is None
        if the robot has no model of these signals, or if the recording lacks them.
        """
        del recording, time, command


def hooks_of(robot: RobotDescription) -> RecordingHooks:
    """Return the hooks of a robot's adapter, or the default hooks."""
    return robot.adapter if isinstance(robot.adapter, RecordingHooks) else RecordingHooks()
