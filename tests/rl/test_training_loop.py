"""The training loop between PPO and the folder of a run: interruption, errors, validation, resuming and warnings."""

import dataclasses
import io
import json
import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest
from brax.training.acme import running_statistics
from brax.training.agents.ppo.losses import PPONetworkParams
from brax.training.types import UInt64
from follower import Follower, weight

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.rl import ppo, training_state
from ballu_mjx.rl.learner import Learner
from ballu_mjx.rl.ppo import Params, PPOConfig
from ballu_mjx.rl.resume_point import ResumePoint, find_resume_point, training_facts
from ballu_mjx.rl.training_loop import TrainingInterrupted, TrainingLoop, Validation
from ballu_mjx.rl.training_state import TrainingState
from ballu_mjx.rl.watchdog import Watchdog
from ballu_mjx.runs.checkpoints import last_checkpoint, list_checkpoints, restore_checkpoint
from ballu_mjx.runs.folder import Run, new_folder, read_config
from ballu_mjx.runs.layout import RUN_FORMAT
from ballu_mjx.runs.metrics import read_metrics
from ballu_mjx.runs.progress import Progress

GOOD = {"reward": 0.1, "diverged": 0.0, "steps_per_second": 100.0, "total_loss": 0.5}


CONFIG = PPOConfig(
    num_timesteps=1000, num_envs=8, batch_size=8, num_minibatches=2, policy_layers=(4,), value_layers=(4,)
)


def state(value: float) -> TrainingState:
    """Return a training state from which no training is resumed."""
    weights = {"w": jnp.full(3, value)}
    array: Any = jnp.full(2, value)
    return TrainingState(
        networks=PPONetworkParams(policy=weights, value=weights),  # pyright: ignore[reportCallIssue]
        averaged=weights,
        averaged_steps=jnp.zeros((), jnp.int32),
        optimizer=array,
        normalizer=running_statistics.init_state({"state": array}),
        environments=array,
        key=jnp.zeros(2, jnp.uint32),
        steps=UInt64(hi=0, lo=0),  # pyright: ignore[reportCallIssue]
    )


def content(config: PPOConfig = CONFIG, **sections: Any) -> dict[str, Any]:
    return {
        "format": RUN_FORMAT,
        "task": "walk",
        "ppo": dataclasses.asdict(config),
        "recordings": {},
        "starts": [],
    } | sections


def open_run(folder: Path) -> Run:
    return Run(folder, content())


def session_in(run: Run, *, greatest: bool = False, stream: io.StringIO | None = None) -> TrainingLoop:
    return TrainingLoop(run, Progress(1000, stream=stream or io.StringIO()), 100, Validation(weight, "error", greatest))


def test_only_one_process_at_a_time_writes_a_run(tmp_path):
    with open_run(tmp_path / "run"), pytest.raises(InputError, match="another process is writing"):
        open_run(tmp_path / "run")
    with open_run(tmp_path / "run"):
        pass


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_training_after_the_step_and_sets_the_exit_status(tmp_path, number):
    before = signal.getsignal(number)
    signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    try:
        with open_run(tmp_path / "run") as run:
            session = session_in(run)
            with session._interrupts_noted():
                session._step_done(100, state(1.0), GOOD)
                os.kill(os.getpid(), number)
                with pytest.raises(KeyboardInterrupt):
                    session._step_done(120, state(2.0), GOOD)
        assert session.exit_status == 128 + number
        stopped = last_checkpoint(tmp_path / "run", training=True)
        assert (stopped.step, stopped.notes["due"]) == (120, 100) and stopped.training is not None
        assert restore_checkpoint(tmp_path / "run", "best")[0] == 100, "the last checkpoint has no validation"
        assert signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL), "handler not restored"
    finally:
        signal.signal(number, before)


