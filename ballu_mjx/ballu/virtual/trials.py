"""Trials of a policy on the robot, compared with the same policy in its own simulator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ballu_mjx.ballu import plots as ballu_plots
from ballu_mjx.ballu.features import foot_positions
from ballu_mjx.ballu.gait import count_steps
from ballu_mjx.ballu.model import CONTROL_TIMESTEP
from ballu_mjx.ballu.virtual.hardware import Hardware
from ballu_mjx.evaluation.transfer import Trajectory, Transfer, compare_trajectories
from ballu_mjx.policies.closed_loop import ClosedLoop
from ballu_mjx.policies.deploy.controller import Controller
from ballu_mjx.policies.deploy.estimator import Capture
from ballu_mjx.policies.deploy.export import weights
from ballu_mjx.policies.policy import Policy
from ballu_mjx.recordings.csv_format import read_recording, write_recording
from ballu_mjx.recordings.reconstruct import reconstruct
from ballu_mjx.recordings.reference import stack_motions
from ballu_mjx.robots.registry import load_robot
from ballu_mjx.sim.observation import ObservationLayout
from ballu_mjx.sim.simulator import Simulator


class ExportedPolicy:
    """A policy as exported by `python -m ballu_mjx export`, with rate limit and time-out, for captured frames."""

    def __init__(self, stored: Mapping[str, np.ndarray]) -> None:
        """`stored` is the result of `export.weights`."""
        self.controller = Controller(stored)
        self._fed = 0

    def __call__(self, capture: Capture) -> Float[np.ndarray, " 2"]:
        """Return the commands after the frames that are new since the last call. Every trial needs a new controller."""
        commands = self.controller.command
        for frame in range(self._fed, len(capture.time)):
            seen = {
                f"{name}_position": place for name, place in zip(capture.names, capture.position[frame], strict=True)
            }
            seen[f"{capture.names[0]}_quaternion"] = capture.quaternion[frame]
            commands = np.array(self.controller.step(capture.time[frame], seen))
        self._fed = len(capture.time)
        return commands


def run_trials(
    policy: Policy,
    hardware: Hardware,
    numbers: Sequence[int],
    folder: Path,
    loop: ClosedLoop | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> list[Transfer]:
    """Run trials in closed loop, and compare each with the policy in its own simulator from the same state.

    On the robot, the exported controller sees motion capture alone. The function writes to `folder` a recording of each
    trial, `trials.png` with the trajectories from above on the robot and in simulation, and `gait.png` with the first
    trial's gait.

    **Arguments**

    - `numbers`: number of each trial for `Hardware.record`, which determines its conditions.
    - `loop`: the policy in its own simulator. None to make it.
    - `tell`: function that is called with a sentence after each trial.
    """
    stored = weights(policy)
    seconds, setting = policy.task.trial_seconds, policy.variant.name
    recordings = []
    for index, number in enumerate(numbers):
        name = f"trial-{index + 1}"
        notes = f"{policy.task.name}, trained in {setting}, closed loop."
        recording = hardware.record(number, ExportedPolicy(stored), seconds, name, notes)
        path = folder / f"{name}.csv.gz"
        write_recording(recording, path, load_robot(), decimals=4)
        recordings.append(read_recording(path, load_robot()))  # reading fills the gaps of hidden points
        tell(f"{policy.task.name}, {setting}: {name} of {len(numbers)} done")

    simulator = Simulator(load_robot(), policy.actuators)
    restore = partial(reconstruct, robot=simulator.robot, model=simulator.mj_model, drivetrain=simulator.drivetrain)
    motions = [restore(recording) for recording in recordings]
    reference, com = stack_motions(simulator, motions)
    starts = [np.stack([getattr(motion, name)[0] for motion in motions]) for name in ("qpos", "qvel")]
    rollout = (loop or policy.closed_loop())(policy.params, starts[0], starts[1], len(motions[0].command))
    if rollout.divergence is not None:
        tell(f"{policy.task.name}, {setting}: {rollout.divergence}")
    recorded = np.asarray(com), np.asarray(reference.features)
    on_robot = [_trajectory(*(x[i, : len(motion.qpos)] for x in recorded)) for i, motion in enumerate(motions)]
    simulated = [_trajectory(*states) for states in zip(rollout.com, rollout.features, strict=True)]
    ballu_plots.draw_trajectories(
        folder / "trials.png", [run.com for run in on_robot], [run.com for run in simulated], setting
    )
    ballu_plots.gait(folder / "gait.png", motions[0].qpos, motions[0].command)
    return [compare_trajectories(sim, real) for sim, real in zip(simulated, on_robot, strict=True)]


def _trajectory(com: Float[np.ndarray, "T 3"], features: Float[np.ndarray, "T 27"]) -> Trajectory:
    """Return the trajectory of states with the features of `observation.observe_features`."""
    yaw, steps = features[:, ObservationLayout.yaw], count_steps(foot_positions(features))
    return Trajectory(com, yaw, steps, CONTROL_TIMESTEP)
