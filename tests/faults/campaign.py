"""Kill trainings at random moments and damage what they saved, again and again, and count what survives.

    python tests/faults/campaign.py --kills 20 --damages 20

The training is a small one without physics, through the run folders and sessions that every training uses. After each
fault the run is resumed; at the end its parameters and measurements are held against those of a training that nobody
disturbed.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import json
import multiprocessing.forkserver
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ballu_mjx import runtime

_HERE = Path(__file__).resolve().parent
TASK = "walk"
STEP = 2 * 8 * 5
"""Control steps of a training step."""
STEPS = 60
"""Training steps of the whole training."""
EVERY = 5
"""Training steps between two checkpoints."""
TIMINGS = ("seconds", "steps_per_second")
"""Measurements that no two trainings share."""


def train(folder: Path) -> None:
    """Begin the training in `folder`, or go on with it, to its end."""
    from follower import Follower

    from ballu_mjx import learner, runs
    from ballu_mjx.ppo import PPOConfig
    from ballu_mjx.session import Session, start_from

    config = PPOConfig(
        num_timesteps=STEPS * STEP,
        num_envs=8,
        batch_size=8,
        num_minibatches=2,
        unroll_length=5,
        num_updates_per_batch=1,
        policy_layers=(8,),
        value_layers=(8,),
        averaging=4,
    )
    begun = (folder / "config.json").exists()
    start = start_from(TASK, folder if begun else None, config, output=None, quick=False)
    content = runs.describe(TASK, {"ppo": config}, {}, [])
    with runs.Run(folder, content, resumed_at=start.resumed_at) as run:
        progress = runs.Progress(learner.total_timesteps(config), start.step, stream=io.StringIO())
        Session(run, progress, EVERY * STEP).train(Follower(), config, start, content)


def quietly(folder: Path, told: Path) -> None:
    """`train`, with what it says in the file `told`."""
    with told.open("a") as stream, contextlib.redirect_stdout(stream), contextlib.redirect_stderr(stream):
        train(folder)


@dataclasses.dataclass
class Trainer:
    """Starts trainings, each in a process of its own."""

    work: Path

    def __post_init__(self) -> None:
        # Forked from a process that has imported everything, with what was compiled before, one starts in a second.
        self._processes = multiprocessing.get_context("forkserver")
        self._processes.set_forkserver_preload(["ready"])
        places = [str(_HERE), str(_HERE.parent), os.environ.get("PYTHONPATH", "")]
        settings = {
            "PYTHONPATH": os.pathsep.join(filter(None, places)),
            "JAX_COMPILATION_CACHE_DIR": str(self.work / "cache"),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        before = {name: os.environ.get(name) for name in settings}
        os.environ.update(settings)
        multiprocessing.forkserver.ensure_running()
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        self.told = self.work / "told.txt"
        self.told.touch()

    def start(self, folder: Path) -> Any:
        process = self._processes.Process(target=quietly, args=(folder, self.told))
        process.start()
        return process

    def finish(self, folder: Path) -> None:
        """Train to the end; raises `RuntimeError` where that fails."""
        process = self.start(folder)
        process.join()
        if process.exitcode:
            raise RuntimeError(f"The training ended with {process.exitcode}:\n{self.told.read_text()}")

    def kill(self, folder: Path, steps: int, delay: float) -> bool:
        """Start training, and kill it `delay` seconds after it has measured `steps` training steps, or after the
        process began where these are 0; returns whether it was still at it."""
        process = self.start(folder)
        path = folder / "metrics.jsonl"
        old = path.stat().st_ino if path.exists() else None
        first: int | None = None  # lines that are kept: the file is a new one then
        while steps and process.is_alive():
            if path.exists() and path.stat().st_ino != old:
                lines = path.read_bytes().count(b"\n")
                first = lines if first is None else first
                if lines >= first + steps:
                    break
            time.sleep(0.002)
        process.join(delay)
        alive = process.is_alive()
        process.kill()
        process.join()
        return alive


@contextlib.contextmanager
def trainer() -> Iterator[Trainer]:
    """A `Trainer` with a folder that is removed after it."""
    with tempfile.TemporaryDirectory() as work:
        yield Trainer(Path(work))


def outcome(folder: Path) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """Measurements but for the timings, and all of the last state. Raises on a torn line."""
    from ballu_mjx import runs

    text = (folder / "metrics.jsonl").read_text()
    rows = [json.loads(line) for line in text.splitlines()]
    last = runs.last_checkpoint(folder, training=True)
    assert text.endswith("\n") and last.training is not None
    return [{name: value for name, value in row.items() if name not in TIMINGS} for row in rows], last.training


def same(first: Path, second: Path) -> bool:
    """Whether two trainings measured and learned the same, to the last bit."""
    (rows, state), (other_rows, other_state) = outcome(first), outcome(second)
    return (
        rows == other_rows
        and state.keys() == other_state.keys()
        and all(np.array_equal(state[name], other_state[name]) for name in state)
    )


def damage(path: Path, random: np.random.Generator) -> str:
    """Cut a file off or turn one of its bits; returns what was done."""
    content = bytearray(path.read_bytes())
    if not content or random.random() < 0.5:
        path.write_bytes(content[: random.integers(0, len(content) + 1)] if content else b"?")
        return "truncated"
    content[random.integers(len(content))] ^= 1 << int(random.integers(8))
    path.write_bytes(content)
    return "bit flipped"


def checkpoint_files(folder: Path) -> list[Path]:
    """The files of a run's last checkpoint."""
    from ballu_mjx import runs

    last = folder / "checkpoints" / str(runs.checkpoints(folder)[-1])
    return sorted(path for path in last.rglob("*") if path.is_file())


