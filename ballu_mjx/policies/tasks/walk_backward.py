"""Walking backward. The reward is the velocity along -x."""

from ballu_mjx.policies.tasks.base import Task

TASK = Task("walk-backward", "Walk backward, along -x.", lambda step: -step.velocity[0], 24.0)