def test_a_signal_during_the_last_validation_is_obeyed(tmp_path, monkeypatch):
    monkeypatch.setattr(signal, "default_int_handler", signal.getsignal(signal.SIGINT))
    measured = []

    def measure(params: Params) -> float:
        measured.append(weight(params))
        if len(measured) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return measured[-1]

    with Run(tmp_path / "run", content()) as run:
        loop = TrainingLoop(run, None, 10_000, Validation(measure))
        with pytest.raises(TrainingInterrupted) as stopped:
            loop.train(Follower(), CONFIG, ResumePoint(), content())
    assert stopped.value.step == last_checkpoint(tmp_path / "run").step >= CONFIG.num_timesteps
    assert len(measured) == 2


def test_a_training_runs_in_any_thread(tmp_path):
    """Python refuses signal handlers outside of its main thread."""
    with Run(tmp_path / "run", content()) as run:
        loop = TrainingLoop(run, None, 10_000, Validation(weight))
        with ThreadPoolExecutor(1) as pool:
            pool.submit(loop.train, Follower(), CONFIG, ResumePoint(), content()).result()
    assert last_checkpoint(tmp_path / "run").step >= CONFIG.num_timesteps


def test_training_stops_at_a_loss_of_nan_and_keeps_the_last_good_checkpoint(tmp_path):
    with open_run(tmp_path / "run") as run:
        session = session_in(run)
        session._step_done(100, state(1.0), GOOD)
        with pytest.raises(
            InputError, match="total_loss is no longer finite. The last good checkpoint is that of step 100"
        ):
            session._step_done(200, state(np.nan), GOOD | {"total_loss": float("nan")})
    step, tree = restore_checkpoint(tmp_path / "run", "last")
    assert step == 100 and np.all(tree["policy"]["w"] == 1.0)
    assert {row["step"] for row in read_metrics(tmp_path / "run")} == {100}


def test_divergence_above_a_thousandth_gives_one_warning(tmp_path):
    stream = io.StringIO()
    with open_run(tmp_path / "run") as run:
        session = session_in(run, stream=stream)
        for step, share in ((100, 0.0005), (200, 0.02), (300, 0.03)):
            session._step_done(step, state(1.0), GOOD | {"diverged": share})
    error = stream.getvalue()
    assert error.count("Physics diverged") == 1 and "2.00%" in error


@pytest.mark.parametrize(("greatest", "best"), [(False, 300), (True, 100)])
def test_validation_selects_the_best_checkpoint_independent_of_the_reward(tmp_path: Path, greatest: bool, best: int):
    measured = {100: 3.0, 200: 2.0, 300: 1.0}
    with open_run(tmp_path / "run") as run:
        session = session_in(run, greatest=greatest)
        session._step_done(0, state(2.5), {})
        for step, reward in ((100, 0.1), (200, 0.3), (300, 0.2)):
            session._step_done(step, state(measured[step]), GOOD | {"reward": reward})
    assert restore_checkpoint(tmp_path / "run", "best")[0] == best
    assert [row["error"] for row in read_metrics(tmp_path / "run") if "error" in row] == [2.5, *measured.values()]


def test_progress_names_the_step_of_the_validation_that_it_shows(tmp_path: Path):
    stream = io.StringIO()
    with open_run(tmp_path / "run") as run:
        session = session_in(run, stream=stream)
        session._step_done(0, state(2.5), {})
        session._step_done(50, state(1.0), GOOD)  # between two validations
    assert stream.getvalue().rstrip().endswith("error 2.500 (step 0)")


def test_validation_after_the_last_step_is_shown(tmp_path: Path):
    stream, run_folder = io.StringIO(), tmp_path / "run"
    with Run(run_folder, content()) as run:
        loop = TrainingLoop(run, Progress(1000, stream=stream), 10_000, Validation(weight, "error"))
        loop.train(Follower(), CONFIG, ResumePoint(), content())
    last = [row for row in read_metrics(run_folder) if "error" in row][-1]
    assert f"At the end: error {last['error']:.3f} (step {last['step']:,})." in stream.getvalue()


@pytest.fixture(scope="module")
def small() -> Learner:
    return Learner(Follower(), CONFIG)


