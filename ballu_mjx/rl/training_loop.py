"""Between PPO and the run's folder: measurements, validations, checkpoints, progress, and Ctrl-C."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

from brax.envs.base import Env

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.rl import distributed, learner, ppo
from ballu_mjx.rl.learner import Learner, TrainingState
from ballu_mjx.rl.ppo import Params, PPOConfig
from ballu_mjx.runs.checkpoints import Checkpoint, last_checkpoint, list_checkpoints
from ballu_mjx.runs.folder import read_config, typed_config
from ballu_mjx.runs.metrics import read_metrics
from ballu_mjx.runs.progress import Progress
from ballu_mjx.runs.record import TrainingRecord
from ballu_mjx.runs.rollout_file import ROLLOUT_FILE

_DIVERGED = 1e-3
"""Share of control steps in which physics may break down before the user is told."""


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

    def state(self, new: Learner, ppo_config: PPOConfig, made_with: Mapping[str, Any]) -> TrainingState:
        """The state to go on from with what `_made_with` says; what cannot go on of the old one is told on the
        terminal."""
        if self.checkpoint is None or self.folder is None:
            return new.begin(ppo_config.seed)
        stored, before = self.checkpoint.training, self.checkpoint.notes
        anew = "the optimizer and the environments start anew"
        if stored is None:
            print(f"{self.folder}: {anew}: an older version kept parameters alone.")
        else:
            if ppo_config.learning_rate != before["learning_rate"]:
                stored = learner.with_learning_rate(stored, ppo_config.learning_rate)
            same = all(before[name] == made_with[name] for name in ("seed", "environments"))
            try:
                state, whole = new.go_on(stored, environments=same)
            except ValueError as error:
                print(f"{self.folder}: {anew}: the stored ones do not fit ({error}).")
            else:
                if not whole:
                    print(
                        f"{self.folder}: the environments start anew, for the options changed; the optimizer goes on."
                    )
                return state
        return new.begin_from(ppo.from_tree(self.checkpoint.params), self.step)


def find_resume_point(
    task: str, folder: Path | None, config: PPOConfig, *, output: Path | None, quick: bool
) -> ResumePoint:
    """Where training starts from: anew, where `folder` is None.

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
        print(f"{folder}: was stopped before its first checkpoint; starting from the beginning.", file=sys.stderr)
        return ResumePoint(folder)
    checkpoint = last_checkpoint(folder, training=True)
    # Whoever was stopped between the last checkpoint and the results still needs these.
    if checkpoint.step >= config.num_timesteps and (folder / ROLLOUT_FILE).exists():
        raise InputError(
            f"{folder}: is at step {checkpoint.step:,} already; give a --num-timesteps above that to train for longer."
        )
    return ResumePoint(folder, checkpoint)


@dataclasses.dataclass(frozen=True)
class Validation:
    """What tells the best checkpoint."""

    measure: Callable[[Params], float]
    name: str = "validation_error"
    """Of the metric."""
    greatest: bool = False
    """Whether the greatest is the best, not the smallest."""


def _made_with(config: Mapping[str, Any]) -> dict[str, Any]:
    """What of a run's `config.json` a training state depends on beyond its shapes. Kept with every checkpoint: the
    `config.json` beside it may be that of a later start."""
    recordings = [entry["sha256"] for entry in config.get("recordings", {}).get("training", [])]
    parts = {name: config.get(name) for name in ("env", "actuators", "residual")} | {"recordings": recordings}
    text = json.dumps(parts, sort_keys=True, default=str)
    return {
        "learning_rate": config["ppo"]["learning_rate"],
        "seed": config["ppo"]["seed"],
        "environments": hashlib.sha256(text.encode()).hexdigest(),
    }


def _seconds_until(folder: Path, step: int) -> float:
    """Return the wall time that a run trained for up to a control step, its validations included."""
    found = 0.0
    for row in read_metrics(folder, step):
        found = row.get("seconds") or found + (row.get("validation_seconds") or 0.0)
    return found


