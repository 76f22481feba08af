"""Kill trainings at random times, damage their checkpoints, fill their disk, and count how many trainings survive.

    python tests/faults/campaign.py --kills 20 --damages 20 --swaps 10 --full 10 --twice 5

The training is small and without physics, but uses the same run folders and training loop as every training. After each
fault the run is resumed. At the end, its parameters and measurements are compared with those of an undisturbed
training. The full disk is a small one in memory. Without the right to mount it (root's), this fault is left out.
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
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ballu_mjx.common import runtime

_HERE = Path(__file__).resolve().parent
TASK = "walk"
STEP = 2 * 8 * 5
"""Control steps per training step."""
STEPS = 60
"""Number of training steps of the training."""
EVERY = 5
"""Number of training steps between two checkpoints."""
DISK = 32 * 2**20
"""Size of the disk that is filled (bytes)."""
TIMINGS = ("seconds", "steps_per_second", "validation_seconds")
"""Measurements that differ between identical trainings."""


def train(folder: Path) -> None:
    """Start or resume the training in `folder`, and finish it."""
    from follower import Follower, weight

    from ballu_mjx.residuals.run_config import describe_run
    from ballu_mjx.rl import learner
    from ballu_mjx.rl.ppo import PPOConfig
    from ballu_mjx.rl.resume_point import find_resume_point
    from ballu_mjx.rl.training_loop import TrainingLoop, Validation
    from ballu_mjx.runs.folder import Run
    from ballu_mjx.runs.progress import Progress

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
    start = find_resume_point(TASK, folder if begun else None, config, output=None, quick=False)
    content = describe_run(TASK, {"ppo": config}, {}, [])
    with Run(folder, content, resumed_at=start.resumed_at) as run:
        progress = Progress(learner.total_timesteps(config), start.step, stream=io.StringIO())
        TrainingLoop(run, progress, EVERY * STEP, Validation(weight)).train(Follower(), config, start, content)


def quietly(folder: Path, told: Path) -> None:
    """Run `train` as a command does, write its output to the file `told`, and end the process with its exit status."""
    # Never restored, because threads that the command has silenced would otherwise print at the end of the process.
    sys.stdout = sys.stderr = told.open("a")
    sys.exit(runtime.exit_status(lambda: train(folder), []))


@dataclasses.dataclass
class Trainer:
    """Starter of trainings, each in its own process."""

    work: Path

    def __post_init__(self) -> None:
        # A process starts in a second if it is forked after all imports, and finds compiled programs in the cache.
        self._processes = multiprocessing.get_context("forkserver")
        self._processes.set_forkserver_preload(["ready"])
        paths = [str(_HERE), str(_HERE.parent), os.environ.get("PYTHONPATH", "")]
        settings = {
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
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
        """Start or resume the training, and wait for its end. **Raises** `RuntimeError` if it fails."""
        process = self.start(folder)
        process.join()
        if process.exitcode:
            raise RuntimeError(f"The training ended with {process.exitcode}:\n{self.told.read_text()}")

    def started(self, folder: Path, steps: int) -> Any:
        """Start training, and return the process after it has logged `steps` training steps or has ended."""
        path = folder / "metrics.jsonl"
        old = path.stat().st_ino if path.exists() else None
        process = self.start(folder)
        first: int | None = None  # number of lines kept at the start of a resumed training, which writes a new file
        while steps and process.is_alive():
            if path.exists() and path.stat().st_ino != old:
                lines = path.read_bytes().count(b"\n")
                first = lines if first is None else first
                if lines >= first + steps:
                    break
            time.sleep(0.002)
        return process

    def kill(self, folder: Path, steps: int, delay: float) -> bool:
        """Start training, and kill it. Return whether it was still running.

        **Arguments**

        - `steps`: number of training steps to wait for. 0 for none.
        - `delay`: time (s) to wait after these steps, or after the start of the process.
        """
        process = self.started(folder, steps)
        process.join(delay)
        alive = process.is_alive()
        process.kill()
        process.join()
        return alive


@contextlib.contextmanager
def trainer() -> Iterator[Trainer]:
    """Yield a `Trainer` with a temporary folder."""
    with tempfile.TemporaryDirectory() as work:
        yield Trainer(Path(work))


def outcome(folder: Path) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """Return the measurements without timings, and the whole last training state. An incomplete line is an error."""
    from ballu_mjx.runs.checkpoints import last_checkpoint

    text = (folder / "metrics.jsonl").read_text()
    rows = [json.loads(line) for line in text.splitlines()]
    last = last_checkpoint(folder, training=True)
    assert text.endswith("\n") and last.training is not None
    return [{name: value for name, value in row.items() if name not in TIMINGS} for row in rows], last.training


def same(first: Path, second: Path) -> bool:
    """Return whether measurements and training states of two trainings are equal to the bit."""
    (rows, state), (other_rows, other_state) = outcome(first), outcome(second)
    return (
        rows == other_rows
        and state.keys() == other_state.keys()
        and all(np.array_equal(state[name], other_state[name]) for name in state)
    )


def damage(path: Path, random: np.random.Generator) -> str:
    """Truncate a file or flip one of its bits. Return a description of the damage."""
    content = bytearray(path.read_bytes())
    if not content or random.random() < 0.5:
        path.write_bytes(content[: random.integers(0, len(content) + 1)] if content else b"?")
        return "truncated"
    content[random.integers(len(content))] ^= 1 << int(random.integers(8))
    path.write_bytes(content)
    return "bit flipped"


def checkpoint_files(folder: Path) -> list[Path]:
    """Return the files of a run's last checkpoint."""
    from ballu_mjx.runs.checkpoints import list_checkpoints

    last = folder / "checkpoints" / str(list_checkpoints(folder)[-1])
    return sorted(path for path in last.rglob("*") if path.is_file())


