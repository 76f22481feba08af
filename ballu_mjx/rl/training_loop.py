"""A training with what surrounds PPO: measurements, validations, checkpoints, progress, and Ctrl-C."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from brax.envs.base import Env

from ballu_mjx.common.errors import InputError
from ballu_mjx.rl import distributed, learner, ppo, training_state
from ballu_mjx.rl.ppo import Params, PPOConfig
from ballu_mjx.rl.resume_point import ResumePoint, training_facts
from ballu_mjx.rl.training_state import TrainingState
from ballu_mjx.rl.watchdog import Watchdog
from ballu_mjx.runs.progress import Progress
from ballu_mjx.runs.record import TrainingRecord

_DIVERGED = 1e-3
"""Share of control steps in which physics may break down before the user is told."""


@dataclasses.dataclass(frozen=True)
class Validation:
    """What tells the best checkpoint."""

    measure: Callable[[Params], float]
    name: str = "validation_error"
    """Of the metric."""
    greatest: bool = False
    """Whether the greatest is the best, not the smallest."""


class TrainingInterrupted(KeyboardInterrupt):
    """A signal ended a training, whose last state is saved."""

    def __init__(self, status: int, step: int) -> None:
        """`status` is a shell's for the signal, `step` the control step that is saved."""
        super().__init__()
        self.status, self.step = status, step


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
        self._watchdog = Watchdog(folder or Path("RUN"), self._tell)

    def train(self, env: Env, config: PPOConfig, start: ResumePoint, content: Mapping[str, Any]) -> None:
        """Train `env` from `start` on; `content` is the run's `config.json`.

        **Raises** `TrainingInterrupted` after SIGINT (Ctrl-C) or SIGTERM, the last state saved, and `InputError`
        where learning broke down, with the last good checkpoint named.
        """
        self._made_with = training_facts(content)
        if start.checkpoint is not None:
            self._saved = start.checkpoint.step
            self._due = start.checkpoint.notes.get("due", self._saved)
            self._seconds_before = start.seconds
        try:
            watched = contextlib.nullcontext() if self._progress is None else self._watchdog
            with self._interrupts_noted(), watched:
                begin = functools.partial(start.state, ppo_config=config, made_with=self._made_with, tell=self._tell)
                state, _ = learner.train(env, config, self._step_done, start=begin)
                if self._due != int(state.steps):
                    self._keep(int(state.steps), state)
        except KeyboardInterrupt:
            self._close()
            raise TrainingInterrupted(self.exit_status, self._saved) from None
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
        if metrics.get("diverged", 0.0) > _DIVERGED and not self._warned:
            self._warned = True
            self._tell(
                f"Physics diverged in {metrics['diverged']:.2%} of the control steps (these robots were reset); the "
                "forces or starting states are too violent for the simulator's time step."
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
        measured = self._validated = self._validation.measure(training_state.params(state))
        self._log(step, {self._validation.name: measured, "validation_seconds": time.perf_counter() - began})
        self._save(step, state, -measured if self._validation.greatest else measured)

    def _save(self, step: int, state: TrainingState, score: float | None) -> None:
        params, training = ppo.as_tree(training_state.params(state)), training_state.stored(state)
        notes = {**self._made_with, "due": self._due}
        if self._run is not None:
            self._run.save(step, params, score, training=training, notes=notes)
        self._saved = step

    def _log(self, step: int, metrics: Mapping[str, float]) -> None:
        if self._run is not None:
            self._run.log(step, metrics)

    def _tell(self, text: str) -> None:
        if self._progress is not None:
            self._progress.tell(text)

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
