"""Names of the simulators of all experiments (`train all`), and the layout of their output folder.

The folder holds `table-TASK.md` for each task and `seed-N/` for each seed. A seed's folder holds the runs of policies
(`TASK-VARIANT/`), the runs of residuals (`METHOD-TASK/`), the predicted errors (`prediction-TASK/`), and the trials
(`trials-TASK-VARIANT/`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from ballu_mjx.evaluation.transfer import Transfer, turning_table, walking_table
from ballu_mjx.policies.simulator_variants import ROUNDS, SimulatorVariant

TABLES: Mapping[str, Callable[[Mapping[str, Sequence[Sequence[Transfer]]]], str]] = {
    "walk": walking_table,
    "turn": turning_table,
}
"""Functions that make the paper's tables, by task."""
PAPER_SIMULATORS = ("vanilla+sysid", "vanilla+dr", "vanilla+sysid+dr", "envmimic", "aerodynamic")
"""The paper's four simulators, and one with identified aerodynamics instead of EnvMimic's forces."""
SHARED = "envmimic-shared"
"""Simulator with one EnvMimic residual for all tasks."""
NEAR = "envmimic-near"
"""Simulator with EnvMimic's forces, whose policies pay a cost outside the residual's training range."""
WRENCH = "envmimic-wrench"
"""Simulator with an EnvMimic residual that also applies a torque."""
PAPER_PRESET = "envmimic-paper"
"""Simulator with EnvMimic's forces, learned with the preset of the paper's options."""
OPTIONAL_SIMULATORS = (NEAR, SHARED, WRENCH, PAPER_PRESET, "supervised", "analytic")
"""Optional simulators. The networks of the last two are learned by regression and by gradients."""


def settings_beyond(folder: Path, task: str) -> tuple[str, ...]:
    """Return the simulators besides `PAPER_SIMULATORS` of which a seed's folder has policies.

    They are those of later rounds and the optional ones.
    """

    def there(name: str) -> bool:
        return (folder / f"{task}-{name}").is_dir()

    later = (SimulatorVariant(ROUNDS, round=number).name for number in itertools.count(2))
    return (*itertools.takewhile(there, later), *filter(there, OPTIONAL_SIMULATORS))


def has_residual(setting: str) -> bool:
    """Return whether a simulator has a residual."""
    return SimulatorVariant.parse(setting).residual is not None


def residual_folder(seed: Path, task: str, setting: str) -> Path:
    """Return the folder, in a seed's folder, in which the residual of a simulator is learned."""
    if setting == SHARED:
        return seed / SHARED
    variant = SimulatorVariant.parse(ROUNDS if setting == NEAR else setting)
    return seed / (f"{variant.residual}-{task}" + (f"-{variant.round}" if variant.round > 1 else ""))


def prediction_file(output: Path, seed: int, task: str) -> Path:
    """Return the file with the predicted errors of a seed's policies for a task."""
    return output / f"seed-{seed}" / f"prediction-{task}" / "prediction.json"


def table_file(output: Path, task: str) -> Path:
    """Return the file of a task's table."""
    return output / f"table-{task}.md"