class Watchdog:
    """Tells the user when no training step has finished for long: a context manager around the training.

    It watches from a thread, which holds nothing up and ends with the process.
    """

    def __init__(self, folder: Path, limit: float = 300.0, stream: TextIO | None = None) -> None:
        """`limit`: s."""
        # Bound now: what a checkpoint says while it is written is caught for a while.
        self._folder, self._limit, self._stream = folder, limit, stream or sys.stderr
        self._step: int | None = None
        self._last = time.monotonic()
        self._told: float | None = None  # when the standstill began that has been told of
        self._woken = threading.Condition()
        self._over = False

    def step_done(self, step: int | None) -> None:
        """Training has got to control step `step`; None: it is about to take its first step."""
        with self._woken:
            self._step, self._last = step, time.monotonic()

    def __enter__(self) -> Watchdog:
        self.step_done(None)
        threading.Thread(target=self._watch, name="watchdog", daemon=True).start()
        return self

    def __exit__(self, *exception: object) -> None:
        with self._woken:
            self._over = True
            self._woken.notify()

    def look(self, now: float) -> float:
        """Tell of a standstill that has lasted for the limit at `now` (s, of `time.monotonic`), unless it has been told
        of; return in how many seconds to look again."""
        left = self._last + self._limit - now
        if left <= 0 and self._told != self._last:
            self._told = self._last
            print(self._said(), file=self._stream, flush=True)
        return max(left, self._limit / 10)

    def _watch(self) -> None:
        with self._woken:
            while not self._over:
                self._woken.wait(self.look(time.monotonic()))

    def _said(self) -> str:
        minutes = f"{self._limit / 60:.3g} minutes"
        if self._step is None:
            return (
                f"No training step has finished for {minutes}: a first compilation takes one or two, more where other "
                "work keeps the machine busy. If nothing comes of it, end the process and try fewer --num-envs, "
                "or delete the cache of compiled programs."
            )
        return (
            f"No training step has finished for {minutes}, since step {self._step:,}: look whether the machine sleeps, "
            "has run out of memory or does other work. If it does not go on, end the process, and go on with "
            f"--resume {self._folder}: what is saved stays."
        )


class TrainingInterrupted(KeyboardInterrupt):
    """A signal ended a training, whose last state is saved."""

    def __init__(self, status: int) -> None:
        """`status`: a shell's for the signal."""
        super().__init__()
        self.status = status


