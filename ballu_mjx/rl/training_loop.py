"""Training loop around PPO: metrics, validations, checkpoints, progress messages and interruption by signals."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import signal
import threading
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
"""Share of control steps whose physics may diverge before the user is warned."""


@dataclasses.dataclass(frozen=True)
class Validation:
    """Validation, whose result selects the best checkpoint."""

    measure: Callable[[Params], float]
    """Function that returns the validation result of the parameters."""
    name: str = "validation_error"
    """Name of the metric."""
    greatest: bool = False
    """Whether a greater result is better. By default a smaller one is."""


class TrainingInterrupted(KeyboardInterrupt):
    """Interruption of a training by a signal, after its last state was saved."""

    def __init__(self, status: int, step: int) -> None:
        """Create it with the exit `status` of a shell for the signal, and the saved control `step`."""
        super().__init__()
        self.status, self.step = status, step


class TrainingLoop:
    """One training from its start, or from a checkpoint, to its end or interruption."""

    interrupted: int | None = None
    """Number of the received signal, set by its handler. Training then ends after the current training step."""

    def __init__(
        self,
        run: TrainingRecord | None,
        progress: Progress | None,
        keep_every: int,
        validation: Validation,
    ) -> None:
        """Prepare a training.

        **Arguments**

        - `run`: receives metrics and checkpoints. None to write nothing.
        - `progress`: shows progress and warnings on the terminal. None to show neither.
        - `keep_every`: control steps between two checkpoints.
        - `validation`: the measurement at each checkpoint, which selects the best.
        """
        self._run, self._progress, self._validation = run, progress, validation
        self._every = keep_every
        self._due: int | None = None  # Step of the last checkpoint, not counting one that an interruption saved.
        self._made_with: dict[str, Any] = {}
        self._saved = 0
        self._validated: str | None = None
        """Last validation, as text. Its step is named, because it may lie far behind the current one."""
        self._warned = False
        self._started = time.perf_counter()
        self._seconds_before = 0.0
        folder = None if run is None else run.folder
        self._watchdog = Watchdog(folder or Path("RUN"), self._tell)

    def train(self, env: Env, config: PPOConfig, start: ResumePoint, content: Mapping[str, Any]) -> None:
        """Train `env` from `start`. `content` is the content of the run's `config.json`.

        **Raises** `TrainingInterrupted` after SIGINT (Ctrl-C) or SIGTERM, when the last state is saved. Raises
        `InputError` if a loss or metric is not finite, naming the last good checkpoint.
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
                    self._tell(f"At the end: {self._validated}.")
                if distributed.anywhere(bool(self.interrupted)):  # during this last validation
                    raise KeyboardInterrupt
        except KeyboardInterrupt:
            self._close()
            raise TrainingInterrupted(self.exit_status, self._saved) from None
        self._close()

    @property
    def exit_status(self) -> int:
        """Exit status that a shell reports for the signal that ended the training."""
        return 128 + (self.interrupted or signal.SIGINT)

    def _step_done(self, step: int, state: TrainingState, metrics: dict[str, float]) -> None:
        self._watchdog.step_done(step if metrics else None)
        if not all(math.isfinite(value) for value in metrics.values()):
            self._close()
            broken = ", ".join(name for name, value in metrics.items() if not math.isfinite(value))
            raise InputError(
                f"Training diverged before step {step:,}: {broken} is no longer finite. The last good checkpoint is "
                f"that of step {self._saved:,}; resume from it with --resume and a smaller --learning-rate, or look "
                "for recordings or options that cause extreme motions."
            )
        if metrics.get("diverged", 0.0) > _DIVERGED and not self._warned:
            self._warned = True
            self._tell(
                f"Physics diverged in {metrics['diverged']:.2%} of the control steps (these robots were reset). The "
                "forces or starting states are too extreme for the simulator's time step."
            )
        if metrics:
            seconds = self._seconds_before + time.perf_counter() - self._started
            self._log(step, metrics | {"seconds": seconds})
        if self._due is None or step - self._due >= self._every:
            self._keep(step, state)
        if metrics and self._progress is not None:
            shown = f"reward {metrics['reward']:.3f}"
            if self._validated is not None:
                shown += f", {self._validated}"
            self._progress.update(step, metrics["steps_per_second"], shown)
        if distributed.anywhere(bool(self.interrupted)):
            self._save(step, state, None)
            raise KeyboardInterrupt
        self._watchdog.step_done(step if metrics else None)

    def _keep(self, step: int, state: TrainingState) -> None:
        self._due = step
        began = time.perf_counter()
        measured = self._validation.measure(training_state.params(state))
        self._validated = f"{self._validation.name.replace('_', ' ')} {measured:.3f} (step {step:,})"
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
        """Let the first SIGINT or SIGTERM end training after the current training step, and the second at once.

        A signal handler that raises an exception at once can interrupt a callback of JAX, which swallows it. Handlers
        that other code has installed stay. Ignored signals stay ignored, as for a job in the background of a shell.
        Python handles signals in its main thread only, so that a training in another thread notes none.
        """

        def note(number: int, frame: Any) -> None:
            if self.interrupted:
                raise KeyboardInterrupt
            self.interrupted = number

        standard = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
        main = threading.current_thread() is threading.main_thread()
        ours = {number: old for number, old in standard.items() if main and signal.getsignal(number) == old}
        for number in ours:
            signal.signal(number, note)
        try:
            yield
        finally:
            for number, old in ours.items():
                signal.signal(number, old)
