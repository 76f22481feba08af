"""What a robot's adapter adds to the recording stage: hooks for what no general code can know of its recordings."""

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
    """The general answers. An adapter of a robot with specialities derives from this beside `RobotAdapter`."""

    def check_recording(self, path: Path, recording: Recording) -> None:
        """Check what only this robot's recordings must satisfy.

        **Raises** `InputError` naming file, column, row and fix (`validation.refuse_recording`).
        """
        del path, recording

    # ---- reconstruction ----

    @property
    def completed_joints(self) -> tuple[str, ...]:
        """Return the joints that `complete_joints` finds where nothing that is measured shows them."""
        return ()

    def complete_positions(self, fit: KinematicFit) -> KinematicFit:
        """Return a fit that agrees with more than single samples' measurements, before it is smoothed."""
        return fit

    def complete_joints(
        self,
        model: mujoco.MjModel,
        grid: MeasurementGrid,
        qpos: Float[np.ndarray, "T nq"],
        qvel: Float[np.ndarray, "T nv"],
    ) -> tuple[Float[np.ndarray, "T nq"], Float[np.ndarray, "T nv"]]:
        """Return smoothed states with the joints filled in that follow from the commands."""
        del model, grid
        return qpos, qvel

    # ---- import ----

    @property
    def origin(self) -> str | None:
        """Return the site that imported recordings start above the origin with; None: the tracked one."""
        return None

    @property
    def floors(self) -> Mapping[str, Mapping[str, float]]:
        """Return ways to find the floor, by the name that mapping files give: sites, and how high (m) each is above
        the floor when it touches it."""
        return {}

    def response(
        self, recording: Recording, time: Float[np.ndarray, " N"], command: Float[np.ndarray, "N commands"]
    ) -> tuple[Float[np.ndarray, "T signals"], Float[np.ndarray, " n"], Float[np.ndarray, "n signals"]] | None:
        """Return recorded signals that commands move, and, with their times (s), the same as a model predicts them for
        `command` sent at `time` (s): what the offset between two clocks is found by.

        None where this robot has no such model, or the recording no such signal.
        """
        del recording, time, command


def hooks_of(robot: RobotDescription) -> RecordingHooks:
    """Return the hooks of a robot's adapter, or the general ones."""
    return robot.adapter if isinstance(robot.adapter, RecordingHooks) else RecordingHooks()
