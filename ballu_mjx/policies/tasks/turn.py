"""Turning left (paper, section "Improved Sim-to-real Transfer"): reward is the velocity along y; trials of 22 s."""

from ballu_mjx.policies.tasks.base import Task

TASK = Task("turn", "Turn left and walk along y.", lambda step: step.velocity[1], 22.0)
