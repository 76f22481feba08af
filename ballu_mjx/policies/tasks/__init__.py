"""Locomotion tasks by name, one file for each."""

from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.tasks import turn, turn_right, walk, walk_backward
from ballu_mjx.policies.tasks.base import Step, Task

TASKS = {module.TASK.name: module.TASK for module in (walk, turn, turn_right, walk_backward)}

__all__ = ["TASKS", "Step", "Task", "find_task"]


def find_task(name: str) -> Task:
    """Return the task with a name.

    **Raises** `InputError` if there is none.
    """
    if name not in TASKS:
        raise InputError(f"There is no task {name!r}; give one of {', '.join(TASKS)}.")
    return TASKS[name]
