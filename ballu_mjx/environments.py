"""Registration of the tasks with Brax, and with Gymnasium if it is installed.

After `import ballu_mjx.environments`, make a task with `gymnasium.make("ballu_mjx/Walk-v0", run="runs/envmimic-...")`,
`gymnasium.make_vec(..., num_envs=512)` or `brax.envs.get_environment("ballu_mjx/Walk-v0", run=...)`. `run` selects the
simulator of a run. Without `run` and `robot`, the task uses BALLU's nominal simulator.
"""

from __future__ import annotations

import functools
import importlib.util

from ballu_mjx.common import runtime

runtime.prepare()

from brax import envs  # noqa: E402

from ballu_mjx.policies.environments.brax_env import BraxEnv  # noqa: E402
from ballu_mjx.policies.tasks import TASKS  # noqa: E402

_GYM = "ballu_mjx.policies.environments.gym_env"


def environment_name(task: str) -> str:
    """Return the name under which a task is registered, such as `ballu_mjx/TurnRight-v0`."""
    return f"ballu_mjx/{task.title().replace('-', '')}-v0"


NAMES = {environment_name(task): task for task in TASKS}
"""Task by the name under which it is registered."""

for _name, _task in NAMES.items():
    envs.register_environment(_name, functools.partial(BraxEnv, _task))  # pyright: ignore[reportArgumentType]

if importlib.util.find_spec("gymnasium") is not None:
    import gymnasium

    for _name, _task in NAMES.items():
        gymnasium.register(
            _name,
            entry_point=f"{_GYM}:gym_env",
            vector_entry_point=f"{_GYM}:gym_vector_env",
            kwargs={"task": _task},
        )
