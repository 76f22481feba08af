"""Turning right. The reward is the velocity along -y."""

from ballu_mjx.policies.tasks.base import Task

TASK = Task("turn-right", "Turn right and walk along -y.", lambda step: -step.velocity[1], 22.0)
