"""Simulators of the whole story (`train all`) by name, and where its folder keeps what.

The folder holds `table-TASK.md` for each task and, for each seed, `seed-N/` with the runs of policies
(`TASK-VARIANT/`), of residuals (`METHOD-TASK/`) and the trials (`trials-TASK-VARIANT/`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from ballu_mjx.evaluation.transfer import Transfer, turning_table, walking_table
from ballu_mjx.policies.variants import SimulatorVariant

TABLES: Mapping[str, Callable[[Mapping[str, Sequence[Sequence[Transfer]]]], str]] = {
    "walk": walking_table,
    "turn": turning_table,
}
"""The paper's tables, by task."""
SETTINGS = ("vanilla+sysid", "vanilla+dr", "vanilla+sysid+dr", "envmimic", "aerodynamic")
"""The paper's four simulators, and one with the identified air instead of EnvMimic's forces."""
SHARED = "envmimic-shared"
"""One EnvMimic for all tasks."""
NEAR = "envmimic-near"
"""EnvMimic's forces, and policies that pay for leaving what these were learned from."""
WRENCH = "envmimic-wrench"
"""An EnvMimic that pushes with a torque too."""
MORE_SETTINGS = (NEAR, SHARED, WRENCH, "supervised", "analytic")
"""Simulators on request; the last two have networks that regression and gradients learn."""
ROUNDS = "envmimic"
"""The residual that is learned again in each round. A later round has its number behind the name."""


def settings_beyond(folder: Path, task: str) -> tuple[str, ...]:
    """Return the simulators beyond `SETTINGS` that a seed's folder has policies of: of later rounds, and on request."""

    def there(name: str) -> bool:
        return (folder / f"{task}-{name}").is_dir()

    later = (SimulatorVariant(ROUNDS, round=number).name for number in itertools.count(2))
    return (*itertools.takewhile(there, later), *filter(there, MORE_SETTINGS))


def residual_folder(seed: Path, task: str, setting: str) -> Path:
    """Return where, in a seed's folder, the residual of a simulator is learned."""
    if setting == SHARED:
        return seed / SHARED
    variant = SimulatorVariant.parse(ROUNDS if setting == NEAR else setting)
    return seed / (f"{variant.residual}-{task}" + (f"-{variant.round}" if variant.round > 1 else ""))


def table_file(output: Path, task: str) -> Path:
    """Return where the table of a task is written."""
    return output / f"table-{task}.md"
