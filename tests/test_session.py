"""Between PPO and the run's folder: what interrupts, breaks or doubles a training."""

import io
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from ballu_mjx import ppo, runs
from ballu_mjx.errors import InputError
from ballu_mjx.runs import Progress, Run
from ballu_mjx.session import Session

GOOD = {"reward": 0.1, "diverged": 0.0, "steps_per_second": 100.0, "total_loss": 0.5}


def params(value: float) -> ppo.Params:
    moments = ({"state": np.full(2, value, np.float32)},) * 3
    weights = {"w": np.full(3, value, np.float32)}
    return ppo.Params(ppo.Normalizer(np.float32(1) * np.ones(()), *moments), weights, weights)


def open_run(folder: Path) -> Run:
    return Run(folder, {"format": runs.FORMAT, "task": "walk", "starts": []})


def session_in(run: Run, **options) -> Session:
    return Session(run, Progress(1000, stream=io.StringIO()), keep_every=100, kept_at=None, **options)


def test_a_run_is_written_by_one_process_at_a_time(tmp_path):
    with open_run(tmp_path / "run"), pytest.raises(InputError, match="another process is writing"):
        open_run(tmp_path / "run")
    with open_run(tmp_path / "run"):
        pass


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_training_after_the_step_and_is_told_to_the_shell(tmp_path, number):
    before = signal.getsignal(number)
    signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    try:
        with open_run(tmp_path / "run") as run:
            session = session_in(run)
            with session._interrupts_noted():
                session._step_done(100, params(1.0), GOOD)
                os.kill(os.getpid(), number)
                with pytest.raises(KeyboardInterrupt):
                    session._step_done(120, params(2.0), GOOD)
        assert session.exit_status == 128 + number
        assert signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL), "given back"
    finally:
        signal.signal(number, before)


def test_a_loss_that_is_no_number_ends_training_with_the_last_good_checkpoint(tmp_path):
    with open_run(tmp_path / "run") as run:
        session = session_in(run)
        session._step_done(100, params(1.0), GOOD)
        with pytest.raises(
            InputError, match="total_loss is not a number any more. The last good checkpoint is that of step 100"
        ):
            session._step_done(200, params(np.nan), GOOD | {"total_loss": float("nan")})
    step, tree = runs.restore(tmp_path / "run", "last")
    assert step == 100 and np.all(tree["policy"]["w"] == 1.0)
    assert [row["step"] for row in runs.read_metrics(tmp_path / "run")] == [100]


def test_diverging_physics_is_told_once_and_only_above_a_thousandth(tmp_path, capsys):
    with open_run(tmp_path / "run") as run:
        session = session_in(run)
        for step, share in ((100, 0.0005), (200, 0.02), (300, 0.03)):
            session._step_done(step, params(1.0), GOOD | {"diverged": share})
    error = capsys.readouterr().err
    assert error.count("Physics diverged") == 1 and "2.00%" in error


def test_without_validation_the_greatest_reward_is_the_best_checkpoint(tmp_path):
    with open_run(tmp_path / "run") as run:
        session = session_in(run)
        session._step_done(0, params(0.0), {})
        for step, reward in ((100, 0.1), (200, 0.3), (300, 0.2)):
            session._step_done(step, params(step), GOOD | {"reward": reward})
    assert runs.restore(tmp_path / "run", "best")[0] == 200
    assert runs.restore(tmp_path / "run", "last")[0] == 300
