"""Measure how accurately the offset of a command log is estimated from the motion of the legs.

Several virtual robots are recorded, on which no choice in the estimate was based. They walk, with two seconds of rest
at both ends. Then their commands jump randomly. The clocks of log and recording are the same. The output is the error
of the offset, and the number of trials with sufficient confidence, for each kind of commands.
"""

from __future__ import annotations

import argparse

from ballu_mjx.common import runtime

runtime.prepare()

import numpy as np

from ballu_mjx.ballu import gaits
from ballu_mjx.ballu.leg_alignment import measured_response, nominal_response
from ballu_mjx.ballu.virtual import robot as virtual_robot
from ballu_mjx.cli.record import LEAST_CONFIDENCE, Import
from ballu_mjx.recordings.clock_alignment import align

SECONDS = 14.0
"""Length of the commands (s)."""
REST = np.zeros((40, 2))
"""Commands of 2 s of rest."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=8, help="number of virtual robots, from seed 11 on")
    robots = range(11, 11 + parser.parse_args().robots)
    rng = np.random.default_rng(0)
    for kind in ("walks", "random jumps"):
        errors, narrow = [], []
        for seed in robots:
            for trial in range(3):
                if kind == "walks":
                    low, high = rng.uniform(0.35, 0.5, 2), rng.uniform(0.75, 1.0, 2)
                    gait = gaits.Gait(
                        rng.uniform(0.8, 1.6), rng.uniform(0.3, 0.7), (low[0], low[1]), (high[0], high[1])
                    )
                    moves = gait.commands(SECONDS)
                else:
                    moves = gaits.telegraph(SECONDS, int(rng.integers(2**31)))
                commands = np.concatenate([REST, moves, REST])
                play, day = virtual_robot.open_loop(commands), virtual_robot.draw_trial(100 * seed + trial)
                seen = virtual_robot.record(virtual_robot.draw_robot(seed), day, play, len(commands) * 0.05, kind)
                motion = measured_response(seen)
                assert motion is not None
                grid, legs = nominal_response(seen.time, seen.command, "free", knees=False)
                found, near = (align(seen.time, motion, grid, legs, within=w) for w in (None, (-0.35, 0.45)))
                assert found is not None and near is not None
                narrow.append(near.best.offset - Import.delay)
                if found.confidence >= LEAST_CONFIDENCE:
                    errors.append(found.best.offset - Import.delay)
        for label, values in (("all offsets", errors), ("within 0.4 s of the truth", narrow)):
            if values:
                share, wrong = np.mean(np.abs(values) <= 0.05), np.sum(np.abs(values) > 0.2)
                print(
                    f"{kind}, searched among {label}: {len(values)} of {len(narrow)} found, {wrong} wrong by a "
                    f"period; error {1e3 * np.mean(values):+.0f} +- {1e3 * np.std(values):.0f} ms, "
                    f"{100 * share:.0f} % within 50 ms, at most {1e3 * np.abs(values).max():.0f} ms"
                )


if __name__ == "__main__":
    main()
