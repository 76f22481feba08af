"""Where a training begins: anew, or where a run stopped."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.rl import ppo, training_state
from ballu_mjx.rl.learner import Learner
from ballu_mjx.rl.ppo import Params, PPOConfig
from ballu_mjx.rl.training_state import TrainingState
from ballu_mjx.runs.checkpoints import Checkpoint, last_checkpoint, list_checkpoints
from ballu_mjx.runs.folder import read_config, typed_config
from ballu_mjx.runs.metrics import read_metrics
from ballu_mjx.runs.rollout_file import ROLLOUT_FILE


@dataclasses.dataclass(frozen=True)
class ResumePoint:
    """Where a training begins: anew, or where a run stopped."""

    folder: Path | None = None
    """The run that goes on."""
    checkpoint: Checkpoint | None = None
    """None: the run was stopped before it had one."""

    @property
    def resumed_at(self) -> int | None:
        """What `Run` wants to know."""
        if self.folder is None:
            return None
        return -1 if self.checkpoint is None else self.checkpoint.step

    @property
    def step(self) -> int:
        """Control steps done before."""
        return 0 if self.checkpoint is None else self.checkpoint.step

    @property
    def params(self) -> Params | None:
        """What was learned before."""
        return None if self.checkpoint is None else ppo.from_tree(self.checkpoint.params)

    @property
    def seconds(self) -> float:
        """Wall time trained before, validations included."""
        if self.checkpoint is None or self.folder is None:
            return 0.0
        found = 0.0
        for row in read_metrics(self.folder, self.step):
            found = row.get("seconds") or found + (row.get("validation_seconds") or 0.0)
        return found

    @property
    def notice(self) -> str | None:
        """What the user should know before training begins; None: nothing."""
        if self.folder is None or self.checkpoint is not None:
            return None
        return f"{self.folder}: was stopped before its first checkpoint; starting from the beginning."

    def state(
        self, new: Learner, ppo_config: PPOConfig, made_with: Mapping[str, Any], tell: Callable[[str], None]
    ) -> TrainingState:
        """Return the state to go on from with what `training_facts` says; `tell` takes sentences on what of the old
        one cannot go on."""
        if self.checkpoint is None or self.folder is None:
            return new.init(ppo_config.seed)
        stored, before = self.checkpoint.training, self.checkpoint.notes
        anew = "the optimizer and the environments start anew"
        if stored is None:
            tell(f"{self.folder}: {anew}: an older version kept parameters alone.")
        else:
            if ppo_config.learning_rate != before["learning_rate"]:
                stored = training_state.with_learning_rate(stored, ppo_config.learning_rate)
            same = all(before[name] == made_with[name] for name in ("seed", "environments"))
            try:
                state, whole = new.resume(stored, environments=same)
            except ValueError as error:
                tell(f"{self.folder}: {anew}: the stored ones do not fit ({error}).")
            else:
                if not whole:
                    tell(f"{self.folder}: the environments start anew, for the options changed; the optimizer goes on.")
                return state
        return new.init_from(ppo.from_tree(self.checkpoint.params), self.step)


def find_resume_point(
    task: str, folder: Path | None, config: PPOConfig, *, output: Path | None, quick: bool
) -> ResumePoint:
    """Return where training starts from: anew, where `folder` is None.

    **Raises** `InputError` where the run to go on with is none, has ended, or does not go with the options.
    """
    if folder is None:
        return ResumePoint()
    for option, given in (("--output", output is not None), ("--quick", quick)):
        if given:
            raise InputError(f"{option} does not go with --resume, which keeps folder and sizes; leave one out.")
    before = read_config(folder, task)
    files.check_folder(folder)
    stored = typed_config(PPOConfig, before, "ppo", folder, ppo.check_values)
    for name in ("policy_layers", "value_layers", "activation", "normalize_observations"):
        if getattr(stored, name) != getattr(config, name):
            raise InputError(
                f"--{name.replace('_', '-')} does not go with --resume: the stored parameters have "
                f"{getattr(stored, name)}; leave it out or start a new run."
            )
    if not list_checkpoints(folder):
        return ResumePoint(folder)
    checkpoint = last_checkpoint(folder, training=True)
    # Whoever was stopped between the last checkpoint and the results still needs these.
    if checkpoint.step >= config.num_timesteps and (folder / ROLLOUT_FILE).exists():
        raise InputError(
            f"{folder}: is at step {checkpoint.step:,} already; give a --num-timesteps above that to train for longer."
        )
    return ResumePoint(folder, checkpoint)


def training_facts(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of a run's `config.json` a training state depends on beyond its shapes.

    It is kept with every checkpoint: the `config.json` beside it may be that of a later start.
    """
    recordings = [entry["sha256"] for entry in config.get("recordings", {}).get("training", [])]
    parts = {name: config.get(name) for name in ("env", "actuators", "residual")} | {"recordings": recordings}
    text = json.dumps(parts, sort_keys=True, default=str)
    return {
        "learning_rate": config["ppo"]["learning_rate"],
        "seed": config["ppo"]["seed"],
        "environments": hashlib.sha256(text.encode()).hexdigest(),
    }
