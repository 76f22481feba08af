"""The simulator of a run of any task, for training, export or comparison."""

from __future__ import annotations

from pathlib import Path

from ballu_mjx.common.errors import InputError
from ballu_mjx.identification.actuators import ACTUATORS_FILE, read_actuators
from ballu_mjx.policies.policy import check_belongs
from ballu_mjx.policies.tasks import TASKS
from ballu_mjx.residuals.registry import RESIDUAL_TASKS
from ballu_mjx.residuals.run_config import ResidualReference, run_actuators, run_residual, run_robot
from ballu_mjx.residuals.trained_residual import TrainedResidual
from ballu_mjx.robots.registry import DEFAULT_ROBOT, load_robot
from ballu_mjx.runs.folder import read_config
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator


def load_simulator(run: Path | str | None = None, robot: str | Path | None = None) -> AugmentedSimulator:
    """Return a run's simulator, with its identified actuators and its residual.

    **Arguments**

    - `run`: run of a residual, of identified actuators, or of a policy (for the simulator of its training). None for
      the nominal simulator of `robot`.
    - `robot`: name of a robot, or its description file. None for the run's robot or, without a run, the default robot.

    **Raises** `InputError` if `run` is none of these runs or is damaged, and if both `run` and `robot` are given.
    """
    if run is None:
        return Simulator(load_robot(DEFAULT_ROBOT if robot is None else robot)).with_residual(None)
    if robot is not None:
        raise InputError(f"{run}: a run has its own robot; leave the robot out.")
    run = Path(run)
    stored = read_config(run, *RESIDUAL_TASKS, "sysid", *TASKS)
    own, task = run_robot(stored, run), stored["task"]
    if task == "sysid":
        _, actuators = read_actuators(own, run / ACTUATORS_FILE)
        return Simulator(own, actuators).with_residual(None)
    reference = ResidualReference(run) if task in RESIDUAL_TASKS else run_residual(stored, run)
    residual = None if reference is None else TrainedResidual.load_reference(reference, own)
    actuators = run_actuators(stored, run, own)
    check_belongs(residual, actuators, None if reference is None else reference.folder)
    return Simulator(own, actuators).with_residual(residual)