def kills(at: Trainer, reference: Path, folder: Path, count: int, random: np.random.Generator) -> tuple[int, bool]:
    """Kill a training `count` times, then finish it.

    **Returns** the number of kills while it was running, and whether its result equals that of `reference`.
    """
    met = 0
    for _ in range(count):
        if random.random() < 0.2:
            met += at.kill(folder, 0, random.uniform(0.0, 3.0))
        else:
            met += at.kill(folder, int(random.integers(1, 20)), random.uniform(0.0, 0.2))
    at.finish(folder)
    return met, same(folder, reference)


def damaged(at: Trainer, reference: Path, folder: Path, random: np.random.Generator) -> tuple[str, bool]:
    """Copy a killed training to `folder`, damage its last checkpoint, and finish it.

    **Returns** a description of the damage, and whether the result equals that of `reference`.
    """
    shutil.copytree(reference.parent / "killed", folder)
    done = damage(random.choice(np.array(checkpoint_files(folder))), random)
    at.finish(folder)
    return done, same(folder, reference)


def swapped(at: Trainer, reference: Path, folder: Path, random: np.random.Generator) -> tuple[str, bool]:
    """Copy a killed training to `folder`, exchange its last two checkpoints or one file of them, and finish it.

    **Returns** a description of the exchange, and whether the result equals that of `reference`.
    """
    from ballu_mjx.runs.checkpoints import list_checkpoints

    shutil.copytree(reference.parent / "killed", folder)
    one, other = (folder / "checkpoints" / str(step) for step in list_checkpoints(folder)[-2:])
    what = "swapped whole"
    if random.random() < 0.7:
        what = "file swapped"
        files = [path.relative_to(other) for path in checkpoint_files(folder)]
        # The names of data files differ between checkpoints.
        name = random.choice(np.array([str(path) for path in files if (one / path).exists()]))
        one, other = one / name, other / name
    aside = folder / "aside"
    one.rename(aside)
    other.rename(one)
    aside.rename(other)
    at.finish(folder)
    return what, same(folder, reference)


@contextlib.contextmanager
def small_disk(work: Path, size: int) -> Iterator[Path | None]:
    """Yield the path of a disk in memory of `size` bytes. None if this process may not mount one."""
    place = work / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    try:
        mounted = sys.platform == "linux" and not subprocess.run(command, capture_output=True, check=False).returncode
    except OSError:
        mounted = False
    try:
        yield place if mounted else None
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(place)], check=True)
        place.rmdir()