def saved(folder: Path, state: TrainingState, config: dict[str, Any], step: int = 160) -> Path:
    with Run(folder, config) as run:
        tree, training = ppo.as_tree(training_state.params(state)), training_state.stored(state)
        run.save(step, tree, -1.0, training=training, notes=training_facts(config))
    return folder


def resumed(folder: Path, config: PPOConfig) -> ResumePoint:
    return find_resume_point("walk", folder, config, output=None, quick=False)


def test_a_resumed_run_restores_its_whole_state(tmp_path, small):
    before = small.init(5)
    start = resumed(saved(tmp_path / "run", before, content(env={"friction": (1.0, 2.0)})), CONFIG)
    messages: list[str] = []
    again = start.state(small, CONFIG, training_facts(content(env={"friction": [1.0, 2.0]})), messages.append)
    for name, value in training_state.stored(before).items():
        np.testing.assert_array_equal(training_state.stored(again)[name], value)
    assert start.step == 160 and start.notice is None and messages == []


@pytest.mark.parametrize(
    ("ppo_change", "sections"),
    [({"seed": 1}, {}), ({}, {"env": {"friction": 2}}), ({}, {"recordings": {"training": [{"sha256": "1"}]}})],
)
def test_changed_options_reset_the_environments_of_a_resumed_run(tmp_path, small, ppo_change, sections):
    before = small.init(5)
    start = resumed(saved(tmp_path / "run", before, content()), CONFIG)
    changed = dataclasses.replace(CONFIG, learning_rate=0.5, **ppo_change)
    messages: list[str] = []
    again = training_state.stored(
        start.state(small, changed, training_facts(content(changed, **sections)), messages.append)
    )
    (message,) = messages
    assert "options have changed; the environments are reset, the optimizer continues" in message
    stored = training_state.stored(before)
    assert np.array_equal(again["optimizer.1.count"], stored["optimizer.1.count"])
    assert again["optimizer.1.hyperparams.learning_rate"] == 0.5
    goal = "environments.pipeline_state.goal"
    assert again[goal].shape == stored[goal].shape and not np.array_equal(again[goal], stored[goal])


def test_the_best_checkpoint_of_a_resumed_run_was_scored_with_its_options(tmp_path):
    folder, params = tmp_path / "run", {"weight": np.zeros(1)}
    later = {20: 0.9, 30: 0.8, 40: 0.88, 50: 0.87, 60: 0.89}
    for options, scores in (({"force_scale": 0.05}, {0: 0.5, 10: 0.6}), ({"force_scale": 0.5}, later)):
        config = content(env=options)
        with Run(folder, config, resumed_at=10 if 20 in scores else None) as run:
            for step, score in scores.items():
                run.save(step, params, score, notes=training_facts(config))
            assert run.best()[0] == min(scores, key=lambda step: scores[step])


@pytest.mark.parametrize("interrupted", [15, 25, 35])
def test_an_interrupted_run_keeps_the_checkpoints_of_an_uninterrupted_one(tmp_path: Path, interrupted: int):
    """The checkpoint of the interruption has no score. `train all` replays the last checkpoints on the robot."""
    folder, params, scores = tmp_path / "run", {"weight": np.zeros(1)}, {10: 0.5, 20: 0.6, 30: 0.9, 40: 0.8}
    for resumed_at in (None, interrupted):
        with Run(folder, content(), resumed_at=resumed_at) as run:
            for step, score in scores.items():
                if (step > interrupted) == (resumed_at is not None):
                    run.save(step, params, score)
            if resumed_at is None:
                run.save(interrupted, params, None)
                assert last_checkpoint(folder).step == interrupted
    assert list_checkpoints(folder) == [10, 20, 30, 40]


def test_the_score_of_an_interruption_s_checkpoint_can_be_added(tmp_path: Path):
    with Run(tmp_path / "run", content()) as run:
        run.save(10, {"weight": np.zeros(1)}, 0.5)
        run.save(20, {"weight": np.ones(1)}, None)
        assert run.best()[0] == 10
        run.save(20, {"weight": np.ones(1)}, 0.4)
        assert run.best()[0] == 20


