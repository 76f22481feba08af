"""The interface to the robot on which `train all` records and runs trials, and virtual robots behind it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol, runtime_checkable

from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.ballu.virtual.robot import CaptureController, TrialConditions, VirtualRobot
from ballu_mjx.recordings.recording import Recording


@runtime_checkable
class Hardware(Protocol):
    """A BALLU that makes recordings: a virtual robot, or the driver of a real one with motion capture."""

    @property
    def name(self) -> str:
        """Name of the robot. Stages of `train all` are made again where it changes."""
        ...

    def record_sweep(self, name: str) -> Recording:
        """Record an actuator sweep with the feet off the ground."""
        ...

    def record(self, trial: int, controller: CaptureController, seconds: float, name: str, notes: str) -> Recording:
        """Run a controller from standing for `seconds`, and return the recording.

        `trial` numbers the conditions of the trial, such as its draught. Equal numbers have equal conditions where the
        robot can repeat them.
        """
        ...


@dataclasses.dataclass(frozen=True)
class VirtualHardware:
    """A virtual robot as `Hardware`."""

    robot: VirtualRobot
    sweep_seed: int = 0
    """Seed of the sweep's noise."""
    conditions: Callable[[int], TrialConditions] = virtual_robot.draw_trial
    """Function from the number of a trial to its conditions."""

    @staticmethod
    def draw(seed: int) -> VirtualHardware:
        """Draw one robot of the family, with the same seed for its sweep."""
        return VirtualHardware(virtual_robot.draw_robot(seed), seed)

    @property
    def name(self) -> str:
        return self.robot.name

    def record_sweep(self, name: str) -> Recording:
        return virtual_robot.record_sweep(self.robot, self.sweep_seed, name)

    def record(self, trial: int, controller: CaptureController, seconds: float, name: str, notes: str) -> Recording:
        return virtual_robot.record(self.robot, self.conditions(trial), controller, seconds, name, notes)
