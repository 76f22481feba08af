"""Starting point of a training: a new training, or the last checkpoint of a run that is resumed."""

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
from ballu_mjx.runs.checkpoints import SCORED_WITH, Checkpoint, last_checkpoint, list_checkpoints
from ballu_mjx.runs.folder import read_config, typed_config
from ballu_mjx.runs.metrics import read_metrics
from ballu_mjx.runs.rollout_file import ROLLOUT_FILE


@dataclasses.dataclass(frozen=True)
class ResumePoint:
    """Starting point of a training: a new training, or the last checkpoint of a run that is resumed."""

    folder: Path | None = None
    """Folder of the resumed run. None for a new training."""
    checkpoint: Checkpoint | None = None
    """Checkpoint to resume from. None for a new training, or if the run stopped before its first checkpoint."""
    policy: Params | None = None
    """Parameters with whose policy a new training starts. None for an untrained policy."""

    @property
    def resumed_at(self) -> int | None:
        """Argument `resumed_at` of `Run`: the resumed control step, -1 without checkpoint, None for a new training."""
        if self.folder is None:
            return None
        return -1 if self.checkpoint is None else self.checkpoint.step

    @property
    def step(self) -> int:
        """Control steps done before this training starts."""
        return 0 if self.checkpoint is None else self.checkpoint.step

    @property
    def params(self) -> Params | None:
        """Parameters of the checkpoint. None without checkpoint."""
        return None if self.checkpoint is None else ppo.from_tree(self.checkpoint.params)

    @property
    def seconds(self) -> float:
        """Wall time (s) of the earlier training up to the checkpoint, validations included."""
        if self.checkpoint is None or self.folder is None:
            return 0.0
        found = 0.0
        for row in read_metrics(self.folder, self.step):
            found = row.get("seconds") or found + (row.get("validation_seconds") or 0.0)
        return found

    @property
    def notice(self) -> str | None:
        """Message for the user before training starts. None if there is none."""
        if self.folder is None or self.checkpoint is not None:
            return None
        return f"{self.folder}: the run stopped before its first checkpoint; starting from the beginning."

    def state(
        self, new: Learner, ppo_config: PPOConfig, made_with: Mapping[str, Any], tell: Callable[[str], None]
    ) -> TrainingState:
        """Return the training state to start with.

        **Arguments**

        - `new`: the learner that will train from this state.
        - `ppo_config`: the options of this training.
        - `made_with`: the result of `training_facts` for this training, to compare with the checkpoint's.
        - `tell`: receives messages about parts of the stored state that cannot be used.
        """
        if self.checkpoint is None or self.folder is None:
            return new.init(ppo_config.seed) if self.policy is None else new.init_with(self.policy)
        stored, before = self.checkpoint.training, self.checkpoint.notes
        anew = "the optimizer and the environments are reset"
        if stored is None:
            tell(f"{self.folder}: {anew}, because an older version saved only the parameters.")
        else:
            # An adaptive rate continues where it was. A constant one is the option's.
            if ppo_config.learning_rate != before["learning_rate"] or not ppo_config.desired_kl:
                stored = training_state.with_learning_rate(stored, ppo_config.learning_rate)
            same = all(before[name] == made_with[name] for name in ("seed", "environments"))
            try:
                state, whole = new.resume(stored, environments=same)
            except ValueError as error:
                tell(f"{self.folder}: {anew}, because the stored ones do not fit ({error}).")
            else:
                if not whole:
                    tell(f"{self.folder}: options have changed; the environments are reset, the optimizer continues.")
                return state
        return new.init_from(ppo.from_tree(self.checkpoint.params), self.step)


def find_resume_point(
    task: str, folder: Path | None, config: PPOConfig, *, output: Path | None, quick: bool
) -> ResumePoint:
    """Return the starting point of a training: the last checkpoint of the run in `folder`, or a new training if None.

    **Raises** `InputError` if `folder` holds no run, if the run has ended, or if the options contradict it.
    """
    if folder is None:
        return ResumePoint()
    for option, given in (("--output", output is not None), ("--quick", quick)):
        if given:
            raise InputError(f"{option} does not go with --resume, which keeps folder and sizes; leave one out.")
    before = read_config(folder, task)
    files.check_folder(folder)
    stored = typed_config(PPOConfig, before, "ppo", folder, ppo.check_values)
    for name in (*ppo.POLICY_OPTIONS, *ppo.START_OPTIONS, "value_layers"):
        if getattr(stored, name) != getattr(config, name):
            raise InputError(
                f"--{name.replace('_', '-')} does not go with --resume: the stored parameters have "
                f"{getattr(stored, name)}; leave it out or start a new run."
            )
    if not list_checkpoints(folder):
        return ResumePoint(folder)
    checkpoint = last_checkpoint(folder, training=True)
    if is_finished(folder, checkpoint.step, config):
        raise InputError(
            f"{folder}: the run is already at step {checkpoint.step:,}; give a larger --num-timesteps to train longer."
        )
    return ResumePoint(folder, checkpoint)


def is_finished(folder: Path, step: int, config: PPOConfig) -> bool:
    """Return whether a run whose last checkpoint is that of `step` has nothing left to do.

    A run that stopped between its last checkpoint and its results still needs the results.
    """
    return step >= config.num_timesteps and (folder / ROLLOUT_FILE).exists()


def training_facts(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parts of a run's `config.json` on which a training state and a score depend, apart from shapes.

    They are saved with every checkpoint, because a later start may overwrite `config.json`.
    """

    def digest(use: str) -> str:
        recordings = [entry["sha256"] for entry in config.get("recordings", {}).get(use, [])]
        parts = {name: config.get(name) for name in ("env", "actuators", "residual")} | {"recordings": recordings}
        if config.get("residual") is not None:
            parts["residual_sha256"] = config.get("residual_sha256")
        return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()

    return {
        "learning_rate": config["ppo"]["learning_rate"],
        "seed": config["ppo"]["seed"],
        "environments": digest("training"),
        SCORED_WITH: digest("validation"),
    }
