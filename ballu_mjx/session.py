"""Between PPO and the run's folder: measurements, validations, checkpoints, progress, and Ctrl-C."""

from __future__ import annotations

import contextlib
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from brax.envs.base import Env

from ballu_mjx import ppo, runs
from ballu_mjx.errors import InputError
from ballu_mjx.ppo import Params, PPOConfig
from ballu_mjx.runs import Progress, Run


def restored_from(
    task: str, folder: Path | None, config: PPOConfig, *, output: Path | None, quick: bool
) -> tuple[int, Params | None]:
    """Step and parameters that training starts from: 0 and None for a new run, which `folder` None is.

    **Raises** `InputError` where the run to go on with is none, has ended, or does not go with the options.
    """
    if folder is None:
        return 0, None
    for option, given in (("--output", output is not None), ("--quick", quick)):
        if given:
            raise InputError(f"{option} does not go with --resume, which keeps folder and sizes; leave one out.")
    stored = runs.typed(PPOConfig, runs.read_config(folder, task)["ppo"], folder)
    for name in ("policy_layers", "value_layers", "activation", "normalize_observations"):
        if getattr(stored, name) != getattr(config, name):
            raise InputError(
                f"--{name.replace('_', '-')} does not go with --resume: the stored parameters have "
                f"{getattr(stored, name)}; leave it out or start a new run."
            )
    step, tree = runs.restore(folder, "last")
    if step >= config.num_timesteps:
        raise InputError(
            f"{folder}: is at step {step:,} already; give a --num-timesteps above that to train for longer."
        )
    return step, ppo.from_tree(tree)


class Session:
    """One stretch of training."""

    interrupted = False
    """Set by a signal handler: the next finished training step is the last."""

    def __init__(
        self,
        run: Run,
        progress: Progress,
        keep_every: int,
        kept_at: int | None,
        validate: Callable[[Params], float] | None = None,
    ) -> None:
        """A checkpoint is kept every `keep_every` control steps, the last at `kept_at` (None: none yet), with the
        validation error that `validate` gives, the smallest being the best; without it the greatest reward is."""
        self._run, self._progress, self._validate = run, progress, validate
        self._every, self._kept_at = keep_every, kept_at
        self._score: float | None = None
        self._last: tuple[int, Params, Mapping[str, float]] | None = None
        self._started = time.perf_counter()

    def train(self, env: Env, config: PPOConfig, restored: Params | None, first_step: int) -> None:
        """Train `env`, from `restored` parameters at `first_step` on where there are any.

        **Raises** `KeyboardInterrupt` after Ctrl-C, the last parameters saved.
        """
        try:
            with self._interrupts_noted():
                ppo.train(env, config, self._step_done, restore=restored, first_step=first_step)
                assert self._last is not None
                if self._last[0] != self._kept_at:
                    self._keep(*self._last)
        except KeyboardInterrupt:
            step = 0
            if self._last is not None:
                step = self._last[0]
                self._run.save(step, ppo.as_tree(self._last[1]), None)
            self._progress.close()
            print(f"Interrupted at step {step:,}.", file=sys.stderr)
            raise
        self._progress.close()

    def _step_done(self, step: int, params: Params, metrics: dict[str, float]) -> None:
        self._last = (step, params, metrics)
        if metrics:
            self._run.log(step, metrics | {"seconds": time.perf_counter() - self._started})
        if self._kept_at is None or step - self._kept_at >= self._every:
            self._keep(step, params, metrics)
        if metrics:
            shown = f"reward {metrics['reward']:.3f}"
            if self._score is not None:
                shown += f", validation error {self._score:.3f}"
            self._progress.update(step, metrics["steps_per_second"], shown)
        if self.interrupted:
            raise KeyboardInterrupt

    def _keep(self, step: int, params: Params, metrics: Mapping[str, float]) -> None:
        self._kept_at = step
        score = -metrics.get("reward", -math.inf)
        if self._validate is not None:
            score = self._score = self._validate(params)
            self._run.log(step, {"validation_error": score})
        self._run.save(step, ppo.as_tree(params), score)

    @contextlib.contextmanager
    def _interrupts_noted(self) -> Iterator[None]:
        """Let the first Ctrl-C end training after its current step; the second interrupts at once, as ever.

        An exception raised wherever Python happens to be can land in a callback of JAX's that swallows it.
        """
        before = signal.getsignal(signal.SIGINT)
        if before != signal.default_int_handler:
            yield  # somebody else's, or ignored in the background of a shell
            return

        def note(*_: Any) -> None:
            if self.interrupted:
                raise KeyboardInterrupt
            self.interrupted = True

        signal.signal(signal.SIGINT, note)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)