def kills(at: Trainer, reference: Path, folder: Path, count: int, random: np.random.Generator) -> tuple[int, bool]:
    """Kill a training `count` times, then let it end; returns how many kills met it alive, and whether it ended as
    `reference` did."""
    met = 0
    for _ in range(count):
        if random.random() < 0.2:
            met += at.kill(folder, 0, random.uniform(0.0, 3.0))
        else:
            met += at.kill(folder, int(random.integers(1, 20)), random.uniform(0.0, 0.2))
    at.finish(folder)
    return met, same(folder, reference)


def damaged(at: Trainer, reference: Path, folder: Path, random: np.random.Generator) -> tuple[str, bool]:
    """Copy a training that was killed to `folder`, damage its last checkpoint, let it end; returns what was done."""
    shutil.copytree(reference.parent / "killed", folder)
    done = damage(random.choice(np.array(checkpoint_files(folder))), random)
    at.finish(folder)
    return done, same(folder, reference)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20, help="trainings killed (SIGKILL)")
    parser.add_argument("--damages", type=int, default=20, help="checkpoints cut off, or with one bit turned")
    parser.add_argument("--seed", type=int, default=0, help="of the moments and places")
    options = parser.parse_args()
    runtime.prepare()
    random = np.random.default_rng(options.seed)
    table: dict[str, list[int]] = {}

    def count(fault: str, faults: int, survived: int) -> None:
        row = table.setdefault(fault, [0, 0])
        row[0] += faults
        row[1] += survived
        print(f"{fault}: {'survived' if survived else 'LOST'}", file=sys.stderr)

    def tried(make: Callable[[], tuple[Any, bool]]) -> tuple[Any, bool]:
        try:
            return make()
        except (RuntimeError, AssertionError, ValueError) as error:
            print(error, file=sys.stderr)
            return None, False

    with trainer() as at:
        reference = at.work / "undisturbed"
        at.finish(reference)
        remaining, run = options.kills, 0
        while remaining > 0:
            folder, share = at.work / f"killed-{run}", min(remaining, 5)
            met, survived = tried(lambda folder=folder, share=share: kills(at, reference, folder, share, random))
            met = share if met is None else met
            count("killed", met, met * survived)
            remaining, run = remaining - max(met, 1), run + 1
        if options.damages:
            at.kill(at.work / "killed", STEPS // 2, 0.0)
        for number in range(options.damages):
            folder = at.work / f"damaged-{number}"
            what, survived = tried(lambda folder=folder: damaged(at, reference, folder, random))
            count(f"checkpoint {what or 'damaged'}", 1, int(survived))
    print("| fault | injected | survived | lost |\n| --- | --- | --- | --- |")
    for fault, (faults, survived) in sorted(table.items()):
        print(f"| {fault} | {faults} | {survived} | {faults - survived} |")
    return int(any(faults != survived for faults, survived in table.values()))


if __name__ == "__main__":
    sys.exit(main())