def fill(place: Path, free: int) -> Path:
    """Fill a disk except for about `free` bytes. Return the file that fills it."""
    ballast = place / "ballast"
    with ballast.open("wb", buffering=0) as file:
        with contextlib.suppress(OSError):
            while True:
                file.write(bytes(4096))
        file.truncate(max(ballast.stat().st_size - free, 0))
    return ballast


def full_disk(at: Trainer, reference: Path, disk: Path, steps: int, free: int) -> bool:
    """Fill the disk of a training after `steps` training steps, except for `free` bytes. Then make room and finish it.

    **Returns** whether the result equals that of `reference`.

    **Raises** `RuntimeError` if the training does not stop, does not report the full disk in one sentence, or leaves no
    intact checkpoint.
    """
    from ballu_mjx.runs.checkpoints import last_checkpoint

    folder = disk / "run"
    process = at.started(folder, steps)
    before = len(at.told.read_text())
    ballast = fill(disk, free)
    process.join(60)
    if process.is_alive():
        process.kill()
        raise RuntimeError("The training did not end within 60 s on a full disk.")
    printed = at.told.read_text()[before:].strip()
    one_sentence = process.exitcode == 2 and "\n" not in printed and f"{folder}: its disk is full; make room" in printed
    last = last_checkpoint(folder, training=True)
    if not one_sentence or (f"step {last.step:,} is intact" not in printed):
        raise RuntimeError(f"Exit status {process.exitcode}, checkpoint {last.step}: {printed!r}")
    ballast.unlink()
    at.finish(folder)
    ended = same(folder, reference)
    shutil.rmtree(folder)
    return ended


def twice(at: Trainer, reference: Path, folder: Path, steps: int) -> bool:
    """Start a second training in the folder of a running one.

    **Returns** whether the second was refused with a message, and the result of the first equals that of `reference`.
    """
    first = at.started(folder, steps)
    before = len(at.told.read_text())
    second = at.start(folder)
    second.join()
    printed = at.told.read_text()[before:]
    alive = first.is_alive()
    first.join()
    refused = second.exitcode == 2 and "another process is writing to this run" in printed
    return alive and refused and first.exitcode == 0 and same(folder, reference)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20, help="number of kills (SIGKILL)")
    parser.add_argument(
        "--damages", type=int, default=20, help="number of checkpoints damaged (truncated, or one bit flipped)"
    )
    parser.add_argument(
        "--swaps",
        type=int,
        default=10,
        help="number of trainings whose last two checkpoints, or one file of them, are exchanged",
    )
    parser.add_argument("--full", type=int, default=10, help="number of full disks")
    parser.add_argument("--twice", type=int, default=5, help="number of second processes in the folder of a run")
    parser.add_argument("--seed", type=int, default=0, help="seed of the times and places of the faults")
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
        if options.damages or options.swaps:
            at.kill(at.work / "killed", STEPS // 2, 0.0)
        for number in range(options.damages):
            folder = at.work / f"damaged-{number}"
            what, survived = tried(lambda folder=folder: damaged(at, reference, folder, random))
            count(f"checkpoint {what or 'damaged'}", 1, int(survived))
        for number in range(options.swaps):
            folder = at.work / f"swapped-{number}"
            what, survived = tried(lambda folder=folder: swapped(at, reference, folder, random))
            count(f"checkpoints: {what or 'swapped'}", 1, int(survived))
        for number in range(options.twice):
            folder, steps = at.work / f"twice-{number}", int(random.integers(1, 20))
            _, survived = tried(lambda f=folder, s=steps: (None, twice(at, reference, f, s)))
            count("second process in the folder", 1, int(survived))
        for _ in range(options.full):
            with small_disk(at.work, DISK) as disk:
                if disk is None:
                    print("disk full: left out, because this process may not mount a small disk", file=sys.stderr)
                    break
                moment = int(random.integers(EVERY + 1, 30)), int(2 ** random.uniform(0, 18))
                _, survived = tried(lambda d=disk, m=moment: (None, full_disk(at, reference, d, *m)))
                count("disk full", 1, int(survived))
    print("| fault | injected | survived | lost |\n| --- | --- | --- | --- |")
    for fault, (faults, survived) in sorted(table.items()):
        print(f"| {fault} | {faults} | {survived} | {faults - survived} |")
    return int(any(faults != survived for faults, survived in table.values()))


if __name__ == "__main__":
    sys.exit(main())
