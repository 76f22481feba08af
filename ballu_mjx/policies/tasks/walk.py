"""Walking forward (paper, section "Improved Sim-to-real Transfer"): reward is the velocity along x; trials of 24 s."""

from ballu_mjx.policies.tasks.base import Task

TASK = Task("walk", "Walk forward, along x.", lambda step: step.velocity[0], 24.0)
