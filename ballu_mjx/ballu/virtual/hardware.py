"""The interface to the robot on which `train all` records and runs trials, and virtual robots behind it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Literal, Protocol, runtime_checkable

from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.ballu.virtual.flexible_robot import draw_flexible_robot
from ballu_mjx.ballu.virtual.paper_robot import draw_paper_robot
from ballu_mjx.ballu.virtual.robot import CaptureController, TrialConditions, VirtualRobot
from ballu_mjx.recordings.recording import Recording

RobotFamily = Literal["default", "paper", "flexible"]
"""Family of virtual robots: of `robot.draw_robot`, `paper_robot.draw_paper_robot` or
`flexible_robot.draw_flexible_robot`."""
_DRAW: Mapping[RobotFamily, Callable[[int], VirtualRobot]] = {
    "default": virtual_robot.draw_robot,
    "paper": draw_paper_robot,
    "flexible": draw_flexible_robot,
}


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
    def draw(seed: int, family: RobotFamily = "default") -> VirtualHardware:
        """Draw one robot of a family, with the same seed for its sweep."""
        return VirtualHardware(_DRAW[family](seed), seed)

    @property
    def name(self) -> str:
        return self.robot.name

    def record_sweep(self, name: str) -> Recording:
        return virtual_robot.record_sweep(self.robot, self.sweep_seed, name)

    def record(self, trial: int, controller: CaptureController, seconds: float, name: str, notes: str) -> Recording:
        return virtual_robot.record(self.robot, self.conditions(trial), controller, seconds, name, notes)
