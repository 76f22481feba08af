"""Forward walking (paper, section "Improved Sim-to-real Transfer"): velocity along x, trials of 24 s."""

from ballu_mjx.policies.tasks.base import Task

TASK = Task("walk", "Walk forward, along x.", lambda step: step.velocity[0], 24.0)