def test_a_run_of_an_older_version_resumes_from_its_parameters(tmp_path, small):
    before = small.init(5)
    folder = tmp_path / "run"
    params = training_state.params(before)
    with Run(folder, content()):
        pass
    options = ocp.CheckpointManagerOptions(enable_async_checkpointing=False)
    with ocp.CheckpointManager((folder / "checkpoints").resolve(), options=options) as manager:
        manager.save(160, args=ocp.args.StandardSave(ppo.as_tree(params)))
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"format": "ballu-run/1"}))
    start = resumed(folder, CONFIG)
    messages: list[str] = []
    again = training_state.params(start.state(small, CONFIG, training_facts(content()), messages.append))
    assert "an older version saved only the parameters" in messages[0]
    assert start.step == 160
    for name, value in training_state.stored(before).items():
        if name.startswith("networks"):
            np.testing.assert_array_equal(
                training_state.stored(start.state(small, CONFIG, training_facts(content()), messages.append))[name],
                value,
            )
    np.testing.assert_array_equal(again.normalizer.mean["state"], params.normalizer.mean["state"])
    with Run(folder, content(), resumed_at=160) as run:
        assert list_checkpoints(folder) == [160]
        run.save(240, ppo.as_tree(params), None)
    assert last_checkpoint(folder).step == 240


def test_elapsed_seconds_continue_in_a_resumed_run(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with Run(folder, content()) as run:
        TrainingLoop(run, None, 10_000, Validation(weight)).train(Follower(), CONFIG, ResumePoint(), content())
    first = [row["seconds"] for row in read_metrics(folder) if "seconds" in row]
    longer = dataclasses.replace(CONFIG, num_timesteps=2000)
    start = resumed(folder, longer)
    with Run(folder, content(longer), resumed_at=start.resumed_at) as run:
        TrainingLoop(run, None, 10_000, Validation(weight)).train(Follower(), longer, start, content(longer))
    seconds = [row["seconds"] for row in read_metrics(folder) if "seconds" in row]
    assert len(seconds) > len(first) and seconds[: len(first)] == first
    assert seconds == sorted(seconds)


def test_a_run_without_a_checkpoint_restarts_in_its_folder(tmp_path):
    folder = tmp_path / "run"
    with open_run(folder) as run:
        run.log(0, {"validation_error": 1.0})
    start = resumed(folder, CONFIG)
    assert start.notice is not None and "starting from the beginning" in start.notice
    with Run(folder, content(), resumed_at=start.resumed_at):
        assert read_metrics(folder) == [], "metrics should be empty"


def test_a_trained_run_can_be_resumed_only_while_its_results_are_missing(tmp_path, small):
    folder = saved(tmp_path / "run", small.init(5), content(), step=1120)
    assert resumed(folder, CONFIG).step == 1120
    (folder / "replay.npz").write_bytes(b"")
    with pytest.raises(InputError, match="already"):
        resumed(folder, CONFIG)


def test_a_longer_training_does_not_keep_the_results_of_the_shorter_one(tmp_path, small):
    """If it is stopped between its last checkpoint and its results, they could never be written otherwise."""
    folder = saved(tmp_path / "run", small.init(5), content(), step=1120)
    for name in ("replay.npz", "evaluation.json", "evaluation.txt"):
        (folder / name).write_bytes(b"")
    longer = dataclasses.replace(CONFIG, num_timesteps=2240)
    state = small.init(5)
    with Run(folder, content(longer), resumed_at=resumed(folder, longer).resumed_at) as run:
        tree, training = ppo.as_tree(training_state.params(state)), training_state.stored(state)
        run.save(2240, tree, -1.0, training=training, notes=training_facts(content(longer)))
    assert not list(folder.glob("evaluation.*"))
    assert resumed(folder, longer).step == 2240


def test_a_resumed_run_keeps_its_mark_of_a_quick_run(tmp_path):
    quick = content() | {"data": {"quick": True, "preset": "paper"}}
    with Run(tmp_path / "run", quick):
        pass
    with Run(tmp_path / "run", content() | {"data": {"quick": False, "preset": None}}, resumed_at=-1):
        pass
    assert read_config(tmp_path / "run", "walk")["data"] == {"quick": True, "preset": "paper"}


@pytest.mark.parametrize("change", [{"initial_std": 3.0}, {"orthogonal_init": True}])
def test_options_of_new_networks_are_refused_with_resume(tmp_path, small, change):
    folder = saved(tmp_path / "run", small.init(5), content())
    with pytest.raises(InputError, match="does not go with --resume"):
        resumed(folder, dataclasses.replace(CONFIG, **change))


def test_a_constant_learning_rate_is_that_of_the_options_after_an_adaptive_one(tmp_path, small):
    state = small.init(5)
    stored = training_state.with_learning_rate(training_state.stored(state), 0.125)
    adapted = small.resume(stored)[0]
    start = resumed(saved(tmp_path / "run", adapted, content()), CONFIG)
    for kl, rate in ((0.02, 0.125), (0.0, CONFIG.learning_rate)):
        config = dataclasses.replace(CONFIG, desired_kl=kl)
        again = training_state.stored(start.state(small, config, training_facts(content(config)), print))
        assert again["optimizer.1.hyperparams.learning_rate"] == pytest.approx(rate)


def test_watchdog_warns_once_per_standstill_and_differently_for_compilation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "compiled/here")
    messages: list[str] = []
    watchdog = Watchdog(Path("runs/walk"), messages.append, limit=300.0)

    def messages_at(moment: float) -> list[str]:
        watchdog.look(moment)
        return list(messages)

    watchdog.step_done(None)
    assert not messages_at(1299.0)
    (compiling,) = messages_at(1300.0)
    assert "a first compilation takes" in compiling and "--num-envs" in compiling
    assert compiling.endswith("the cache of compiled programs, compiled/here.")
    assert len(messages_at(1900.0)) == 1, "warned twice"
    for step in range(20, 120, 20):  # progress for longer than the limit
        now[0] += 200.0
        watchdog.step_done(step)
        assert len(messages_at(now[0] + 199.0)) == 1
    _, standing = messages_at(now[0] + 300.0)
    assert "since step 100" in standing and "--resume runs/walk" in standing
    assert watchdog.look(now[0] + 100.0) == 200.0, "the next check would be too late"


