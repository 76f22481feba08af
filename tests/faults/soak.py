"""Run the main job for a long time, and check for leaks of memory, file handles, memory maps and compiled programs.

    python tests/faults/soak.py --minutes 60

The training is that of `python -m ballu_mjx.train envmimic` on the bundled recordings, with a validation and a
checkpoint about every minute. A line is fitted to the samples after the warm-up by the Theil-Sen estimator, which
tolerates outliers. Its rise must be at most 2 % of its initial value. For counts, a rise of less than 0.5 also passes.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from scipy import stats

from ballu_mjx.common import runtime

MOST = 2.0
"""Largest accepted drift (percent)."""
INTERVAL = 10.0
"""Time between two samples (s)."""
COUNTED = ("file handles", "compiled programs")
"""Quantities that are counts. A fitted rise of less than 0.5 over all samples is not a leak."""


def sample() -> dict[str, float]:
    """Return the resources that this process holds now."""
    import jax

    status = Path("/proc/self/statm").read_text().split()
    return {
        "resident memory (MiB)": int(status[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20,
        "file handles": len(os.listdir("/proc/self/fd")),
        "memory maps": Path("/proc/self/maps").read_bytes().count(b"\n"),
        "compiled programs": len(jax.local_devices()[0].client.live_executables()),
    }


class Sampler(threading.Thread):
    """Thread that samples the process's resources, and then ends the training as Ctrl-C does.

    Sampling begins `warm_up` seconds after the first training steps, and lasts `seconds`.
    """

    def __init__(self, metrics: Path, warm_up: float, seconds: float) -> None:
        super().__init__(daemon=True)
        self._metrics, self._warm_up, self._seconds = metrics, warm_up, seconds
        self.times: list[float] = []
        self.samples: list[dict[str, float]] = []

    def run(self) -> None:
        while not (self._metrics.exists() and self._metrics.read_bytes().count(b'"reward"') >= 2):
            time.sleep(1.0)
        time.sleep(self._warm_up)
        began = time.monotonic()
        while (now := time.monotonic() - began) < self._seconds:
            self.times.append(now)
            self.samples.append(sample())
            time.sleep(INTERVAL)
        os.kill(os.getpid(), signal.SIGINT)


def drift(times: list[float], values: list[float]) -> tuple[float, float]:
    """Return the slope (per hour) and the drift over all samples (percent of the fitted line's initial value)."""
    fitted: Any = stats.theilslopes(values, times)
    slope, intercept = float(fitted[0]), float(fitted[1])
    return 3600.0 * slope, 100.0 * slope * (times[-1] - times[0]) / (intercept + slope * times[0])


def table(times: list[float], samples: list[dict[str, float]]) -> tuple[str, bool]:
    """Return a Markdown table, and whether no quantity grows."""
    lines = ["| | first | last | slope an hour | drift (%) |", "| --- | ---: | ---: | ---: | ---: |"]
    flat = True
    for name in samples[0]:
        values = [each[name] for each in samples]
        slope, percent = drift(times, values)
        grown = slope / 3600.0 * (times[-1] - times[0])
        flat &= percent <= MOST or (name in COUNTED and grown < 0.5)
        lines.append(f"| {name} | {values[0]:.0f} | {values[-1]:.0f} | {slope:+.2f} | {percent:+.2f} |")
    return "\n".join(lines), flat


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="duration of sampling after the warm-up (minutes)")
    parser.add_argument("--warm-up", type=float, default=120.0, help="duration of training before the first sample (s)")
    parser.add_argument(
        "--rate", type=float, default=1e5, help="upper limit of this machine's control steps per second"
    )
    parser.add_argument(
        "--quick", action="store_true", help="use the small sizes of `train envmimic --quick`, to try the script"
    )
    options = parser.parse_args()
    if not Path("/proc/self/statm").exists():
        print("Memory is read from /proc, which only Linux has.", file=sys.stderr)
        return 2
    if options.minutes * 60 < 3 * INTERVAL:
        parser.error(f"--minutes: give {3 * INTERVAL / 60:g} or more")
    runtime.prepare()
    from ballu_mjx.cli import train_envmimic
    from ballu_mjx.residuals.envmimic import EnvMimicConfig
    from ballu_mjx.rl.ppo import PPOConfig
    from ballu_mjx.rl.training_loop import TrainingInterrupted

    sizes = dict(train_envmimic.QUICK) if options.quick else {}
    steps = round(60 * options.minutes * options.rate)
    config = PPOConfig(**{**sizes, "num_timesteps": steps})
    with tempfile.TemporaryDirectory() as work:
        output = Path(work) / "run"
        sampler = Sampler(output / "metrics.jsonl", options.warm_up, 60 * options.minutes)
        sampler.start()
        data = train_envmimic.Data(output=output, quick=options.quick)
        # Shells start background processes with this signal ignored.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            status = train_envmimic.train(data, EnvMimicConfig(), config)
        except TrainingInterrupted as stopped:
            status = stopped.status
    if len(sampler.samples) < 3:
        print(f"The training ended before three samples were taken, with exit status {status}.", file=sys.stderr)
        return 1
    text, flat = table(sampler.times, sampler.samples)
    print(f"\n{len(sampler.samples)} samples over {sampler.times[-1] / 60:.1f} minutes\n\n{text}")
    if status != 128 + signal.SIGINT:
        print(f"The training ended before the last sample, with exit status {status}.", file=sys.stderr)
        return 1
    return 0 if flat else 1


if __name__ == "__main__":
    sys.exit(main())