class TrainingLoop:
    """One stretch of training."""

    interrupted: int | None = None
    """The signal that came, set by its handler: the next finished training step is the last."""

    def __init__(
        self,
        run: TrainingRecord | None,
        progress: Progress | None,
        keep_every: int,
        validation: Validation,
    ) -> None:
        """A checkpoint is kept every `keep_every` control steps, with what `validation` measures, which tells the best.
        Without `progress` nothing is told on the terminal, of trouble neither."""
        self._run, self._progress, self._validation = run, progress, validation
        self._every = keep_every
        self._due: int | None = None  # step of the last checkpoint that was not an interruption's
        self._made_with: dict[str, Any] = {}
        self._saved = 0
        self._validated: float | None = None
        self._warned = False
        self._started = time.perf_counter()
        self._seconds_before = 0.0
        folder = None if run is None else run.folder
        self._watchdog = Watchdog(folder or Path("RUN"))

    def train(self, env: Env, config: PPOConfig, start: ResumePoint, content: Mapping[str, Any]) -> None:
        """Train `env` from `start` on; `content` is the run's `config.json`.

        **Raises** `TrainingInterrupted` after SIGINT (Ctrl-C) or SIGTERM, the last state saved, and `InputError`
        where learning broke down, with the last good checkpoint named.
        """
        self._made_with = _made_with(content)
        if start.checkpoint is not None:
            self._saved = start.checkpoint.step
            self._due = start.checkpoint.notes.get("due", self._saved)
            if self._run is not None and self._run.folder is not None:
                self._seconds_before = _seconds_until(self._run.folder, self._saved)
        try:
            watched = contextlib.nullcontext() if self._progress is None else self._watchdog
            with self._interrupts_noted(), watched:
                state, _ = learner.train(
                    env, config, self._step_done, start=lambda new: start.state(new, config, self._made_with)
                )
                if self._due != int(state.steps):
                    self._keep(int(state.steps), state)
        except KeyboardInterrupt:
            self._close()
            if self._progress is not None:
                print(f"Interrupted; saved at step {self._saved:,}.", file=sys.stderr)
            raise TrainingInterrupted(self.exit_status) from None
        self._close()

    @property
    def exit_status(self) -> int:
        """A shell's for the signal that ended the training."""
        return 128 + (self.interrupted or signal.SIGINT)

    def _step_done(self, step: int, state: TrainingState, metrics: dict[str, float]) -> None:
        self._watchdog.step_done(step if metrics else None)
        if not all(math.isfinite(value) for value in metrics.values()):
            self._close()
            broken = ", ".join(name for name, value in metrics.items() if not math.isfinite(value))
            raise InputError(
                f"Learning broke down before step {step:,}: {broken} is not a number any more. The last good "
                f"checkpoint is that of step {self._saved:,}; go on from it with --resume and a smaller "
                "--learning-rate, or look for recordings or options that throw the robot about."
            )
        if metrics.get("diverged", 0.0) > _DIVERGED and not self._warned and self._progress is not None:
            self._warned = True
            print(
                f"Physics diverged in {metrics['diverged']:.2%} of the control steps (these robots were reset); the "
                "forces or starting states are too violent for the simulator's time step.",
                file=sys.stderr,
            )
        if metrics:
            seconds = self._seconds_before + time.perf_counter() - self._started
            self._log(step, metrics | {"seconds": seconds})
        if self._due is None or step - self._due >= self._every:
            self._keep(step, state)
        if metrics and self._progress is not None:
            shown = f"reward {metrics['reward']:.3f}"
            if self._validated is not None:
                shown += f", {self._validation.name.replace('_', ' ')} {self._validated:.3f}"
            self._progress.update(step, metrics["steps_per_second"], shown)
        if distributed.anywhere(bool(self.interrupted)):
            self._save(step, state, None)
            raise KeyboardInterrupt
        self._watchdog.step_done(step if metrics else None)

    def _keep(self, step: int, state: TrainingState) -> None:
        self._due = step
        began = time.perf_counter()
        measured = self._validated = self._validation.measure(learner.params(state))
        self._log(step, {self._validation.name: measured, "validation_seconds": time.perf_counter() - began})
        self._save(step, state, -measured if self._validation.greatest else measured)

    def _save(self, step: int, state: TrainingState, score: float | None) -> None:
        params, training = ppo.as_tree(learner.params(state)), learner.stored(state)
        notes = {**self._made_with, "due": self._due}
        if self._run is not None:
            self._run.save(step, params, score, training=training, notes=notes)
        self._saved = step

    def _log(self, step: int, metrics: Mapping[str, float]) -> None:
        if self._run is not None:
            self._run.log(step, metrics)

    def _close(self) -> None:
        if self._progress is not None:
            self._progress.close()

    @contextlib.contextmanager
    def _interrupts_noted(self) -> Iterator[None]:
        """Let the first SIGINT or SIGTERM end training after its current step; the second interrupts at once.

        An exception raised wherever Python happens to be can land in a callback of JAX's that swallows it. Handlers
        that are somebody else's stay, and so do signals that are ignored, as in the background of a shell.
        """

        def note(number: int, frame: Any) -> None:
            if self.interrupted:
                raise KeyboardInterrupt
            self.interrupted = number

        standard = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
        ours = {number: old for number, old in standard.items() if signal.getsignal(number) == old}
        for number in ours:
            signal.signal(number, note)
        try:
            yield
        finally:
            for number, old in ours.items():
                signal.signal(number, old)