def eventually(condition: Callable[[], bool]) -> bool:
    """Return whether a condition holds within a minute. On a busy machine, threads may wait for long."""
    end = time.monotonic() + 60.0
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()


def watchdogs() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "watchdog"]


def test_watchdog_runs_until_training_ends(tmp_path: Path) -> None:
    messages: list[str] = []
    with Watchdog(tmp_path, messages.append, limit=0.01):
        assert eventually(lambda: "No training step has finished" in "".join(messages))
    with open_run(tmp_path / "run") as run:
        session = session_in(run)
        assert session._watchdog._limit == 300.0
        with session._watchdog:
            assert all(thread.daemon for thread in watchdogs()) and watchdogs()
        assert eventually(lambda: not watchdogs()), "the watchdog is still running"


def test_a_folder_without_write_access_is_refused_before_training(tmp_path):
    (tmp_path / "file").write_text("")
    places = [tmp_path / "file" / "run"]
    if Path("/proc").is_dir():
        places.append(Path("/proc/run"))  # read-only for root too
    if os.geteuid():
        (tmp_path / "locked").mkdir(mode=0o555)
        places.append(tmp_path / "locked" / "run")
    for place in places:
        with pytest.raises(InputError, match="cannot be written to .*; fix its permissions, or give another folder"):
            files.check_folder(place)
        with pytest.raises(InputError, match="cannot be written to"):
            new_folder(place, "walk")
    files.check_folder(tmp_path / "new" / "run")
    left = {path.name for path in tmp_path.iterdir()} - {"locked"}
    assert left == {"file"}, "the check left files behind"
