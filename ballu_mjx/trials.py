"""Trials of a policy on the virtual robot, beside the same policy in its own simulator."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ballu_mjx import plots, robot, virtual_robot
from ballu_mjx.deployment import PolicyController
from ballu_mjx.envmimic import Simulator, stack
from ballu_mjx.locomotion import Setting
from ballu_mjx.policy import ClosedLoop, Policy
from ballu_mjx.reconstruction import reconstruct
from ballu_mjx.recording import read_recording, write_recording
from ballu_mjx.transfer import Path as Way
from ballu_mjx.transfer import Transfer, compare
from ballu_mjx.virtual_robot import Trial, VirtualRobot


def run(
    policy: Policy, hardware: VirtualRobot, draws: Sequence[Trial], folder: Path, loop: ClosedLoop, setting: Setting
) -> list[Transfer]:
    """Run each trial in closed loop from motion capture alone, and compare it with simulation (`loop` in `setting`, the
    policy's own) from the same state.

    Leaves in `folder` a recording a trial, and `trials.png`: the ways from above, on the robot and in simulation.
    """
    act, seconds = policy.act(), policy.task.trial_seconds
    recordings = []
    for number, draw in enumerate(draws):
        name = f"trial-{number + 1}"
        notes = f"{policy.task.name}, trained in {policy.setting}, closed loop."
        recording = virtual_robot.record(hardware, draw, PolicyController(act), seconds, name, notes)
        path = folder / f"{name}.csv.gz"
        write_recording(recording, path, decimals=4)
        recordings.append(read_recording(path))  # reading fills the gaps
        print(f"{policy.task.name}, {policy.setting}: {name} of {len(draws)} done", flush=True)

    model = robot.load_model(policy.actuators)
    motions = [reconstruct(recording, model) for recording in recordings]
    reference, com = stack(Simulator(model), motions)
    starts = [np.stack([getattr(motion, name)[0] for motion in motions]) for name in ("qpos", "qvel")]
    rollout = loop(policy.params, starts[0], starts[1], len(motions[0].command), setting)
    hardware_ways = [
        Way(np.asarray(com[i])[: len(m.qpos)], np.asarray(reference.features)[i, : len(m.qpos), 8])
        for i, m in enumerate(motions)
    ]
    simulated = [Way(rollout.com[i], rollout.yaw[i]) for i in range(len(motions))]
    plots.ways(
        folder / "trials.png", [way.com for way in hardware_ways], [way.com for way in simulated], policy.setting
    )
    plots.gait(folder / "gait.png", motions[0].qpos, motions[0].command)
    return [compare(sim, real) for sim, real in zip(simulated, hardware_ways, strict=True)]
