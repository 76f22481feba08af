"""Locomotion tasks, by name: a file each."""

from ballu_mjx.policies.tasks import turn, turn_right, walk, walk_backward
from ballu_mjx.policies.tasks.base import Step, Task

TASKS = {module.TASK.name: module.TASK for module in (walk, turn, turn_right, walk_backward)}

__all__ = ["TASKS", "Step", "Task"]
