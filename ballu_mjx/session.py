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

_DIVERGED = 1e-3
"""Share of control steps in which physics may break down before the user is told."""


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

    interrupted: int | None = None
    """The signal that came, set by its handler: the next finished training step is the last."""

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
        self._warned = False
        self._started = time.perf_counter()

    def train(self, env: Env, config: PPOConfig, restored: Params | None, first_step: int) -> None:
        """Train `env`, from `restored` parameters at `first_step` on where there are any.

        **Raises** `KeyboardInterrupt` after SIGINT (Ctrl-C) or SIGTERM, the last parameters saved, and `InputError`
        where learning broke down, with the last good checkpoint named.
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

    @property
    def exit_status(self) -> int:
        """A shell's for the signal that ended the training."""
        return 128 + (self.interrupted or signal.SIGINT)

    def _step_done(self, step: int, params: Params, metrics: dict[str, float]) -> None:
        if not all(math.isfinite(value) for value in metrics.values()):
            self._progress.close()
            broken = ", ".join(name for name, value in metrics.items() if not math.isfinite(value))
            raise InputError(
                f"Learning broke down before step {step:,}: {broken} is not a number any more. The last good "
                f"checkpoint is that of step {self._kept_at:,}; go on from it with --resume and a smaller "
                "--learning-rate, or look for recordings or options that throw the robot about."
            )
        if metrics.get("diverged", 0.0) > _DIVERGED and not self._warned:
            self._warned = True
            print(
                f"Physics diverged in {metrics['diverged']:.2%} of the control steps (these robots were reset); the "
                "forces or starting states are too violent for the simulator's time step.",
                file=sys.stderr,
            )
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
